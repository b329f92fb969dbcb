"""Evaluation of calibration: promised and observed miss rates, and reliability."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_safety.evaluation.metrics import Estimate, proportion
from drake_safety.learning.calibration import (
    SAFE,
    UNKNOWN,
    UNSAFE,
    Calibration,
    allowed_misses,
    episodes_needed,
    score_threshold,
)

MISS_RATES = (0.01, 0.05, 0.1)
"""Promised miss rates."""
NUM_SPLITS = 200


@dataclass(frozen=True, kw_only=True)
class PromiseKept:
    """A promised miss rate and the rates observed over many splits of the same episodes.

    Attributes:
        miss_rate: Promised miss rate.
        confidence: Confidence of the promise; None for a promise on average.
        num_needed: Number of unsafe episodes that the promise needs.
        num_calibration: Number of unsafe calibration episodes of each split.
        observed: Mean observed miss rate, with the binomial interval of the total number of unsafe
            episodes; NaN with too few of them.
        share_broken: Share of splits whose test half exceeds the promised miss rate.
        safe_recall: Mean safe recall, with its 5 % and 95 % quantiles over the splits.
    """

    miss_rate: float
    confidence: float | None
    num_needed: int
    num_calibration: int
    observed: Estimate
    share_broken: float
    safe_recall: Estimate

    @property
    def is_kept(self) -> bool:
        """Whether the promise lies within or above the interval of the observed miss rate."""
        return not self.observed.low > self.miss_rate


def repeated_splits(
    unsafe_score: np.ndarray,
    is_unsafe: np.ndarray,
    *,
    miss_rates: Sequence[float] = MISS_RATES,
    confidence: float | None = None,
    num_splits: int = NUM_SPLITS,
    seed: int = 0,
) -> list[PromiseKept]:
    """Splits episodes in halves, calibrates on one and counts misses in the other.

    The classes are split separately, so that all splits have the same number of unsafe episodes.

    Args:
        unsafe_score: Unsafe score of each episode, (N,); NaN counts as the most unsafe.
        is_unsafe: Whether each ended unsafely, (N,).
        miss_rates: Promised miss rates.
        confidence: Confidence of the promise; None for on average.
        num_splits: Number of splits.
        seed: Seed of the splits.

    Raises:
        ValueError: A rate is not in (0, 1), or one of the classes has fewer than two episodes.
    """
    score = np.asarray(unsafe_score, dtype=float)
    score = np.where(np.isnan(score), math.inf, score)
    label = np.asarray(is_unsafe, dtype=bool)
    unsafe, safe = np.flatnonzero(label), np.flatnonzero(~label)
    if min(unsafe.size, safe.size) < 2:
        raise ValueError(
            f"repeated splits: of {len(score)} episodes {unsafe.size} are unsafe; it takes two of "
            "either kind"
        )
    num_calibration = unsafe.size // 2
    kept = []
    for miss_rate in miss_rates:
        # All promises use the same splits.
        rng = np.random.default_rng(seed)
        is_possible = allowed_misses(num_calibration, miss_rate, confidence=confidence) >= 0
        missed, accepted = [], []
        for _ in range(num_splits if is_possible else 0):
            one, other = rng.permutation(unsafe), rng.permutation(safe)
            seen = np.concatenate([one[:num_calibration], other[: safe.size // 2]])
            threshold = score_threshold(score[seen], label[seen], miss_rate, confidence=confidence)
            missed.append(np.mean(score[one[num_calibration:]] <= threshold))
            accepted.append(np.mean(score[other[safe.size // 2 :]] <= threshold))
        kept.append(
            PromiseKept(
                miss_rate=miss_rate,
                confidence=confidence,
                num_needed=episodes_needed(miss_rate, confidence=confidence),
                num_calibration=num_calibration,
                observed=_observed(missed, unsafe.size),
                share_broken=float(np.mean(np.array(missed) > miss_rate)) if missed else math.nan,
                safe_recall=_spread(accepted, safe.size),
            )
        )
    return kept


def _observed(missed: list[float], num_unsafe: int) -> Estimate:
    if not missed:
        return Estimate.exact(math.nan, 0)
    mean = float(np.mean(missed))
    # Splits of the same episodes are not independent: n is the number of episodes.
    binomial = proportion(round(mean * num_unsafe), num_unsafe)
    return Estimate(mean, min(binomial.low, mean), max(binomial.high, mean), num_unsafe)


def _spread(values: list[float], n: int) -> Estimate:
    if not values:
        return Estimate.exact(math.nan, 0)
    low, high = np.quantile(values, [0.05, 0.95])
    return Estimate(float(np.mean(values)), float(low), float(high), n)


def verdict_shares(
    calibration: Calibration, unsafe_score: np.ndarray, is_unsafe: np.ndarray
) -> dict[str, Estimate]:
    """Rates of the verdicts of a stored calibration on fresh episodes.

    Args:
        calibration: The calibration.
        unsafe_score: 1 - Γ of each episode, (N,), for the kind of the calibration.
        is_unsafe: Whether each ended unsafely, (N,).

    Returns:
        `promised_miss_rate`; `miss_rate` and `unsafe_unknown`, shares of the unsafe episodes;
        `safe_recall`, `safe_unknown` and `false_alarm_rate`, shares of the safe ones.
    """
    verdict = calibration.verdicts(1.0 - np.asarray(unsafe_score, dtype=float))
    label = np.asarray(is_unsafe, dtype=bool)

    def share(rows: np.ndarray, expected: str) -> Estimate:
        return proportion(int(np.sum(verdict[rows] == expected)), int(rows.sum()))

    promised = calibration.miss_rate
    return {
        "promised_miss_rate": Estimate.exact(promised, calibration.num_unsafe),
        "miss_rate": share(label, SAFE),
        "unsafe_unknown": share(label, UNKNOWN),
        "safe_recall": share(~label, SAFE),
        "safe_unknown": share(~label, UNKNOWN),
        "false_alarm_rate": share(~label, UNSAFE),
    }


@dataclass(frozen=True, kw_only=True, eq=False)
class Reliability:
    """Predicted probabilities against observed frequencies, by bin.

    Attributes:
        expected: Mean predicted probability of an unsafe end, (B,).
        observed: Share of unsafe ends, (B,).
        low: Lower end of its 95 % interval, (B,).
        high: Upper end, (B,).
        count: Number of episodes, (B,).
    """

    expected: np.ndarray
    observed: np.ndarray
    low: np.ndarray
    high: np.ndarray
    count: np.ndarray

    @property
    def calibration_error(self) -> float:
        """Expected calibration error: mean distance between predicted and observed values."""
        return float(self.count @ np.abs(self.expected - self.observed) / self.count.sum())


def reliability(
    unsafe_probability: np.ndarray, is_unsafe: np.ndarray, *, num_bins: int = 10
) -> Reliability:
    """Compares probabilities with outcomes in bins of equal numbers of episodes.

    Args:
        unsafe_probability: 1 - Γ of each episode, (N,), in [0, 1]; NaN counts as one.
        is_unsafe: Whether each ended unsafely, (N,).
        num_bins: Number of bins; fewer if episodes share probabilities.

    Raises:
        ValueError: There is no episode, or a probability outside [0, 1].
    """
    p = np.asarray(unsafe_probability, dtype=float)
    p = np.where(np.isnan(p), 1.0, p)
    label = np.asarray(is_unsafe, dtype=bool)
    if p.size == 0 or not np.all((p >= 0.0) & (p <= 1.0)):
        raise ValueError(
            f"reliability: expected probabilities in [0, 1], got {p.size} of them"
            + (f" in {p.min()}..{p.max()}" if p.size else "")
        )
    # Edges are occurring values, so that equal probabilities share a bin.
    edges = np.unique(np.quantile(p, np.linspace(0, 1, num_bins + 1)[1:-1], method="nearest"))
    members = np.searchsorted(edges, p, side="right")
    bins = np.unique(members)
    shares = [proportion(int(label[members == i].sum()), int(np.sum(members == i))) for i in bins]
    return Reliability(
        expected=np.array([p[members == i].mean() for i in bins]),
        observed=np.array([share.value for share in shares]),
        low=np.array([share.low for share in shares]),
        high=np.array([share.high for share in shares]),
        count=np.array([share.n for share in shares]),
    )
