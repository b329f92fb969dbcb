"""Evaluation of scorers on fresh nominal episodes: every segment, and the first row alone."""

from collections.abc import Mapping, Sequence

import numpy as np

from drake_safety.evaluation.metrics import Estimate, proportion, segment_estimates, threshold_at
from drake_safety.evaluation.results import Key
from drake_safety.evaluation.scorers import Scorer
from drake_safety.learning.assessment import Prediction
from drake_safety.learning.calibration import episodes_needed, score_threshold
from drake_safety.learning.causes import likely_cause
from drake_safety.learning.seeds import check_unused
from drake_safety.learning.segments import DIVERGED, Episodes, Segments, split

PROMISED_UNSAFE_RECALL = 0.992
"""Unsafe recall for which thresholds of plans are chosen where none is stored."""


def evaluate_episodes(
    scorers: Sequence[Scorer], calibration: Episodes, test: Episodes
) -> dict[Key, Estimate]:
    """Evaluates scorers on fresh episodes, on every segment and at k = 0.

    Thresholds have the best balanced accuracy on the calibration set.
    """
    segments, others = (split(one, stride=1, discount=1.0) for one in (test, calibration))
    rows_of = {
        "segments": (np.ones(len(segments), dtype=bool), np.ones(len(others), dtype=bool)),
        "episodes": (segments.is_first, others.is_first),
    }  # For the test set and the calibration set.
    estimates: dict[Key, Estimate] = {}
    for scorer in scorers:
        check_unused(scorer.used, [calibration.info.seed, test.info.seed], f"'{scorer.name}'")
        score, other_score = scorer.unsafe_score(segments), scorer.unsafe_score(others)
        for kind, (rows, other_rows) in rows_of.items():
            threshold = threshold_at(other_score[other_rows], others.is_unsafe[other_rows])
            judged = segment_estimates(segments.take(rows), score[rows], threshold=threshold)
            estimates |= {(kind, scorer.name, metric): one for metric, one in judged.items()}
    num_judged = test.num_unsafe + test.num_safe
    estimates["episodes", "", "share_unsafe"] = proportion(test.num_unsafe, num_judged)
    return estimates


def evaluate_plans(
    scorers: Sequence[Scorer],
    calibration: Episodes,
    test: Episodes,
    thresholds: Mapping[str, float],
) -> dict[Key, Estimate]:
    """Evaluates verdicts on fresh plans with a goal, at k = 0, before anything moves.

    A scorer without a threshold of its unsafe score is given one on the calibration set: it accepts
    most while a future unsafe plan is refused with probability `PROMISED_UNSAFE_RECALL`, or what
    the number of unsafe calibration plans allows. Estimates give thresholds as Γ_thre.
    """
    first, others = first_segments(test), first_segments(calibration)
    miss_rate = promised_miss_rate(others.is_unsafe)
    promised = Estimate.exact(1.0 - miss_rate, int(others.is_unsafe.sum()))
    estimates = {("plans", "", "promised_unsafe_recall"): promised}
    for scorer in scorers:
        check_unused(scorer.used, [calibration.info.seed, test.info.seed], f"'{scorer.name}'")
        threshold = thresholds.get(scorer.name)
        if threshold is None:
            threshold = score_threshold(scorer.unsafe_score(others), others.is_unsafe, miss_rate)
        judged = segment_estimates(first, scorer.unsafe_score(first), threshold=threshold)
        judged["threshold"] = Estimate.exact(1.0 - threshold, len(others))
        estimates |= {("plans", scorer.name, metric): one for metric, one in judged.items()}
    causes = [episode.cause for episode in test]
    for name in ("", *test.info.constraint_names, DIVERGED):
        key = "plans", "outcomes", name or "safe"
        estimates[key] = proportion(causes.count(name), len(causes))
    return estimates


def evaluate_causes(
    predicted: Prediction, test: Episodes, *, margin_unit: float, threshold: float
) -> dict[Key, Estimate]:
    """Share of the correctly refused plans whose likely cause is the violated constraint.

    Args:
        predicted: Prediction of the first row of each episode that has not diverged.
    """
    causes = [episode.cause for episode in test if episode.cause != DIVERGED]
    parts = predicted.cause_probability, predicted.predicted_margins
    every = test.info.constraint_names
    names = [likely_cause(every, *one, margin_unit) for one in zip(*parts, strict=True)]
    refused = [
        i for i, cause in enumerate(causes) if cause and predicted.probability[i] < threshold
    ]
    right = sum(names[i] == causes[i] for i in refused)
    return {("plans", "causes", "right_cause"): proportion(right, len(refused))}


def first_segments(episodes: Episodes) -> Segments:
    """The first segment of each episode that has not diverged, even if it ends early."""
    segments = split(episodes, stride=episodes.info.horizon, discount=1.0, shortest=1)
    return segments.take(segments.is_first)


def promised_miss_rate(is_unsafe: np.ndarray) -> float:
    """Miss rate that thresholds chosen on plans with these labels, (N,), can promise."""
    num_unsafe, wanted = int(is_unsafe.sum()), 1.0 - PROMISED_UNSAFE_RECALL
    if num_unsafe == 0:
        needed = f"it takes {episodes_needed(wanted)} to promise {PROMISED_UNSAFE_RECALL:g}"
        raise ValueError(f"0 of {len(is_unsafe)} calibration plans are unsafe; {needed}")
    return max(1.0 / (num_unsafe + 1), wanted)
