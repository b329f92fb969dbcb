"""Figures of merit with intervals that respect what is independent: episodes, not their segments.

A scorer gives every segment an unsafe score: a number that is larger where it expects an unsafe
end, such as 1 - Gamma. A segment is judged unsafe when its score exceeds a threshold, as a recovery
triggers on Gamma < Gamma_thre. A score that is NaN says "don't know", which counts as unsafe.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drake_safety.learning.segments import Segments

CRITERIA = ("balanced_accuracy", "equal_error")


@dataclass(frozen=True)
class Estimate:
    """A figure of merit and its interval.

    Attributes:
        value: The estimate; NaN where there is nothing to estimate it from.
        low: Lower end of the interval.
        high: Upper end of the interval.
        n: Number of independent samples behind it: episodes, throws, never segments.
    """

    value: float
    low: float
    high: float
    n: int

    def to_json(self) -> dict[str, float | int | None]:
        """The figure as JSON knows it; what is not finite becomes None."""
        fields = {"value": self.value, "low": self.low, "high": self.high}
        finite = {k: float(v) if math.isfinite(v) else None for k, v in fields.items()}
        return {**finite, "n": int(self.n)}


@dataclass(frozen=True, kw_only=True)
class Bootstrap:
    """How an interval is found by drawing the independent samples again, with replacement.

    Attributes:
        confidence: Of the interval.
        num_resamples: How often as many samples are drawn.
        seed: Of the draws.
    """

    confidence: float = 0.95
    num_resamples: int = 1000
    seed: int = 0

    @property
    def quantiles(self) -> list[float]:
        """The two shares of the draws that lie below the interval's ends."""
        return [0.5 - 0.5 * self.confidence, 0.5 + 0.5 * self.confidence]

    def over_episodes(
        self, statistic: Callable[[np.ndarray], float], episode: np.ndarray
    ) -> Estimate:
        """A statistic of weighted samples, and its percentiles when whole episodes are drawn again.

        Args:
            statistic: Takes the weight of each sample, (N,); NaN where it is not defined.
            episode: Which episode each sample belongs to, (N,).
        """
        members = np.unique(episode, return_inverse=True)[1]
        value = statistic(np.ones(len(members)))
        num_episodes = int(members.max()) + 1 if members.size else 0
        if math.isnan(value):
            return Estimate(math.nan, math.nan, math.nan, num_episodes)
        rng = np.random.default_rng(self.seed)
        shares = np.full(num_episodes, 1.0 / num_episodes)
        drawn = np.array(
            [
                statistic(rng.multinomial(num_episodes, shares)[members])
                for _ in range(self.num_resamples)
            ]
        )
        # A draw without one of the classes says nothing.
        low, high = np.quantile(drawn[~np.isnan(drawn)], self.quantiles)
        return Estimate(value, float(low), float(high), num_episodes)


_BOOTSTRAP = Bootstrap()
_MEDIAN_BOOTSTRAP = Bootstrap(num_resamples=2000)


def proportion(count: int, n: int, *, confidence: float = 0.95) -> Estimate:
    """The share `count` of `n` independent samples, with its Clopper-Pearson interval.

    Raises:
        ValueError: `count` is not in 0..n.
    """
    if not 0 <= count <= n:
        raise ValueError(f"proportion: count is {count}, expected 0..{n}")
    from scipy.stats import binomtest

    if n == 0:
        return Estimate(value=math.nan, low=0.0, high=1.0, n=0)
    interval = binomtest(count, n).proportion_ci(confidence, method="exact")
    return Estimate(value=count / n, low=float(interval.low), high=float(interval.high), n=int(n))


def median(values: np.ndarray, *, bootstrap: Bootstrap = _MEDIAN_BOOTSTRAP) -> Estimate:
    """The median of independent values (N,), with its bootstrap interval.

    Infinite values take part: a fall that never comes is later than any other.

    Raises:
        ValueError: A value is NaN.
    """
    values = np.sort(np.asarray(values, dtype=float))
    if np.isnan(values).any():
        raise ValueError(f"median: {np.isnan(values).sum()} of {values.size} values are NaN")
    if values.size == 0:
        return Estimate(math.nan, math.nan, math.nan, 0)
    rng = np.random.default_rng(bootstrap.seed)
    size = (bootstrap.num_resamples, values.size)
    drawn = np.sort(rng.integers(values.size, size=size), axis=1)
    # Order statistics, not interpolation, which would subtract infinities.
    low, high = np.quantile(_middle(values[drawn]), bootstrap.quantiles, method="nearest")
    return Estimate(float(_middle(values)), float(low), float(high), values.size)


