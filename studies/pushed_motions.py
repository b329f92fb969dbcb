"""Pushed motions: safe motions to random goals, simulated undisturbed and with a push."""

from __future__ import annotations

from functools import partial
from typing import Any

from drake_safety.evaluation.shift_study import SEEN
from drake_safety.simulation.capabilities import CanBePushed, HasGoals, require
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.motion import Motion
from drake_safety.simulation.rollouts import episode_rng, run_to_goal, worker_loop
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import Progress, map_items

_MAX_TRIES = 50


def run_pushed_motion(loop: ClosedLoop, index: int, *, seed: int) -> tuple[Motion, Motion]:
    """Simulates a random motion that is safe undisturbed, and once more with a random push.

    Goals are drawn until the undisturbed motion is safe.

    Raises:
        ValueError: The task has no goals or pushes, or hardly any goal is safe.
    """
    rng = episode_rng(seed, index)
    push = require(loop, CanBePushed).sample_push(rng)
    box = require(loop, HasGoals).target_box
    noise_seed = int(rng.integers(2**31))
    options: dict[str, Any] = {
        "duration_s": loop.scenario.episode_duration_s,
        "seed": noise_seed,
        "ports": SEEN,
        "index": index,
    }
    for _ in range(_MAX_TRIES):
        goal = rng.uniform(*box)
        undisturbed = run_to_goal(loop, goal, after_leaving_s=0.0, **options)
        if not undisturbed.has_left:
            return undisturbed, run_to_goal(loop, goal, push=push, **options)
    raise ValueError(
        f"pushed motion {index} of '{loop.scenario.name}': none of {_MAX_TRIES} random goals is "
        "reached safely without a push"
    )


def run_pushed_motions(
    scenario: Scenario,
    num_motions: int,
    *,
    seed: int,
    variation: str = "actual",
    num_workers: int | None = None,
    progress: Progress | None = None,
) -> list[Motion]:
    """Simulates pairs of random safe motions, undisturbed and pushed, in worker processes."""
    make = worker_loop(scenario, variation, **scenario.options_for("evaluation"))
    pairs = map_items(
        partial(make.run, run_pushed_motion, seed=seed),
        range(num_motions),
        num_workers=num_workers,
        progress=progress,
        stage="pushed motions",
    )
    return [motion for pair in sorted(pairs, key=lambda p: p[0].index) for motion in pair]
