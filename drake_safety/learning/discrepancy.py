"""The discrepancy function D between actual and nominal unsafety scores."""

from __future__ import annotations

from typing import Any

import numpy as np

_MOST_FITTED = 250
_CHUNK = 2048


class DiscrepancyFunction:
    """D(y), a Gaussian process regression of |lambda actual - lambda nominal| on Psi(x).

    The kernel's amplitude is fixed at one: a fitted amplitude shrinks with the differences, which
    makes sigma small everywhere, even without data. Length scale and noise are fitted on at most
    250 points; the posterior is exact with all points.
    """

    def fit(self, points: np.ndarray, difference: np.ndarray) -> DiscrepancyFunction:
        """Fits D to |lambda actual - lambda nominal|, (N,), at Psi(x) of the feedback, (N, 2)."""
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF

        is_finite = np.isfinite(points).all(axis=1)
        points, difference = points[is_finite].astype(float), difference[is_finite].astype(float)
        if not len(points):
            raise ValueError("DiscrepancyFunction: none of the feedback's points is finite")
        kernel = _fitted_kernel(points, difference)
        scale, noise = float(kernel.k1.k2.length_scale), float(kernel.k2.noise_level)
        # As `alpha`, the noise of the observations is no part of sigma.
        process = GaussianProcessRegressor(RBF(scale), alpha=noise, optimizer=None)
        self._process: Any = process.fit(points, difference)
        return self

    def predict(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predicts the mean m, clipped to [0, 1], and sigma without noise at points (M, 2).

        Where a point is not finite, they are the prior's 0 and 1.
        """
        mean, deviation = np.zeros(len(points)), np.ones(len(points))
        rows = np.flatnonzero(np.isfinite(points).all(axis=1))
        for start in range(0, len(rows), _CHUNK):
            chunk = rows[start : start + _CHUNK]
            mean[chunk], deviation[chunk] = self._process.predict(
                points[chunk].astype(float), return_std=True
            )
        return np.clip(mean, 0.0, 1.0), deviation


def _fitted_kernel(points: np.ndarray, difference: np.ndarray) -> Any:
    import warnings

    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    kernel = ConstantKernel(1.0, "fixed") * RBF(10.0, (3.0, 40.0)) + WhiteKernel(0.03, (1e-3, 0.08))
    if len(points) > _MOST_FITTED:
        rows = np.random.default_rng(0).choice(len(points), _MOST_FITTED, replace=False)
        points, difference = points[rows], difference[rows]
    with warnings.catch_warnings():
        # Hyperparameters may end at their bounds.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return GaussianProcessRegressor(kernel=kernel).fit(points, difference).kernel_


def updated_uncertainty(
    mean: np.ndarray, deviation: np.ndarray, *, gate: float, least: float, initial: float
) -> np.ndarray:
    """The uncertainty mu of nominal beliefs, (N,), from m and sigma of the discrepancy there."""
    return np.where(deviation <= gate, least + mean * (1.0 - least), initial)
