"""Evaluation of trained maps Psi in numpy, without torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

INPUT_LIMIT = 1e30
"""Squared norm above which an input counts as not finite."""

_CHUNK = 8192


class EmbeddingOutput(NamedTuple):
    """Outputs of a stack of K maps.

    Attributes:
        embedding: y, (K, N, 2).
        unsafe_logit: Logit of an unsafe end, (K, N); NaN for maps without a safety head.
        margins: Predicted smallest future margin of each constraint [unit of the margins], (K, N,
            n_c); no columns for maps without a margin head.
    """

    embedding: np.ndarray
    unsafe_logit: np.ndarray
    margins: np.ndarray


class Embedding:
    """An immutable stack of K trained maps Psi of equal shape.

    The arrays `weights` are "trunk.i.weight" (K, in, out) and "trunk.i.bias" (K, out);
    "output.weight" (K, width, 2 + n_c) whose first two columns give y and the others the margins;
    with a safety head also "safety.0.weight" (K, 2, hidden), "safety.0.bias", "safety.1.weight"
    (K, hidden, 1) and "safety.1.bias". Standardisation is folded into them. They are copied to
    single precision.

    Args:
        weights: The arrays.
        num_margins: n_c, the number of predicted margins.
        input_range: Least and largest value of each column, to which inputs are clipped, (2, n_x);
            None for no clipping.

    Raises:
        ValueError: Weights are missing or shapes are inconsistent.
    """

    def __init__(
        self,
        weights: Mapping[str, np.ndarray],
        *,
        num_margins: int,
        input_range: np.ndarray | None = None,
    ):
        self.weights = {
            name: np.ascontiguousarray(w, dtype=np.float32) for name, w in weights.items()
        }
        for w in self.weights.values():
            w.setflags(write=False)
        self.num_margins = num_margins
        self.num_layers = sum(name.startswith("trunk.") for name in self.weights) // 2
        self.has_safety_head = any(name.startswith("safety.") for name in self.weights)
        names = [f"trunk.{i}" for i in range(self.num_layers)] + ["output"]
        heads = ["safety.0", "safety.1"] if self.has_safety_head else []
        expected = {f"{name}.{kind}" for name in names + heads for kind in ("weight", "bias")}
        if expected != self.weights.keys() or self.num_layers == 0:
            missing, surplus = expected - self.weights.keys(), self.weights.keys() - expected
            raise ValueError(
                f"Embedding: a map of {self.num_layers} hidden layers has the arrays "
                f"{sorted(expected)}; missing {sorted(missing)}, unexpected {sorted(surplus)}"
            )
        self._layers = [self._layer(name) for name in names]
        for (w, _), (next_w, _) in zip(self._layers, self._layers[1:], strict=False):
            if w.shape[0] != next_w.shape[0] or w.shape[2] != next_w.shape[1]:
                raise ValueError(
                    f"Embedding: a layer of shape {w.shape} is followed by one of {next_w.shape}"
                )
        self.num_members, self.num_inputs, _ = self._layers[0][0].shape
        self.num_activations = self._layers[-1][0].shape[1]
        if self._layers[-1][0].shape[2] != 2 + num_margins:
            raise ValueError(
                f"Embedding: the output layer has {self._layers[-1][0].shape[2]} columns, expected "
                f"{2 + num_margins} for {num_margins} margins"
            )
        if self.has_safety_head:
            self._safety_layers = [self._layer(f"safety.{i}") for i in range(2)]
        self.input_range = np.full((2, self.num_inputs), np.inf, dtype=np.float32)
        self.input_range[0] = -np.inf
        if input_range is not None:
            if np.shape(input_range) != self.input_range.shape:
                raise ValueError(
                    f"Embedding: the range of inputs has the shape {np.shape(input_range)}, "
                    f"expected {self.input_range.shape}"
                )
            self.input_range[:] = input_range
        self.input_range.setflags(write=False)

    def _layer(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Weights (K, in, out) and biases (K, 1, out)."""
        return self.weights[f"{name}.weight"], self.weights[f"{name}.bias"][:, None, :]

    @property
    def has_heads(self) -> bool:
        """Whether the maps have a safety head or a margin head."""
        return self.has_safety_head or self.num_margins > 0

    def is_same(self, other: Embedding) -> bool:
        """Whether weights and input range are identical."""
        return (
            self.weights.keys() == other.weights.keys()
            and all(np.array_equal(w, other.weights[name]) for name, w in self.weights.items())
            and np.array_equal(self.input_range, other.input_range)
        )

    def clipping(self, input_range: np.ndarray) -> Embedding:
        """Returns the same maps, with inputs clipped to a range of each column, (2, n_x)."""
        return Embedding(self.weights, num_margins=self.num_margins, input_range=input_range)

    def scaled(self, factors: np.ndarray) -> Embedding:
        """Returns maps with y scaled by one factor each, (K,), and the same safety logits."""
        weights = {name: w.copy() for name, w in self.weights.items()}
        for name in ("output.weight", "output.bias"):
            weights[name][..., :2] *= factors.reshape(-1, *[1] * (weights[name].ndim - 1))
        if self.has_safety_head:
            weights["safety.0.weight"] /= factors[:, None, None]
        return Embedding(weights, num_margins=self.num_margins, input_range=self.input_range)

    def evaluate(self, x: np.ndarray) -> EmbeddingOutput:
        """Evaluates all members at inputs (N, n_x); rows that are not finite give NaN."""
        x = self._checked(x)
        shape = (self.num_members, len(x))
        output = EmbeddingOutput(
            np.empty((*shape, 2)),
            np.full(shape, np.nan),
            np.empty((*shape, self.num_margins)),
        )
        weight, bias = self._layers[-1]
        for start in range(0, len(x), _CHUNK):
            rows = slice(start, start + _CHUNK)
            is_finite = np.isfinite(x[rows]).all(axis=1)
            chunk = np.where(is_finite[:, None], x[rows], np.float32(0.0))
            z = self._hidden(chunk) @ weight + bias
            z[:, ~is_finite] = np.nan
            output.embedding[:, rows] = z[..., :2]
            output.margins[:, rows] = z[..., 2:]
            if self.has_safety_head:
                output.unsafe_logit[:, rows] = self._logit(z[..., :2])
        return output

    def activations(self, x: np.ndarray) -> np.ndarray:
        """Returns the last hidden layers at finite inputs (N, n_x), (K, N, num_activations)."""
        return self._hidden(self._checked(x))

    def embed(self, x: np.ndarray) -> np.ndarray:
        """Applies Psi to inputs (N, n_x), (K, N, 2)."""
        return self.evaluate(x).embedding

    def logit_gradient(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the mean safety logit at x (N, n_x) and its gradient: (N,) and (N, n_x).

        The gradient is zero along a column that is clipped.

        Raises:
            ValueError: The maps have no safety head.
        """
        if not self.has_safety_head:
            raise ValueError("Embedding.logit_gradient: the maps have no safety head")
        w = self.weights
        x = np.asarray(x, dtype=float)
        clipped = np.clip(x, *self.input_range)
        logit, gradient = np.zeros(len(x)), np.zeros(np.shape(x))
        for k in range(self.num_members):
            z = clipped
            is_active = []
            for i in range(self.num_layers):
                z = z @ w[f"trunk.{i}.weight"][k] + w[f"trunk.{i}.bias"][k]
                is_active.append(z > 0.0)
                z = np.maximum(z, 0.0)
            y = z @ w["output.weight"][k][:, :2] + w["output.bias"][k][:2]
            hidden = y @ w["safety.0.weight"][k] + w["safety.0.bias"][k]
            member = np.maximum(hidden, 0.0) @ w["safety.1.weight"][k] + w["safety.1.bias"][k]
            logit += member[:, 0]
            back = (hidden > 0.0) * w["safety.1.weight"][k][:, 0]
            back = back @ w["safety.0.weight"][k].T @ w["output.weight"][k][:, :2].T
            for i in reversed(range(self.num_layers)):
                back = (back * is_active[i]) @ w[f"trunk.{i}.weight"][k].T
            gradient += back * (clipped == x)
        return logit / self.num_members, gradient / self.num_members

    def _checked(self, x: np.ndarray) -> np.ndarray:
        x = np.asarray(x, dtype=np.float32)
        if x.ndim != 2 or x.shape[1] != self.num_inputs:
            raise ValueError(
                f"Embedding: inputs have shape {x.shape}, expected (N, {self.num_inputs})"
            )
        return np.clip(x, *self.input_range)

    def _hidden(self, x: np.ndarray) -> np.ndarray:
        for weight, bias in self._layers[:-1]:
            x = x @ weight
            x += bias
            np.maximum(x, 0.0, out=x)
        return x

    def _logit(self, y: np.ndarray) -> np.ndarray:
        (first, first_bias), (second, second_bias) = self._safety_layers
        return (np.maximum(y @ first + first_bias, 0.0) @ second + second_bias)[..., 0]
