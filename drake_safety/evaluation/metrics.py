"""Metrics with confidence intervals over episodes: the segments of one are not independent.

A scorer gives every segment an unsafe score, such as 1 - Γ: larger means an unsafe end is more
likely. A segment is classified unsafe when its score exceeds a threshold, as a recovery triggers on
Γ < Γ_thre. A NaN score means "don't know" and counts as unsafe.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from drake_safety.learning.calibration import checked_scores
from drake_safety.learning.segments import Segments


@dataclass(frozen=True)
class Estimate:
    """An estimated value, NaN without samples, and its interval."""

    value: float
    low: float
    high: float
    n: int  # Number of independent samples: episodes or throws, never segments.

    @classmethod
    def exact(cls, value: float, n: int) -> Estimate:
        """A value without uncertainty, such as a threshold: both ends of the interval equal it."""
        return cls(value, value, value, n)


_CONFIDENCE = 0.95  # All intervals.
_ENDS = [0.5 - 0.5 * _CONFIDENCE, 0.5 + 0.5 * _CONFIDENCE]


@dataclass(frozen=True, kw_only=True)
class Bootstrap:
    """Bootstrap intervals: percentiles over resamples of the independent samples."""

    num_resamples: int = 1000
    seed: int = 0

    def over_episodes(
        self, statistic: Callable[[np.ndarray], float], episode: np.ndarray
    ) -> Estimate:
        """A statistic of weights (N,), or NaN, by resampling the episodes of samples, (N,)."""
        members = np.unique(episode, return_inverse=True)[1]
        value = statistic(np.ones(len(members)))
        num_episodes = int(members.max()) + 1 if members.size else 0
        if math.isnan(value):
            return Estimate.exact(math.nan, num_episodes)
        rng = np.random.default_rng(self.seed)
        shares = np.full(num_episodes, 1.0 / num_episodes)
        weights = (rng.multinomial(num_episodes, shares) for _ in range(self.num_resamples))
        drawn = np.array([statistic(one[members]) for one in weights])
        # A resample without one of the classes has no value.
        low, high = np.quantile(drawn[~np.isnan(drawn)], _ENDS)
        return Estimate(value, float(low), float(high), num_episodes)

    def over_values(
        self, statistic: Callable[[np.ndarray], np.ndarray], values: np.ndarray
    ) -> Estimate:
        """A statistic along the last axis of independent values (N,), some perhaps infinite."""
        rng = np.random.default_rng(self.seed)
        drawn = values[rng.integers(values.size, size=(self.num_resamples, values.size))]
        # Without interpolation, which would subtract infinities.
        low, high = np.quantile(statistic(drawn), _ENDS, method="nearest")
        return Estimate(float(statistic(values)), float(low), float(high), values.size)


_BOOTSTRAP = Bootstrap()


def proportion(count: int, n: int) -> Estimate:
    """The share `count` of `n` independent samples, with its Clopper-Pearson interval."""
    from scipy.stats import binomtest

    if n == 0:
        return Estimate(value=math.nan, low=0.0, high=1.0, n=0)
    interval = binomtest(count, n).proportion_ci(_CONFIDENCE, method="exact")
    return Estimate(value=count / n, low=float(interval.low), high=float(interval.high), n=int(n))


def median(values: np.ndarray) -> Estimate:
    """The median of independent values (N,), some perhaps infinite, with its bootstrap interval."""
    if values.size == 0:
        return Estimate.exact(math.nan, 0)
    bootstrap = Bootstrap(num_resamples=2000)
    return bootstrap.over_values(partial(np.median, axis=-1), np.sort(values))


def quantile(values: np.ndarray, share: float, *, bootstrap: Bootstrap) -> Estimate:
    """A quantile of independent values (N,), some infinite, with its bootstrap interval."""
    return bootstrap.over_values(partial(np.quantile, q=share, axis=-1, method="higher"), values)


def rate_per_hour(count: float, duration_s: float, n: int) -> Estimate:
    """Events per hour on n motions, with the exact interval of a Poisson process."""
    from scipy.stats import chi2

    if not duration_s > 0:
        return Estimate.exact(math.nan, n)
    hours = duration_s / 3600.0
    low = 0.5 * chi2.ppf(_ENDS[0], 2 * count) if count else 0.0
    high = 0.5 * chi2.ppf(_ENDS[1], 2 * count + 2)
    return Estimate(count / hours, float(low / hours), float(high / hours), n)


def area_under_curve(
    unsafe_score: np.ndarray, is_unsafe: np.ndarray
) -> Callable[[np.ndarray], float]:
    """Area under the ROC curve as a function of the samples' weights, (N,); a tie counts half."""
    score, label = checked_scores(unsafe_score, is_unsafe)
    rank = np.unique(score, return_inverse=True)[1]

    def area(weight: np.ndarray) -> float:
        unsafe, safe = (np.bincount(rank, weights=weight * one) for one in (label, ~label))
        pairs = unsafe.sum() * safe.sum()
        # A safe sample below counts one, a tie half.
        won = unsafe @ (np.cumsum(safe) - 0.5 * safe)
        return float(won / pairs) if pairs else math.nan

    return area


