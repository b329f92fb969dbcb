"""Recalibration: the sharpened mode's update of base logit and beliefs from feedback."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from drake_safety.learning import beliefs as belief_masses
from drake_safety.learning.assessment_parameters import AdaptationParameters, AssessmentParameters
from drake_safety.learning.feedback import EpisodePair, FeedbackSegments
from drake_safety.learning.grid import Grid
from drake_safety.learning.inputs import InputColumns
from drake_safety.learning.prediction import BaseLogit, Correction, hidden_sum, sigmoid
from drake_safety.learning.trained_maps import Embedding
from drake_safety.learning.training_scores import TrainingScores
from drake_safety.learning.trees import Trees


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcomes:
    """Outputs of the maps for rows of episodes, with the episodes' labels.

    Attributes:
        heads: Inputs of the base logit, see `BaseLogit.heads`, (M, 2) or (M, 3).
        activations: Activations of the maps' last hidden layer, (K, M, n).
        is_unsafe: Whether the row's episode ended unsafely, (M,).
        weight: Sample weight, (M,).
    """

    heads: np.ndarray
    activations: np.ndarray
    is_unsafe: np.ndarray
    weight: np.ndarray


def row_weights(num_rows: np.ndarray) -> np.ndarray:
    """Returns sample weights: one for an episode's first row, and two spread over all its rows.

    The rows of an episode share one label, so an episode counts as a few samples.
    """
    first = np.cumsum(num_rows) - num_rows
    weight = np.repeat(2.0 / num_rows, num_rows)
    weight[first] += 1.0
    return weight


def outcomes(
    feedback: Sequence[EpisodePair],
    columns: InputColumns,
    embedding: Embedding,
    base_logit: BaseLogit,
    trees: Trees | None,
) -> tuple[Outcomes, Outcomes]:
    """Outcomes of all rows of the actual episodes, and of the twins' first rows."""
    num_rows = np.array([len(pair.rows) for pair in feedback])
    actual = [(one.rows.state, one.rows.desired_preview, one.rows.features) for one in feedback]
    first = [(one.twin, slice(one.twin.first_step, one.twin.first_step + 1)) for one in feedback]
    twins = [(one.state[k], one.desired_preview[k], one.features[k]) for one, k in first]
    fell = np.repeat([not one.actual.is_safe for one in feedback], num_rows)
    twin_fell = np.array([not one.twin.is_safe for one in feedback])

    def of(rows: list[Any], is_unsafe: np.ndarray, weight: np.ndarray) -> Outcomes:
        x = columns.of(*map(np.concatenate, zip(*rows, strict=True)))
        trees_logit = None if trees is None else trees.evaluate(x)
        heads = base_logit.heads(embedding.evaluate(x), trees_logit)
        known = embedding.activations(x)
        return Outcomes(heads=heads, activations=known, is_unsafe=is_unsafe, weight=weight)

    return of(actual, fell, row_weights(num_rows)), of(twins, twin_fell, np.ones(len(feedback)))


