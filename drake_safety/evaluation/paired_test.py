"""Sequential tests of paired outcomes, valid for any number of looks and any time of stopping.

An *e-process* is a nonnegative supermartingale that starts at 1. By Ville's inequality it ever
reaches 1/α under its null hypothesis with a probability of at most α. Source: Ramdas, Grünwald,
Vovk and Shafer, Game-theoretic statistics and safe anytime-valid inference, Stat. Science 2023.
"""

import math
from collections.abc import Sequence

import numpy as np

from drake_safety.evaluation.metrics import Estimate

_SHARES = 0.95 * 0.5 ** np.arange(8)
"""Shares u of the capital to bet. Large shares have larger weights: failures are rare."""
_WEIGHTS = np.sqrt(_SHARES) / np.sqrt(_SHARES).sum()
_EDGE = 1e-9  # Distance from the ends of the range of means, where a bet would be infinite.


def betting_log_e(values: np.ndarray, counts: np.ndarray, mean: float) -> np.ndarray:
    """Logarithm of the capital of bets that the mean of outcomes in [-1, 1] is above m.

    Values are (V,), their counts (..., V). The factor of an outcome d is 1 + λ(d - m) with
    λ = u / (1 + m) for a share u of the capital. The capital is a weighted mean over fixed shares,
    and monotone in m. Source: Waudby-Smith and Ramdas, Estimating means of bounded random variables
    by betting, JRSS B 2024.
    """
    from scipy.special import logsumexp

    factors = 1.0 - _SHARES + _SHARES * (1.0 + values[:, None]) / (1.0 + mean)
    log_e: np.ndarray = logsumexp(np.asarray(counts) @ np.log(factors), axis=-1, b=_WEIGHTS)
    return log_e


def interim_estimate(
    outcomes: Sequence[float], before: Sequence[Estimate], alpha: float
) -> Estimate:
    """A look at a confidence sequence: the mean of all outcomes so far, (N,) in ±1, and its ends.

    Each end holds at all looks at once with a probability of at least 1 - alpha, and both with
    1 - 2 alpha. Means that an earlier look excluded stay excluded.
    """
    values, counts = np.unique(outcomes, return_counts=True)
    low, high = (sign * _low(sign * values, counts, alpha) for sign in (1.0, -1.0))
    low = max([low, *(one.low for one in before[-1:])])
    high = min([high, *(one.high for one in before[-1:])])
    return Estimate(float(np.mean(outcomes)), low, high, len(outcomes))


def _low(values: np.ndarray, counts: np.ndarray, alpha: float) -> float:
    """The mean up to which bets that it is above have won 1 / alpha."""
    from scipy.optimize import brentq

    def excess(mean: float) -> float:
        return float(betting_log_e(values, counts, mean)) + math.log(alpha)

    edge = 1.0 - _EDGE
    if excess(-edge) <= 0.0:
        return -1.0
    # At the mean of the outcomes no bet has won.
    mean = float(np.clip(values @ counts / counts.sum(), -edge, edge))
    return float(brentq(excess, -edge, mean, xtol=1e-12))
