"""Recalibration: the sharpened mode's update of base logit and beliefs from feedback."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_safety.learning import beliefs as belief_masses
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.feedback import EpisodePair, FeedbackSegments
from drake_safety.learning.grid import Grid
from drake_safety.learning.inputs import InputColumns
from drake_safety.learning.prediction import BaseLogit, Correction, Model, hidden_sum, sigmoid
from drake_safety.learning.training_scores import TrainingScores

# Prior standard deviations of the changes of offset, slopes and hidden layer's contribution.
OFFSET_STD, SLOPE_STD, HIDDEN_STD = 2.0, 0.5, 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class LabelledHeads:
    """Heads and activations for rows of episodes, with the episodes' labels and sample weights."""

    heads: np.ndarray  # (M, 2) or (M, 3)
    activations: np.ndarray  # (K, M, n)
    is_unsafe: np.ndarray
    weight: np.ndarray


def row_weights(num_rows: np.ndarray) -> np.ndarray:
    """Returns sample weights: one for an episode's first row, and two spread over all its rows."""
    first = np.cumsum(num_rows) - num_rows
    weight = np.repeat(2.0 / num_rows, num_rows)
    weight[first] += 1.0
    return weight


def _labelled(
    feedback: Sequence[EpisodePair], columns: InputColumns, model: Model
) -> tuple[LabelledHeads, LabelledHeads]:
    """All rows of the actual episodes, and the twins' first rows."""
    num_rows = np.array([len(pair.rows) for pair in feedback])
    actual = [(pair.rows.state, pair.rows.desired_preview, pair.rows.features) for pair in feedback]
    twins = [pair.twin.first_inputs for pair in feedback]

    def labelled(x: np.ndarray, **labels: np.ndarray) -> LabelledHeads:
        heads, activations = model.evaluate(x).heads, model.embedding.activations(x)
        assert heads is not None
        return LabelledHeads(heads=heads, activations=activations, **labels)

    x = columns.of(*map(np.concatenate, zip(*actual, strict=True)))
    is_unsafe = np.repeat([not pair.actual.is_safe for pair in feedback], num_rows)
    x_twins = columns.of(*map(np.stack, zip(*twins, strict=True)))
    twin_is_unsafe = np.array([not pair.twin.is_safe for pair in feedback])
    return (
        labelled(x, is_unsafe=is_unsafe, weight=row_weights(num_rows)),
        labelled(x_twins, is_unsafe=twin_is_unsafe, weight=np.ones(len(feedback))),
    )


