"""One episode of any task with Γ, and its log: no goal, no ball, no recovery is needed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_safety.learning.segments import DivergenceError
from drake_safety.simulation.capabilities import CanFall
from drake_safety.simulation.closed_loop import ClosedLoop, require_ports
from drake_safety.simulation.episode_recorder import Recorder, advance_to
from drake_safety.simulation.rollouts import episode_rng

_AFTER_LEAVING_S = 0.5  # Time for which a motion continues outside the safe set.


@dataclass(kw_only=True, eq=False)
class FreeMotion:
    """Log of one episode, with a row every ``log_period_s``.

    Attributes:
        time_s: [s], (N,).
        margins: (N, n_c), of the true state.
        leave_time_s: Time at which it left the safe set [s]; infinite if it did not.
        cause: The first violated constraint; "" if there is none.
        failure: Why the simulation ended early; "" if it did not.
        extra: Other ports, (N, size) each.
    """

    time_s: np.ndarray
    margins: np.ndarray
    leave_time_s: float = math.inf
    cause: str = ""
    failure: str = ""
    extra: dict[str, np.ndarray] = field(default_factory=dict)


def run_free(
    loop: ClosedLoop,
    index: int = 0,
    *,
    seed: int,
    duration_s: float,
    log_period_s: float = 0.02,
    ports: tuple[str, ...] = (),
    realtime_rate: float = 0.0,
) -> FreeMotion:
    """Simulates an episode from a random start, beyond the safe set for half a second.

    Args:
        index: Number of the episode; it and the seed determine start and plan.
        duration_s: End time [s]; a fall, or half a second outside the safe set, ends it sooner.
        ports: More output ports to log, into ``extra``.

    Raises:
        ValueError: The loop has no such port, or the simulation fails before the first row.
    """
    require_ports(loop, ("margins", *ports))
    simulator = Simulator(loop)
    simulator.set_target_realtime_rate(realtime_rate)
    context = simulator.get_mutable_context()
    if not realtime_rate:
        loop.remove_visuals(context)
    loop.reset(context, episode_rng(seed, index))
    recorder = Recorder(loop, ("margins", *ports))
    margins_port = loop.GetOutputPort("margins")
    fall = loop.constraint_names.index(loop.fall_name) if isinstance(loop, CanFall) else None
    leave_s, cause, failure = math.inf, "", ""
    try:
        simulator.Initialize()
        for row in range(round(duration_s / log_period_s) + 1):
            time = row * log_period_s
            advance_to(simulator, time)
            margins = margins_port.Eval(context)
            if not np.isfinite(margins).all():
                raise DivergenceError(f"a margin is not finite at {time:g} s")
            recorder.record(context, time)
            if margins.min() < 0 and not cause:
                leave_s, cause = time, loop.constraint_names[int(np.argmin(margins))]
            has_fallen = fall is not None and margins[fall] < 0
            if has_fallen or time >= leave_s + _AFTER_LEAVING_S:
                break
    except RuntimeError as error:
        # Drake's solvers raise it, and so does a task whose simulation diverges.
        failure = str(error)
    arrays = recorder.arrays()
    if not len(arrays["time_s"]):
        raise ValueError(f"the simulation failed at its start: {failure}")
    extra = {name: arrays.pop(name) for name in ports}
    return FreeMotion(**arrays, leave_time_s=leave_s, cause=cause, failure=failure, extra=extra)
