"""Motions of walking robots: tours of commands, and pushes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_safety.evaluation.shift_study import SEEN
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.episode_recorder import Recorder, advance_to
from drake_safety.simulation.goal_motion import GoalMotion, run_to_goal
from drake_safety.simulation.rollouts import episode_rng, worker_loop
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import Progress
from studies.alarms import WatchedMotion
from studies.harness import Arrays, kept

ROW_S = 0.02
"""Time between two rows of a motion [s]."""
_AFTER_FALL_S = 0.6  # Until the robot lies.


@dataclass(kw_only=True, eq=False)
class WalkedMotion(WatchedMotion):
    """A watched motion and what the robot did.

    Attributes:
        output: Measured (v_x, v_y, ω_z), (N, 3) [m/s, rad/s].
        desired_output: The command, (N, 3) [m/s, rad/s].
        is_changed: Whether a guard passed on another command, (N,).
        impact_m_s: Largest downward velocity of the base after the push [m/s].
    """

    output: np.ndarray
    desired_output: np.ndarray
    is_changed: np.ndarray
    impact_m_s: float


def unusual_command(loop: Any, rng: np.random.Generator) -> np.ndarray:
    """A command past the policy's ranges, but within those of training, (3,)."""
    limits = loop.policy.parameters.command
    while True:
        command = rng.uniform(*loop.target_box)
        if np.any(command < limits.lowest) or np.any(command > limits.highest):
            return command


def run_tour(loop: Any, index: int, *, seed: int, duration_s: float) -> WalkedMotion:
    """Follows random commands inside the policy's ranges, undisturbed, from standing.

    Args:
        loop: A loop of the walking task.
        index: Number of the tour in its set.
        seed: Seed of the set.
        duration_s: Duration [s]; a fall ends it.
    """
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    loop.remove_visuals(context)
    loop.reset_undisturbed(context, episode_rng(seed, index), duration_s)
    simulator.Initialize()
    ports = (*SEEN, "margins", "output", "desired_output")
    guarded = loop.HasOutputPort("guard_active")
    recorder = Recorder(loop, (*ports, *(("guard_active",) if guarded else ())))
    fall = loop.constraint_names.index(loop.fall_name)
    leave_s = fall_s = np.inf
    for row in range(round(duration_s / ROW_S) + 1):
        time = row * ROW_S
        advance_to(simulator, time)
        recorder.record(context, time)
        margins = loop.GetOutputPort("margins").Eval(context)
        if margins.min() < 0:
            leave_s = min(leave_s, time)
        if margins[fall] < 0:
            fall_s = time
            break
    arrays = recorder.arrays()
    changed = arrays.pop("guard_active", np.zeros((len(arrays["time_s"]), 1)))[:, 0]
    return WalkedMotion(
        index=index,
        push_time_s=np.inf,
        leave_time_s=float(leave_s),
        fall_time_s=float(fall_s),
        is_changed=changed,
        impact_m_s=np.nan,
        **arrays,
    )


def run_push(
    loop: Any, index: int, *, seed: int, duration_s: float, is_pushed: bool = True
) -> WalkedMotion:
    """Holds a random command inside the ranges, and pushes the robot once.

    Args:
        loop: A loop of the walking task.
        index: Number of the motion in its set.
        seed: Seed of the set.
        duration_s: Duration [s]; it ends a little after a fall.
        is_pushed: Whether there is a push.
    """
    rng = episode_rng(seed, index)
    push = loop.sample_push(rng) if is_pushed else None
    command = loop.usual_command(rng)
    return _walked(loop, index, command, rng, duration_s, push=push)


def run_command(loop: Any, index: int, *, seed: int, duration_s: float) -> WalkedMotion:
    """Holds a random command past the policy's ranges, from standing.

    Args:
        loop: A loop of the walking task.
        index: Number of the motion in its set.
        seed: Seed of the set.
        duration_s: Duration [s]; it ends a little after a fall.
    """
    rng = episode_rng(seed, index)
    return _walked(loop, index, unusual_command(loop, rng), rng, duration_s)


