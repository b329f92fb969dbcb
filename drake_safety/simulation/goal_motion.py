"""Motions from the standing posture to a goal, and logs of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_safety.plants.pushes import Push
from drake_safety.simulation.capabilities import CanBePushed, CanFall, HasGoals, require
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.episode_recorder import Recorder, advance_to
from drake_safety.simulation.rollouts import episode_rng

_PORTS = ("output", "margins", "plant_state")


@dataclass(kw_only=True, eq=False)
class Mishap:
    """Outcome of a motion.

    Attributes:
        leave_time_s: Time at which the robot left its safe set [s]; infinite if it did not.
        fall_time_s: Time of the fall [s]; infinite without one.
    """

    leave_time_s: float
    fall_time_s: float

    @property
    def has_left(self) -> bool:
        """Whether the robot left its safe set."""
        return math.isfinite(self.leave_time_s)

    @property
    def has_fallen(self) -> bool:
        """Whether the robot fell."""
        return math.isfinite(self.fall_time_s)


@dataclass(kw_only=True, eq=False)
class GoalMotion(Mishap):
    """Log of one motion, with a row every ``log_period_s``.

    Attributes:
        goal: In the world, (3,) [m].
        time_s: [s], (N,).
        output: Measured output, in the world, (N, 3) [m].
        margins: (N, n_c), of the true state.
        plant_state: (N, n_q + n_v) of the robot alone.
        cause: The first violated constraint; "" if there is none.
        extra: Other ports, (N, size) each.
    """

    goal: np.ndarray
    push: Push | None
    time_s: np.ndarray
    output: np.ndarray
    margins: np.ndarray
    plant_state: np.ndarray
    cause: str
    extra: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def miss(self) -> np.ndarray:
        """Output minus goal at the end, (3,)."""
        return self.output[-1] - self.goal


def run_to_goal(
    loop: ClosedLoop,
    goal: np.ndarray,
    *,
    push: Push | None = None,
    duration_s: float,
    seed: int = 0,
    log_period_s: float = 0.02,
    ports: tuple[str, ...] = (),
    realtime_rate: float = 0.0,
    until_unsafe: bool = False,
    after_fall_s: float = 0.0,
) -> GoalMotion:
    """Simulates the motion from the standing posture to a goal, safe or not.

    Args:
        goal: In the world, (3,) [m].
        duration_s: End time [s]; a fall ends the motion sooner.
        ports: More output ports to log, into ``extra``.
        until_unsafe: Whether the motion ends when it leaves the safe set, not only at a fall.
        after_fall_s: Time for which a motion continues after a fall [s].

    Raises:
        ValueError: The task's plans have no goal, its robot cannot be pushed, or has no such body.
    """
    simulator = Simulator(loop)
    simulator.set_target_realtime_rate(realtime_rate)
    context = simulator.get_mutable_context()
    loop.remove_visuals(context)
    with_goals = require(loop, HasGoals)
    with_goals.reset_standing(context, goal, episode_rng(seed, 0))
    if push is not None:
        require(loop, CanBePushed).set_push(context, push)
    simulator.Initialize()
    recorder = Recorder(loop, (*_PORTS, *ports))
    margins_port = loop.GetOutputPort("margins")
    fall_column = loop.constraint_names.index(require(loop, CanFall).fall_name)
    leave_s = fall_s = math.inf
    cause = ""
    for row in range(round(duration_s / log_period_s) + 1):
        time = row * log_period_s
        advance_to(simulator, time)
        recorder.record(context, time)
        margins = margins_port.Eval(context)
        if margins.min() < 0 and not cause:
            leave_s, cause = time, loop.constraint_names[int(np.argmin(margins))]
            if until_unsafe:
                break
        if margins[fall_column] < 0:
            fall_s = min(fall_s, time)
        if time >= fall_s + after_fall_s:
            break
    arrays = recorder.arrays()
    extra = {name: arrays.pop(name) for name in ports}
    return GoalMotion(
        goal=np.array(goal, dtype=float),
        push=push,
        **arrays,
        leave_time_s=leave_s,
        cause=cause,
        fall_time_s=fall_s,
        extra=extra,
    )
