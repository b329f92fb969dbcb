"""Thresholds with a promised miss rate: the share of unsafe episodes whose verdict is "safe".

Every episode has one score, because only episodes are independent. The threshold lies below the
k-th lowest score of n unsafe episodes, so that k - 1 of them are missed. Two rules choose k:

- Conformal, k = ⌊miss rate (n + 1)⌋: a new unsafe episode is missed with a probability of at most
  the miss rate, on average over calibration sets, as every rank is equally likely.
- With a confidence ("PAC"), the largest k with P(Binomial(n, miss rate) ≤ k - 1) ≤ 1 - confidence,
  Clopper and Pearson's bound: the promise holds for this calibration set with that confidence.

Both rules use one class alone and hold for any share of unsafe episodes.
"""

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from drake_safety.files.schema import Share, schema
from drake_safety.learning.segments import Segments, floats

SAFE, UNSAFE, UNKNOWN = "safe", "unsafe", "don't know"
Kind = Literal["plan", "motion"]
"""Score of an episode: that of its first row, at planning time, or that of its worst row."""
PLAN: Kind = "plan"
MOTION: Kind = "motion"
KINDS = (PLAN, MOTION)

_TEMPERATURES = (math.log(0.25), math.log(4.0))
_BELOW_ALL = 1e-6  # Distance of a threshold below the lowest score, robust against rounding.
# Below the lowest score, or above the highest one.
_Threshold = Annotated[float, Field(ge=-2.0 * _BELOW_ALL, le=1.0 + 2.0 * _BELOW_ALL)]
_Number = Annotated[int, Field(ge=0)]


@schema(frozen=True, kw_only=True)
class Calibration:
    """Two thresholds of the probability, and their promised rates.

    The verdict is "safe" for a probability of at least `threshold`, "unsafe" for one below
    `unsafe_below`, and "don't know" in between. The rates are promised for the plant `variation`.
    """

    kind: Kind
    miss_rate: Share  # Promised share of unsafe episodes with the verdict "safe".
    false_alarm_rate: Share  # Promised share of safe episodes with the verdict "unsafe".
    confidence: Share | None  # For this calibration set; None for rates on average.
    threshold: _Threshold
    unsafe_below: _Threshold
    num_unsafe: _Number
    num_safe: _Number
    num_missed: _Number
    num_accepted: _Number
    seed: int
    scenario_hash: str
    variation: str = "nominal"
    plants: _Number = 0  # Random plants, a fresh one for each episode; 0 for one plant.

    def __post_init__(self) -> None:
        if not self.unsafe_below <= self.threshold:
            raise ValueError(f"unsafe_below {self.unsafe_below} exceeds {self.threshold}")

    @property
    def key(self) -> str:
        """The kind, with ``.family`` for thresholds over a family's plants."""
        return f"{self.kind}.family" if self.plants else self.kind

    @property
    def promise(self) -> str:
        """The promised miss rate in words."""
        basis = "on average"
        if self.confidence is not None:
            basis = f"{100 * self.confidence:g} % confidence"
        where = f"on the plant '{self.variation}' as long as it behaves as in its episodes"
        if self.plants:
            where = "over plants drawn as the scenario's family draws them"
        return (
            f"at most {100 * self.miss_rate:g} % of unsafe episodes called safe, {basis}, {where}"
        )

    @property
    def origin(self) -> str:
        """Where the thresholds come from, in words."""
        number = self.num_unsafe + self.num_safe
        return f"calibrated on {number} episodes for a promised miss rate: {self.promise}"

    def verdicts(self, safety_probability: np.ndarray) -> np.ndarray:
        """Returns the verdicts for probabilities (N,) as strings; "don't know" for NaN.

        Pass NaN where the belief is "don't know": its probability of 0 is "unsafe" here.
        """
        probability = floats(safety_probability)
        verdicts = np.full(probability.shape, UNKNOWN, dtype=object)
        verdicts[probability >= self.threshold] = SAFE
        verdicts[probability < self.unsafe_below] = UNSAFE
        return verdicts


def calibrate(
    unsafe_score: np.ndarray,
    is_unsafe: np.ndarray,
    *,
    kind: Kind,
    miss_rate: float,
    false_alarm_rate: float = 0.05,
    confidence: float | None = None,
    seed: int = 0,
    scenario_hash: str = "",
    variation: str = "nominal",
    plants: int = 0,
) -> Calibration:
    """Chooses both thresholds on episodes that were not used for training, by scores (N,).

    A score is 1 - probability; NaN counts as most unsafe.
    """
    score, label = checked_scores(unsafe_score, is_unsafe)
    above = score_threshold(score, label, miss_rate, confidence=confidence)
    # The same rule for the safe class, with the order of the scores reversed.
    below = -score_threshold(-score, ~label, false_alarm_rate, confidence=confidence, whose="safe")
    return Calibration(
        kind=kind,
        miss_rate=miss_rate,
        false_alarm_rate=false_alarm_rate,
        confidence=confidence,
        threshold=1.0 - above,
        # If the classes are separable, no gap is left for "don't know".
        unsafe_below=1.0 - max(above, below),
        num_unsafe=int(label.sum()),
        num_safe=int((~label).sum()),
        num_missed=int(np.sum(score[label] <= above)),
        num_accepted=int(np.sum(score[~label] <= above)),
        seed=seed,
        scenario_hash=scenario_hash,
        variation=variation,
        plants=plants,
    )


