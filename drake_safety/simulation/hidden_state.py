"""State that a diagram keeps outside its Context: an episode differs when it is repeated."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress

from pydrake.systems.framework import Context, Diagram, OutputPort, PortDataType

from drake_safety.learning.segments import Episode
from drake_safety.simulation.dataset import is_same
from drake_safety.systems.monitored_assessor import leaf_systems

_CAUSE = (
    "the diagram, or its reset, keeps state outside its Context, such as a memory, a random "
    "generator or a cache in an attribute of a system; declare it as state"
)
_Hashes = dict[tuple[str, str, str], int]


def difference(episode: Episode, make: Callable[[], Diagram], run: Callable[..., Episode]) -> str:
    """Says where an episode differs when it is repeated after the next one; "" if it does not.

    If it does, it is simulated alone and after the next once more, and the vector ports of all
    systems are compared after each step.

    Args:
        run: Simulates an episode of a diagram and an index; ``monitor`` is called with the Context
            after each step.
    """
    index, diagram = episode.index, make()
    run(diagram, index + 1)
    if is_same(episode, run(diagram, index)):
        return ""

    def trace(*indices: int) -> list[tuple[float, _Hashes]]:
        diagram, steps = make(), list[tuple[float, _Hashes]]()
        for index in indices:
            steps.clear()
            run(diagram, index, monitor=lambda c: steps.append((c.get_time(), _hashes(diagram, c))))
        return steps

    pairs = zip(trace(index), trace(index + 1, index), strict=False)
    for (time_s, alone), (_, later) in pairs:
        changed = [key for key in alone if alone[key] != later.get(key)]
        states = {path for path, kind, _ in changed if kind == "state"}
        inputs = {path for path, kind, _ in changed if kind == "input"}
        if outputs := [(path, port) for path, kind, port in changed if kind == "output"]:
            # A discrete state follows from values before the step, which were still the same.
            path, port = min(outputs, key=lambda out: (out[0] not in states, out[0] in inputs))
            where = f"output port '{port}' of system '{path}'"
            return f"differs, first at {time_s:g} s in {where}: {_CAUSE}"
    return f"differs from the first time in this process: {_CAUSE}"


def _hashes(diagram: Diagram, root: Context) -> _Hashes:
    """Hashes of discrete state and vector ports of all leaf systems, by path, kind and name."""
    hashes = {}
    for system in leaf_systems([diagram]):
        path = system.GetSystemPathname().removeprefix("::").partition("::")[2]
        path = re.sub("@[0-9a-f]+", "", path)  # The name of one without a name has its address.
        context = system.GetMyContextFromRoot(root)
        state = context.get_discrete_state()
        values = [state.value(i).tobytes() for i in range(state.num_groups())]
        hashes[path, "state", ""] = hash(b"".join(values))
        inputs = map(system.get_input_port, range(system.num_input_ports()))
        outputs = map(system.get_output_port, range(system.num_output_ports()))
        for port in (*inputs, *outputs):
            if port.get_data_type() == PortDataType.kVectorValued:
                with suppress(Exception):  # Such as that of a port without an input.
                    kind = "output" if isinstance(port, OutputPort) else "input"
                    hashes[path, kind, port.get_name()] = hash(port.Eval(context).tobytes())
    return hashes