def fitted_change(
    actual: LabelledHeads, twins: LabelledHeads, base_logit: BaseLogit
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fits `change` (3,) or (4,), `hidden` (K, n + 1) and `hidden_range` (2,) of a `Correction`.

    With phi = (1, heads, activations) and the base logit ell, w minimises the log loss of
    sigma(ell + w . phi) on the actual episodes with a normal prior, minus the error of ell at the
    start of the twins, w . sum phi (sigma(ell) - label), so that errors that a pair shares cancel.
    Activations are centred and divided by their mean distance from the mean, so that their joint
    contribution has the standard deviation `HIDDEN_STD`. The corrected slopes stay >= 0.
    """
    from scipy.optimize import minimize

    num_members, _, num_activations = actual.activations.shape
    mean = actual.activations.mean(axis=1, keepdims=True)
    unit = np.sqrt(np.mean(np.sum((actual.activations - mean) ** 2, axis=(0, 2))))
    unit = max(float(unit), 1e-12)  # Zero for a single row.

    def columns(rows: LabelledHeads) -> np.ndarray:
        hidden = (rows.activations - mean).transpose(1, 0, 2).reshape(len(rows.heads), -1)
        return np.column_stack([np.ones(len(hidden)), rows.heads, hidden / unit])

    phi, logit = columns(actual), base_logit.of_heads(actual.heads)
    label = actual.is_unsafe.astype(float)
    error = sigmoid(base_logit.of_heads(twins.heads)) - twins.is_unsafe
    expected = columns(twins).T @ (twins.weight * error)
    num_heads = actual.heads.shape[1]
    deviation = np.full(phi.shape[1], HIDDEN_STD)
    deviation[: 1 + num_heads] = OFFSET_STD, *[SLOPE_STD] * num_heads
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
    options = {"ftol": 1e-13, "gtol": 1e-7, "maxiter": 2000, "maxcor": 30, "maxfun": 4000}
    start = np.zeros(phi.shape[1])
    w = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
    weights = w[1 + num_heads :].reshape(num_members, num_activations) / unit
    hidden = np.column_stack([weights, -np.sum(weights * mean[:, 0], axis=1)])
    added = hidden_sum(actual.activations, hidden)
    return w[: 1 + num_heads], hidden, np.array([added.min(), added.max()])


def _cell_means(values: np.ndarray, points: np.ndarray, grid: Grid) -> np.ndarray:
    """Averages values (M,) at points (K, M, 2) in each map's cells, (K, R*R); 0 in empty cells."""
    means = []
    for member_points in points:
        cells = grid.locate(member_points)
        inside = cells >= 0
        count = np.bincount(cells[inside], minlength=grid.num_cells)
        total = np.bincount(cells[inside], values[inside], minlength=grid.num_cells)
        means.append(total / np.maximum(count, 1))
    return np.array(means)


def recalibrated(
    model: Model,
    feedback: Sequence[EpisodePair],
    segments: FeedbackSegments,
    training: TrainingScores,
    columns: InputColumns,
    parameters: AssessmentParameters,
) -> tuple[Correction, np.ndarray]:
    """Returns the correction and the beliefs, (K, R*R, 3 + n_c), by feedback and its segments.

    Only pairs with different outcomes are evidence of a reality gap; without any, the correction is
    zero. Cells that training leaves empty are filled by the feedback.

    Departure: the paper raises the uncertainty where nominal scores are unreliable, which hardly
    changes the safe share of a cell. Adding sigma(ell + shift) - sigma(ell) to every score moves
    the boundary between safe and unsafe. The hidden layer's contribution is known at the feedback
    only; its mean in a cell is used for all training segments of the cell.
    """
    assert model.base_logit is not None
    assert training.heads is not None and training.nearest is not None
    grid, mu, num_causes = model.grid, parameters.initial_uncertainty, model.num_causes
    x = columns.of(segments.state, segments.desired_preview, segments.features)
    points = model.embedding.embed(x)
    correction = Correction.none(model.embedding, grid, model.trees)
    if any(pair.differs for pair in feedback):
        actual, twins = _labelled(feedback, columns, model)
        change = fitted_change(actual, twins, model.base_logit)
        # Where most feedback was unsafe, the base logit must not fall.
        vote = np.where(segments.is_unsafe, 1.0, -1.0)
        guard = (_cell_means(vote, points, grid) > 0.0).astype(float)
        correction = Correction(*change, guard)
    means = _cell_means(correction.residual(model.embedding.activations(x)), points, grid)
    of_feedback = belief_masses.from_scores(segments.score, mu, segments.cause, num_causes)
    options = {"num_cells": grid.num_cells, "min_count": parameters.min_count}
    beliefs = []
    members = zip(training.points, points, means, correction.guard, strict=True)
    for training_points, feedback_points, added, guard in members:
        cells = grid.locate(training_points)
        inside = cells >= 0
        heads, score, cells = training.heads[inside], training.score[inside], cells[inside]
        logit = model.base_logit.of_heads(heads)
        shift = correction.shift(heads, added[cells], guard[cells])
        # Without a shift the difference is exactly zero, and the scores stay the same.
        score = np.clip(score + (sigmoid(logit + shift) - sigmoid(logit)), 0.0, 1.0)
        # Newly unsafe segments get the constraint with the smallest margin.
        cause = np.where(training.cause >= 0, training.cause, training.nearest)[inside]
        masses = belief_masses.from_scores(score, mu, cause, num_causes)
        times = training.times[inside]
        learned = belief_masses.fuse_cells(masses, cells, multiplicity=times, **options)
        filled = belief_masses.fuse_cells(
            np.concatenate([masses, of_feedback]),
            np.concatenate([cells, grid.locate(feedback_points)]),
            multiplicity=np.concatenate([times, np.ones(len(of_feedback))]),
            **options,
        )
        is_empty = learned[:, belief_masses.UNCERTAINTY] == 1.0
        beliefs.append(np.where(is_empty[:, None], filled, learned))
    return correction, np.stack(beliefs)
