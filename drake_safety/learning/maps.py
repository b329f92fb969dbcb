"""Training of the maps Psi, of the trees beside them, and of the logit of both."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_safety.files.progress import ignore
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.inputs import InputColumns
from drake_safety.learning.mode_settings import ModeSettings, mode_settings
from drake_safety.learning.points import Points
from drake_safety.learning.prediction import LOGIT_LIMIT, BaseLogit, mean_of_maps
from drake_safety.learning.segments import Segments
from drake_safety.learning.trained_maps import Embedding, EmbeddingOutput
from drake_safety.learning.trees import Trees

_INSIDE_SHARE = 0.995  # Quantile of the outputs that are scaled to the extent of t-SNE's points.
_CLIPPED_SHARE = 1e-3  # Share of the training inputs at either end of a column of x.
_SMALLEST_SPREAD = 1e-3
_SAFETY_HIDDEN = 32
_TARGET_WEIGHT, _SAFETY_WEIGHT = 0.1, 5.0
"""Weights of the distance to t-SNE's points and of the safety head's loss, beside the margins'."""
_Report = Callable[[float], object]


@dataclass(frozen=True, kw_only=True, eq=False)
class MapData(Points):
    """Training data of a map Psi."""

    x: np.ndarray  # (N, n_x)
    is_unsafe: np.ndarray
    margins: np.ndarray  # The smallest until the episode's end, (N, n_c).
    sample_weight: np.ndarray
    input_scale: np.ndarray  # Spread of each column of x after standardisation, (n_x,).

    def take(self, rows: np.ndarray) -> MapData:
        """Selects inputs by a mask (N,)."""
        names = ("x", "has_target", "is_unsafe", "margins", "sample_weight")
        return replace(
            self,
            **{name: getattr(self, name)[rows] for name in names},
            target=self.target[rows[self.has_target]],
        )


def learned_maps(
    segments: Segments,
    points: Points,
    columns: InputColumns,
    parameters: AssessmentParameters,
    progress: _Report = ignore,
) -> tuple[Embedding, BaseLogit | None, Trees | None]:
    """Trains the maps Psi, the base logit and the trees; the last two are None in the paper's mode.

    Trees are also None without episodes of both labels to learn from and to weigh them on.

    Departure ("sharpened" only): maps of rectifiers extrapolate linearly, off the grid or into
    cells of others, so the 0.1 and 99.9 % quantiles of training clip every column of x.
    """
    settings, x = mode_settings(parameters), columns.of_rows(segments)
    is_raw = np.arange(x.shape[1]) < columns.plan.stop
    data = MapData(
        **vars(points),
        x=x,
        is_unsafe=segments.is_unsafe,
        margins=segments.future_margins,
        sample_weight=_sample_weight(segments, settings),
        input_scale=np.where(is_raw, settings.raw_input_scale, 1.0),
    )
    if settings.is_paper:
        return _train(data, parameters, progress), None, None
    is_held_out = held_out_segments(segments, parameters)
    label = segments.is_unsafe[is_held_out]
    tried_trees = trees = None
    if not 0 < label.sum() < len(label):
        # No held-out episodes of both labels.
        tried = embedding = _train(data, parameters, progress)
        is_held_out = np.ones(len(segments), dtype=bool)
    else:
        # A first ensemble is evaluated on the held-out episodes, the final one is trained on all.
        tried = _train(data.take(~is_held_out), parameters, lambda done: progress(0.5 * done))
        embedding = _train(data, parameters, lambda done: progress(0.5 * (1 + done)))
        tried_trees, trees = learned_trees(data, segments.group, is_held_out, parameters.seed)
    judged = x[is_held_out]
    trees_logit = None if tried_trees is None else tried_trees.evaluate(judged)
    base_logit = fitted_base_logit(
        tried.evaluate(judged), segments.take(is_held_out), parameters, trees_logit
    )
    known = np.quantile(x, [_CLIPPED_SHARE, 1.0 - _CLIPPED_SHARE], axis=0)
    return Embedding(embedding.weights, known), base_logit, trees


def learned_trees(
    data: MapData, group: np.ndarray, is_held_out: np.ndarray, seed: int
) -> tuple[Trees, Trees] | tuple[None, None]:
    """Trees without the held-out inputs, and as many of all; None if the others have one label."""
    # A tenth of the other episodes and plants, on which their number is chosen.
    is_stopping = np.isin(group, np.unique(group[~is_held_out])[::10])
    label = data.is_unsafe[~is_held_out & ~is_stopping]
    if label.all() or not label.any():
        return None, None
    others = data.take(~is_held_out)
    tried = Trees.fit(
        *(others.x, others.is_unsafe, others.sample_weight),
        seed=seed,
        is_held_out=is_stopping[~is_held_out],
    )
    every = data.x, data.is_unsafe, data.sample_weight
    return tried, Trees.fit(*every, seed=seed, num_trees=len(tried))


