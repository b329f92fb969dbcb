"""Thresholds with a promised miss rate: how often an unsafe episode may be called safe.

An episode has one score, however many segments it has: only episodes are independent. Of the
scores of n unsafe episodes a threshold stays below the k-th lowest, so that k - 1 of them are
missed. How large k may be is what the two rules differ in.

Conformal: of n episodes and one more, drawn alike, each is as likely as any other to have the k-th
lowest score. With k = ⌊miss rate (n + 1)⌋ the further one is missed with a probability of at most
the miss rate, on average over calibration sets.

With a confidence ("PAC"): k is the largest for which Clopper and Pearson's upper bound of the miss
rate, k - 1 of n being missed, does not exceed the promise: P(Binomial(n, miss rate) ≤ k - 1) ≤
1 - confidence. It then holds for this calibration set, with that confidence.

Either rule looks at one class alone, so it holds whatever the share of unsafe episodes is.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from drake_safety.learning.segments import Segments

SAFE, UNSAFE, UNKNOWN = "safe", "unsafe", "don't know"
"""The verdicts."""
PLAN, MOTION = "plan", "motion"
"""What an episode is scored by: its first row, when the plan is made, or its worst row of all."""
KINDS = (PLAN, MOTION)

_BELOW_ALL = 1e-6  # By how much a threshold stays below the lowest score, wherever it is rounded.


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Two thresholds of Γ = b_safe / (1 - μ), and what they promise.

    Γ ≥ `threshold` is safe, Γ < `unsafe_below` unsafe, and between them the answer is "don't
    know".

    Attributes:
        kind: "plan" or "motion": what an episode was scored by.
        miss_rate: Promised share of unsafe episodes called safe.
        false_alarm_rate: Promised share of safe episodes called unsafe.
        confidence: With which both hold for this calibration set; None for on average over sets.
        threshold: From which Γ on the verdict is safe.
        unsafe_below: Below which Γ the verdict is unsafe; at most `threshold`.
        num_unsafe: Unsafe episodes it was made with.
        num_safe: Safe ones.
        num_missed: How many of these unsafe episodes are called safe.
        num_accepted: How many of these safe ones are.
        seed: Seed of the episodes.
        scenario_hash: Of the simulation they came from.
    """

    kind: str
    miss_rate: float
    false_alarm_rate: float
    confidence: float | None
    threshold: float
    unsafe_below: float
    num_unsafe: int
    num_safe: int
    num_missed: int
    num_accepted: int
    seed: int
    scenario_hash: str

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(
                f"calibration: unknown kind '{self.kind}'; the kinds are {list(KINDS)}"
            )
        if not self.unsafe_below <= self.threshold:
            raise ValueError(
                f"calibration: unsafe_below is {self.unsafe_below}, expected at most the threshold "
                f"{self.threshold}"
            )

    @property
    def promise(self) -> str:
        """What it promises, in words."""
        how = "on average" if self.confidence is None else f"{100 * self.confidence:g} % confidence"
        return f"at most {100 * self.miss_rate:g} % of unsafe episodes called safe, {how}"

    def verdicts(self, safety_probability: np.ndarray) -> np.ndarray:
        """The verdicts on Γ (N,), as words; on NaN it is "don't know"."""
        gamma = np.asarray(safety_probability, dtype=float)
        verdicts = np.full(gamma.shape, UNKNOWN, dtype=object)
        verdicts[gamma >= self.threshold] = SAFE
        verdicts[gamma < self.unsafe_below] = UNSAFE
        return verdicts

    def to_json(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)


def calibrate(
    unsafe_score: np.ndarray,
    is_unsafe: np.ndarray,
    *,
    kind: str,
    miss_rate: float,
    false_alarm_rate: float = 0.05,
    confidence: float | None = None,
    seed: int = 0,
    scenario_hash: str = "",
) -> Calibration:
    """Chooses both thresholds on episodes that Γ has not learned from.

    Args:
        unsafe_score: 1 - Γ of each episode, (N,); NaN counts as the most unsafe of all.
        is_unsafe: Whether each ended unsafely, (N,).
        kind: What the episodes were scored by.
        miss_rate: Promised share of unsafe episodes called safe, in (0, 1).
        false_alarm_rate: Promised share of safe episodes called unsafe, in (0, 1).
        confidence: With which both shall hold, in (0, 1); None for on average.
        seed: Seed of the episodes.
        scenario_hash: Of the simulation they came from.

    Raises:
        ValueError: Too few unsafe or safe episodes for what is promised; says how many it takes.
    """
    score, label = _checked(unsafe_score, is_unsafe)
    above = score_threshold(score, label, miss_rate, confidence=confidence)
    # The same rule for the other class, whose scores count from the other end.
    below = -score_threshold(-score, ~label, false_alarm_rate, confidence=confidence, whose="safe")
    return Calibration(
        kind=kind,
        miss_rate=miss_rate,
        false_alarm_rate=false_alarm_rate,
        confidence=confidence,
        threshold=1.0 - above,
        # Where the classes lie apart, what is not safe is unsafe.
        unsafe_below=1.0 - max(above, below),
        num_unsafe=int(label.sum()),
        num_safe=int((~label).sum()),
        num_missed=int(np.sum(score[label] <= above)),
        num_accepted=int(np.sum(score[~label] <= above)),
        seed=seed,
        scenario_hash=scenario_hash,
    )


