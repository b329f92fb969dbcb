"""State that a diagram keeps outside its Context: an episode differs when it is repeated."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from pydrake.systems.framework import Context, Diagram, PortDataType, System

from drake_safety.learning.segments import Episode
from drake_safety.simulation.dataset import is_same

_CAUSE = (
    "the diagram, or its reset, keeps state outside its Context, such as a memory, a random "
    "generator or a cache in an attribute of a system; declare it as state"
)
_Key = tuple[str, str, str]  # Path of a leaf system, kind and name of a port.


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
    if is_same(found, run(diagram, found.index)):
        return ""

    def steps(diagram: Diagram) -> list[tuple[float, dict[_Key, int]]]:
        seen: list[tuple[float, dict[_Key, int]]] = []

        def monitor(context: Context) -> None:
            seen.append((context.get_time(), _hashes(diagram, context)))

        run(diagram, found.index, monitor=monitor)
        return seen

    alone, diagram = steps(make()), make()
    run(diagram, other)
    for (time_s, one), (_, two) in zip(alone, steps(diagram), strict=False):
        changed = [key for key in one if one[key] != two.get(key)]
        states, inputs = (
            {path for path, of, _ in changed if of == kind} for kind in ("state", "input")
        )
        outputs = [(path, port) for path, kind, port in changed if kind == "output"]
        if outputs:
            # A discrete state follows from values before the step, which were still the same.
            path, port = min(outputs, key=lambda one: (one[0] not in states, one[0] in inputs))
            where = f"output port '{port}' of system '{path}'"
            return f"differs, first at {time_s:g} s in {where}: {_CAUSE}"
    return f"differs from the first time in this process: {_CAUSE}"


def _hashes(system: System, root: Context) -> dict[_Key, int]:
    """Of discrete states and vector ports."""
    found: dict[_Key, int] = {}
    if isinstance(system, Diagram):
        for inner in system.GetSystems():
            found |= _hashes(inner, root)
        return found
    path = system.GetSystemPathname().removeprefix("::").partition("::")[2]
    context = system.GetMyContextFromRoot(root)
    state = context.get_discrete_state()
    groups = (state.value(i).tobytes() for i in range(state.num_groups()))
    found[path, "state", ""] = hash(b"".join(groups))
    inputs = map(system.get_input_port, range(system.num_input_ports()))
    outputs = map(system.get_output_port, range(system.num_output_ports()))
    for kind, ports in (("input", inputs), ("output", outputs)):
        for port in ports:
            if port.get_data_type() == PortDataType.kVectorValued:
                with suppress(Exception):  # Such as of a port without an input.
                    found[path, kind, port.get_name()] = hash(port.Eval(context).tobytes())
    return found