def fitted_change(
    actual: Outcomes, twins: Outcomes, base_logit: BaseLogit, settings: AdaptationParameters
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fits `change` (3,) or (4,), `hidden` (K, n + 1) and `hidden_range` (2,) of a `Correction`.

    With phi = (1, heads, activations) and the base logit ell, w minimises the log
    loss of sigma(ell + w . phi) on the actual episodes with a normal prior, minus the error of ell
    at the start of the twins, w . sum phi (sigma(ell) - label). Errors of ell that a pair shares,
    from an ambiguous start or on the nominal plant, cancel. Later rows of the actual episodes have
    no counterpart, as the twin is then in another state. Activations are centred and divided by
    their mean distance from the mean, so that their joint contribution has the standard deviation
    `hidden_std`. The corrected slopes stay >= 0.
    """
    from scipy.optimize import minimize

    num_members, _, num_activations = actual.activations.shape
    mean = actual.activations.mean(axis=1, keepdims=True)
    unit = np.sqrt(np.mean(np.sum((actual.activations - mean) ** 2, axis=(0, 2))))
    unit = max(float(unit), 1e-12)  # Zero for a single row.

    def columns(outcomes: Outcomes) -> np.ndarray:
        hidden = (outcomes.activations - mean).transpose(1, 0, 2).reshape(len(outcomes.heads), -1)
        return np.column_stack([np.ones(len(hidden)), outcomes.heads, hidden / unit])

    phi, logit = columns(actual), base_logit.of_heads(actual.heads)
    label = actual.is_unsafe.astype(float)
    error = sigmoid(base_logit.of_heads(twins.heads)) - twins.is_unsafe
    expected = columns(twins).T @ (twins.weight * error)
    num_heads = actual.heads.shape[1]
    deviation = np.full(phi.shape[1], settings.hidden_std)
    deviation[: 1 + num_heads] = settings.offset_std, *[settings.slope_std] * num_heads
    precision = deviation**-2.0

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        shifted = logit + phi @ w
        value = actual.weight @ (np.logaddexp(0.0, shifted) - label * shifted)
        residual = actual.weight * (np.exp(-np.logaddexp(0.0, -shifted)) - label)
        pull = precision * w
        slope = phi.T @ residual - expected + pull
        return float(value - expected @ w + 0.5 * pull @ w), slope

    bounds: list[tuple[float | None, None]] = [(None, None)] * phi.shape[1]
    bounds[1 : 1 + num_heads] = [(-slope, None) for slope in base_logit.slopes[:num_heads]]
    options = {"ftol": 1e-13, "gtol": 1e-7, "maxiter": 2000, "maxfun": 4000, "maxcor": 30}
    start = np.zeros(phi.shape[1])
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
    weights = found[1 + num_heads :].reshape(num_members, num_activations) / unit
    constant = -np.sum(weights * mean[:, 0], axis=1)
    hidden = np.column_stack([weights, constant])
    added = hidden_sum(actual.activations, hidden)
    return found[: 1 + num_heads], hidden, np.array([added.min(), added.max()])


def cell_means(values: np.ndarray, points: np.ndarray, grid: Grid) -> np.ndarray:
    """Averages values (M,) at points (K, M, 2) in each map's cells, (K, R*R); 0 in empty ones."""
    means = []
    for member_points in points:
        cells = grid.locate(member_points)
        inside = cells >= 0
        count = np.bincount(cells[inside], minlength=grid.num_cells)
        total = np.bincount(cells[inside], values[inside], minlength=grid.num_cells)
        means.append(total / np.maximum(count, 1))
    return np.array(means)


def recalibrated_beliefs(
    feedback: Sequence[EpisodePair],
    segments: FeedbackSegments,
    *,
    columns: InputColumns,
    embedding: Embedding,
    base_logit: BaseLogit,
    trees: Trees | None,
    training: TrainingScores,
    grid: Grid,
    parameters: AssessmentParameters,
    num_causes: int,
) -> tuple[Correction, np.ndarray]:
    """Corrects base logit and beliefs, (K, R*R, 3 + n_c), by feedback and its segments.

    Only pairs with different outcomes are evidence of a reality gap; without any, the correction is
    zero. Training scores are shifted as the base logit is; cells that training leaves empty are
    filled by the feedback.

    Departure: the paper raises the uncertainty where nominal scores are unreliable. That hardly
    changes the safe share of a cell, as F keeps the ratio of its masses and the discrepancy has no
    sign. Adding sigma(ell + shift) - sigma(ell) to every score moves the boundary between safe and
    unsafe. The hidden layer's contribution is known at the feedback only; its mean in a cell is
    used for all training segments of the cell.
    """
    if training.heads is None or training.nearest is None:
        raise ValueError("recalibrated_beliefs: the maps have no heads")
    x = columns.of(segments.state, segments.desired_preview, segments.features)
    points = embedding.embed(x)
    correction = Correction.none(embedding, grid, trees)
    if any(pair.differs for pair in feedback):
        both = outcomes(feedback, columns, embedding, base_logit, trees)
        fitted = fitted_change(*both, base_logit, parameters.adaptation)
        # Where most feedback was unsafe, the base logit must not fall.
        vote = np.where(segments.is_unsafe, 1.0, -1.0)
        guard = (cell_means(vote, points, grid) > 0.0).astype(float)
        correction = Correction(*fitted, guard)
    all_logit = base_logit.of_heads(training.heads)
    actual = belief_masses.from_scores(
        segments.score, parameters.initial_uncertainty, segments.cause, num_causes
    )
    fuse = partial(
        belief_masses.fuse_cells, num_cells=grid.num_cells, min_count=parameters.min_count
    )
    fused = []
    means = cell_means(correction.residual(embedding, x), points, grid)
    members = zip(training.points, points, means, correction.guard, strict=True)
    for training_points, actual_points, added, guard in members:
        cells = grid.locate(training_points)
        inside = cells >= 0
        logit, score = all_logit[inside], training.score[inside]
        here = cells[inside]
        shift = correction.shift(training.heads[inside], added[here], guard[here])
        # Without a shift the difference is exactly zero, and the scores stay the same.
        score = np.clip(score + (sigmoid(logit + shift) - sigmoid(logit)), 0.0, 1.0)
        cause = training.cause[inside]
        # Newly unsafe segments get the constraint with the smallest margin.
        cause = np.where(cause >= 0, cause, training.nearest[inside])
        masses = belief_masses.from_scores(score, parameters.initial_uncertainty, cause, num_causes)
        times = training.times[inside]
        learned = fuse(masses, here, multiplicity=times)
        filled = fuse(
            np.concatenate([masses, actual]),
            np.concatenate([here, grid.locate(actual_points)]),
            multiplicity=np.concatenate([times, np.ones(len(actual))]),
        )
        is_empty = learned[:, belief_masses.UNCERTAINTY] == 1.0
        fused.append(np.where(is_empty[:, None], filled, learned))
    return correction, np.stack(fused)
