"""Sequential tests of paired outcomes, valid however often one looks and whenever one stops.

By Ville's inequality a nonnegative supermartingale that starts at 1, an *e-process*, reaches 1/α
under its null hypothesis with a probability of at most α, at any time (Ramdas, Grünwald, Vovk and
Shafer, Game-theoretic statistics and safe anytime-valid inference, Statistical Science 2023).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

_SHARES = 0.95 * 0.5 ** np.arange(8)
"""Shares u of the capital that are bet. Large ones have larger weights: failures are rare."""
_WEIGHTS = np.sqrt(_SHARES) / np.sqrt(_SHARES).sum()
_EDGE = 1e-9  # Of the range of means, where a bet would be infinite.


def betting_log_e(
    values: np.ndarray, counts: np.ndarray, mean: float, *, is_above: bool
) -> np.ndarray:
    """Logarithm of the capital of bets against a mean of outcomes in [-1, 1].

    Against means of at most m the factor of an outcome d is 1 + λ(d - m) with λ = u / (1 + m),
    against means of at least m it is 1 - λ(d - m) with λ = u / (1 - m); the capital is a weighted
    mean over fixed shares u. It is monotone in m (Waudby-Smith and Ramdas, Estimating means of
    bounded random variables by betting, JRSS B 2024). Of outcomes -1, 0 and 1 and m = 0 it is a
    mixture of likelihood ratios of the discordant pairs alone, to one half.

    Args:
        values: The different outcomes, (V,).
        counts: How often each was seen, (..., V).
        mean: m, in (-1, 1).
        is_above: Whether the bets are that the mean is above m.
    """
    from scipy.special import logsumexp

    sign = 1.0 if is_above else -1.0
    factors = 1.0 - _SHARES + _SHARES * (1.0 + sign * values[:, None]) / (1.0 + sign * mean)
    log_e: np.ndarray = logsumexp(np.asarray(counts) @ np.log(factors), axis=-1, b=_WEIGHTS)
    return log_e


@dataclass
class ConfidenceSequence:
    """A confidence sequence of the mean of outcomes in [-bound, bound], one row a look.

    Each end holds at all looks at once with a probability of at least 1 - alpha, and both with
    1 - 2 alpha.

    Attributes:
        pairs: Number of outcomes at each look.
        mean: Their means; `low` and `high` are the ends.
    """

    alpha: float
    bound: float = 1.0
    pairs: list[int] = field(default_factory=list)
    mean: list[float] = field(default_factory=list)
    low: list[float] = field(default_factory=list)
    high: list[float] = field(default_factory=list)

    def look(self, outcomes: np.ndarray) -> None:
        """Adds a look at all outcomes so far, (N,).

        Raises:
            ValueError: An outcome is not in [-bound, bound].
        """
        scaled = np.asarray(outcomes, dtype=float) / self.bound
        if not (np.abs(scaled) <= 1.0 + _EDGE).all():
            worst = outcomes[np.argmax(~(np.abs(scaled) <= 1.0 + _EDGE))]
            raise ValueError(
                f"confidence sequence: outcomes must be in ±{self.bound:g}; got {worst}"
            )
        values, counts = np.unique(np.clip(scaled, -1.0, 1.0), return_counts=True)
        low, high = (self.bound * self._end(values, counts, is_low) for is_low in (True, False))
        self.pairs.append(len(scaled))
        self.mean.append(float(np.mean(outcomes)))
        # What has been excluded once stays so.
        self.low.append(max([low, *self.low[-1:]]))
        self.high.append(min([high, *self.high[-1:]]))

    def _end(self, values: np.ndarray, counts: np.ndarray, is_low: bool) -> float:
        from scipy.optimize import brentq

        def excess(mean: float) -> float:
            found = betting_log_e(values, counts, mean, is_above=is_low)
            return float(found) + math.log(self.alpha)

        # The capital is below 1 at the mean of the outcomes, where no bet has won.
        middle = float(np.clip(values @ counts / counts.sum(), -1.0 + _EDGE, 1.0 - _EDGE))
        edge = -1.0 + _EDGE if is_low else 1.0 - _EDGE
        if excess(edge) <= 0.0 or excess(middle) >= 0.0:
            return math.copysign(1.0, edge)
        return float(brentq(excess, edge, middle, xtol=1e-12))
