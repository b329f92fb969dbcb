"""Γ under shifts: what it is confident of and wrong, and when the monitor gives an alarm.

Confident error (CE) is the share of rows that are called safe with at least 0.9, with a belief that
is not "don't know", in motions that end unsafely. DK is the share of "don't know".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from drake_safety.evaluation.metrics import Bootstrap, Estimate, auc, proportion
from drake_safety.evaluation.monitoring_study import rate_per_hour
from drake_safety.evaluation.scorers import Scorer
from drake_safety.evaluation.shifted_motions import Motion, ShiftedSet
from drake_safety.extras import require_extra
from drake_safety.files.progress import StageProgress, shown
from drake_safety.learning.adaptive_threshold import AdaptiveThreshold
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.calibration import PLAN, Calibration
from drake_safety.learning.novelty import Novelty
from drake_safety.learning.prediction import is_unknown
from drake_safety.learning.segments import Episodes
from drake_safety.simulation.watched_motion import SEEN

CONFIDENT = 0.9
"""Least safety probability of a confident verdict."""
SPANS_S = (10.0, 60.0)
"""Times since a shift over which confident errors with the monitor are counted [s]."""
_LASTING = ("plant", "sensor")
"""Kinds whose motions follow each other."""
_MOST_STARTS = 100  # Sequences of motions per shift.
_BOOTSTRAP = Bootstrap(num_resamples=200)
_NUM_TREES = 100
_NEIGHBOURS, _MOST_REFERENCES = 10, 10_000


@dataclass(kw_only=True, eq=False)
class Verdicts:
    """Verdicts of one method on the rows of a shift.

    Attributes:
        probability: Safety probability, 0 for "don't know", (N,).
        is_unknown: Whether the row is "don't know", (N,).
    """

    probability: np.ndarray
    is_unknown: np.ndarray


Judge = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], Verdicts]
"""Maps states, previews, features and whether a row is outside the safe set to verdicts."""


def assessment_judge(assessment: SafetyAssessment, *, is_novelty_used: bool = True) -> Judge:
    """Γ as a :class:`SafetyAssessor` with the port ``margins`` gives it, without the monitor."""
    novelty = assessment.novelty_
    if not is_novelty_used:
        novelty = Novelty(
            training=novelty.training,
            limits=np.full_like(novelty.limits, np.inf),
            plan=novelty.plan,
        )

    def judge(
        state: np.ndarray, preview: np.ndarray, features: np.ndarray, is_outside: np.ndarray
    ) -> Verdicts:
        found = assessment.predict(
            state, preview, features if assessment.uses_features else None, novelty=novelty
        )
        unknown = is_unknown(found.belief, assessment.parameters.initial_uncertainty)
        is_refused = is_outside & is_novelty_used
        return Verdicts(
            probability=np.where(is_refused, 0.0, found.probability), is_unknown=unknown
        )

    return judge


def classifier_judge(scorer: Scorer) -> Judge:
    """A classifier, which knows no "don't know"."""

    def judge(
        state: np.ndarray, preview: np.ndarray, features: np.ndarray, is_outside: np.ndarray
    ) -> Verdicts:
        del is_outside
        probability = scorer.probability(state, preview, features)
        return Verdicts(probability=probability, is_unknown=np.isnan(probability))

    return judge


def detector_judges(assessment: SafetyAssessment, episodes: Episodes) -> dict[str, Judge]:
    """Published detectors of unknown inputs in place of the novelty: the same Γ, another limit.

    Isolation forest (Liu et al. 2008), and the distance to the k-th nearest training input in the
    last hidden layer of the first map (Sun et al. 2022). Each limit is exceeded in the same share
    of safe training episodes as the novelty's.

    Args:
        assessment: Γ.
        episodes: Its training episodes.
    """
    require_extra("train", "detector_judges", "sklearn")
    from sklearn.ensemble import IsolationForest
    from sklearn.neighbors import NearestNeighbors
    from threadpoolctl import threadpool_limits

    safe = [one for one in episodes if one.is_safe]
    x = [
        assessment.inputs_of(one.state, one.desired_preview, one.features)[one.first_step :]
        for one in safe
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

    def distance(values: np.ndarray) -> np.ndarray:
        found: np.ndarray = neighbours.kneighbors(activations(values))[0][:, -1]
        return found

    def strangeness(values: np.ndarray) -> np.ndarray:
        found: np.ndarray = -forest.score_samples(values)
        return found

    plain = assessment_judge(assessment, is_novelty_used=False)
    judges: dict[str, Judge] = {}
    for name, score in {"isolation_forest": strangeness, "deep_knn": distance}.items():
        worst = np.array([score(one).max() for one in held_out])
        limit = np.quantile(worst, 1.0 - assessment.parameters.novelty_rate, method="higher")

        def judge(
            state: np.ndarray,
            preview: np.ndarray,
            features: np.ndarray,
            is_outside: np.ndarray,
            score: Callable[[np.ndarray], np.ndarray] = score,
            limit: float = float(limit),
        ) -> Verdicts:
            found = plain(state, preview, features, is_outside)
            values = assessment.inputs_of(state, preview, features)
            is_strange = np.concatenate(
                [score(part) for part in np.array_split(values, len(values) // 4096 + 1)]
            )
            unknown = found.is_unknown | (is_strange > limit)
            return Verdicts(
                probability=np.where(unknown, 0.0, found.probability), is_unknown=unknown
            )

        judges[name] = judge
    return judges


@dataclass(kw_only=True, eq=False)
class ShiftResult:
    """What a shift does.

    Attributes:
        kind: That of the :class:`ShiftedSet`.
        estimates: By key.
    """

    kind: str
    estimates: dict[str, Estimate] = field(default_factory=dict)


def evaluate_shift(
    shifted: ShiftedSet, assessment: SafetyAssessment, judges: Mapping[str, Judge]
) -> ShiftResult:
    """Evaluates all methods and the monitor on a shift.

    Args:
        shifted: The motions.
        assessment: Γ, with the monitor's innovation.
        judges: Methods by name; "gamma" is Γ.
    """
    motions = shifted.motions
    rows = {
        name: np.concatenate([getattr(one, name) for one in motions])
        for name in (*SEEN, "is_outside")
    }
    sizes = np.array([len(one.state) for one in motions])
    motion = np.repeat(np.arange(len(motions)), sizes)
    is_unsafe = np.array([one.is_unsafe for one in motions])
    first = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    result = ShiftResult(kind=shifted.kind)
    found = result.estimates
    found["unsafe"] = proportion(int(is_unsafe.sum()), len(motions))

    def share(mask: np.ndarray, of: np.ndarray = motion) -> Estimate:
        def mean(weight: np.ndarray) -> float:
            return float(np.average(mask, weights=weight)) if weight.any() else np.nan

        return _BOOTSTRAP.over_episodes(mean, of)

    judged = {name: judge(*rows.values()) for name, judge in judges.items()}
    gamma = judged["gamma"]
    is_known, ends_unsafely = ~gamma.is_unknown, is_unsafe[motion]
    for name, verdicts in judged.items():
        is_wrong = (verdicts.probability >= CONFIDENT) & ~verdicts.is_unknown & ends_unsafely
        found[f"{name}.confident_error"] = share(is_wrong)
        found[f"{name}.unknown"] = share(verdicts.is_unknown)
        found[f"{name}.first.confident_error"] = proportion(
            int(is_wrong[first].sum()), len(motions)
        )
        # Of all rows, with "don't know" as the lowest probability, and of those that Γ knows.
        for key, which in (("auc", np.ones(len(motion), dtype=bool)), ("known_auc", is_known)):
            if 0 < ends_unsafely[which].sum() < which.sum():
                score = 1.0 - np.nan_to_num(verdicts.probability[which])
                found[f"{name}.{key}"] = auc(score, ends_unsafely[which], motion[which])
        if name == "gamma":
            is_confident = is_wrong
    promise = assessment.calibrations_.get(PLAN)
    if promise is not None and is_unsafe.any():
        found |= _promised(promise, gamma.probability[first], is_unsafe)
    if shifted.kind in _LASTING:
        found |= _monitored(shifted, assessment, is_confident, first)
    return result


def _promised(
    promise: Calibration, probability: np.ndarray, is_unsafe: np.ndarray
) -> dict[str, Estimate]:
    """Verdicts on the first rows by the promise's threshold, and by one that follows outcomes."""
    adaptive = AdaptiveThreshold(promise)
    is_accepted = np.zeros((2, len(probability)), dtype=bool)
    for i, (gamma, ends_unsafely) in enumerate(zip(probability, is_unsafe, strict=True)):
        is_accepted[:, i] = gamma >= promise.threshold, adaptive.is_safe(gamma)
        adaptive.update(gamma, ends_unsafely)
    # The outcomes of the first half; the figures are those of the second.
    is_counted = np.cumsum(is_unsafe) > 0.5 * is_unsafe.sum()
    found = {"missed": proportion(int((is_accepted[0] & is_unsafe).sum()), int(is_unsafe.sum()))}
    for name, row in (("fixed", is_accepted[0]), ("adaptive", is_accepted[1])):
        for what, of in (("missed", is_unsafe), ("accepted", ~is_unsafe)):
            if (of & is_counted).any():
                found[f"{name}.{what}"] = proportion(
                    int((row & of & is_counted).sum()), int((of & is_counted).sum())
                )
    return found


