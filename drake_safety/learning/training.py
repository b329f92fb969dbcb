"""Training of an assessment's maps: from episodes to segments, t-SNE's points and Psi."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.distance import neighbour_graph
from drake_safety.learning.embedding import MapData, stack_members, train_map, tsne
from drake_safety.learning.grid import Grid
from drake_safety.learning.prediction import LOGIT_LIMIT, BaseLogit
from drake_safety.learning.segments import Episodes, EpisodesInfo, Segments, split
from drake_safety.learning.trained_maps import Embedding, EmbeddingOutput

_NUM_NEIGHBOURS = 15
"""Nearest neighbours of a segment in the loss of parametric t-SNE, as in its publication."""
_INSIDE_SHARE = 0.995
"""Quantile of the inputs whose outputs are scaled to the extent of t-SNE's points."""
_CLIPPED_SHARE = 1e-3
"""Share of the training inputs that is clipped at either end of a column of x."""
_logger = logging.getLogger("drake_safety")


def check_preview(info: EpisodesInfo, parameters: AssessmentParameters) -> None:
    """Checks that episodes have the preview of an assessment's parameters."""
    for name in ("horizon", "preview_stride"):
        here, there = getattr(parameters, name), getattr(info, name)
        if here != there:
            raise ValueError(
                f"SafetyAssessment: {name} is {here}, but that of the episodes of "
                f"'{info.scenario}' is {there}"
            )


