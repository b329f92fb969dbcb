"""Γ under shifts beside baselines: other detectors, postures, contradictions, and promises."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from pydrake.math import RotationMatrix
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.cli.evaluate import Evaluation, add_shifts
from drake_safety.cli.training_folder import episodes_folder
from drake_safety.control.kinematics import RobotKinematics
from drake_safety.evaluation.metrics import Estimate, auc, proportion
from drake_safety.evaluation.scorers import Scorer
from drake_safety.evaluation.shift_study import (
    SEEN,
    Judge,
    JudgedShift,
    MotionSet,
    assessment_judge,
)
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.calibration import PLAN, Calibration
from drake_safety.learning.novelty import Novelty
from drake_safety.learning.segments import RECORDED, Episode, Episodes
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.dataset import load_episodes
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.motion import Motion, Recorder, simulate
from drake_safety.simulation.rollouts import episode_rng, run_episode, worker_loop
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import map_items
from studies.baselines import classifier_scorers

_NUM_TREES = 100
_NEIGHBOURS, _MOST_REFERENCES = 10, 10_000
_FARTHER, _FASTER = 1.5, 2.0
_START_SPEED = 0.75  # Of sqrt(g h), h the standing height: the capture point is 0.75 h ahead.
_LIFT_SHARE = 0.5  # Of the standing height.


def without_novelty(assessment: SafetyAssessment) -> Judge:
    """The grid alone: Γ without novelty, that knows nothing of the measured margins."""
    novelty, blind = assessment.novelty_, copy.copy(assessment)
    limits = np.full_like(novelty.limits, np.inf)
    blind.novelty_ = Novelty(training=novelty.training, limits=limits, plan=novelty.plan)
    judge = assessment_judge(blind)
    return lambda state, preview, features, _: judge(
        state, preview, features, np.zeros(len(state), dtype=bool)
    )


def classifier_judge(scorer: Scorer) -> Judge:
    """A classifier, which knows no "don't know"."""
    return lambda *rows: scorer.probability(*rows[:3])


def detector_judges(assessment: SafetyAssessment, episodes: Episodes) -> dict[str, Judge]:
    """Published detectors of unknown inputs in place of the novelty: the same Γ, another limit.

    Isolation forest (Liu et al. 2008), and the distance to the k-th nearest training input in the
    last hidden layer of the first map (Sun et al. 2022). Each limit is exceeded in the same share
    of safe training episodes as the novelty's.

    Args:
        assessment: Γ.
        episodes: Its training episodes.
    """
    from sklearn.ensemble import IsolationForest
    from sklearn.neighbors import NearestNeighbors
    from threadpoolctl import threadpool_limits

    x = [
        assessment.inputs_of(one.state, one.desired_preview, one.features)[one.first_step :]
        for one in episodes
        if one.is_safe
    ]
    half = len(x) // 2
    reference, held_out = np.concatenate(x[:half]), x[half:]
    rng = np.random.default_rng(0)
    reference = reference[rng.permutation(len(reference))[:_MOST_REFERENCES]]

    def activations(values: np.ndarray) -> np.ndarray:
        hidden = assessment.embedding_.activations(values)[0]
        return hidden / np.maximum(np.linalg.norm(hidden, axis=1, keepdims=True), 1e-9)

    with threadpool_limits(1):
        forest = IsolationForest(n_estimators=_NUM_TREES, random_state=0).fit(reference)
        neighbours = NearestNeighbors(n_neighbors=_NEIGHBOURS, algorithm="brute")
        neighbours.fit(activations(reference))
    scores: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "isolation_forest": lambda values: -forest.score_samples(values),
        "deep_knn": lambda values: neighbours.kneighbors(activations(values))[0][:, -1],
    }
    plain = without_novelty(assessment)

    def judge(
        *rows: np.ndarray, score: Callable[[np.ndarray], np.ndarray], limit: float
    ) -> np.ndarray:
        values = assessment.inputs_of(*rows[:3])
        is_strange = np.concatenate(
            [score(part) for part in np.array_split(values, len(values) // 4096 + 1)]
        )
        return np.where(is_strange > limit, np.nan, plain(*rows))

    judges: dict[str, Judge] = {}
    for name, score in scores.items():
        worst = np.array([score(one).max() for one in held_out])
        limit = np.quantile(worst, 1.0 - assessment.parameters.novelty_rate, method="higher")
        judges[name] = partial(judge, score=score, limit=float(limit))
    return judges


Reshape = Callable[[EpisodeStart, RobotKinematics], EpisodeStart]
"""Changes a start of an episode."""


def _scaled_plan(start: EpisodeStart, *, distance: float, speed: float) -> EpisodeStart:
    """A plan whose points are farther from its start, and reached earlier."""
    plan = start.plan
    start_s = plan.start_time()
    origin = plan.value(start_s)
    scaled = PiecewisePolynomial(origin) if plan.get_number_of_segments() == 0 else plan
    times = np.array(scaled.get_segment_times())
    samples = np.linspace(times[0], times[-1], 41)
    points = origin + distance * (np.hstack([scaled.value(t) for t in samples]) - origin)
    times = start_s + (samples - start_s) / speed
    return dataclasses.replace(start, plan=PiecewisePolynomial.FirstOrderHold(times, points))


def _moving(start: EpisodeStart, kinematics: RobotKinematics) -> EpisodeStart:
    v = start.v.copy()
    v[4] += _START_SPEED * math.sqrt(9.81 * kinematics.standing_height)
    return dataclasses.replace(start, v=v)


def _lifted(start: EpisodeStart, kinematics: RobotKinematics) -> EpisodeStart:
    q = start.q.copy()
    q[6] += _LIFT_SHARE * kinematics.standing_height
    return dataclasses.replace(start, q=q)


def _lying(start: EpisodeStart, *, roll_rad: float) -> EpisodeStart:
    q = start.q.copy()
    R = RotationMatrix.MakeXRotation(roll_rad).ToQuaternion()
    q[:4], q[6] = R.wxyz(), 0.3 * q[6]
    return dataclasses.replace(start, q=q, v=np.zeros_like(start.v))


STARTS: Mapping[str, Reshape] = {
    "farther": lambda start, _: _scaled_plan(start, distance=_FARTHER, speed=1.0),
    "faster": lambda start, _: _scaled_plan(start, distance=1.0, speed=_FASTER),
    "moving": _moving,
}
"""Plans and initial velocities outside the range of training, by name."""
POSTURES: Mapping[str, Reshape] = {
    "lifted": _lifted,
    "on_its_side": lambda start, _: _lying(start, roll_rad=0.5 * math.pi),
    "on_its_back": lambda start, _: _lying(start, roll_rad=math.pi),
}
"""Postures in which no episode of training is, by name; all are unsafe."""


def run_changed_starts(
    scenario: Scenario, num_motions: int, seed: int, num_workers: int | None = None
) -> dict[str, MotionSet]:
    """Simulates plans and starts outside the range of training, and evaluates such postures.

    Postures are single rows, unsafe by definition. "falling" has the rows outside the safe
    set of nominal episodes in which the robot falls.

    Args:
        scenario: The scenario; if its robot has no legs, nothing is returned.
        num_motions: Number of motions of each kind.
        seed: Seed of their starts.
        num_workers: Number of processes.

    Returns:
        By name the kind, "plan" or "posture", and the motions.
    """
    found: dict[str, MotionSet] = {}
    make = worker_loop(scenario)
    if not isinstance(make(), LeggedLoop):
        return found
    for name in (*STARTS, *POSTURES, "falling"):
        run = partial(make.run, _changed_motion, name, seed)
        results = map_items(run, range(num_motions), num_workers=num_workers)
        motions = [motion for motion in results if len(motion.state)]
        if motions:
            found[name] = ("plan" if name in STARTS else "posture", motions)
    return found


def _changed_motion(loop: ClosedLoop, name: str, seed: int, index: int) -> Episode:
    assert isinstance(loop, LeggedLoop)
    if name == "falling":
        return _fall(loop, seed, index)
    context = loop.CreateDefaultContext()
    loop.reset(context, episode_rng(seed, index))
    start = loop.start_of(context)
    if name in STARTS:
        start = STARTS[name](start, loop.kinematics)
        return run_episode(loop, index, seed=seed, start=start)
    loop.reset_to(context, episode_rng(seed, index), POSTURES[name](start, loop.kinematics))
    recorder = Recorder(loop)
    recorder.record(context)
    arrays = recorder.arrays()
    return Motion(time_s=arrays.pop("time_s"), ports=arrays, cause=name, index=index).episode()


def _fall(loop: LeggedLoop, seed: int, index: int) -> Episode:
    """The rows of a nominal episode outside the safe set, if the robot falls."""
    motion = simulate(
        loop,
        lambda context: loop.reset(context, episode_rng(seed, index)),
        RECORDED,
        duration_s=loop.scenario.episode_duration_s,
        step_s=loop.scenario.step_s,
        after_fall_s=math.inf,
        may_fail=True,
        index=index,
    )
    is_kept = np.any(motion["margins"] < 0.0, axis=1) & motion.has_fallen
    rows = {name: motion[name][is_kept] for name in RECORDED}
    return dataclasses.replace(motion.episode(), **rows, is_safe=False)


def junk(motions: Sequence[Episode], seed: int) -> dict[str, MotionSet]:
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
    found: dict[str, MotionSet] = {}
    for name, replaced in changed.items():
        values = {**rows, **replaced}
        found[name] = (
            "junk",
            [
                dataclasses.replace(
                    one,
                    **{key: values[key][motion == i] for key in SEEN},
                    margins=np.abs(one.margins),
                    is_safe=False,
                )
                for i, one in enumerate(motions)
            ],
        )
    return found


def baseline_estimates(
    judged: JudgedShift, promise: Calibration | None = None
) -> dict[str, Estimate]:
    """What the documentation compares beside `shift_estimates`.

    Args:
        judged: The verdicts; "gamma" is Γ.
        promise: Γ's promise for plans, if there is one.

    Returns:
        Of each method the confident error at k = 0 and the AUC of the rows that Γ knows; what a
        promise for plans misses, with the stored threshold and one that follows outcomes.
    """
    found = {}
    is_known, is_unsafe = ~np.isnan(judged.probability["gamma"]), judged.is_unsafe
    label = is_unsafe[judged.motion]
    first = np.unique(judged.motion, return_index=True)[1]
    for name, probability in judged.probability.items():
        is_wrong = judged.is_wrong(name)[first]
        found[f"{name}.first.confident_error"] = proportion(int(is_wrong.sum()), len(is_wrong))
        if 0 < label[is_known].sum() < is_known.sum():
            score = 1.0 - np.nan_to_num(probability[is_known])
            found[f"{name}.known_auc"] = auc(score, label[is_known], judged.motion[is_known])
    if promise is not None and is_unsafe.any():
        is_accepted = np.nan_to_num(judged.probability["gamma"][first]) >= promise.threshold
        num_missed = int((is_accepted & is_unsafe).sum())
        found["missed"] = proportion(num_missed, int(is_unsafe.sum()))
    return found


def add_all_shifts(evaluation: Evaluation, num_motions: int, num_nominal: int) -> None:
    """As `drake-safety evaluate`, beside baselines, on more than plants and sensors."""
    scenario, gamma = evaluation.scenario, evaluation.assessments["sharpened"]
    training = load_episodes(episodes_folder(evaluation.run_folder))
    shortest = gamma.parameters.shortest_segment or None
    classifiers = classifier_scorers(training, evaluation.stages, shortest=shortest)
    judges = {
        "gamma": assessment_judge(gamma),
        "without_novelty": without_novelty(gamma),
        **{one.name: classifier_judge(one) for one in classifiers},
        **detector_judges(gamma, training),
    }
    seed = evaluation.seeds["shifts"]

    def others(nominal: Sequence[Episode]) -> dict[str, MotionSet]:
        changed = run_changed_starts(scenario, num_motions, seed, evaluation.workers)
        return changed | junk(nominal, seed)

    more = partial(baseline_estimates, promise=gamma.calibrations_.get(PLAN))
    add_shifts(evaluation, num_motions, num_nominal, judges, others, more)