def held_out_segments(segments: Segments, parameters: AssessmentParameters) -> np.ndarray:
    """Returns which segments, (N,), are held out for the base logit: whole episodes and plants."""
    settings, groups = mode_settings(parameters), np.unique(segments.group)
    seed = np.random.SeedSequence(parameters.seed, spawn_key=(settings.num_maps,))
    rng, share = np.random.default_rng(seed), min(settings.held_out, 0.5)
    drawn = [
        rng.permutation(part)[: int(share * len(part))]
        for part in (groups[groups >= 0], groups[groups < 0])
    ]
    return np.isin(segments.group, np.concatenate(drawn))


def _sample_weight(segments: Segments, settings: ModeSettings) -> np.ndarray:
    weight = np.where(segments.is_first, settings.first_row_weight, 1.0)
    return weight / weight.mean()


def _train(data: MapData, parameters: AssessmentParameters, progress: _Report) -> Embedding:
    settings, members = mode_settings(parameters), []
    num_maps = settings.num_maps
    for k in range(num_maps):

        def report(fraction: float, k: int = k) -> None:
            progress((k + fraction) / num_maps)

        seed = int(np.random.SeedSequence(parameters.seed, spawn_key=(k,)).generate_state(1)[0])
        members.append(train_map(data, parameters, seed=seed, progress=report))
    embedding = stack_members(members)
    if settings.is_paper:
        return embedding
    # Departure: the small weight of the distance to t-SNE's points leaves the maps' scale open, so
    # outputs are made as wide as the points.
    reach = np.abs(embedding.embed(data.x)).max(axis=2)
    extent = np.quantile(reach, _INSIDE_SHARE, axis=1)
    return embedding.scaled((np.abs(data.target).max() / extent).astype(np.float32))


def stack_members(members: list[dict[str, np.ndarray]]) -> Embedding:
    """Stacks maps of `train_map`."""
    return Embedding({name: np.stack([member[name] for member in members]) for name in members[0]})


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Trains in one thread, with the same bits on any machine; restores torch's generator."""
    import torch

    number = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            yield
    finally:
        torch.set_num_threads(number)


def train_map(
    data: MapData, parameters: AssessmentParameters, *, seed: int, progress: _Report = ignore
) -> dict[str, np.ndarray]:
    """Trains one map Psi, the same for a seed and a machine; names its arrays as in `Embedding`.

    Departure ("sharpened" only): the paper trains Psi on ||y - Psi(x)|| alone. With a safety head
    on y and a margin head on the trunk, it separates neighbours in t-SNE that end differently.
    """
    import torch
    from torch.nn import functional

    settings = mode_settings(parameters)
    mean = data.x.mean(axis=0)
    spread = np.ones(len(mean))
    if settings.standardized:
        # With a lower bound, so that nearly constant columns are not amplified.
        spread = np.maximum(data.x.std(axis=0), _SMALLEST_SPREAD) / data.input_scale
    target_scale = float(data.target.std())

    def single(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.asarray(values, dtype=np.float32))

    with one_torch_thread():
        torch.manual_seed(seed)
        net = _network(data.x.shape[1], data.margins.shape[1], settings)
        x = single((data.x - mean) / spread)
        target = torch.zeros(len(x), 2)
        has_target = torch.from_numpy(np.asarray(data.has_target, dtype=bool))
        target[has_target] = single(data.target / target_scale)
        weight = single(data.sample_weight)
        target_weight = weight * has_target
        is_unsafe = single(data.is_unsafe)
        low, high = parameters.margin_range
        margins = single(np.clip(data.margins, low, high) / parameters.margin_unit)
        rate, num_batches = parameters.learning_rate, -(-len(x) // parameters.batch_size)
        optimiser = torch.optim.AdamW(
            net.parameters(), lr=rate, weight_decay=settings.weight_decay, fused=True
        )
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, max_lr=rate, total_steps=settings.epochs * num_batches + 1
        )
        # The share of targets varies between batches, so the mean over the whole set normalises.
        mean_target_weight = float(target_weight.mean())
        for epoch in range(settings.epochs):
            for batch in torch.randperm(len(x)).split(parameters.batch_size):
                output = net["output"](net["trunk"](x[batch]))
                y, w = output[:, :2], weight[batch]
                distance = ((y - target[batch]) ** 2).sum(dim=1)
                distance = (target_weight[batch] * distance).mean()
                if settings.is_paper:
                    loss = distance / mean_target_weight
                else:
                    entropy = functional.binary_cross_entropy_with_logits(
                        net["safety"](y)[:, 0], is_unsafe[batch], weight=w
                    )
                    huber = functional.huber_loss(output[:, 2:], margins[batch], reduction="none")
                    loss = _TARGET_WEIGHT * distance / mean_target_weight
                    loss = loss + _SAFETY_WEIGHT * entropy + (w * huber.mean(dim=1)).mean()
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                optimiser.step()
                schedule.step()
            progress((epoch + 1) / settings.epochs)
    return _folded_weights(net, mean, spread, target_scale, parameters.margin_unit)