def _walked(
    loop: Any,
    index: int,
    command: np.ndarray,
    rng: np.random.Generator,
    duration_s: float,
    **options: Any,
) -> WalkedMotion:
    guarded = loop.HasOutputPort("guard_active")
    motion = run_to_goal(
        loop,
        command,
        duration_s=duration_s,
        seed=int(rng.integers(2**31)),
        log_period_s=ROW_S,
        ports=(*SEEN, "desired_output", *(("guard_active",) if guarded else ())),
        after_fall_s=_AFTER_FALL_S,
        **options,
    )
    watched = WatchedMotion.of_goal_motion(index, motion)
    changed = motion.extra.get("guard_active", np.zeros((len(motion.time_s), 1)))[:, 0]
    return WalkedMotion(
        **vars(watched),
        output=motion.output,
        desired_output=motion.extra["desired_output"],
        is_changed=changed,
        impact_m_s=_impact(loop, motion),
    )


def _impact(loop: Any, motion: GoalMotion) -> float:
    since_s = 0.0 if motion.push is None else motion.push.time_s
    rows = motion.time_s >= since_s
    downward = -motion.plant_state[rows, loop.kinematics.num_positions + 5]
    return float(downward.max(initial=0.0))


KINDS: dict[str, Callable[..., WalkedMotion]] = {
    "tour": run_tour,
    "push": run_push,
    "command": run_command,
}


def run_motions(
    scenario: Scenario,
    kind: str,
    indices: Sequence[int],
    *,
    seed: int,
    duration_s: float,
    folder: Path,
    variation: str = "nominal",
    assessment: SafetyAssessment | None = None,
    options: dict[str, Any] | None = None,
    num_workers: int | None = None,
    progress: Progress | None = None,
) -> list[WalkedMotion]:
    """Simulates motions in worker processes, and keeps them in a folder; existing ones are reused.

    Args:
        scenario: A scenario of the walking task.
        kind: One of `KINDS`.
        indices: Numbers of the motions.
        seed: Seed of the set.
        duration_s: Duration of each [s].
        folder: The set's folder.
        variation: The plant.
        assessment: Γ, for loops with a guard or recovery.
        options: Options of the loop.
        num_workers: Number of worker processes; one a core by default.
        progress: Called with the number done and in all.
    """
    common = (scenario, variation, assessment, options or {}, kind, seed, duration_s)
    found = kept(
        folder,
        {f"{i:05d}": (*common, i) for i in indices},
        _run_motion,
        workers=num_workers,
        progress=progress,
    )
    return [_motion(arrays) for arrays in found.values()]


def _motion(arrays: Arrays) -> WalkedMotion:
    fields: dict[str, Any] = {
        n: value if value.ndim else value.item() for n, value in arrays.items()
    }
    return WalkedMotion(**fields)


def _run_motion(
    scenario: Scenario,
    variation: str,
    assessment: SafetyAssessment | None,
    options: dict[str, Any],
    kind: str,
    seed: int,
    duration_s: float,
    index: int,
) -> Arrays:
    if assessment is None:
        loop = worker_loop(scenario, variation, options)
    else:
        loop = _assessed_loop(scenario, variation, assessment, options)
    motion = KINDS[kind](loop, index, seed=seed, duration_s=duration_s)
    arrays = {name: np.asarray(value) for name, value in vars(motion).items()}
    return {name: a.astype(np.float32) if a.ndim == 2 else a for name, a in arrays.items()}


_LOOPS: dict[str, Any] = {}


def _assessed_loop(
    scenario: Scenario, variation: str, assessment: SafetyAssessment, options: dict[str, Any]
) -> Any:
    """The loop of this process; only the last one is kept, as building it takes a second."""
    key = repr((scenario.to_yaml(), variation, options))
    if key not in _LOOPS:
        _LOOPS.clear()
        _LOOPS[key] = scenario.make_loop(variation, assessment=assessment, **options)
    return _LOOPS[key]
