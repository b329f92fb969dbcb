"""Evaluation of trained maps Psi in numpy, without torch."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import numpy as np

from drake_safety.learning.blas_threads import ONE_BLAS_THREAD

INPUT_LIMIT = 1e15  # Magnitude from which on an entry of an input counts as not finite.
_CHUNK = 8192


def are_usable(x: np.ndarray) -> bool:
    """Whether all entries are far below `INPUT_LIMIT`, by one pass; False for NaN."""
    return bool(np.vdot(x, x) < INPUT_LIMIT**2)


class EmbeddingOutput(NamedTuple):
    """Outputs of a stack of K maps; without heads the logit is NaN, and n_c is 0."""

    embedding: np.ndarray  # y, (K, N, 2)
    unsafe_logit: np.ndarray  # (K, N)
    margins: np.ndarray  # (K, N, n_c)


class Embedding:
    """An immutable stack of K trained maps Psi of equal shape.

    The arrays `weights` are "trunk.i.weight" (K, in, out) and "trunk.i.bias" (K, out);
    "output.weight" (K, width, 2 + n_c) whose first two columns give y and the others the margins;
    with heads also "safety.0.weight" (K, 2, hidden), "safety.0.bias", "safety.1.weight"
    (K, hidden, 1) and "safety.1.bias". Standardisation is folded into them.

    Attributes:
        input_range: Range to which each column of inputs is clipped, (2, n_x); may be infinite.
        centre: Offset that is subtracted from inputs before the first product, (n_x,).
        centred_bias: Bias of the first layer for these inputs, (K, out).
    """

    def __init__(self, weights: Mapping[str, np.ndarray], input_range: np.ndarray | None = None):
        self.weights = {
            name: np.ascontiguousarray(w, dtype=np.float32) for name, w in weights.items()
        }
        for w in self.weights.values():
            w.setflags(write=False)
        self.num_layers = sum(name.startswith("trunk.") for name in self.weights) // 2
        self.has_heads = any(name.startswith("safety.") for name in self.weights)
        names = [f"trunk.{i}" for i in range(self.num_layers)] + ["output"]
        heads = ["safety.0", "safety.1"] if self.has_heads else []
        expected = {f"{name}.{kind}" for name in names + heads for kind in ("weight", "bias")}
        if expected != self.weights.keys() or self.num_layers == 0:
            raise ValueError(
                f"Embedding: the arrays are {sorted(self.weights)}, expected {sorted(expected)}"
            )
        self._layers = [self._layer(name) for name in names]
        self.num_members, self.num_inputs, _ = self._layers[0][0].shape
        _, self.num_activations, num_outputs = self._layers[-1][0].shape
        self.num_margins = num_outputs - 2
        unlimited = np.tile([[-np.inf], [np.inf]], self.num_inputs)
        limits = unlimited if input_range is None else input_range
        self.input_range = np.array(limits, dtype=np.float32)
        self.input_range.setflags(write=False)
        self._prepare()

    def _prepare(self) -> None:
        """Sets what `evaluate` multiplies, each with an axis for the rows of x."""
        (weight, bias), *others = self._layers
        self.centre = np.zeros(self.num_inputs)
        self._range = self.input_range.astype(float)
        self._is_clipping = bool(np.isfinite(self._range).any())
        if np.isfinite(self.input_range).all():
            # A spread may be a thousandth of the values, which single precision would lose.
            self.centre = self.input_range.mean(axis=0, dtype=float)
            bias = (bias + (self.centre @ weight.astype(float))[:, None]).astype(np.float32)
        self.centred_bias = bias[:, 0]
        layers = [(w[:, None], b[:, None]) for w, b in ((weight, bias), *others)]
        *self._trunk, self._readout = layers
        if self.has_heads:
            # The safety head reads y, so its first layer is a part of the output layer.
            (weight, bias), (head, head_bias) = self._layers[-1], self._layer("safety.0")
            y = [part[..., :2].astype(float) for part in (weight, bias)]
            columns = (weight, y[0] @ head), (bias, y[1] @ head + head_bias)
            weight, bias = (np.concatenate(c, axis=2).astype(np.float32)[:, None] for c in columns)
            self._readout = weight, bias
            weight, bias = self._layer("safety.1")
            self._logit = weight[:, None], bias[:, None]

    def _layer(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Weights (K, in, out) and biases (K, 1, out)."""
        return self.weights[f"{name}.weight"], self.weights[f"{name}.bias"][:, None, :]

    def is_same(self, other: Embedding) -> bool:
        """Whether weights and input range are identical."""
        own, others = ({**maps.weights, "range": maps.input_range} for maps in (self, other))
        return own.keys() == others.keys() and all(np.array_equal(own[k], others[k]) for k in own)

    def scaled(self, factors: np.ndarray) -> Embedding:
        """Returns maps with y scaled by one factor each, (K,), and the same safety logits."""
        weights = {name: w.copy() for name, w in self.weights.items()}
        weights["output.weight"][..., :2] *= factors[:, None, None]
        weights["output.bias"][..., :2] *= factors[:, None]
        if self.has_heads:
            weights["safety.0.weight"] /= factors[:, None, None]
        return Embedding(weights, self.input_range)

    def evaluate(self, x: np.ndarray) -> EmbeddingOutput:
        """Evaluates all members at inputs (N, n_x), each row by itself; NaN if not finite."""
        if np.ndim(x) != 2 or np.shape(x)[1] != self.num_inputs:
            expected = f"expected (N, {self.num_inputs})"
            raise ValueError(f"Embedding: inputs have shape {np.shape(x)}, {expected}")
        if are_usable(x):
            return self._outputs(self._clipped(x))
        is_usable = (np.abs(x) < INPUT_LIMIT).all(axis=1)  # False for NaN.
        output = self._outputs(self._clipped(np.where(is_usable[:, None], x, 0.0)))
        for values in output:
            values[:, ~is_usable] = np.nan
        return output

    def _outputs(self, x: np.ndarray) -> EmbeddingOutput:
        """Outputs at finite inputs, given as `_clipped` returns them."""
        if len(x) > _CHUNK:
            parts = (self._outputs(x[i : i + _CHUNK]) for i in range(0, len(x), _CHUNK))
            return EmbeddingOutput(*map(partial(np.concatenate, axis=1), zip(*parts, strict=True)))
        with ONE_BLAS_THREAD:
            weight, bias = self._readout
            z = self._hidden(x) @ weight
            z += bias
            width = 2 + self.num_margins
            if self.has_heads:
                weight, bias = self._logit
                logit = (np.maximum(z[..., width:], 0.0) @ weight)[..., 0, 0] + bias[:, 0, 0]
            else:
                logit = np.full(z.shape[:2], np.nan)
        output = z[:, :, 0, :width].astype(float)
        return EmbeddingOutput(output[..., :2], logit.astype(float), output[..., 2:])

    def activations(self, x: np.ndarray) -> np.ndarray:
        """Returns the last hidden layers at finite inputs (N, n_x), (K, N, num_activations)."""
        with ONE_BLAS_THREAD:
            return self._hidden(self._clipped(x))[:, :, 0]

    def embed(self, x: np.ndarray) -> np.ndarray:
        """Applies Psi to inputs (N, n_x), (K, N, 2)."""
        return self.evaluate(x).embedding

    def logit_gradient(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the mean safety logit at x (N, n_x) and its gradient: (N,) and (N, n_x).

        The maps need heads. The gradient is zero along a column that is clipped.
        """
        x = np.asarray(x, dtype=float)
        clipped = np.clip(x, *self.input_range)
        *trunk, (weight, bias) = self._layers
        z, is_active = clipped, []
        for of_layer, of_bias in trunk:
            z = z @ of_layer + of_bias
            is_active.append(z > 0.0)
            z = np.maximum(z, 0.0)
        (head, head_bias), (last, last_bias) = self._layer("safety.0"), self._layer("safety.1")
        hidden = (z @ weight[..., :2] + bias[..., :2]) @ head + head_bias
        logit = (np.maximum(hidden, 0.0) @ last + last_bias)[..., 0]
        back = (hidden > 0.0) * last.swapaxes(1, 2)
        back = back @ head.swapaxes(1, 2) @ weight[..., :2].swapaxes(1, 2)
        for (of_layer, _), active in zip(reversed(trunk), reversed(is_active), strict=True):
            back = (back * active) @ of_layer.swapaxes(1, 2)
        gradient = (back * (clipped == x)).sum(axis=0, dtype=float)
        return logit.sum(axis=0) / self.num_members, gradient / self.num_members

    def _clipped(self, x: np.ndarray) -> np.ndarray:
        """Inputs clipped to the range, from its centre, in single precision."""
        if not self._is_clipping:
            return np.asarray(x, dtype=np.float32)
        least, largest = self._range
        offset = np.minimum(np.maximum(np.asarray(x, dtype=float), least), largest)
        return (offset - self.centre).astype(np.float32)

    def _hidden(self, x: np.ndarray) -> np.ndarray:
        """The last hidden layers, (K, N, 1, num_activations), at inputs of `_clipped`.

        One product for each row: a product of many rows would round differently.
        """
        z = x[None, :, None]
        for weight, bias in self._trunk:
            z = z @ weight
            z += bias
            np.maximum(z, 0.0, out=z)
        return z