def fitted_temperature(probability: np.ndarray, is_unsafe: np.ndarray) -> float:
    """The temperature T, at which ``logit / T`` predicts the labels (N,) best (Guo et al., 2017).

    The probabilities (N,) are of a safe end; rows with "don't know", which are 0, do not count.
    """
    from scipy.optimize import minimize_scalar

    is_used = (probability > 0.0) & (probability < 1.0)
    p, label = probability[is_used], is_unsafe[is_used]
    if not 0 < label.sum() < len(label):
        return 1.0
    logit = np.log1p(-p) - np.log(p)

    def loss(log_temperature: float) -> float:
        z = logit * math.exp(-log_temperature)
        return float(np.mean(np.logaddexp(0.0, z) - label * z))

    found = minimize_scalar(loss, bounds=_TEMPERATURES, method="bounded")
    return float(math.exp(found.x))


def score_threshold(
    unsafe_score: np.ndarray,
    is_unsafe: np.ndarray,
    miss_rate: float,
    *,
    confidence: float | None = None,
    whose: str = "unsafe",
) -> float:
    """Returns the highest score with the verdict "safe", between the k-th and the next lower one.

    The k-th lowest is of the unsafe scores, the next lower one of either label.
    """
    score, label = checked_scores(unsafe_score, is_unsafe)
    if not np.isfinite(score).any():
        raise ValueError(f"calibration: none of the {len(score)} scores is finite")
    unsafe = np.sort(score[label])
    rank = allowed_misses(unsafe.size, miss_rate, confidence=confidence) + 1
    if rank < 1:
        needed = episodes_needed(miss_rate, confidence=confidence)
        basis = "on average" if confidence is None else f"with a confidence of {confidence:g}"
        raise ValueError(
            f"calibration: a rate of {miss_rate:g} {basis} needs at least {needed} {whose} "
            f"episodes; of {len(score)} episodes {unsafe.size} are {whose}"
        )
    bound = unsafe[rank - 1]
    lower = score[np.isfinite(score) & (score < bound)]
    if math.isinf(bound):
        return float(lower.max()) if bound > 0.0 and lower.size else float(bound)
    return float(0.5 * (bound + lower.max()) if lower.size else bound - _BELOW_ALL)


def allowed_misses(num_unsafe: int, miss_rate: float, *, confidence: float | None = None) -> int:
    """Number of n unsafe episodes that may be missed, k - 1; -1 if n is too small."""
    check_share("miss_rate", miss_rate)
    if confidence is None:
        return math.floor(miss_rate * (num_unsafe + 1) + 1e-9) - 1
    check_share("confidence", confidence)
    from scipy.stats import binom

    # The quantile is the smallest count with P(X <= count) >= 1 - confidence.
    count = int(binom.ppf(1.0 - confidence, num_unsafe, miss_rate))
    is_met = binom.cdf(count, num_unsafe, miss_rate) <= (1.0 - confidence) * (1.0 + 1e-12)
    return count if is_met else count - 1


def episodes_needed(miss_rate: float, *, confidence: float | None = None) -> int:
    """Returns the least number of unsafe episodes for a promised miss rate."""
    check_share("miss_rate", miss_rate)
    if confidence is None:
        return math.ceil(1.0 / miss_rate - 1e-9) - 1
    check_share("confidence", confidence)
    return math.ceil(math.log1p(-confidence) / math.log1p(-miss_rate) - 1e-9)


def episode_scores(
    segments: Segments, unsafe_score: np.ndarray, kind: str
) -> tuple[np.ndarray, np.ndarray]:
    """Reduces unsafe scores of segments (N,), from every row, to score and label of each episode.

    A plan is assessed by its first row. A motion is unsafe as soon as one of its rows is.
    """
    if kind not in KINDS:
        raise ValueError(f"calibration: unknown kind '{kind}'; the kinds are {list(KINDS)}")
    score, label = checked_scores(unsafe_score, segments.is_unsafe)
    if kind == PLAN:
        return score[segments.is_first], label[segments.is_first]
    _, first, member = np.unique(segments.episode, return_index=True, return_inverse=True)
    worst = np.full(len(first), -math.inf)
    np.maximum.at(worst, member, score)
    return worst, label[first]


def checked_scores(
    unsafe_score: np.ndarray, is_unsafe: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Scores (N,), infinite where they are NaN, and boolean labels (N,)."""
    score, label = np.asarray(unsafe_score, dtype=float), np.asarray(is_unsafe)
    if label.dtype != bool or score.ndim != 1 or score.shape != label.shape:
        shapes = f"{score.shape} and {label.shape} of {label.dtype}"
        raise ValueError(f"expected scores and boolean labels, (N,) both; got {shapes}")
    return np.where(np.isnan(score), math.inf, score), label


def check_share(name: str, value: float) -> None:
    """Checks that a rate or confidence is between 0 and 1."""
    if not 0.0 < value < 1.0:
        raise ValueError(f"calibration: {name} is {value}, expected a value in (0, 1)")