def segments_for(
    episodes: Episodes, parameters: AssessmentParameters
) -> tuple[Segments, np.ndarray]:
    """Splits training episodes into segments according to the mode.

    Returns:
        The segments, and whether each is embedded by t-SNE, (N,).

    Raises:
        ValueError: The episodes give too few segments for t-SNE.
    """
    is_sharpened, horizon = parameters.is_sharpened, parameters.horizon
    segments = split(
        episodes,
        stride=parameters.stride,
        discount=parameters.discount,
        shortest=parameters.shortest,
    )
    every = max(horizon // 2, 1) * parameters.preview_stride if is_sharpened else 1
    first = np.array([episode.first_step for episode in episodes])[segments.episode]
    has_target = (segments.start_row - first) % every == 0
    num_targeted, num_neighbours = int(has_target.sum()), int(3 * parameters.perplexity)
    if num_targeted <= num_neighbours:
        raise ValueError(
            f"SafetyAssessment: perplexity {parameters.perplexity} needs more than "
            f"{num_neighbours} segments, the {len(episodes)} episodes give {num_targeted}: record "
            "more episodes, or lower the perplexity"
        )
    _logger.info(
        "training on %d segments of %d episodes (%d unsafe, %d diverged), %d of them in t-SNE",
        len(segments),
        len(episodes),
        episodes.num_unsafe,
        episodes.num_diverged,
        num_targeted,
    )
    return segments, has_target


def learned_maps(
    segments: Segments,
    has_target: np.ndarray,
    x: np.ndarray,
    grid: Grid,
    parameters: AssessmentParameters,
    progress: StageProgress | None,
) -> tuple[Embedding, BaseLogit | None]:
    """Embeds the segments by t-SNE and trains the maps Psi to reproduce the embedding.

    Args:
        has_target: Whether each is embedded by t-SNE, (N,).
        x: Their inputs, (N, n_x).
        grid: The grid that t-SNE's points are scaled to.
        progress: Called with "distances", "t-SNE", "training", the percentage done and 100.

    Returns:
        The maps, and the base logit of their heads; None without heads.
    """

    def stage(name: str) -> Callable[[float], None] | None:
        return None if progress is None else lambda done: progress(name, round(100 * done), 100)

    targeted = segments.take(has_target)
    num_neighbours = int(3 * parameters.perplexity)
    graph = neighbour_graph(
        targeted.error,
        targeted.length,
        targeted.score,
        score_weight=parameters.score_weight,
        cost=parameters.warping_cost,
        num_neighbours=num_neighbours,
        num_candidates=parameters.candidates_per_neighbour * num_neighbours or None,
        backend=parameters.distance_backend,
        progress=stage("distances"),
    )
    points = tsne(
        graph,
        perplexity=parameters.perplexity,
        exaggeration=parameters.exaggeration,
        initialization=parameters.initialization,
        seed=parameters.seed,
        progress=stage("t-SNE"),
    )
    target = grid.scale(points)
    nearest = graph.indices[:, :_NUM_NEIGHBOURS]
    neighbours = np.full((len(x), nearest.shape[1]), -1)
    neighbours[has_target] = np.flatnonzero(has_target)[nearest]
    data = MapData(
        x=x,
        has_target=has_target,
        target=target,
        is_unsafe=segments.is_unsafe,
        margins=segments.future_margins,
        sample_weight=_sample_weight(segments, parameters),
        input_scale=_input_scale(x.shape[1], segments.features.shape[1], parameters),
        neighbours=neighbours,
        tsne_unit=float(target.std() / points.std()),
    )
    is_held_out = held_out_segments(segments, parameters)
    label = segments.is_unsafe[is_held_out]
    report = stage("training")
    if not parameters.is_sharpened:
        held_out = data.take(is_held_out) if is_held_out.any() else None
        return _train(data.take(~is_held_out), parameters, report, held_out), None
    if not 0 < label.sum() < len(label):
        # No held-out episodes of both labels.
        embedding = _train(data, parameters, report)
        tried, is_held_out = embedding, np.ones(len(segments), dtype=bool)
    else:
        # As scikit-learn's CalibratedClassifierCV(ensemble=False): a first ensemble is evaluated
        # on the held-out episodes, and the final one is trained on all episodes.
        tried = _train(data.take(~is_held_out), parameters, _part(report, 0))
        embedding = _train(data, parameters, _part(report, 1))
    if not embedding.has_heads:
        return embedding, None
    base_logit = fitted_base_logit(
        tried.evaluate(x[is_held_out]), segments.take(is_held_out), parameters
    )
    return embedding, base_logit


def known_range(x: np.ndarray) -> np.ndarray:
    """Returns the range of each column to which the maps' inputs are clipped, (2, n_x).

    Departure: a map of rectifiers extrapolates linearly, off the grid or into cells of others; of a
    clipped input it knows at least the other columns, as a decision tree does.
    """
    return np.quantile(x, [_CLIPPED_SHARE, 1.0 - _CLIPPED_SHARE], axis=0)


def _part(progress: Callable[[float], None] | None, half: int) -> Callable[[float], None] | None:
    """Progress of the first or second half of a stage."""
    return None if progress is None else lambda fraction: progress(0.5 * (half + fraction))


def held_out_segments(segments: Segments, parameters: AssessmentParameters) -> np.ndarray:
    """Returns which segments are held out, (N,), by whole episodes.

    They are held out for the base logit, a function of the ensemble's mean, so all maps hold out
    the same episodes; in the paper's mode for early stopping.
    """
    episodes = np.unique(segments.episode)
    share = parameters.held_out if parameters.is_sharpened else parameters.paper.held_out
    rng = np.random.default_rng(
        np.random.SeedSequence(parameters.seed, spawn_key=(parameters.num_members,))
    )
    return np.isin(
        segments.episode, rng.permutation(episodes)[: int(min(share, 0.5) * len(episodes))]
    )


def _sample_weight(segments: Segments, parameters: AssessmentParameters) -> np.ndarray:
    weight = np.ones(len(segments))
    if parameters.is_sharpened:
        weight[segments.is_first] = parameters.first_row_weight
    return weight / weight.mean()


def _input_scale(
    num_inputs: int, num_features: int, parameters: AssessmentParameters
) -> np.ndarray:
    scale = np.ones(num_inputs)
    if parameters.is_sharpened:
        num_copies = 2 if parameters.feature_unit else 1
        scale[: num_inputs - num_copies * num_features] = parameters.raw_input_scale
    return scale


def _train(
    data: MapData,
    parameters: AssessmentParameters,
    progress: Callable[[float], None] | None,
    held_out: MapData | None = None,
) -> Embedding:
    parameters = parameters.of_maps()
    num_members = parameters.num_members
    members = []
    for member in range(num_members):

        def report(fraction: float, member: int = member) -> None:
            if progress is not None:
                progress((member + fraction) / num_members)

        seed = int(
            np.random.SeedSequence(parameters.seed, spawn_key=(member,)).generate_state(1)[0]
        )
        members.append(train_map(data, parameters, seed=seed, held_out=held_out, progress=report))
    num_margins = data.margins.shape[1] if parameters.margin_weight > 0.0 else 0
    embedding = stack_members(members, num_margins=num_margins)
    return _fill_grid(embedding, data) if parameters.is_sharpened else embedding


def _fill_grid(embedding: Embedding, data: MapData) -> Embedding:
    """Scales the maps so that their outputs are as wide as t-SNE's points.

    Departure: a small weight of the distance to t-SNE's points leaves the maps' scale open; outputs
    would fall outside the grid, or into few of its cells.
    """
    reach = np.abs(embedding.embed(data.x)).max(axis=2)
    extent = np.quantile(reach, _INSIDE_SHARE, axis=1)
    return embedding.scaled((np.abs(data.target).max() / extent).astype(np.float32))


def fitted_base_logit(
    output: EmbeddingOutput, segments: Segments, parameters: AssessmentParameters
) -> BaseLogit:
    """Fits the base logit to the ensemble's heads by logistic regression.

    Args:
        output: The maps' outputs for held-out segments; on training segments they are
            overconfident.
    """
    logit = BaseLogit(
        margin_unit=parameters.margin_unit,
        margin_range=(parameters.margin_range[0], parameters.margin_range[1]),
    )
    offset, safety_slope, margin_slope = _logistic(
        logit.heads(output), segments.is_unsafe, _sample_weight(segments, parameters)
    )
    return replace(logit, offset=offset, safety_slope=safety_slope, margin_slope=margin_slope)


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
