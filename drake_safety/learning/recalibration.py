"""How feedback changes L, and beliefs with it: the update of the sharpened mode."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_safety.learning import beliefs as belief_masses
from drake_safety.learning.adaptation import TrainingScores
from drake_safety.learning.assessment_parameters import AdaptationParameters, AssessmentParameters
from drake_safety.learning.feedback import FeedbackSegments
from drake_safety.learning.grid import Grid
from drake_safety.learning.prediction import BaseLogit, Correction, sigmoid


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcomes:
    """What the maps say of rows of episodes, and how the episodes ended.

    Attributes:
        heads: What L is made of, see `BaseLogit.heads`, (M, 2).
        is_unsafe: Whether the row's episode ended unsafely, (M,).
        weight: What the row counts for, (M,).
    """

    heads: np.ndarray
    is_unsafe: np.ndarray
    weight: np.ndarray


def row_weights(num_rows: np.ndarray) -> np.ndarray:
    """What rows of episodes count for: one for an episode's first row, and one for the mean of all.

    Args:
        num_rows: Rows of each episode; they follow each other.
    """
    first = np.cumsum(num_rows) - num_rows
    weight = np.repeat(1.0 / num_rows, num_rows)
    weight[first] += 1.0
    return weight


def fitted_change(
    actual: Outcomes, twins: Outcomes, base_logit: BaseLogit, settings: AdaptationParameters
) -> np.ndarray:
    """What is added to the offset, the safety slope and the margin slope of L, (3,).

    The change w minimises the log loss of sigma(L + w . phi) on the actual episodes, phi = (1, z,
    -m / margin_unit), with a normal prior, and less what L itself is wrong about at the start of
    the twins: w . sum phi (sigma(L) - label). What is hard to tell of a start is so for both of a
    pair and cancels, and so does what L is wrong about on the nominal plant, too. Later a twin is
    in another state, and its end says nothing of where the actual robot is: those rows of the
    actual episodes count without one. Both slopes of L + w . phi stay >= 0.

    Args:
        actual: Rows of the actual episodes.
        twins: The twins' first rows.
        base_logit: L.
        settings: Standard deviations of the prior.
    """
    from scipy.optimize import minimize

    def columns(outcomes: Outcomes) -> np.ndarray:
        return np.column_stack([np.ones(len(outcomes.heads)), outcomes.heads])

    phi, logit = columns(actual), base_logit.of_heads(actual.heads)
    label = actual.is_unsafe.astype(float)
    error = sigmoid(base_logit.of_heads(twins.heads)) - twins.is_unsafe
    expected = columns(twins).T @ (twins.weight * error)
    precision = np.array([settings.offset_std, settings.slope_std, settings.slope_std]) ** -2.0

    def loss(change: np.ndarray) -> tuple[float, np.ndarray]:
        shifted = logit + phi @ change
        value = actual.weight @ (np.logaddexp(0.0, shifted) - label * shifted)
        residual = actual.weight * (np.exp(-np.logaddexp(0.0, -shifted)) - label)
        pull = precision * change
        return float(value - expected @ change + 0.5 * pull @ change), (
            phi.T @ residual - expected + pull
        )

    bounds = [(None, None), (-base_logit.safety_slope, None), (-base_logit.margin_slope, None)]
    options = {"ftol": 1e-14, "gtol": 1e-9, "maxiter": 1000}
    found = minimize(loss, np.zeros(3), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return np.asarray(found.x)


def guarded_cells(feedback: FeedbackSegments, points: np.ndarray, grid: Grid) -> np.ndarray:
    """1 in the cells of every map most of whose feedback was unsafe, else 0, (K, R*R).

    Args:
        feedback: The feedback.
        points: Psi(x) of it, (K, M, 2).
        grid: The grid.
    """
    # Safe counts against unsafe: a majority of unsafe segments is above zero.
    vote = np.where(feedback.is_unsafe, 1.0, -1.0)
    guard = []
    for member_points in points:
        cells = grid.locate(member_points)
        inside = cells >= 0
        guard.append(np.bincount(cells[inside], vote[inside], minlength=grid.num_cells) > 0.0)
    return np.array(guard, dtype=float)


def recalibrated_beliefs(
    training: TrainingScores,
    base_logit: BaseLogit,
    correction: Correction,
    grid: Grid,
    parameters: AssessmentParameters,
    num_causes: int,
) -> np.ndarray:
    """Beliefs from training scores that are moved as the logit is, (K, R*R, 3 + n_c).

    Departure: the paper learns where the nominal scores are unreliable and trusts them less there.
    That hardly moves the safe share of a cell, as F keeps the ratio of its masses, and the
    discrepancy has no sign. Adding sigma(L + shift) - sigma(L) to every score moves the boundary
    between safe and unsafe itself, and needs few pairs, as it is three numbers.

    Args:
        training: The training segments.
        base_logit: L.
        correction: What is added to L.
        grid: The grid.
        parameters: Of the assessment.
        num_causes: n_c.
    """
    if training.heads is None or training.nearest is None:
        raise ValueError("recalibrated_beliefs: the maps have no heads, and so no logit to move")
    all_logit = base_logit.of_heads(training.heads)
    fused = []
    for points, guard in zip(training.points, correction.guard, strict=True):
        cells = grid.locate(points)
        inside = cells >= 0
        logit, score = all_logit[inside], training.score[inside]
        shift = correction.shift(training.heads[inside], guard[cells[inside]])
        # Without a shift the difference is zero to the bit, and so are the scores the same.
        score = np.clip(score + (sigmoid(logit + shift) - sigmoid(logit)), 0.0, 1.0)
        cause = training.cause[inside]
        # What has become possible has the cause that is nearest.
        cause = np.where(cause >= 0, cause, training.nearest[inside])
        masses = belief_masses.from_scores(score, parameters.initial_uncertainty, cause, num_causes)
        fused.append(
            belief_masses.fuse_cells(
                masses,
                cells[inside],
                num_cells=grid.num_cells,
                min_count=parameters.min_count,
            )
        )
    return np.stack(fused)
