"""Motions of walking robots: tours of commands, and pushes."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.evaluation.shift_study import SEEN
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.motion import End, Motion, simulate
from drake_safety.simulation.rollouts import episode_rng, run_to_goal
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import MadeOnce, Progress
from studies.harness import Arrays, kept

_AFTER_FALL_S = 0.6  # Until the robot lies.


def unusual_command(loop: Any, rng: np.random.Generator) -> np.ndarray:
    """A command past the policy's ranges, but within the ranges of training, (3,)."""
    limits = loop.policy.parameters.command
    while True:
        command = rng.uniform(*loop.target_box)
        if np.any(command < limits.lowest) or np.any(command > limits.highest):
            return command


def run_tour(loop: Any, index: int, *, seed: int, duration_s: float) -> Motion:
    """Follows random commands inside the policy's ranges, undisturbed, until a fall."""
    return simulate(
        loop,
        lambda context: loop.reset_undisturbed(context, episode_rng(seed, index), duration_s),
        (*SEEN, "margins", "output", *filter(loop.HasOutputPort, ["guard_active"])),
        End(duration_s=duration_s),
        index=index,
    )


def run_push(loop: Any, index: int, *, seed: int, duration_s: float) -> Motion:
    """Holds a random command inside the ranges, and pushes the robot once."""
    rng = episode_rng(seed, index)
    push = loop.sample_push(rng)
    command = loop.usual_command(rng)
    return _walked(loop, index, command, rng, duration_s, push=push)


def run_command(loop: Any, index: int, *, seed: int, duration_s: float) -> Motion:
    """Holds a random command past the policy's ranges, from standing."""
    rng = episode_rng(seed, index)
    return _walked(loop, index, unusual_command(loop, rng), rng, duration_s)


def _walked(
    loop: Any,
    index: int,
    command: np.ndarray,
    rng: np.random.Generator,
    duration_s: float,
    **options: Any,
) -> Motion:
    motion = run_to_goal(
        loop,
        command,
        duration_s=duration_s,
        seed=int(rng.integers(2**31)),
        ports=(*SEEN, *filter(loop.HasOutputPort, ["guard_active"])),
        after_fall_s=_AFTER_FALL_S,
        index=index,
        **options,
    )
    column = loop.kinematics.num_positions + 5
    motion.ports["downward_m_s"] = -motion.ports.pop("plant_state")[:, [column]]
    return motion


KINDS: dict[str, Callable[..., Motion]] = {
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
) -> list[Motion]:
    """Simulates motions in worker processes, and reuses the motions in the folder."""
    # The folder is named after all that a loop depends on.
    loop = partial(scenario.make_loop, variation, assessment=assessment, **(options or {}))
    make = MadeOnce(str(folder), loop)
    run = partial(_run_motion, make, kind, seed, duration_s)
    found = kept(folder, indices, run, workers=num_workers, progress=progress)
    return [_motion(arrays) for arrays in found]


def _motion(arrays: Arrays) -> Motion:
    ports = {name: array for name, array in arrays.items() if array.ndim == 2}
    scalars: dict[str, Any] = {n: array.item() for n, array in arrays.items() if array.ndim == 0}
    return Motion(time_s=arrays["time_s"], ports=ports, **scalars)


def _run_motion(
    make: Callable[[], Any], kind: str, seed: int, duration_s: float, index: int
) -> tuple[int, Arrays]:
    motion = KINDS[kind](make(), index, seed=seed, duration_s=duration_s)
    arrays = {name: np.asarray(one) for name, one in vars(motion).items() if name != "ports"}
    rows = {name: one.astype(np.float32) for name, one in motion.ports.items()}
    return index, arrays | rows
