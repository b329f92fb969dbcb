"""Evaluation of scorers on fresh nominal episodes: every segment, and the first row alone."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import numpy as np

from drake_safety.evaluation.metrics import Estimate, proportion, segment_estimates, threshold_at
from drake_safety.evaluation.results import key_part
from drake_safety.evaluation.scorers import Scorer
from drake_safety.learning.calibration import episodes_needed, least_miss_rate, score_threshold
from drake_safety.learning.seeds import check_unused
from drake_safety.learning.segments import DIVERGED, Episodes, Segments, split

PROMISED_UNSAFE_RECALL = 0.992
"""Unsafe recall for which thresholds of plans are chosen where none is stored."""

_LOGGER = logging.getLogger("drake_safety")


def evaluate_episodes(
    scorers: Sequence[Scorer], calibration: Episodes, test: Episodes
) -> tuple[dict[str, Estimate], dict[str, np.ndarray], Segments]:
    """Evaluates scorers on fresh episodes, on every segment and at k = 0.

    Thresholds maximise the balanced accuracy on the calibration set, separately for all segments
    and for k = 0. Returns the estimates by dotted key, the unsafe score of every test segment by
    scorer, (N,) each, and the test segments.
    """
    segments = split(test, stride=1, discount=1.0)
    seen = split(calibration, stride=1, discount=1.0)
    # Rows of the test set and of the calibration set, by prefix of the keys.
    rows_of = {
        "segments": (np.ones(len(segments), dtype=bool), np.ones(len(seen), dtype=bool)),
        "episodes": (segments.is_first, seen.is_first),
    }
    estimates: dict[str, Estimate] = {}
    scores = {}
    for scorer in scorers:
        check_unused(scorer.used, [calibration.info.seed, test.info.seed], f"'{scorer.name}'")
        score, seen_score = scorer.unsafe_score(segments), scorer.unsafe_score(seen)
        scores[scorer.name] = score
        for kind, (rows, seen_rows) in rows_of.items():
            threshold = threshold_at(seen_score[seen_rows], seen.is_unsafe[seen_rows])
            found = segment_estimates(segments.take(rows), score[rows], threshold=threshold)
            estimates |= {f"{kind}.{scorer.name}.{key}": one for key, one in found.items()}
    estimates["episodes.share_unsafe"] = proportion(
        test.num_unsafe, test.num_unsafe + test.num_safe
    )
    estimates["episodes.share_diverged"] = proportion(test.num_diverged, len(test))
    return estimates, scores, segments


def evaluate_plans(
    scorers: Sequence[Scorer],
    calibration: Episodes,
    test: Episodes,
    thresholds: Mapping[str, float],
) -> tuple[dict[str, Estimate], dict[str, np.ndarray], Segments]:
    """Evaluates verdicts on fresh plans with a goal, at k = 0, before anything moves.

    Thresholds that are not given are chosen on the calibration set: each accepts most while a
    future unsafe plan is refused with probability `PROMISED_UNSAFE_RECALL`, or what the number of
    unsafe calibration plans allows. Estimates give thresholds as Γ_thre.
    Given ones are the unsafe score above which a plan is refused, by scorer. Returns what
    :func:`evaluate_episodes` does, of the first segments, with the outcomes' shares.
    """
    first, seen = first_segments(test), first_segments(calibration)
    miss_rate = promised_miss_rate(seen.is_unsafe)
    num_unsafe = int(seen.is_unsafe.sum())
    estimates = {"plans.promised_unsafe_recall": Estimate.exact(1.0 - miss_rate, num_unsafe)}
    scores = {}
    for scorer in scorers:
        check_unused(scorer.used, [calibration.info.seed, test.info.seed], f"'{scorer.name}'")
        threshold = thresholds.get(scorer.name)
        if threshold is None:
            threshold = score_threshold(scorer.unsafe_score(seen), seen.is_unsafe, miss_rate)
        score = scores[scorer.name] = scorer.unsafe_score(first)
        found = segment_estimates(first, score, threshold=threshold)
        found["threshold"] = Estimate.exact(1.0 - threshold, len(seen))
        estimates |= {f"plans.{scorer.name}.{key}": one for key, one in found.items()}
    causes = [episode.cause for episode in test]
    for name in ("", *test.info.constraint_names, DIVERGED):
        share = proportion(causes.count(name), len(causes))
        estimates[f"plans.outcomes.{key_part(name) or 'safe'}"] = share
    return estimates, scores, first


def first_segments(episodes: Episodes) -> Segments:
    """The first segment of each episode, however early it ends; diverged ones have none."""
    segments = split(episodes, stride=episodes.info.horizon, discount=1.0, shortest=1)
    return segments.take(segments.is_first)


def promised_miss_rate(is_unsafe: np.ndarray) -> float:
    """Miss rate that thresholds promise if chosen on plans with these labels, (N,).

    It is higher than wanted with few unsafe plans.
    """
    num_unsafe, wanted = int(is_unsafe.sum()), 1.0 - PROMISED_UNSAFE_RECALL
    if num_unsafe == 0:
        raise ValueError(
            f"thresholds: 0 of {len(is_unsafe)} calibration plans are unsafe; it takes "
            f"{episodes_needed(wanted)} to promise an unsafe recall of {PROMISED_UNSAFE_RECALL:g}"
        )
    least = least_miss_rate(num_unsafe)
    if least > wanted:
        _LOGGER.warning(
            "%d unsafe calibration episodes promise an unsafe recall of %.3f; %.3f takes %d",
            num_unsafe,
            1.0 - least,
            PROMISED_UNSAFE_RECALL,
            episodes_needed(wanted),
        )
    return max(least, wanted)
