"""Reliability of probabilities, and of stored thresholds."""

from __future__ import annotations

import numpy as np

from drake_safety.evaluation.metrics import Bootstrap, Estimate, proportion
from drake_safety.learning.calibration import SAFE, UNKNOWN, UNSAFE, Calibration

_BOOTSTRAP = Bootstrap(num_resamples=100)


def verdict_shares(
    calibration: Calibration, unsafe_score: np.ndarray, is_unsafe: np.ndarray
) -> dict[str, Estimate]:
    """Shares of the verdicts of stored thresholds on fresh episodes with scores (N,)."""
    verdict = calibration.verdicts(1.0 - unsafe_score)

    def share_of(rows: np.ndarray, expected: str) -> Estimate:
        return proportion(int(np.sum(verdict[rows] == expected)), int(rows.sum()))

    return {
        "promised_miss_rate": Estimate.exact(calibration.miss_rate, calibration.num_unsafe),
        "miss_rate": share_of(is_unsafe, SAFE),
        "unsafe_unknown": share_of(is_unsafe, UNKNOWN),
        "safe_recall": share_of(~is_unsafe, SAFE),
        "safe_unknown": share_of(~is_unsafe, UNKNOWN),
        "false_alarm_rate": share_of(~is_unsafe, UNSAFE),
    }


def calibration_error(
    unsafe_probability: np.ndarray, is_unsafe: np.ndarray, episode: np.ndarray, num_bins: int = 10
) -> Estimate:
    """The expected calibration error: mean distance of predicted and observed shares of bins.

    Bins have about equal numbers of rows (N,); rows of equal probability share one.
    """
    p = unsafe_probability

    def error(weight: np.ndarray) -> float:
        drawn = np.repeat(np.arange(len(p)), weight.astype(int))
        # Edges are occurring values.
        quantiles = np.linspace(0, 1, num_bins + 1)[1:-1]
        edges = np.unique(np.quantile(p[drawn], quantiles, method="nearest"))
        bins = np.searchsorted(edges, p[drawn], side="right")
        apart = np.bincount(bins, p[drawn] - is_unsafe[drawn])
        return float(np.abs(apart).sum() / len(drawn))

    return _BOOTSTRAP.over_episodes(error, episode)
