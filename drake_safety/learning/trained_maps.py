"""Trained maps Psi, evaluated by numpy: an online run needs no torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

INPUT_LIMIT = 1e30
"""Squared length from which on an input counts as not finite."""

_CHUNK = 8192


class EmbeddingOutput(NamedTuple):
    """What a stack of K maps says of inputs.

    Attributes:
        embedding: y, (K, N, 2).
        unsafe_logit: Logit of an unsafe end, (K, N); NaN for maps without a safety head.
        margins: Predicted smallest future margin of each constraint, in the margins' own unit,
            (K, N, n_c); NaN for maps without a margin head.
    """

    embedding: np.ndarray
    unsafe_logit: np.ndarray
    margins: np.ndarray


class Embedding:
    """A stack of K trained maps Psi of equal shape, immutable.

    Its weights are the arrays `weights`: "trunk.i.weight" (K, in, out) and "trunk.i.bias" (K, out);
    "output.weight" (K, width, 2 + n_c) whose first two columns give y and the others the margins;
    with a safety head also "safety.0.weight" (K, 2, hidden), "safety.0.bias", "safety.1.weight"
    (K, hidden, 1) and "safety.1.bias". Standardisation is folded into them.
    """

    def __init__(self, weights: Mapping[str, np.ndarray], *, num_margins: int):
        """Takes the weights as they are.

        Raises:
            ValueError: Weights are missing or their shapes do not fit each other.
        """
        self.weights = {
            name: np.ascontiguousarray(w, dtype=np.float32) for name, w in weights.items()
        }
        for w in self.weights.values():
            w.setflags(write=False)
        self.num_margins = num_margins
        self.num_layers = sum(name.startswith("trunk.") for name in self.weights) // 2
        names = [f"trunk.{i}" for i in range(self.num_layers)] + ["output"]
        missing = [
            f"{name}.{kind}"
            for name in names
            for kind in ("weight", "bias")
            if f"{name}.{kind}" not in self.weights
        ]
        if missing or self.num_layers == 0:
            raise ValueError(
                f"Embedding: {missing or 'trunk layers'} missing in {list(self.weights)}"
            )
        self._layers = [
            (self.weights[f"{name}.weight"], self.weights[f"{name}.bias"][:, None, :])
            for name in names
        ]
        for (w, _), (next_w, _) in zip(self._layers, self._layers[1:], strict=False):
            if w.shape[0] != next_w.shape[0] or w.shape[2] != next_w.shape[1]:
                raise ValueError(
                    f"Embedding: a layer of shape {w.shape} is followed by one of {next_w.shape}"
                )
        self.num_members, self.num_inputs, width = self._layers[0][0].shape
        self.num_activations = self._layers[-1][0].shape[1]
        if self._layers[-1][0].shape[2] != 2 + num_margins:
            raise ValueError(
                f"Embedding: the output layer has {self._layers[-1][0].shape[2]} columns, expected "
                f"{2 + num_margins} for {num_margins} margins"
            )
        self.has_safety_head = "safety.0.weight" in self.weights
        # For one input at a time every operation counts: a last entry that is always one carries
        # the biases through the products, and all members share the first.
        layers = [_with_bias(w, bias[:, 0]) for w, bias in self._layers[:-1]]
        layers.append(np.concatenate([self._layers[-1][0], self._layers[-1][1]], axis=1))
        joint = layers[0].transpose(1, 0, 2).reshape(self.num_inputs + 1, -1)
        self._first, *following = _pack([joint, *layers[1:]])
        self._stacked: tuple[int, ...] = (self.num_members, 1, width + 1)
        self._product: Callable[[np.ndarray, np.ndarray], np.ndarray] = np.matmul
        if self.num_members == 1:
            # Plain products of a vector and a matrix cost numpy half of what stacks of one cost.
            self._stacked, self._product = (width + 1,), np.dot
            following = [w[0] for w in following]
        widths = [w.shape[-2] for w in following]
        self._following = [
            (np.zeros((*self._stacked[:-1], width), dtype=np.float32), w)
            for width, w in zip(widths, following, strict=True)
        ]

    @property
    def has_heads(self) -> bool:
        """Whether the maps predict safety or margins besides y."""
        return self.has_safety_head or self.num_margins > 0

    def is_same(self, other: Embedding) -> bool:
        """Whether the maps are the same to the bit."""
        return self.weights.keys() == other.weights.keys() and all(
            np.array_equal(w, other.weights[name]) for name, w in self.weights.items()
        )

    def scaled(self, factors: np.ndarray) -> Embedding:
        """The same maps with y multiplied by a factor each, (K,); their safety heads follow."""
        weights = {name: w.copy() for name, w in self.weights.items()}
        for name in ("output.weight", "output.bias"):
            weights[name][..., :2] *= factors.reshape(-1, *[1] * (weights[name].ndim - 1))
        if self.has_safety_head:
            weights["safety.0.weight"] /= factors[:, None, None]
        return Embedding(weights, num_margins=self.num_margins)

    def evaluate(self, x: np.ndarray) -> EmbeddingOutput:
        """All members' outputs for inputs (N, n_x); rows that are not finite give NaN."""
        x = self._checked(x)
        shape = (self.num_members, len(x))
        output = EmbeddingOutput(
            np.empty((*shape, 2)),
            np.full(shape, np.nan),
            np.full((*shape, self.num_margins), np.nan),
        )
        for start in range(0, len(x), _CHUNK):
            rows = slice(start, start + _CHUNK)
            is_finite = np.all(np.isfinite(x[rows]), axis=1)
            chunk = np.where(is_finite[:, None], x[rows], np.float32(0.0))
            for member in range(self.num_members):
                z = self._activations(chunk, member)
                weight, bias = self._layers[-1]
                z = z @ weight[member]
                z += bias[member]
                z[~is_finite] = np.nan
                output.embedding[member, rows] = z[:, :2]
                output.margins[member, rows] = z[:, 2:]
                if self.has_safety_head:
                    output.unsafe_logit[member, rows] = self._logit(z[None, :, :2], member)
        return output

    def activations(self, x: np.ndarray) -> np.ndarray:
        """Of the members' last hidden layer at finite inputs (N, n_x), (K, N, num_activations)."""
        x = self._checked(x)
        return np.stack([self._activations(x, member) for member in range(self.num_members)])

    def _checked(self, x: np.ndarray) -> np.ndarray:
        x = np.asarray(x, dtype=np.float32)
        if x.ndim != 2 or x.shape[1] != self.num_inputs:
            raise ValueError(
                f"Embedding: inputs have shape {x.shape}, expected (N, {self.num_inputs})"
            )
        return x

    def _activations(self, x: np.ndarray, member: int) -> np.ndarray:
        for weight, bias in self._layers[:-1]:
            x = x @ weight[member]
            x += bias[member]
            np.maximum(x, 0.0, out=x)
        return x

    def embed(self, x: np.ndarray) -> np.ndarray:
        """Psi: inputs (N, n_x) to points (K, N, 2)."""
        return self.evaluate(x).embedding

    def evaluate_one(self, *parts: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """What every member makes of one input.

        Args:
            parts: Vectors that x consists of, in their order, (n_x,) together.

        Returns:
            y and margins, (K, 2 + n_c), and the activations of the last hidden layer with a last
            entry of 1, (K, num_activations + 1); None for an input that is not finite, or too
            large for single precision.
        """
        x = np.empty(self.num_inputs + 1, dtype=np.float32)
        start, square = 0, 0.0
        for part in parts:
            square += np.vdot(part, part)  # Unlike part.dot(part), silent when it overflows.
            if not square < INPUT_LIMIT:
                return None
            stop = start + len(part)
            x[start:stop] = part
            start = stop
        x[start:] = 1.0
        z = x.dot(self._first).reshape(self._stacked)
        hidden = z
        for zero, weight in self._following:
            hidden = np.maximum(z, zero, out=z)
            z = self._product(hidden, weight)
        return z.reshape(self.num_members, -1), hidden.reshape(self.num_members, -1)

    def unsafe_logit_one(self, points: np.ndarray) -> list[float]:
        """Logit of every member's safety head at its own point of one input.

        Args:
            points: y by every member, (K, 2).
        """
        hidden = np.matmul(points[:, None, :], self.weights["safety.0.weight"])
        hidden += self.weights["safety.0.bias"][:, None, :]
        np.maximum(hidden, 0.0, out=hidden)
        logit = np.matmul(hidden, self.weights["safety.1.weight"])[:, 0, 0]
        return (logit + self.weights["safety.1.bias"][:, 0]).tolist()

    def _logit(self, y: np.ndarray, member: int) -> np.ndarray:
        w = self.weights
        hidden = np.maximum(y[0] @ w["safety.0.weight"][member] + w["safety.0.bias"][member], 0.0)
        return (hidden @ w["safety.1.weight"][member] + w["safety.1.bias"][member])[:, 0]


def _with_bias(weight: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """Weights (K, n, m) and biases (K, m) as one (K, n + 1, m + 1) that keeps a last entry of 1."""
    k, n, m = weight.shape
    joined = np.zeros((k, n + 1, m + 1), dtype=weight.dtype)
    joined[:, :n, :m], joined[:, n, :m], joined[:, n, m] = weight, bias, 1.0
    return joined


def _pack(arrays: list[np.ndarray]) -> list[np.ndarray]:
    """Copies float32 arrays into one block that numpy places on huge pages.

    The weights of an ensemble nearly fill a processor's L2 cache; spread over small pages they
    evict each other, and a single input takes an eighth longer.
    """
    page = 2 * 1024 * 1024 // 4
    block = np.zeros(sum(array.size + 16 for array in arrays) + 2 * page, dtype=np.float32)
    start = (-block.ctypes.data // 4) % page
    packed = []
    for array in arrays:
        view = block[start : start + array.size].reshape(array.shape)
        view[...] = array
        packed.append(view)
        start += -(-array.size // 16) * 16
    return packed
