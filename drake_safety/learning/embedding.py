"""The low-dimensional embedding: its t-SNE target and the map Psi that reproduces it.

torch trains the map; numpy evaluates it, so that an online run needs no torch.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from drake_safety.learning.distance import NeighbourGraph

_SMALLEST_SPREAD = 1e-3
_CHUNK = 8192
_SAFETY_HIDDEN = 32


def tsne(
    graph: NeighbourGraph,
    *,
    perplexity: float,
    seed: int,
    progress: Callable[[float], None] | None = None,
) -> np.ndarray:
    """The t-SNE embedding of a neighbour graph, (N, 2); the same seed gives the same bits.

    The distances enter as they are: openTSNE squares them itself. It runs on one thread:
    several gain nothing with the FFT of large sets, and on a busy machine they mostly wait.

    Raises:
        ValueError: The graph has fewer than three times `perplexity` neighbours a segment.
    """
    num_neighbours = graph.indices.shape[1]
    if num_neighbours < int(3 * perplexity):
        raise ValueError(
            f"tsne: perplexity {perplexity} needs {int(3 * perplexity)} neighbours a segment, "
            f"the graph has {num_neighbours}"
        )
    import openTSNE
    from openTSNE.affinity import PerplexityBasedNN
    from openTSNE.nearest_neighbors import PrecomputedNeighbors

    done = 0

    def report(iteration: int, error: float, embedding: np.ndarray) -> bool:
        nonlocal done
        done += 50
        if progress is not None:
            progress(min(done / 750, 1.0))
        return False

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        affinities = PerplexityBasedNN(
            knn_index=PrecomputedNeighbors(graph.indices, graph.distances),
            perplexity=perplexity,
            random_state=seed,
            n_jobs=1,
        )
        embedding = openTSNE.TSNE(
            initialization="random",
            random_state=seed,
            n_jobs=1,
            callbacks=report,
            callbacks_every_iters=50,
        ).fit(affinities=affinities)
    return np.asarray(embedding, dtype=float).copy()


INPUT_LIMIT = 1e30
"""Squared length from which on an input counts as not finite."""


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
        x = np.asarray(x, dtype=np.float32)
        if x.ndim != 2 or x.shape[1] != self.num_inputs:
            raise ValueError(
                f"Embedding: inputs have shape {x.shape}, expected (N, {self.num_inputs})"
            )
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
                z = chunk
                for weight, bias in self._layers[:-1]:
                    z = z @ weight[member]
                    z += bias[member]
                    np.maximum(z, 0.0, out=z)
                weight, bias = self._layers[-1]
                z = z @ weight[member]
                z += bias[member]
                z[~is_finite] = np.nan
                output.embedding[member, rows] = z[:, :2]
                output.margins[member, rows] = z[:, 2:]
                if self.has_safety_head:
                    output.unsafe_logit[member, rows] = self._logit(z[None, :, :2], member)
        return output

    def embed(self, x: np.ndarray) -> np.ndarray:
        """Psi: inputs (N, n_x) to points (K, N, 2)."""
        return self.evaluate(x).embedding

    def evaluate_one(self, *parts: np.ndarray) -> np.ndarray | None:
        """y and margins of one input by every member, (K, 2 + n_c).

        Args:
            parts: Vectors that x consists of, in their order, (n_x,) together.

        Returns:
            None for an input that is not finite, or too large for single precision.
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
        for zero, weight in self._following:
            z = self._product(np.maximum(z, zero, out=z), weight)
        return z.reshape(self.num_members, -1)

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


