"""Pushed motions: what somebody who watches a robot sees of a motion, and when it went wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.goal_motion import GoalMotion, run_to_goal
from drake_safety.simulation.rollouts import (
    Progress,
    batches,
    episode_rng,
    parallel_map,
    worker_loop,
)
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.throws import ThrowLog

_SEEN = ("state", "desired_preview", "features")
_MAX_TRIES = 50


@dataclass(kw_only=True, eq=False)
class WatchedMotion:
    """One motion, pushed or not: rows of what a monitor sees, and what came of it.

    Attributes:
        index: Number of the motion in its set; what begins alike has the same.
        push_time_s: When the push begins [s]; infinite if nobody pushes.
        time_s: [s], (N,).
        state: (N, n_s), as the assessor sees it.
        desired_preview: (N, H n_z).
        features: (N, n_f).
        margins: (N, n_c), of the true state.
        leave_time_s: When the robot left its safe set [s]; infinite if it did not.
        fall_time_s: When it fell [s]; infinite if it did not.
    """

    index: int
    push_time_s: float
    time_s: np.ndarray
    state: np.ndarray
    desired_preview: np.ndarray
    features: np.ndarray
    margins: np.ndarray
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

    @classmethod
    def of_throw(cls, log: ThrowLog) -> WatchedMotion:
        """A throw without recovery; the push is the ball's touch."""
        return cls(
            index=log.index,
            push_time_s=log.throw.time_s,
            time_s=log.time_s,
            state=log.state,
            desired_preview=log.desired_preview,
            features=log.features,
            margins=log.margins,
            leave_time_s=log.leave_time_s,
            fall_time_s=log.fall_time_s,
        )

    @classmethod
    def of_goal_motion(cls, index: int, motion: GoalMotion) -> WatchedMotion:
        """A motion to a goal that was run with the ports that a monitor sees."""
        return cls(
            index=index,
            push_time_s=math.inf if motion.push is None else motion.push.time_s,
            time_s=motion.time_s,
            margins=motion.margins,
            leave_time_s=motion.leave_time_s,
            fall_time_s=motion.fall_time_s,
            **{name: motion.extra[name] for name in _SEEN},
        )


def run_pushed_motion(
    loop: ClosedLoop, index: int, *, seed: int
) -> tuple[WatchedMotion, WatchedMotion]:
    """Carries out a random motion that is safe by itself, and once more with a random push.

    A goal that is not safe by itself is drawn again: who pushes a robot on its way has let it
    begin.

    Args:
        loop: A closed loop whose plans have a goal and whose robot can be pushed.
        index: Number of the motion in its set.
        seed: Seed of the set.

    Returns:
        The motion undisturbed, and pushed.

    Raises:
        ValueError: The task has no goals or pushes, or hardly any goal is safe.
    """
    rng = episode_rng(seed, index)
    push = loop.sample_push(rng)
    box = loop.target_box
    if box is None:
        raise ValueError(f"task '{type(loop).__name__}' has plans without a goal")
    noise_seed = int(rng.integers(2**31))
    duration_s = loop.scenario.episode_duration_s
    for _ in range(_MAX_TRIES):
        goal = rng.uniform(*box)
        calm = run_to_goal(
            loop, goal, duration_s=duration_s, seed=noise_seed, ports=_SEEN, until_unsafe=True
        )
        if not calm.has_left:
            pushed = run_to_goal(
                loop, goal, push=push, duration_s=duration_s, seed=noise_seed, ports=_SEEN
            )
            return (
                WatchedMotion.of_goal_motion(index, calm),
                WatchedMotion.of_goal_motion(index, pushed),
            )
    raise ValueError(
        f"pushed motion {index} of '{loop.scenario.name}': none of {_MAX_TRIES} random goals is "
        "reached safely even if nobody pushes"
    )


def run_pushed_motions(
    scenario: Scenario,
    num_motions: int,
    *,
    seed: int,
    variation: str = "actual",
    num_workers: int | None = None,
    progress: Progress | None = None,
) -> list[WatchedMotion]:
    """Carries out random safe motions, each undisturbed and pushed, in worker processes.

    Args:
        scenario: The scenario.
        num_motions: How many; twice as many are returned.
        seed: Seed of the set.
        variation: Which plant.
        num_workers: Processes; as many as there are cores by default.
        progress: Called with the number done and the number wanted.
    """
    arguments = [(scenario, variation, seed, batch) for batch in batches(list(range(num_motions)))]
    pairs: dict[int, tuple[WatchedMotion, WatchedMotion]] = {}
    if progress is not None:
        progress(0, num_motions)
    for batch in parallel_map(_motion_batch, arguments, num_workers):
        pairs |= batch
        if progress is not None:
            progress(len(pairs), num_motions)
    return [motion for index in sorted(pairs) for motion in pairs[index]]


def _motion_batch(
    scenario: Scenario, variation: str, seed: int, indices: list[int]
) -> dict[int, tuple[WatchedMotion, WatchedMotion]]:
    options = dict(scenario.task_class().judging_options)
    loop = worker_loop(scenario, variation, options)
    return {index: run_pushed_motion(loop, index, seed=seed) for index in indices}
