"""Training of the low-dimensional embedding: the t-SNE target and the map Psi."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.distance import NeighbourGraph
from drake_safety.learning.trained_maps import Embedding

_SMALLEST_SPREAD = 1e-3
_SAFETY_HIDDEN = 32


def tsne(
    graph: NeighbourGraph,
    *,
    perplexity: float,
    exaggeration: float,
    initialization: str,
    seed: int,
    progress: Callable[[float], None] | None = None,
) -> np.ndarray:
    """Computes the t-SNE embedding of a neighbour graph, (N, 2), deterministically for a seed.

    Distances are not squared here: openTSNE squares them. It runs on one thread, as more threads
    do not speed up the FFT of large sets.

    Args:
        perplexity: Effective number of neighbours.
        exaggeration: Factor of the attraction after the early phase, 1 for plain t-SNE.
    """
    num_neighbours = graph.indices.shape[1]
    if num_neighbours < int(3 * perplexity):
        raise ValueError(
            f"tsne: perplexity {perplexity} needs {int(3 * perplexity)} neighbours per segment, "
            f"the graph has {num_neighbours}"
        )
    require_extra("train", "tsne", "openTSNE", "sklearn")
    import openTSNE
    from openTSNE import initialization as initial_points
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
        is_random = initialization == "random"
        embedding = openTSNE.TSNE(
            initialization="random"
            if is_random
            else initial_points.spectral(affinities.P, random_state=seed),
            exaggeration=exaggeration,
            random_state=seed,
            n_jobs=1,
            callbacks=report,
            callbacks_every_iters=50,
        ).fit(affinities=affinities)
    return np.asarray(embedding, dtype=float).copy()


@dataclass(frozen=True, kw_only=True, eq=False)
class MapData:
    """Training data of a map Psi.

    Attributes:
        x: Inputs, (N, n_x).
        has_target: Whether the input has a point in t-SNE, (N,).
        target: Points of these inputs, in the order of x, (M, 2).
        is_unsafe: Whether the input's episode ended unsafely, (N,).
        margins: Smallest future margins, (N, n_c).
        sample_weight: Weight of each input in all losses, (N,).
        input_scale: Spread of each column of x after standardisation, (n_x,).
        neighbours: Nearest neighbours under Omega of each input, as rows of x, (N, k); -1 for an
            input without a point in t-SNE or a neighbour that was not selected.
        tsne_unit: Length of t-SNE's unit in that of the target.
    """

    x: np.ndarray
    has_target: np.ndarray
    target: np.ndarray
    is_unsafe: np.ndarray
    margins: np.ndarray
    sample_weight: np.ndarray
    input_scale: np.ndarray
    neighbours: np.ndarray
    tsne_unit: float

    def take(self, rows: np.ndarray) -> MapData:
        """Selects inputs by a mask (N,)."""
        # The last entry is that of no neighbour.
        position = np.append(np.where(rows, np.cumsum(rows) - 1, -1), -1)
        return MapData(
            x=self.x[rows],
            has_target=self.has_target[rows],
            target=self.target[rows[self.has_target]],
            is_unsafe=self.is_unsafe[rows],
            margins=self.margins[rows],
            sample_weight=self.sample_weight[rows],
            input_scale=self.input_scale,
            neighbours=position[self.neighbours[rows]],
            tsne_unit=self.tsne_unit,
        )


def train_map(
    data: MapData,
    parameters: AssessmentParameters,
    *,
    seed: int,
    held_out: MapData | None = None,
    progress: Callable[[float], None] | None = None,
) -> dict[str, np.ndarray]:
    """Trains one map Psi, deterministically for a seed and a machine.

    Departure: the paper trains Psi on ||y - Psi(x)|| alone. With a safety head on y and a margin
    head on the trunk, the map separates neighbours in t-SNE that end differently; held-out accuracy
    on the robots rises to that of a direct classifier.

    Args:
        data: Inputs and targets; x is standardised here, with a lower bound on the spread so that
            nearly constant columns are not amplified.
        held_out: If given, the weights of the epoch with the smallest distance to t-SNE's points of
            these inputs are kept instead of the last epoch's.

    Returns:
        The weights of one member, named as in `Embedding`, without the leading member axis.
    """
    require_extra("train", "train_map", "torch")
    import torch

    with one_torch_thread():
        return _train(torch, data, parameters, seed, held_out, progress)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Training in one thread: fastest for small layers, and the same bits on any machine."""
    import torch

    number = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(number)


