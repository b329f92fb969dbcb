"""A threshold of the probability that follows an actual robot: online conformal prediction."""

from __future__ import annotations

import math

from drake_safety.learning.calibration import Calibration

_LOGIT_LIMIT = 12.0  # The probability is clipped to within this logit.


class AdaptiveThreshold:
    """Adjusts the threshold of a promise after every episode that ends unsafely.

    A miss raises the threshold's logit by ``step (1 - α)``, an unsafe episode that was not called
    safe lowers it by ``step α``, where α is the promised miss rate (Gibbs and Candès 2021; in this
    form Angelopoulos, Candès and Tibshirani 2023). Of T unsafe episodes at most
    ``α + (24 / step + 1) / T`` are missed, under any shift; the price is the share of safe episodes
    that are called safe. The bound counts every unsafe episode: where plans that are refused are
    never carried out, only misses are seen, and the threshold only rises.

    Args:
        calibration: The promise, with the initial threshold.
        step: Step of the threshold's logit; larger ones follow faster, and vary more.

    Raises:
        ValueError: The step is not positive.
    """

    def __init__(self, calibration: Calibration, step: float = 1.0):
        if not 0.0 < step < math.inf:
            raise ValueError(f"adaptive threshold: step must be positive; got {step}")
        self._miss_rate, self._step = calibration.miss_rate, step
        self._logit = _logit(calibration.threshold)

    @property
    def threshold(self) -> float:
        """Present lower bound of the probability for "safe"; above 1 if none is."""
        if self._logit > _LOGIT_LIMIT:
            return math.nextafter(1.0, 2.0)
        return 1.0 / (1.0 + math.exp(-self._logit))

    def is_safe(self, safety_probability: float) -> bool:
        """Whether the verdict on the probability is "safe"; never for NaN."""
        return _logit(safety_probability) >= self._logit

    def update(self, safety_probability: float, is_unsafe: bool) -> None:
        """Takes in the outcome of an episode; a safe one changes nothing."""
        if is_unsafe:
            missed = self.is_safe(safety_probability)
            self._logit += self._step * (missed - self._miss_rate)


def _logit(probability: float) -> float:
    if math.isnan(probability):
        return -math.inf
    least = 1.0 / (1.0 + math.exp(_LOGIT_LIMIT))
    clipped = min(max(probability, least), 1.0 - least)
    return math.log(clipped / (1.0 - clipped))