def auc(
    unsafe_score: np.ndarray,
    is_unsafe: np.ndarray,
    episode: np.ndarray,
    *,
    bootstrap: Bootstrap = _BOOTSTRAP,
) -> Estimate:
    """The area under the ROC curve of samples (N,), with a bootstrap over their episodes (N,)."""
    return bootstrap.over_episodes(area_under_curve(unsafe_score, is_unsafe), episode)


def share(
    is_hit: np.ndarray, episode: np.ndarray, *, bootstrap: Bootstrap = _BOOTSTRAP
) -> Estimate:
    """The share of samples (N,) that hit, with an interval over their episodes (N,)."""
    num_hits, num_samples = int(is_hit.sum()), len(is_hit)
    if num_samples == (num_episodes := len(np.unique(episode))):
        return proportion(num_hits, num_samples)
    if num_hits in (0, num_samples):  # Resampling has no spread.
        return proportion(num_episodes if num_hits else 0, num_episodes)
    return mean(is_hit, episode, bootstrap=bootstrap)


def mean(values: np.ndarray, episode: np.ndarray, *, bootstrap: Bootstrap) -> Estimate:
    """The mean of the values of samples (N,), with an interval over their episodes (N,)."""

    def average(weight: np.ndarray) -> float:
        total = weight.sum()
        return float(weight @ values / total) if total else math.nan

    return bootstrap.over_episodes(average, episode)


def segment_estimates(
    segments: Segments, unsafe_score: np.ndarray, *, threshold: float
) -> dict[str, Estimate]:
    """AUC, recalls and Brier score of unsafe scores (N,) in [0, 1], unsafe above the threshold."""
    score, label = checked_scores(unsafe_score, segments.is_unsafe)
    episode, probability = segments.episode, np.minimum(score, 1.0)  # "Don't know" is infinite.
    return {
        "auc": auc(score, label, episode),
        "safe_recall": share((score <= threshold)[~label], episode[~label]),
        "unsafe_recall": share((score > threshold)[label], episode[label]),
        "brier": mean((probability - label) ** 2, episode, bootstrap=_BOOTSTRAP),
    }


def threshold_at(unsafe_score: np.ndarray, is_unsafe: np.ndarray) -> float:
    """The threshold of scores (N,) with the best balanced accuracy, midway between two scores."""
    score, label = checked_scores(unsafe_score, is_unsafe)
    finite = np.unique(score[np.isfinite(score)])
    if label.all() or not label.any() or finite.size == 0:
        numbers = f"{label.sum()} of {len(label)}"
        raise ValueError(f"a threshold takes both classes; got {numbers} unsafe")
    middle = 0.5 * (finite[:-1] + finite[1:])
    # Infinite scores stay above every threshold.
    candidates = np.array([np.nextafter(finite[0], -math.inf), *middle, finite[-1]])
    safe_recall, miss_rate = (
        np.searchsorted(np.sort(one), candidates, side="right") / len(one)
        for one in (score[~label], score[label])
    )
    balanced = 0.5 * (safe_recall + 1.0 - miss_rate)
    best = np.flatnonzero(balanced >= balanced.max() - 1e-12)
    return float(candidates[best[(len(best) - 1) // 2]])
