"""The discrepancy function D: where the nominal model's scores cannot be relied on."""

from __future__ import annotations

from typing import Any

import numpy as np

_MOST_FITTED = 250
_CHUNK = 2048


class DiscrepancyFunction:
    """D(y), a Gaussian process regression of |lambda actual - lambda nominal| on Psi(x).

    The amplitude of the kernel is fixed at one: a fitted one shrinks with the differences, and then
    sigma is small everywhere, data or not. Length scale and noise are fitted on at most 250 of the
    points; the posterior is exact with all of them.
    """

    def __init__(self) -> None:
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

        self._kernel: Any = ConstantKernel(1.0, "fixed") * RBF(10.0, (3.0, 40.0)) + WhiteKernel(
            0.03, (1e-3, 0.08)
        )

    def fit(self, points: np.ndarray, difference: np.ndarray) -> DiscrepancyFunction:
        """Learns D.

        Args:
            points: Psi(x) of the feedback, (N, 2), in units of the grid.
            difference: |lambda actual - lambda nominal|, (N,).

        Returns:
            Itself.

        Raises:
            ValueError: No point is finite.
        """
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF

        is_finite = np.isfinite(points).all(axis=1)
        points, difference = points[is_finite].astype(float), difference[is_finite].astype(float)
        if not len(points):
            raise ValueError("DiscrepancyFunction: none of the feedback's points is finite")
        kernel = _fitted(self._kernel, points, difference)
        self.length_scale = float(kernel.k1.k2.length_scale)
        self.noise = float(kernel.k2.noise_level)
        # The noise is of what was seen, and no part of sigma.
        self._process: Any = GaussianProcessRegressor(
            RBF(self.length_scale), alpha=self.noise, optimizer=None
        ).fit(points, difference)
        return self

    def predict(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean m, clipped to [0, 1], and standard deviation sigma without the noise.

        Args:
            points: (M, 2).

        Returns:
            m and sigma, (M,) each; 0 and 1, the prior's, where a point is not finite.
        """
        mean, deviation = np.zeros(len(points)), np.ones(len(points))
        rows = np.flatnonzero(np.isfinite(points).all(axis=1))
        for start in range(0, len(rows), _CHUNK):
            chunk = rows[start : start + _CHUNK]
            mean[chunk], deviation[chunk] = self._process.predict(
                points[chunk].astype(float), return_std=True
            )
        return np.clip(mean, 0.0, 1.0), deviation


def _fitted(kernel: Any, points: np.ndarray, difference: np.ndarray) -> Any:
    import warnings

    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor

    if len(points) > _MOST_FITTED:
        rows = np.random.default_rng(0).choice(len(points), _MOST_FITTED, replace=False)
        points, difference = points[rows], difference[rows]
    with warnings.catch_warnings():
        # Of a parameter that ends at its bound, which is what bounds are for.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return GaussianProcessRegressor(kernel=kernel).fit(points, difference).kernel_


def updated_uncertainty(
    mean: np.ndarray,
    deviation: np.ndarray,
    *,
    gate: float,
    least: float,
    initial: float,
) -> np.ndarray:
    """The uncertainty mu of nominal beliefs under a discrepancy, (N,).

    Args:
        mean: m of the discrepancy at each belief's point, (N,).
        deviation: sigma there, (N,).
        gate: sigma_thre.
        least: mu_min.
        initial: mu_ini, where the discrepancy is not known.
    """
    return np.where(deviation <= gate, least + mean * (1.0 - least), initial)
