"""State that a diagram keeps outside its Context: an episode differs when it is repeated."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from pydrake.systems.framework import (
    Context,
    Diagram,
    InputPort,
    OutputPort,
    PortDataType,
    System,
)

from drake_safety.learning.segments import Episode
from drake_safety.simulation.dataset import is_same

_CAUSE = (
    "the diagram, or its reset, keeps state outside its Context, such as a memory, a random "
    "generator or a cache in an attribute of a system; declare it as state"
)


def difference(
    found: Episode, other: int, *, make: Callable[[], Diagram], run: Callable[..., Episode]
) -> str:
    """Says where an episode differs when it is repeated after another one; "" if it does not.

    If it does, it is simulated alone and after the other once more, and the vector ports of all
    systems are compared after each step.

    Args:
        other: Index of the other episode.
        make: Makes a new diagram.
        run: Simulates an episode of a diagram and an index; ``monitor`` is called with the Context
            after each step.
    """
    diagram = make()
    run(diagram, other)
    again = run(diagram, found.index)
    if is_same(found, again):
        return ""
    traced, alone = _traced(make(), run, found.index)
    _, after = _traced(make(), run, other, found.index)
    for (time_s, one), (_, two) in zip(alone, after, strict=False):
        changed = [what for what, a, b in zip(traced, one, two, strict=True) if a != b]
        outputs = [port for port in changed if isinstance(port, OutputPort)]
        if outputs:
            # A discrete state follows from values before the step, which were still the same.
            states = {_path(what) for what in changed if isinstance(what, System)}
            inputs = {_path(what) for what in changed if isinstance(what, InputPort)}
            first = min(outputs, key=lambda p: (_path(p) not in states, _path(p) in inputs))
            where = f"output port '{first.get_name()}' of system '{_path(first)}'"
            return f"differs, first at {time_s:g} s in {where}: {_CAUSE}"
    return f"differs from the first time in this process: {_CAUSE}"


def _traced(
    diagram: Diagram, run: Callable[..., Episode], *indices: int
) -> tuple[list[Any], list[tuple[float, list[int | None]]]]:
    """Simulates episodes; what is traced, and its bits after each step of the last episode."""
    traced = list(_parts(diagram))
    steps: list[tuple[float, list[int | None]]] = []

    def monitor(context: Context) -> None:
        steps.append((context.get_time(), [_hash(what, context) for what in traced]))

    for index in indices[:-1]:
        run(diagram, index)
    run(diagram, indices[-1], monitor=monitor)
    return traced, steps


def _parts(system: System) -> Iterator[Any]:
    """The leaf systems, for their discrete state, and their vector ports."""
    if isinstance(system, Diagram):
        for inner in system.GetSystems():
            yield from _parts(inner)
        return
    yield system
    inputs = map(system.get_input_port, range(system.num_input_ports()))
    outputs = map(system.get_output_port, range(system.num_output_ports()))
    for port in (*inputs, *outputs):
        if port.get_data_type() == PortDataType.kVectorValued:
            yield port


def _hash(what: Any, root: Context) -> int | None:
    """Of its bits; None for a port that cannot be evaluated, such as one without an input."""
    if isinstance(what, System):
        state = what.GetMyContextFromRoot(root).get_discrete_state()
        return hash(b"".join(state.value(i).tobytes() for i in range(state.num_groups())))
    try:
        return hash(what.Eval(what.get_system().GetMyContextFromRoot(root)).tobytes())
    except Exception:  # A user's system may raise anything.
        return None


def _path(what: Any) -> str:
    """Path of a system in its diagram, such as ``controller::policy``."""
    system = what if isinstance(what, System) else what.get_system()
    return system.GetSystemPathname().removeprefix("::").partition("::")[2]
