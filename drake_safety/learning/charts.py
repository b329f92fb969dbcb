"""Control charts of innovations: whitening, weighted means and limits."""

from __future__ import annotations

import numpy as np

FALSE_ALARMS_PER_HOUR = 0.02
"""Rate of false alarms of each chart on the nominal plant, by extrapolation."""
_TRIMMED = 0.1  # Share of the largest errors left out of their covariance, such as impacts.
_TRIMMINGS = 4
_BLOCK_S = 2.0  # Blocks whose maxima give the tail of a chart.
_TAIL = 0.1  # Share of the blocks in the tail.


def whitening_of(values: np.ndarray, *, is_centred: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Mean and W with (values - mean) W of unit covariance, by shrinkage."""
    from sklearn.covariance import LedoitWolf

    # Constant states have no covariance to invert.
    scale = np.maximum(values.std(axis=0), 1e-9)
    found = LedoitWolf(assume_centered=is_centred).fit(values / scale)
    ridge = 1e-6 * np.eye(len(scale))
    root = np.linalg.cholesky(np.linalg.inv(found.covariance_ + ridge))
    mean = np.zeros(len(scale)) if is_centred else found.location_ * scale
    return mean, root / scale[:, None]


def trimmed_whitening_of(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same without the largest values, which would hide a change of the others."""
    mean, whitening = whitening_of(values)
    for _ in range(_TRIMMINGS):
        norm = np.linalg.norm((values - mean) @ whitening, axis=1)
        mean, whitening = whitening_of(values[norm <= np.quantile(norm, 1.0 - _TRIMMED)])
    return mean, whitening


def averaged(values: np.ndarray, rate: float) -> np.ndarray:
    """Exponentially weighted means of consecutive rows, from zero."""
    from scipy.signal import lfilter

    means: np.ndarray = lfilter([rate], [1.0, rate - 1.0], values, axis=0)
    return means


def limit_of(statistic: np.ndarray, step_s: float) -> float:
    """A limit for the rate of false alarms, by an exponential tail (peaks over threshold)."""
    size = max(1, round(_BLOCK_S / step_s))
    blocks = statistic[: max(1, len(statistic) // size) * size]
    if len(blocks) >= size:
        blocks = blocks.reshape(-1, size).max(axis=1)
    threshold = float(np.quantile(blocks, 1.0 - _TAIL))
    excess = blocks[blocks > threshold] - threshold
    if not len(excess):
        return 2.0 * float(statistic.max())
    per_hour = _TAIL * 3600.0 / (size * step_s)
    extrapolated = threshold + excess.mean() * np.log(per_hour / FALSE_ALARMS_PER_HOUR)
    return float(max(extrapolated, statistic.max()))
