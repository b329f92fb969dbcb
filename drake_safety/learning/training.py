"""How an assessment's maps are trained: from episodes to segments, t-SNE's points and Psi."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.distance import neighbour_graph
from drake_safety.learning.embedding import (
    Embedding,
    MapData,
    MapSettings,
    stack_members,
    train_map,
    tsne,
)
from drake_safety.learning.grid import Grid
from drake_safety.learning.prediction import LOGIT_LIMIT, BaseLogit
from drake_safety.learning.segments import Episodes, Segments, split

_INSIDE_SHARE = 0.995
"""Share of the inputs that a map may not send beyond the extent of t-SNE's points."""
_logger = logging.getLogger("drake_safety")

StageProgress = Callable[[str, float], None]
"""Called with a stage and the fraction of it that is done."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingSegments:
    """The segments of training episodes, and which of them t-SNE sees.

    Attributes:
        segments: The N segments.
        has_target: Those that t-SNE sees, (N,).
    """

    segments: Segments
    has_target: np.ndarray


def segments_for(episodes: Episodes, parameters: AssessmentParameters) -> TrainingSegments:
    """Cuts training episodes as the mode wants them.

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
    every = max(horizon // 2, 1) if is_sharpened else 1
    first = np.array([episode.first_step for episode in episodes])[segments.episode]
    has_target = (segments.start_row - first) % every == 0
    num_targeted, num_neighbours = int(has_target.sum()), int(3 * parameters.perplexity)
    if num_targeted <= num_neighbours:
        raise ValueError(
            f"SafetyAssessment: perplexity {parameters.perplexity} needs more than "
            f"{num_neighbours} segments, the {len(episodes)} episodes give {num_targeted}"
        )
    _logger.info(
        "training on %d segments of %d episodes (%d unsafe, %d diverged), %d of them in t-SNE",
        len(segments),
        len(episodes),
        episodes.num_unsafe,
        episodes.num_diverged,
        num_targeted,
    )
    return TrainingSegments(segments=segments, has_target=has_target)


def learned_maps(
    training: TrainingSegments,
    x: np.ndarray,
    grid: Grid,
    parameters: AssessmentParameters,
    progress: StageProgress | None,
) -> Embedding:
    """t-SNE of the segments, and the maps Psi that reproduce it.

    Args:
        training: The training segments.
        x: Their inputs, (N, n_x).
        grid: The grid that t-SNE's points are scaled to.
        parameters: Of the assessment.
        progress: Called with "distances", "t-SNE", "training" and the fraction that is done.
    """

    def stage(name: str) -> Callable[[float], None] | None:
        return None if progress is None else lambda fraction: progress(name, fraction)

    segments = training.segments
    targeted = segments.take(training.has_target)
    graph = neighbour_graph(
        targeted.error,
        targeted.length,
        targeted.score,
        score_weight=parameters.score_weight,
        num_neighbours=int(3 * parameters.perplexity),
        progress=stage("distances"),
    )
    points = tsne(
        graph,
        perplexity=parameters.perplexity,
        seed=parameters.seed,
        progress=stage("t-SNE"),
    )
    data = MapData(
        x=x,
        has_target=training.has_target,
        target=grid.scale(points),
        is_unsafe=segments.is_unsafe,
        margins=segments.future_margins,
        sample_weight=_sample_weight(segments, parameters),
        input_scale=_input_scale(x.shape[1], segments.features.shape[1], parameters),
    )
    return _train(data, parameters, stage("training"))


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
    data: MapData, parameters: AssessmentParameters, progress: Callable[[float], None] | None
) -> Embedding:
    is_sharpened = parameters.is_sharpened
    settings = MapSettings(
        hidden_sizes=tuple(parameters.hidden_sizes) if is_sharpened else (128, 128),
        dropout=parameters.dropout if is_sharpened else 0.0,
        epochs=parameters.epochs if is_sharpened else 40,
        batch_size=parameters.batch_size,
        learning_rate=parameters.learning_rate,
        target_weight=parameters.target_weight if is_sharpened else 1.0,
        safety_weight=parameters.safety_weight if is_sharpened else 0.0,
        margin_weight=parameters.margin_weight if is_sharpened else 0.0,
        margin_unit=parameters.margin_unit,
        margin_range=(parameters.margin_range[0], parameters.margin_range[1]),
    )
    num_members = parameters.num_members
    members = []
    for member in range(num_members):

        def report(fraction: float, member: int = member) -> None:
            if progress is not None:
                progress((member + fraction) / num_members)

        seed = int(
            np.random.SeedSequence(parameters.seed, spawn_key=(member,)).generate_state(1)[0]
        )
        members.append(train_map(data, settings, seed=seed, progress=report))
    num_margins = data.margins.shape[1] if settings.margin_weight > 0.0 else 0
    embedding = stack_members(members, num_margins=num_margins)
    return _fill_grid(embedding, data) if is_sharpened else embedding


def _fill_grid(embedding: Embedding, data: MapData) -> Embedding:
    """Scales the maps so that what they do with the inputs is as wide as t-SNE's points.

    Departure: a light weight on the distance to t-SNE's points leaves the maps' scale open;
    some inputs would fall off the grid, or all into few of its cells.
    """
    reach = np.abs(embedding.embed(data.x)).max(axis=2)
    extent = np.quantile(reach, _INSIDE_SHARE, axis=1)
    return embedding.scaled((np.abs(data.target).max() / extent).astype(np.float32))


def fitted_base_logit(
    margins: np.ndarray, segments: Segments, parameters: AssessmentParameters
) -> BaseLogit:
    """Scales the smallest predicted margin to a logit, by logistic regression.

    Args:
        margins: Predicted margins of the training segments, mean of the maps, (N, n_c); n_c is 0
            without a margin head.
        segments: The training segments.
        parameters: Of the assessment.
    """
    logit = BaseLogit(
        intercept=0.0,
        slope=1.0,
        margin_unit=parameters.margin_unit,
        margin_range=(parameters.margin_range[0], parameters.margin_range[1]),
    )
    if not margins.shape[1]:
        return logit
    from scipy.optimize import minimize

    scaled = np.clip(margins.min(axis=1), *logit.margin_range) / logit.margin_unit
    weight = _sample_weight(segments, parameters) / len(segments)
    is_unsafe = segments.is_unsafe.astype(float)

    def loss(values: np.ndarray) -> tuple[float, np.ndarray]:
        z = values[0] - values[1] * scaled
        # As light as a hundredth of a sample: it only keeps separable classes finite.
        penalty = 0.01 / len(segments) * values
        residual = weight * (1.0 / (1.0 + np.exp(-np.clip(z, -500.0, 500.0))) - is_unsafe)
        cost = weight @ (np.logaddexp(0.0, z) - is_unsafe * z) + 0.5 * penalty @ values
        gradient = np.array([residual.sum(), -residual @ scaled]) + penalty
        return float(cost), gradient

    found = minimize(
        loss, [0.0, 1.0], jac=True, method="L-BFGS-B", bounds=[(-LOGIT_LIMIT, LOGIT_LIMIT), (0, 50)]
    )
    return BaseLogit(
        intercept=float(found.x[0]),
        slope=float(found.x[1]),
        margin_unit=logit.margin_unit,
        margin_range=logit.margin_range,
    )