def _monitored(
    shifted: ShiftedSet,
    assessment: SafetyAssessment,
    is_confident: np.ndarray,
    first: np.ndarray,
) -> dict[str, Estimate]:
    """The monitor on motions one after another, begun at each of them."""
    motions, innovation = shifted.motions, assessment.innovation_
    x = [assessment.inputs_of(m.state, m.desired_preview, m.features) for m in motions]
    distances = [assessment.novelty_.of(one) for one in x]
    step_s = innovation.step_s
    promise = assessment.calibrations_.get(PLAN)
    accepted = np.zeros(len(motions), dtype=bool)
    if promise is not None:
        accepted = _first_probability(assessment, motions) >= promise.threshold
    delay, errors = [], {span: [] for span in SPANS_S}  # type: ignore[var-annotated]
    counted = []  # Missed and unsafe motions of each sequence.
    starts = np.linspace(0, len(motions), min(_MOST_STARTS, len(motions)), endpoint=False)
    for start in starts.astype(int):
        order, rows = [], 0
        for i in range(len(motions)):
            order.append((start + i) % len(motions))
            rows += len(x[order[-1]])
            if rows * step_s > max(SPANS_S):
                break
        levels = innovation.levels([x[i] for i in order], [distances[i] for i in order])
        is_alarm = levels.max(axis=1) > 1.0
        alarm = int(np.argmax(is_alarm)) if is_alarm.any() else len(is_alarm)
        delay.append((alarm + 1) * step_s if is_alarm.any() else np.inf)
        wrong = np.concatenate([is_confident[first[i] : first[i] + len(x[i])] for i in order]) & (
            np.arange(rows) < alarm
        )
        for span in SPANS_S:
            errors[span].append(wrong[: round(span / step_s)].mean())
        begins = np.concatenate([[0], np.cumsum([len(x[i]) for i in order])[:-1]])
        is_unsafe = np.array([motions[i].is_unsafe for i in order])
        is_missed = is_unsafe & accepted[order] & (begins < alarm)
        counted.append((is_missed.sum(), is_unsafe.sum()))
    found = {
        f"monitor.confident_error_{span:g}s": _mean(np.array(values))
        for span, values in errors.items()
    }
    found["monitor.delay_s"] = _quantile(np.array(delay), 0.5)
    found["monitor.delay_95_s"] = _quantile(np.array(delay), 0.95)
    found["monitor.alarmed"] = proportion(int(np.isfinite(delay).sum()), len(delay))
    counts = np.array(counted)
    if promise is not None and counts[:, 1].any():

        def missed_share(weight: np.ndarray) -> float:
            num_missed, num_unsafe = weight @ counts
            return float(num_missed / num_unsafe) if num_unsafe else np.nan

        found["monitor.missed"] = _BOOTSTRAP.over_episodes(missed_share, np.arange(len(counts)))
    return found