def score_threshold(
    unsafe_score: np.ndarray,
    is_unsafe: np.ndarray,
    miss_rate: float,
    *,
    confidence: float | None = None,
    whose: str = "unsafe",
) -> float:
    """The highest score that may be called safe for a promised miss rate.

    Args:
        unsafe_score: Unsafe scores, (N,); NaN counts as the most unsafe of all.
        is_unsafe: Labels, (N,).
        miss_rate: Promised share of unsafe samples that score at most the threshold, in (0, 1).
        confidence: With which it shall hold, in (0, 1); None for on average.
        whose: What the samples with the label are called in an error.

    Returns:
        A threshold midway between the score it must stay below and the next lower one, of either
        label; just below it when there is none.

    Raises:
        ValueError: Too few samples have the label, no score is finite, or a share is not in (0,
            1).
    """
    score, label = _checked(unsafe_score, is_unsafe)
    if not np.isfinite(score).any():
        raise ValueError(f"calibration: none of the {len(score)} scores is finite")
    found = np.sort(score[label])
    rank = allowed_misses(found.size, miss_rate, confidence=confidence) + 1
    if rank < 1:
        needed = episodes_needed(miss_rate, confidence=confidence)
        how = "on average" if confidence is None else f"with a confidence of {confidence:g}"
        raise ValueError(
            f"calibration: a rate of {miss_rate:g} {how} takes at least {needed} {whose} episodes; "
            f"of {len(score)} episodes {found.size} are {whose}"
        )
    bound = found[rank - 1]
    lower = score[np.isfinite(score) & (score < bound)]
    if math.isinf(bound):
        return float(lower.max()) if bound > 0.0 and lower.size else float(bound)
    return float(0.5 * (bound + lower.max()) if lower.size else bound - _BELOW_ALL)


def allowed_misses(num_unsafe: int, miss_rate: float, *, confidence: float | None = None) -> int:
    """How many of n unsafe episodes a threshold may miss; -1 if n are too few for the promise.

    Args:
        num_unsafe: n.
        miss_rate: The rate that is promised, in (0, 1).
        confidence: With which it shall hold, in (0, 1); None for on average.

    Raises:
        ValueError: A share is not in (0, 1).
    """
    _check_share("miss_rate", miss_rate)
    if confidence is None:
        return math.floor(miss_rate * (num_unsafe + 1) + 1e-9) - 1
    _check_share("confidence", confidence)
    from scipy.stats import binom

    # The quantile is the smallest count with P(X <= count) >= 1 - confidence.
    count = int(binom.ppf(1.0 - confidence, num_unsafe, miss_rate))
    is_met = binom.cdf(count, num_unsafe, miss_rate) <= (1.0 - confidence) * (1.0 + 1e-12)
    return count if is_met else count - 1


def episodes_needed(miss_rate: float, *, confidence: float | None = None) -> int:
    """The least number of unsafe episodes with which a miss rate can be promised.

    Args:
        miss_rate: The rate that is promised, in (0, 1).
        confidence: With which it shall hold, in (0, 1); None for on average.

    Raises:
        ValueError: A share is not in (0, 1).
    """
    _check_share("miss_rate", miss_rate)
    if confidence is None:
        return math.ceil(1.0 / miss_rate - 1e-9) - 1
    _check_share("confidence", confidence)
    return math.ceil(math.log1p(-confidence) / math.log1p(-miss_rate) - 1e-9)


def least_miss_rate(num_unsafe: int) -> float:
    """The lowest miss rate that n unsafe episodes can promise on average: none is missed."""
    return 1.0 / (num_unsafe + 1)


def episode_scores(
    segments: Segments, unsafe_score: np.ndarray, kind: str
) -> tuple[np.ndarray, np.ndarray]:
    """One score an episode.

    A plan is judged once, by its first row. A motion is watched: it is called unsafe as soon as one
    row is, so its score is the largest of all.

    Args:
        segments: The N segments of some episodes, every row of them.
        unsafe_score: Unsafe score of each, (N,); NaN counts as the most unsafe of all.
        kind: "plan" or "motion".

    Returns:
        Score and label of each episode that has segments, (M,) each.

    Raises:
        ValueError: Unknown kind.
    """
    if kind not in KINDS:
        raise ValueError(f"calibration: unknown kind '{kind}'; the kinds are {list(KINDS)}")
    score, label = _checked(unsafe_score, segments.is_unsafe)
    if kind == PLAN:
        return score[segments.is_first], label[segments.is_first]
    _, first, member = np.unique(segments.episode, return_index=True, return_inverse=True)
    worst = np.full(len(first), -math.inf)
    np.maximum.at(worst, member, score)
    return worst, label[first]


def _checked(unsafe_score: np.ndarray, is_unsafe: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    score, label = np.asarray(unsafe_score, dtype=float), np.asarray(is_unsafe)
    if label.dtype != bool:
        raise ValueError(f"calibration: labels must be boolean, got {label.dtype}")
    if score.ndim != 1 or score.shape != label.shape:
        raise ValueError(
            f"calibration: scores and labels must be as many, got {score.shape} and {label.shape}"
        )
    return np.where(np.isnan(score), math.inf, score), label


def _check_share(name: str, value: float) -> None:
    if not 0.0 < value < 1.0:
        raise ValueError(f"calibration: {name} is {value}, expected a value in (0, 1)")