def _train(
    torch: Any,
    data: MapData,
    parameters: AssessmentParameters,
    seed: int,
    held_out: MapData | None,
    progress: Callable[[float], None] | None,
) -> dict[str, np.ndarray]:
    reading = parameters.paper
    has_safety, has_margins = parameters.safety_weight > 0.0, parameters.margin_weight > 0.0
    mean = data.x.mean(axis=0)
    spread = np.maximum(data.x.std(axis=0), _SMALLEST_SPREAD) / data.input_scale
    weight_decay, has_norm, neighbour_weight = 1e-4, False, 0.0
    if not parameters.is_sharpened:
        weight_decay, has_norm = reading.weight_decay, reading.loss == "norm"
        neighbour_weight = reading.neighbour_weight
        if not reading.standardized:
            spread = np.ones(len(mean))
    target_scale = float(data.target.std())
    num_inputs, num_margins = data.x.shape[1], data.margins.shape[1] if has_margins else 0

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = _build_network(torch, num_inputs, num_margins, has_safety, parameters)
        x = torch.from_numpy(((data.x - mean) / spread).astype(np.float32))
        target = torch.zeros(len(x), 2)
        has_target = torch.from_numpy(np.asarray(data.has_target, dtype=bool))
        target[has_target] = torch.from_numpy((data.target / target_scale).astype(np.float32))
        weight = torch.from_numpy(np.asarray(data.sample_weight, dtype=np.float32))
        target_weight = weight * has_target
        neighbours = torch.from_numpy(np.asarray(data.neighbours, dtype=np.int64))
        is_unsafe = torch.from_numpy(np.asarray(data.is_unsafe, dtype=np.float32))
        low, high = parameters.margin_range
        clipped = np.clip(data.margins, low, high) / parameters.margin_unit
        margins = torch.from_numpy(clipped.astype(np.float32))
        num_batches = -(-len(x) // parameters.batch_size)
        optimiser = torch.optim.AdamW(
            net.parameters(), lr=parameters.learning_rate, weight_decay=weight_decay, fused=True
        )
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser,
            max_lr=parameters.learning_rate,
            total_steps=parameters.epochs * num_batches + 1,
        )
        functional = torch.nn.functional
        # The share of targets varies between batches, so the mean over the whole set normalises.
        mean_target_weight = float(target_weight.mean())
        best = _BestWeights(torch, held_out, mean, spread, target_scale)
        for epoch in range(parameters.epochs):
            for batch in torch.randperm(len(x)).split(parameters.batch_size):
                z = net["trunk"](x[batch])
                output = net["output"](z)
                y, w = output[:, :2], weight[batch]
                distance = ((y - target[batch]) ** 2).sum(dim=1)
                if has_norm:
                    # The offset keeps the gradient finite at distance zero.
                    distance = torch.sqrt(distance + _SMALLEST_SPREAD**2)
                loss = (
                    parameters.target_weight
                    * (target_weight[batch] * distance).mean()
                    / mean_target_weight
                )
                if neighbour_weight > 0.0:
                    chosen = torch.randint(neighbours.shape[1], (len(batch),))
                    neighbour = neighbours[batch, chosen]
                    other = net["output"](net["trunk"](x[neighbour.clamp(min=0)]))[:, :2]
                    contrast = _neighbour_loss(torch, y, other, target_scale / data.tsne_unit)
                    contrast = (contrast * (neighbour >= 0)).mean()
                    loss = (1.0 - neighbour_weight) * loss + neighbour_weight * contrast
                if has_safety:
                    logit = net["safety"](y)[:, 0]
                    entropy = functional.binary_cross_entropy_with_logits(
                        logit, is_unsafe[batch], weight=w
                    )
                    loss = loss + parameters.safety_weight * entropy
                if has_margins:
                    huber = functional.huber_loss(output[:, 2:], margins[batch], reduction="none")
                    loss = loss + parameters.margin_weight * (w * huber.mean(dim=1)).mean()
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                optimiser.step()
                schedule.step()
            best.keep(net)
            if progress is not None:
                progress((epoch + 1) / parameters.epochs)
        best.restore(net)
    return _folded_weights(net, mean, spread, target_scale, num_margins, parameters)