def _first_probability(assessment: SafetyAssessment, motions: Sequence[Motion]) -> np.ndarray:
    features = np.stack([one.features[0] for one in motions])
    found = assessment.predict(
        np.stack([one.state[0] for one in motions]),
        np.stack([one.desired_preview[0] for one in motions]),
        features if assessment.uses_features else None,
    )
    return found.probability


def _mean(values: np.ndarray) -> Estimate:
    return _BOOTSTRAP.over_episodes(
        lambda weight: float(np.average(values, weights=weight)), np.arange(len(values))
    )


def _quantile(values: np.ndarray, quantile: float) -> Estimate:
    def of(weight: np.ndarray) -> float:
        drawn = np.sort(np.repeat(values, weight.astype(int)))
        return float(drawn[min(int(quantile * len(drawn)), len(drawn) - 1)])

    value = of(np.ones(len(values)))
    rng = np.random.default_rng(0)
    drawn = [
        of(np.bincount(rng.integers(len(values), size=len(values)), minlength=len(values)))
        for _ in range(_BOOTSTRAP.num_resamples)
    ]
    low, high = np.quantile(drawn, _BOOTSTRAP.quantiles, method="nearest")
    return Estimate(value, float(low), float(high), len(values))


def false_alarms(motions: Sequence[Motion], assessment: SafetyAssessment) -> Estimate:
    """False alarms of the monitor per hour, on nominal motions one after another.

    Motions that end unsafely are left out; the charts begin anew after an alarm.

    Args:
        motions: Nominal motions.
        assessment: Γ, with the monitor's innovation.
    """
    innovation = assessment.innovation_
    waiting = [
        assessment.inputs_of(one.state, one.desired_preview, one.features)
        for one in motions
        if not one.is_unsafe
    ]
    num_motions, count, rows = len(waiting), 0, sum(map(len, waiting))
    distances = [assessment.novelty_.of(one) for one in waiting]
    ends = np.cumsum([len(one) for one in waiting])
    begin = 0
    while begin < num_motions:
        levels = innovation.levels(waiting[begin:], distances[begin:])
        is_alarm = levels.max(axis=1) > 1.0
        if not is_alarm.any():
            break
        count += 1
        row = int(np.argmax(is_alarm)) + (ends[begin - 1] if begin else 0)
        begin = int(np.searchsorted(ends, row, side="right")) + 1
    return rate_per_hour(count, rows * innovation.step_s, num_motions)


def evaluate_shifts(
    sets: Mapping[str, ShiftedSet],
    assessment: SafetyAssessment,
    classifiers: Sequence[Scorer],
    training: Episodes | None,
    progress: StageProgress | bool | None = None,
) -> dict[str, ShiftResult]:
    """Evaluates Γ, its monitor and the baselines on every shift.

    Args:
        sets: Motions by shift.
        assessment: Γ.
        classifiers: Baseline classifiers.
        training: Training episodes, for the published detectors; None to leave these out.
        progress: Called with a stage, the number done and the number wanted; True shows it.
    """
    judges = {
        "gamma": assessment_judge(assessment),
        "without_novelty": assessment_judge(assessment, is_novelty_used=False),
        **{scorer.name: classifier_judge(scorer) for scorer in classifiers},
    }
    if training is not None:
        judges |= detector_judges(assessment, training)
    results = {}
    with shown(progress, lambda stages: stages) as report:
        for i, (name, shifted) in enumerate(sets.items()):
            if report is not None:
                report("shifts", i, len(sets))
            results[name] = evaluate_shift(shifted, assessment, judges)
        if report is not None:
            report("shifts", len(sets), len(sets))
    return results
