"""Prediction of the next measured state from the inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

HIDDEN_SIZES = (128, 128)
"""Units of the hidden layers."""
_SMALLEST_SPREAD = 1e-2  # Of a column [unit of the column].
_RIDGE = 1.0
_LEAST_EARLY_STOPPING = 100  # Rows, of which a tenth is held out.
_MOST_ROWS = 40_000  # For the network.


@dataclass(frozen=True, kw_only=True, eq=False)
class Predictor:
    """Predicts the change of the measured state in one step from x.

    A linear regression with a network of two hidden layers on its residual.

    Attributes:
        mean, scale: Standardisation of x, (n_x,).
        linear, bias: The regression, (n_x, n_s), (n_s,).
        layers: Weights and biases of the network.
    """

    mean: np.ndarray
    scale: np.ndarray
    linear: np.ndarray
    bias: np.ndarray
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]

    @classmethod
    def fit(cls, x: np.ndarray, change: np.ndarray) -> Predictor:
        """Fits the change (N, n_s) to inputs (N, n_x)."""
        from sklearn.linear_model import Ridge
        from sklearn.neural_network import MLPRegressor
        from threadpoolctl import threadpool_limits

        mean, scale = x.mean(axis=0), np.maximum(x.std(axis=0), _SMALLEST_SPREAD)
        z = (x - mean) / scale
        with threadpool_limits(1):
            ridge = Ridge(alpha=_RIDGE).fit(z, change)
            residual = change - ridge.predict(z)
            unit = np.maximum(residual.std(axis=0), 1e-12)
            rows = np.random.default_rng(0).permutation(len(x))[:_MOST_ROWS]
            network = MLPRegressor(
                hidden_layer_sizes=HIDDEN_SIZES,
                alpha=1e-3,
                batch_size=min(256, len(rows)),
                early_stopping=len(rows) >= _LEAST_EARLY_STOPPING,
                n_iter_no_change=4,
                max_iter=40,
                tol=1e-3,
                random_state=0,
            )
            _fit_quietly(network, z[rows], residual[rows] / unit)
        layers = [*zip(network.coefs_, network.intercepts_, strict=True)]
        layers[-1] = (layers[-1][0] * unit, layers[-1][1] * unit)
        # Files store the network in single precision.
        layers = [tuple(np.float32(part).astype(float) for part in layer) for layer in layers]
        return cls(
            mean=mean,
            scale=scale,
            linear=ridge.coef_.T,
            bias=ridge.intercept_,
            layers=tuple(layers),
        )

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Returns the predicted changes (N, n_s) at inputs (N, n_x)."""
        z = (x - self.mean) / self.scale
        hidden = z
        for weight, bias in self.layers[:-1]:
            hidden = np.maximum(hidden @ weight + bias, 0.0)
        weight, bias = self.layers[-1]
        return z @ self.linear + self.bias + (hidden @ weight + bias)

    def corrected(self, x: np.ndarray, change: np.ndarray) -> Predictor:
        """Returns the predictor with the regression fitted to another plant's changes."""
        from sklearn.linear_model import Ridge

        z = (x - self.mean) / self.scale
        # Few rows: what they do not determine stays as it was.
        ridge = Ridge(alpha=len(x) / 10.0).fit(z, change - self(x))
        return Predictor(
            mean=self.mean,
            scale=self.scale,
            linear=self.linear + ridge.coef_.T,
            bias=self.bias + ridge.intercept_,
            layers=self.layers,
        )


def _fit_quietly(network: Any, z: np.ndarray, target: np.ndarray) -> None:
    import warnings

    with warnings.catch_warnings():
        # The number of epochs is limited on purpose.
        warnings.simplefilter("ignore")
        network.fit(z, target)