def _network(num_inputs: int, num_margins: int, settings: ModeSettings) -> Any:
    from torch import nn

    trunk: list[nn.Module] = []
    width = num_inputs
    for size in settings.hidden_sizes:
        trunk += [nn.Linear(width, size), nn.ReLU()]
        if settings.dropout > 0.0:
            trunk.append(nn.Dropout(settings.dropout))
        width = size
    num_outputs = 2 if settings.is_paper else 2 + num_margins
    net = nn.ModuleDict({"trunk": nn.Sequential(*trunk), "output": nn.Linear(width, num_outputs)})
    if not settings.is_paper:
        head = nn.Linear(2, _SAFETY_HIDDEN), nn.ReLU(), nn.Linear(_SAFETY_HIDDEN, 1)
        net["safety"] = nn.Sequential(*head)
    return net


def _folded_weights(
    net: Any, mean: np.ndarray, spread: np.ndarray, target_scale: float, margin_unit: float
) -> dict[str, np.ndarray]:
    """The trained layers with the standardisation of x, y and the margins folded in."""
    weights: dict[str, np.ndarray] = {}
    for part in net:
        layers = [layer for layer in net[part].modules() if hasattr(layer, "weight")]
        for i, layer in enumerate(layers):
            name = "output" if part == "output" else f"{part}.{i}"
            weights[f"{name}.weight"] = layer.weight.detach().numpy().astype(float).T
            weights[f"{name}.bias"] = layer.bias.detach().numpy().astype(float)
    weight = weights["trunk.0.weight"]
    weights["trunk.0.bias"] = weights["trunk.0.bias"] - (mean / spread) @ weight
    weights["trunk.0.weight"] = weight / spread[:, None]
    scale = np.full(len(weights["output.bias"]), margin_unit)
    scale[:2] = target_scale
    weights["output.weight"] = weights["output.weight"] * scale
    weights["output.bias"] = weights["output.bias"] * scale
    if "safety" in net:
        weights["safety.0.weight"] = weights["safety.0.weight"] / target_scale
    return weights


def fitted_base_logit(
    output: EmbeddingOutput,
    segments: Segments,
    parameters: AssessmentParameters,
    trees_logit: np.ndarray | None = None,
) -> BaseLogit:
    """Fits the base logit to heads and trees at held-out segments by logistic regression.

    Beside trees the slopes of both logits are scaled to a sum of at most one: what is surer than
    either holds for the nominal plant, as on a changed one both err together.
    """
    low, high = parameters.margin_range
    logit = BaseLogit(margin_unit=parameters.margin_unit, margin_range=(low, high))
    weight = _sample_weight(segments, mode_settings(parameters))
    offset, safety_slope, margin_slope, *of_trees = _logistic(
        logit.heads(output, mean_of_maps(output.margins), trees_logit), segments.is_unsafe, weight
    )
    trees_slope = sum(of_trees)
    total = max(1.0, safety_slope + trees_slope) if of_trees else 1.0
    return replace(
        logit,
        offset=offset,
        safety_slope=safety_slope / total,
        margin_slope=margin_slope,
        trees_slope=trees_slope / total,
    )


def _logistic(z: np.ndarray, label: np.ndarray, weight: np.ndarray) -> list[float]:
    """Intercept and slopes, none of them negative, of a logistic regression on z (N, m)."""
    from scipy.optimize import minimize

    share = weight / weight.sum()
    y = label.astype(float)
    columns = np.column_stack([np.ones(len(z)), z])

    def loss(values: np.ndarray) -> tuple[float, np.ndarray]:
        logit = columns @ values
        # The weight of a hundredth of a sample keeps the slopes finite for separable classes.
        penalty = 0.01 / len(z) * values
        residual = share * (1.0 / (1.0 + np.exp(-np.clip(logit, -500.0, 500.0))) - y)
        cost = share @ (np.logaddexp(0.0, logit) - y * logit) + 0.5 * penalty @ values
        return float(cost), residual @ columns + penalty

    bounds = [(-LOGIT_LIMIT, LOGIT_LIMIT), *((0.0, 50.0) for _ in range(z.shape[1]))]
    start = np.r_[0.0, np.ones(z.shape[1])]
    return minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds).x.tolist()
