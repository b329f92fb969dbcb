"""Motions and inputs under shifts: what `shift_study` judges."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_safety.evaluation.shifts import POSTURES, STARTS, PlantShift
from drake_safety.learning.segments import DIVERGED, Episode, Episodes
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.rollouts import episode_rng, run_episode, worker_loop
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.watched_motion import SEEN
from drake_safety.simulation.worker_processes import run_batches


@dataclass(kw_only=True, eq=False)
class Motion:
    """The inputs of one motion, in the order of time, and its outcome.

    Attributes:
        state: (N, n_s).
        desired_preview: (N, H n_z).
        features: (N, n_f).
        is_outside: Whether the state is outside the safe set, (N,).
        is_unsafe: Whether it ends unsafely.
    """

    state: np.ndarray
    desired_preview: np.ndarray
    features: np.ndarray
    is_outside: np.ndarray
    is_unsafe: bool

    @classmethod
    def of_episode(cls, episode: Episode) -> Motion:
        """The rows of an episode from its first undisturbed one."""
        rows = slice(episode.first_step, None)
        return cls(
            **{name: getattr(episode, name)[rows] for name in SEEN},
            is_outside=np.any(episode.margins[rows] < 0.0, axis=1),
            is_unsafe=not episode.is_safe,
        )


@dataclass(kw_only=True, eq=False)
class ShiftedSet:
    """Motions under a shift.

    Attributes:
        kind: "nominal", "plant", "sensor", "plan", "posture" or "junk".
        motions: The motions; those of postures and junk are single rows.
    """

    kind: str
    motions: list[Motion]


def of_episodes(kind: str, episodes: Episodes) -> ShiftedSet:
    """The motions of episodes; those that diverged are left out."""
    motions = [Motion.of_episode(one) for one in episodes if one.cause != DIVERGED]
    return ShiftedSet(kind=kind, motions=[one for one in motions if len(one.state)])


def shifted_scenario(scenario: Scenario, name: str, shift: PlantShift) -> Scenario:
    """The scenario with a shift as a further variation."""
    shifted = copy.copy(scenario)
    shifted.variations = {**scenario.variations, name: shift.variation}
    return shifted


def run_changed_starts(
    scenario: Scenario, num_motions: int, seed: int, num_workers: int | None = None
) -> dict[str, ShiftedSet]:
    """Simulates plans and starts outside the range of training, and evaluates such postures.

    Postures are single rows, unsafe by definition. "falling" has the rows outside the safe
    set of nominal episodes in which the robot falls.

    Args:
        scenario: The scenario; if its robot has no legs, nothing is returned.
        num_motions: Number of motions of each kind.
        seed: Seed of their starts.
        num_workers: Number of processes.
    """
    if not isinstance(scenario.make_loop(), LeggedLoop):
        return {}
    found = {}
    names = [*STARTS, *POSTURES, "falling"]
    for name in names:
        results = run_batches(
            partial(_changed_batch, scenario, name, seed),
            list(range(num_motions)),
            num_workers=num_workers,
        )
        motions = [motion for motion in results if len(motion.state)]
        kind = "plan" if name in STARTS else "posture"
        if motions:
            found[name] = ShiftedSet(kind=kind, motions=motions)
    return found


def _changed_batch(scenario: Scenario, name: str, seed: int, indices: list[int]) -> list[Motion]:
    loop = worker_loop(scenario, "nominal", {})
    return [_changed_motion(loop, name, seed, index) for index in indices]


def _changed_motion(loop: ClosedLoop, name: str, seed: int, index: int) -> Motion:
    assert isinstance(loop, LeggedLoop)
    if name == "falling":
        return _fall(loop, seed, index)
    context = loop.CreateDefaultContext()
    loop.reset(context, episode_rng(seed, index))
    start = loop.start_of(context)
    kinematics = loop.kinematics
    if name in STARTS:
        start = STARTS[name](start, kinematics)
        return Motion.of_episode(run_episode(loop, index, seed=seed, start=start))
    loop.reset_to(context, episode_rng(seed, index), POSTURES[name](start, kinematics))
    return _rows_of(loop, [context])


def _fall(loop: LeggedLoop, seed: int, index: int) -> Motion:
    """The rows of a nominal episode outside the safe set, if the robot falls."""
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    loop.reset(context, episode_rng(seed, index))
    simulator.Initialize()
    margins_port = loop.GetOutputPort("margins")
    fall_column = loop.constraint_names.index(loop.fall_name)
    rows, has_fallen = [], False
    for step in range(loop.scenario.num_steps + 1):
        try:
            simulator.AdvanceTo(step * loop.scenario.step_s)
        except RuntimeError:
            break
        margins = margins_port.Eval(context)
        has_fallen = has_fallen or bool(margins[fall_column] < 0.0)
        if margins.min() < 0.0:
            rows.append(context.Clone())
    return _rows_of(loop, rows if has_fallen else [])


def _rows_of(loop: ClosedLoop, contexts: Sequence) -> Motion:
    def stacked(name: str) -> np.ndarray:
        port = loop.GetOutputPort(name)
        rows = [port.Eval(context).copy() for context in contexts]
        return np.stack(rows) if rows else np.empty((0, port.size()))

    return Motion(
        **{name: stacked(name) for name in SEEN},
        is_outside=np.any(stacked("margins") < 0.0, axis=1),
        is_unsafe=True,
    )


def junk(motions: Sequence[Motion], seed: int) -> dict[str, ShiftedSet]:
    """Inputs that contradict themselves, in which no robot can be.

    "Another row" is one of another motion: those of the same motion may agree with each other.

    Args:
        motions: Nominal motions, at least two.
        seed: Seed of the permutations.
    """
    rng = np.random.default_rng(seed)
    rows = {name: np.concatenate([getattr(one, name) for one in motions]) for name in SEEN}
    motion = np.concatenate([np.full(len(one.state), i) for i, one in enumerate(motions)])

    def permuted(values: np.ndarray) -> np.ndarray:
        return values[rng.permutation(len(values))]

    changed: dict[str, Mapping[str, np.ndarray]] = {
        "columns shuffled": {
            name: np.stack([permuted(column) for column in values.T], axis=1)
            for name, values in rows.items()
            if values.shape[1]
        },
        "gaussian": {
            name: rng.normal(values.mean(axis=0), values.std(axis=0), values.shape)
            for name, values in rows.items()
        },
    }
    order = rng.permutation(len(motion))
    while (is_own := motion[order] == motion).any():
        order[is_own] = rng.integers(len(motion), size=int(is_own.sum()))
    for name, what in zip(SEEN, ("state", "plan", "features"), strict=True):
        if rows[name].shape[1]:
            changed[f"{what} of another row"] = {name: rows[name][order]}
    found = {}
    for name, replaced in changed.items():
        values = {**rows, **replaced}
        found[name] = ShiftedSet(
            kind="junk",
            motions=[
                Motion(
                    **{key: values[key][motion == i] for key in SEEN},
                    is_outside=np.zeros(int((motion == i).sum()), dtype=bool),
                    is_unsafe=True,
                )
                for i in range(len(motions))
            ],
        )
    return found
