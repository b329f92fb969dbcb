"""Every scorer on fresh nominal episodes: per segment, and at planning time alone."""

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
    """Every scorer on fresh episodes, per segment and at k = 0.

    The threshold of the recalls is the one of best balanced accuracy on the calibration set, of
    its segments and of its first steps; the test set decides nothing.

    Args:
        scorers: Who is judged.
        calibration: Other fresh episodes, for thresholds.
        test: Fresh episodes.

    Returns:
        The figures by dotted key, the unsafe score of every test segment by scorer, (N,) each, and
        whether each segment's episode ends unsafely, (N,).

    Raises:
        ValueError: Some of the episodes are none that a scorer has not seen.
    """
    for scorer in scorers:
        check_unused(scorer.used, (calibration.info.seed, test.info.seed), f"'{scorer.name}'")
    segments = split(test, stride=1, discount=1.0)
    seen = split(calibration, stride=1, discount=1.0)
    # Per kind of figure, the segments it is about in either set.
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