def _middle(ordered: np.ndarray) -> np.ndarray:
    """Median along the last axis of what is already in order."""
    size = ordered.shape[-1]
    return 0.5 * (ordered[..., (size - 1) // 2] + ordered[..., size // 2])


def area_under_curve(
    unsafe_score: np.ndarray, is_unsafe: np.ndarray, weight: np.ndarray | None = None
) -> float:
    """Area under the ROC curve: how often an unsafe sample scores above a safe one, ties half.

    Args:
        unsafe_score: Unsafe scores, (N,); NaN counts as the most unsafe of all.
        is_unsafe: Labels, (N,).
        weight: Weights, (N,); one each by default.

    Returns:
        The area; NaN unless both classes have weight.
    """
    score, label = _checked("area_under_curve", unsafe_score, is_unsafe)
    rank = _ranks(score)
    weight = np.ones(len(score)) if weight is None else np.asarray(weight, dtype=float)
    return _ranked_area(rank, label, weight)


def auc(
    unsafe_score: np.ndarray,
    is_unsafe: np.ndarray,
    episode: np.ndarray,
    *,
    bootstrap: Bootstrap = _BOOTSTRAP,
) -> Estimate:
    """The area under the ROC curve, with an interval from a bootstrap over episodes.

    Where the scores of unsafe and safe samples do not overlap the bootstrap sees no spread, and low
    is 1 as well.

    Args:
        unsafe_score: Unsafe scores, (N,).
        is_unsafe: Labels, (N,).
        episode: Which episode each sample belongs to, (N,).
        bootstrap: How the interval is found.
    """
    score, label = _checked("auc", unsafe_score, is_unsafe, episode)
    rank = _ranks(score)

    def area(weight: np.ndarray) -> float:
        return _ranked_area(rank, label, weight)

    return bootstrap.over_episodes(area, episode)


def auc_difference(
    unsafe_score: np.ndarray,
    other_score: np.ndarray,
    is_unsafe: np.ndarray,
    episode: np.ndarray,
    *,
    bootstrap: Bootstrap = _BOOTSTRAP,
) -> Estimate:
    """By how much one scorer's area exceeds another's on the same samples, resampled in pairs.

    Args:
        unsafe_score: Unsafe scores of the one, (N,).
        other_score: Unsafe scores of the other, (N,).
        is_unsafe: Labels, (N,).
        episode: Which episode each sample belongs to, (N,).
        bootstrap: How the interval is found.
    """
    score, label = _checked("auc_difference", unsafe_score, is_unsafe, episode)
    other, _ = _checked("auc_difference", other_score, is_unsafe)
    rank, other_rank = _ranks(score), _ranks(other)

    def difference(weight: np.ndarray) -> float:
        return _ranked_area(rank, label, weight) - _ranked_area(other_rank, label, weight)

    return bootstrap.over_episodes(difference, episode)


def segment_estimates(
    segments: Segments,
    unsafe_score: np.ndarray,
    *,
    threshold: float,
    is_probability: bool = True,
    bootstrap: Bootstrap = _BOOTSTRAP,
) -> dict[str, Estimate]:
    """How well a scorer tells segments that lead to an unsafe end from those that do not.

    The segments of one episode are not independent: every interval is a bootstrap over episodes.
    Recalls have Clopper-Pearson's interval where that is exact, as each episode has one sample
    (k = 0 alone: `segments.take(segments.is_first)`), and for as many episodes where there is not
    a single error (or hit), and so no spread to resample.

    Args:
        segments: The N segments, as `split(episodes, stride=1, ...)` gives them.
        unsafe_score: Unsafe score of each, (N,).
        threshold: Above it a segment is judged unsafe.
        is_probability: Whether the scores are probabilities, and there is a Brier score.
        bootstrap: How the intervals are found.

    Returns:
        `auc`, `safe_recall`, `unsafe_recall`, and `brier` for probabilities.

    Raises:
        ValueError: Not one score a segment, or a probability outside [0, 1].
    """
    score, label = _checked("segment_estimates", unsafe_score, segments.is_unsafe)
    episode = segments.episode

    def mean(values: np.ndarray, rows: np.ndarray) -> Estimate:
        values, members = values[rows].astype(float), episode[rows]

        def average(weight: np.ndarray) -> float:
            total = weight.sum()
            return float(weight @ values / total) if total else math.nan

        return bootstrap.over_episodes(average, members)

    def recall(is_right: np.ndarray, rows: np.ndarray) -> Estimate:
        num_right, num_samples = int(is_right[rows].sum()), int(rows.sum())
        num_episodes = len(np.unique(episode[rows]))
        confidence = bootstrap.confidence
        if num_samples == num_episodes:
            return proportion(num_right, num_samples, confidence=confidence)
        if num_right in (0, num_samples):
            count = num_episodes if num_right else 0
            return proportion(count, num_episodes, confidence=confidence)
        return mean(is_right, rows)

    estimates = {
        "auc": auc(score, label, episode, bootstrap=bootstrap),
        "safe_recall": recall(score <= threshold, ~label),
        "unsafe_recall": recall(score > threshold, label),
    }
    if is_probability:
        squared = _squared_error("segment_estimates", score, label)
        estimates["brier"] = mean(squared, np.ones(len(label), dtype=bool))
    return estimates


def threshold_at(
    unsafe_score: np.ndarray, is_unsafe: np.ndarray, criterion: str = "balanced_accuracy"
) -> float:
    """Chooses a threshold; choose it on other samples than those it is then judged by.

    Args:
        unsafe_score: Unsafe scores, (N,).
        is_unsafe: Labels, (N,).
        criterion: "balanced_accuracy" makes the mean of both recalls as large as it gets;
            "equal_error" makes the recalls as equal as they get.

    Returns:
        A threshold midway between two scores. Of equally good ones it is the middle one.

    Raises:
        ValueError: Unknown criterion, or one of the classes is missing.
    """
    if criterion not in CRITERIA:
        raise ValueError(
            f"threshold_at: unknown criterion '{criterion}'; the criteria are {list(CRITERIA)}"
        )
    score, label = _checked("threshold_at", unsafe_score, is_unsafe)
    num_unsafe = int(label.sum())
    if num_unsafe in (0, len(label)):
        raise ValueError(
            f"threshold_at: {num_unsafe} of {len(label)} samples are unsafe; it takes both classes"
        )
    values, rank = np.unique(score, return_inverse=True)
    # After value i: how many of each class lie at or below it, and so are judged safe.
    below_unsafe = np.cumsum(np.bincount(rank, weights=label, minlength=len(values)))
    below_safe = np.cumsum(np.bincount(rank, weights=~label, minlength=len(values)))
    unsafe_recall = 1.0 - np.concatenate([[0.0], below_unsafe]) / num_unsafe
    safe_recall = np.concatenate([[0.0], below_safe]) / (len(label) - num_unsafe)
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        raise ValueError(f"threshold_at: none of the {len(score)} scores is finite")
    lowest = np.nextafter(finite[0], -math.inf)
    middle = 0.5 * (finite[:-1] + finite[1:])
    # What is infinitely unsafe stays above every threshold.
    candidates = np.concatenate([[lowest], middle, [finite[-1]]])
    unsafe_recall, safe_recall = (r[: len(candidates)] for r in (unsafe_recall, safe_recall))
    balanced = 0.5 * (unsafe_recall + safe_recall)
    merit = balanced
    if criterion == "equal_error":
        merit = -np.abs(unsafe_recall - safe_recall) + 1e-6 * balanced
    best = np.flatnonzero(merit >= merit.max() - 1e-12)
    return float(candidates[best[(len(best) - 1) // 2]])


def _checked(
    who: str, unsafe_score: np.ndarray, is_unsafe: np.ndarray, episode: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    score = np.asarray(unsafe_score, dtype=float)
    label = np.asarray(is_unsafe)
    if label.dtype != bool:
        raise ValueError(f"{who}: labels must be boolean, got {label.dtype}")
    shapes = [score.shape, label.shape] + ([] if episode is None else [np.shape(episode)])
    if score.ndim != 1 or len(set(shapes)) != 1:
        raise ValueError(f"{who}: scores, labels and episodes must be as many, got {shapes}")
    return np.where(np.isnan(score), math.inf, score), label


def _squared_error(who: str, score: np.ndarray, label: np.ndarray) -> np.ndarray:
    probability = np.where(np.isposinf(score), 1.0, score)
    if not np.all((probability >= 0.0) & (probability <= 1.0)):
        raise ValueError(
            f"{who}: probabilities must lie in [0, 1], got {probability.min()}.."
            f"{probability.max()}; scores of another kind take is_probability=False"
        )
    return (probability - label) ** 2


def _ranks(score: np.ndarray) -> np.ndarray:
    return np.unique(score, return_inverse=True)[1]


def _ranked_area(rank: np.ndarray, label: np.ndarray, weight: np.ndarray) -> float:
    if rank.size == 0:
        return math.nan
    unsafe = np.bincount(rank, weights=weight * label)
    safe = np.bincount(rank, weights=weight * ~label)
    pairs = unsafe.sum() * safe.sum()
    if pairs == 0.0:
        return math.nan
    # A safe sample below counts one, a tie half.
    return float(unsafe @ (np.cumsum(safe) - 0.5 * safe) / pairs)