def _neighbour_loss(torch: Any, y: Any, neighbour: Any, unit: float) -> Any:
    """The loss of parametric t-SNE for inputs and one neighbour of each, (N,).

    InfoNC-t-SNE (Damrich et al., 2023), the contrastive form of t-SNE's loss: -log(q / (q + sum of
    those of the other inputs)), q = 1 / (1 + ||y - y'||^2).
    """
    near = 1.0 / (1.0 + (unit * (y - neighbour)).square().sum(dim=1))
    others = 1.0 / (1.0 + (unit * (y[:, None] - y[None])).square().sum(dim=2))
    return torch.log1p((others.sum(dim=1) - 1.0) / near)


class _BestWeights:
    """The weights of the epoch with the smallest mean distance on held-out inputs, if any."""

    def __init__(
        self,
        torch: Any,
        held_out: MapData | None,
        mean: np.ndarray,
        spread: np.ndarray,
        target_scale: float,
    ):
        self._torch, self._is_used = torch, held_out is not None
        self._loss = np.inf
        self._weights: dict[str, Any] | None = None
        if held_out is not None:
            x = (held_out.x[held_out.has_target] - mean) / spread
            self._x = torch.from_numpy(x.astype(np.float32))
            self._target = torch.from_numpy((held_out.target / target_scale).astype(np.float32))

    def keep(self, net: Any) -> None:
        if not self._is_used:
            return
        net.eval()
        with self._torch.no_grad():
            y = net["output"](net["trunk"](self._x))[:, :2]
            loss = float((y - self._target).norm(dim=1).mean())
        net.train()
        if loss < self._loss:
            self._loss = loss
            self._weights = {name: value.clone() for name, value in net.state_dict().items()}

    def restore(self, net: Any) -> None:
        if self._weights is not None:
            net.load_state_dict(self._weights)


def stack_members(members: list[dict[str, np.ndarray]], *, num_margins: int) -> Embedding:
    """Stacks members returned by `train_map` into one `Embedding`."""
    weights = {name: np.stack([member[name] for member in members]) for name in members[0]}
    return Embedding(weights, num_margins=num_margins)


def _build_network(
    torch: Any,
    num_inputs: int,
    num_margins: int,
    has_safety: bool,
    parameters: AssessmentParameters,
) -> Any:
    nn = torch.nn
    trunk, width = [], num_inputs
    for size in parameters.hidden_sizes:
        trunk += [nn.Linear(width, size), nn.ReLU()]
        if parameters.dropout > 0.0:
            trunk.append(nn.Dropout(parameters.dropout))
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
    parameters: AssessmentParameters,
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
    column_scale = np.array([target_scale] * 2 + [parameters.margin_unit] * num_margins)
    weights["output.weight"], weights["output.bias"] = weight * column_scale, bias * column_scale
    if "safety" in net:
        for index, (weight, bias) in enumerate(linear_layers(net["safety"])):
            if index == 0:
                weight = weight / target_scale
            weights[f"safety.{index}.weight"], weights[f"safety.{index}.bias"] = weight, bias
    return weights
