"""The logit of a fall, fitted to episodes that go on after they leave the safe set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from pydantic import FiniteFloat, NonNegativeInt

_LIMIT = 20.0  # Bounds the logit, so that exp does not overflow.
_INVERSE_PENALTY = 0.01  # For inputs with unit variance.


@dataclass(frozen=True, kw_only=True)
class FallLogit:
    """A logit of a fall, linear in predicted margins, unsafe logit, and some columns of x.

    Departure: the paper's Γ has learned whether a motion leaves the safe set, which a walking robot
    often does without a fall.
    """

    columns: tuple[NonNegativeInt, ...]
    weights: tuple[FiniteFloat, ...]
    offset: FiniteFloat

    @classmethod
    def fit(
        cls, inputs: Sequence[np.ndarray], has_fallen: Sequence[bool], columns: Sequence[int]
    ) -> FallLogit:
        """Fits it to the finite rows of episodes."""
        from sklearn.linear_model import LogisticRegression
        from sklearn.preprocessing import StandardScaler

        num_falls = sum(has_fallen)
        if num_falls in (0, len(has_fallen)):
            raise ValueError(
                f"FallLogit: {num_falls} of {len(has_fallen)} episodes end in a fall; the fit "
                "takes both: give more episodes"
            )
        every = np.concatenate(inputs)
        labels = np.repeat(has_fallen, [len(rows) for rows in inputs])
        is_used = np.isfinite(every).all(axis=1)
        scaler = StandardScaler().fit(every[is_used])
        model = LogisticRegression(C=_INVERSE_PENALTY, max_iter=500)
        model.fit(scaler.transform(every[is_used]), labels[is_used])
        weights = model.coef_[0] / scaler.scale_
        offset = model.intercept_[0] - weights @ scaler.mean_
        return cls(columns=tuple(columns), weights=tuple(weights.tolist()), offset=float(offset))

    def at(self, temperature: float) -> FallLogit:
        """The same logit, of an unsafe logit that is divided by a temperature."""
        weights, place = list(self.weights), -1 - len(self.columns)
        weights[place] *= temperature
        return replace(self, weights=tuple(weights))

    def of(self, margins: np.ndarray, unsafe_logit: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Returns the logit (N,) of margins (N, n_c), unsafe logit (N,) and inputs (N, n_x)."""
        columns, weights = self._arrays
        terms = self.inputs(margins, unsafe_logit, x, columns) * weights
        logit = np.add.reduce(terms, axis=1) + self.offset
        return np.minimum(np.maximum(logit, -_LIMIT), _LIMIT)

    @cached_property
    def _arrays(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array(self.columns, dtype=np.intp), np.array(self.weights)

    @staticmethod
    def inputs(
        margins: np.ndarray,
        unsafe_logit: np.ndarray,
        x: np.ndarray,
        columns: Sequence[int] | np.ndarray,
    ) -> np.ndarray:
        """Returns what the weights multiply, (N, n_c + 1 + num_columns)."""
        read = x.take(np.asarray(columns, dtype=np.intp), axis=1)
        return np.concatenate([margins, unsafe_logit[:, None], read], axis=1)