@dataclass(frozen=True, kw_only=True)
class MapSettings:
    """How a map Psi is built and trained.

    Attributes:
        hidden_sizes: Widths of the trunk's layers.
        dropout: Share of trunk activations dropped while training.
        epochs: Passes over the inputs.
        batch_size: Inputs a step.
        learning_rate: Peak of the one-cycle schedule.
        target_weight: Weight of the squared distance to t-SNE's point.
        safety_weight: Weight of the safety head's cross entropy; 0 leaves the head out.
        margin_weight: Weight of the margin head's Huber loss; 0 leaves the head out.
        margin_unit: Margin that counts as one in the Huber loss [unit of the margins].
        margin_range: Margins are clipped to this range [unit of the margins].
    """

    hidden_sizes: tuple[int, ...]
    dropout: float
    epochs: int
    batch_size: int
    learning_rate: float
    target_weight: float
    safety_weight: float
    margin_weight: float
    margin_unit: float
    margin_range: tuple[float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class MapData:
    """What a map Psi learns from.

    Attributes:
        x: Inputs, (N, n_x).
        has_target: Inputs that t-SNE saw, (N,).
        target: Their points, in the order of x, (M, 2).
        is_unsafe: Whether the input's episode ended unsafely, (N,).
        margins: Smallest future margins, (N, n_c).
        sample_weight: Weight of each input in all losses, (N,).
        input_scale: Spread of each column of x as the map sees it, (n_x,).
    """

    x: np.ndarray
    has_target: np.ndarray
    target: np.ndarray
    is_unsafe: np.ndarray
    margins: np.ndarray
    sample_weight: np.ndarray
    input_scale: np.ndarray

    def take(self, rows: np.ndarray) -> MapData:
        """Some of the inputs, chosen by a mask (N,)."""
        return MapData(
            x=self.x[rows],
            has_target=self.has_target[rows],
            target=self.target[rows[self.has_target]],
            is_unsafe=self.is_unsafe[rows],
            margins=self.margins[rows],
            sample_weight=self.sample_weight[rows],
            input_scale=self.input_scale,
        )


def train_map(
    data: MapData,
    settings: MapSettings,
    *,
    seed: int,
    progress: Callable[[float], None] | None = None,
) -> dict[str, np.ndarray]:
    """Trains one map Psi; the same seed on the same machine gives the same weights.

    Departure: the paper trains Psi on ||y - Psi(x)|| alone and leaves safety out. With a safety
    head on y and a margin head on the trunk, the map separates what t-SNE places together but ends
    differently; held-out accuracy on the robots rises from weak to that of a direct classifier.

    Args:
        data: Inputs and targets; x is standardised here, with a floor under the spread so that a
            column that hardly moves is not amplified.
        settings: Shape of the network and of the training.
        seed: Seeds the initial weights, the batches and the dropout.
        progress: Called with the fraction done.

    Returns:
        The weights of one member, as `Embedding` names them, without the leading member axis.
    """
    import torch

    num_threads = torch.get_num_threads()
    # Layers this small gain nothing from threads; one is also the quickest on the wall clock.
    torch.set_num_threads(1)
    try:
        return _train(torch, data, settings, seed, progress)
    finally:
        torch.set_num_threads(num_threads)


def _train(
    torch: Any,
    data: MapData,
    settings: MapSettings,
    seed: int,
    progress: Callable[[float], None] | None,
) -> dict[str, np.ndarray]:
    has_safety, has_margins = settings.safety_weight > 0.0, settings.margin_weight > 0.0
    mean = data.x.mean(axis=0)
    spread = np.maximum(data.x.std(axis=0), _SMALLEST_SPREAD) / data.input_scale
    target_scale = float(data.target.std())
    num_inputs, num_margins = data.x.shape[1], data.margins.shape[1] if has_margins else 0

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = _build_network(torch, num_inputs, num_margins, has_safety, settings)
        x = torch.from_numpy(((data.x - mean) / spread).astype(np.float32))
        target = torch.zeros(len(x), 2)
        has_target = torch.from_numpy(np.asarray(data.has_target, dtype=bool))
        target[has_target] = torch.from_numpy((data.target / target_scale).astype(np.float32))
        weight = torch.from_numpy(np.asarray(data.sample_weight, dtype=np.float32))
        target_weight = weight * has_target
        is_unsafe = torch.from_numpy(np.asarray(data.is_unsafe, dtype=np.float32))
        margins = torch.from_numpy(
            (np.clip(data.margins, *settings.margin_range) / settings.margin_unit).astype(
                np.float32
            )
        )
        num_batches = -(-len(x) // settings.batch_size)
        optimiser = torch.optim.AdamW(
            net.parameters(), lr=settings.learning_rate, weight_decay=1e-4, fused=True
        )
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser,
            max_lr=settings.learning_rate,
            total_steps=settings.epochs * num_batches + 1,
        )
        functional = torch.nn.functional
        # The targets' share of a batch varies by chance, so its mean over the whole set divides.
        mean_target_weight = float(target_weight.mean())
        for epoch in range(settings.epochs):
            for batch in torch.randperm(len(x)).split(settings.batch_size):
                z = net["trunk"](x[batch])
                output = net["output"](z)
                y, w = output[:, :2], weight[batch]
                squared = ((y - target[batch]) ** 2).sum(dim=1)
                loss = (
                    settings.target_weight
                    * (target_weight[batch] * squared).mean()
                    / mean_target_weight
                )
                if has_safety:
                    logit = net["safety"](y)[:, 0]
                    entropy = functional.binary_cross_entropy_with_logits(
                        logit, is_unsafe[batch], weight=w
                    )
                    loss = loss + settings.safety_weight * entropy
                if has_margins:
                    huber = functional.huber_loss(output[:, 2:], margins[batch], reduction="none")
                    loss = loss + settings.margin_weight * (w * huber.mean(dim=1)).mean()
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                optimiser.step()
                schedule.step()
            if progress is not None:
                progress((epoch + 1) / settings.epochs)
    return _folded_weights(net, mean, spread, target_scale, num_margins, settings)


def stack_members(members: list[dict[str, np.ndarray]], *, num_margins: int) -> Embedding:
    """One `Embedding` of the members that `train_map` returned."""
    weights = {name: np.stack([member[name] for member in members]) for name in members[0]}
    return Embedding(weights, num_margins=num_margins)


def _build_network(
    torch: Any, num_inputs: int, num_margins: int, has_safety: bool, settings: MapSettings
) -> Any:
    nn = torch.nn
    trunk, width = [], num_inputs
    for size in settings.hidden_sizes:
        trunk += [nn.Linear(width, size), nn.ReLU()]
        if settings.dropout > 0.0:
            trunk.append(nn.Dropout(settings.dropout))
        width = size
    net = nn.ModuleDict(
        {"trunk": nn.Sequential(*trunk), "output": nn.Linear(width, 2 + num_margins)}
    )
    if has_safety:
        net["safety"] = nn.Sequential(
            nn.Linear(2, _SAFETY_HIDDEN), nn.ReLU(), nn.Linear(_SAFETY_HIDDEN, 1)
        )
    return net


def _folded_weights(
    net: Any,
    mean: np.ndarray,
    spread: np.ndarray,
    target_scale: float,
    num_margins: int,
    settings: MapSettings,
) -> dict[str, np.ndarray]:
    """The trained layers with the standardisation of x, y and the margins folded in."""

    def linear_layers(module: Any) -> list[tuple[np.ndarray, np.ndarray]]:
        return [
            (
                layer.weight.detach().numpy().astype(float).T,
                layer.bias.detach().numpy().astype(float),
            )
            for layer in module
            if hasattr(layer, "weight")
        ]

    weights: dict[str, np.ndarray] = {}
    for index, (weight, bias) in enumerate(linear_layers(net["trunk"])):
        if index == 0:
            bias = bias - (mean / spread) @ weight
            weight = weight / spread[:, None]
        weights[f"trunk.{index}.weight"], weights[f"trunk.{index}.bias"] = weight, bias
    ((weight, bias),) = linear_layers([net["output"]])
    column_scale = np.array([target_scale] * 2 + [settings.margin_unit] * num_margins)
    weights["output.weight"], weights["output.bias"] = weight * column_scale, bias * column_scale
    if "safety" in net:
        for index, (weight, bias) in enumerate(linear_layers(net["safety"])):
            if index == 0:
                weight = weight / target_scale
            weights[f"safety.{index}.weight"], weights[f"safety.{index}.bias"] = weight, bias
    return weights
