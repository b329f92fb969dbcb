"""Evaluation of scorers on fresh nominal episodes: every segment, and the first row alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drake_safety.evaluation.baselines import KINDS
from drake_safety.evaluation.metrics import (
    Estimate,
    auc_difference,
    proportion,
    segment_estimates,
    threshold_at,
)
from drake_safety.evaluation.scorers import Scorer
from drake_safety.learning.seeds import check_unused
from drake_safety.learning.segments import Episodes, split


def evaluate_episodes(
    scorers: Sequence[Scorer], calibration: Episodes, test: Episodes
) -> tuple[dict[str, Estimate], dict[str, np.ndarray], np.ndarray]:
    """Evaluates scorers on fresh episodes, on every segment and at k = 0.

    Thresholds maximise the balanced accuracy on the calibration set, separately for all segments
    and for k = 0.

    Args:
        scorers: The scorers.
        calibration: Fresh episodes for thresholds.
        test: Other fresh episodes.

    Returns:
        The estimates by dotted key, the unsafe score of every test segment by scorer, (N,) each,
        and whether each segment's episode ends unsafely, (N,).

    Raises:
        ValueError: A scorer has used the seed of a set.
    """
    for scorer in scorers:
        check_unused(scorer.used, (calibration.info.seed, test.info.seed), f"'{scorer.name}'")
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
        name = scorer.name
        score, seen_score = scorer.unsafe_score(segments), scorer.unsafe_score(seen)
        scores[name] = score
        for kind, (rows, seen_rows) in rows_of.items():
            threshold = threshold_at(seen_score[seen_rows], seen.is_unsafe[seen_rows])
            found = segment_estimates(segments.take(rows), score[rows], threshold=threshold)
            estimates |= {f"{kind}.{name}.{key}": estimate for key, estimate in found.items()}
    classifiers = [name for name in scores if name in KINDS]
    if "sharpened" in scores and classifiers:
        for kind, (rows, _) in rows_of.items():
            best = max(classifiers, key=lambda name: estimates[f"{kind}.{name}.auc"].value)
            estimates[f"{kind}.sharpened_minus_best_classifier.auc"] = auc_difference(
                scores["sharpened"][rows],
                scores[best][rows],
                segments.is_unsafe[rows],
                segments.episode[rows],
            )
    estimates["episodes.share_unsafe"] = proportion(
        test.num_unsafe, test.num_unsafe + test.num_safe
    )
    estimates["episodes.share_diverged"] = proportion(test.num_diverged, len(test))
    return estimates, scores, segments.is_unsafe
