"""How feedback changes beliefs: the paper's update, and the paired shift of the sharpened mode."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_safety.learning import beliefs as belief_masses
from drake_safety.learning.assessment_parameters import AdaptationParameters, AssessmentParameters
from drake_safety.learning.discrepancy import DiscrepancyFunction, updated_uncertainty
from drake_safety.learning.feedback import FeedbackSegments
from drake_safety.learning.grid import Grid
from drake_safety.learning.prediction import sigmoid


@dataclass(frozen=True, kw_only=True)
class Adaptation:
    """What an assessment was adapted to.

    Attributes:
        method: "paper" or "shift".
        variation: Of the actual episodes.
        num_sets: How many feedback sets there were.
        num_differing: How many of them had a twin that ended differently.
        shift: b, what was added to the logit of an unsafe end (shift).
    """

    method: str
    variation: str
    num_sets: int
    num_differing: int
    shift: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingScores:
    """What the training segments left behind in the cells.

    Attributes:
        points: Psi(x), (K, N, 2).
        score: lambda, (N,).
        cause: Column of the constraint that ended the episode, -1 when safe, (N,).
        logit: L, (N,); none where the maps have no heads.
        nearest: Column of the constraint that is predicted to be nearest its violation, (N,).
    """

    points: np.ndarray
    score: np.ndarray
    cause: np.ndarray
    logit: np.ndarray | None
    nearest: np.ndarray | None


def prior_beliefs(
    training: TrainingScores,
    grid: Grid,
    parameters: AssessmentParameters,
    num_causes: int,
    uncertainty: np.ndarray | None = None,
) -> np.ndarray:
    """Beliefs of every map's cells from the training segments alone, (K, R*R, 3 + n_c).

    Args:
        training: The training segments.
        grid: The grid.
        parameters: Of the assessment.
        num_causes: n_c.
        uncertainty: mu of every segment in every map, (K, N); mu_ini by default.
    """
    if uncertainty is None:
        uncertainty = np.full(training.points.shape[:2], parameters.initial_uncertainty)
    return np.stack(
        [
            belief_masses.fuse_cells(
                belief_masses.from_scores(training.score, mu, training.cause, num_causes),
                # L(x): the cell of Psi(x), not of the point t-SNE gave the segment.
                grid.locate(points),
                num_cells=grid.num_cells,
                min_count=parameters.min_count,
            )
            for points, mu in zip(training.points, uncertainty, strict=True)
        ]
    )


def paper_beliefs(
    training: TrainingScores,
    feedback: FeedbackSegments,
    points: np.ndarray,
    grid: Grid,
    parameters: AssessmentParameters,
    num_causes: int,
) -> np.ndarray:
    """Beliefs as the paper adapts them, (K, R*R, 3 + n_c).

    Args:
        training: The training segments.
        feedback: Segments of all feedback so far.
        points: Psi(x) of the feedback, (K, M, 2).
        grid: The grid.
        parameters: Of the assessment.
        num_causes: n_c.
    """
    settings = parameters.adaptation
    difference = np.abs(feedback.score - feedback.nominal_score)
    uncertainty = []
    for member_points, training_points in zip(points, training.points, strict=True):
        discrepancy = DiscrepancyFunction().fit(member_points, difference)
        mean, deviation = discrepancy.predict(training_points)
        uncertainty.append(
            updated_uncertainty(
                mean,
                deviation,
                gate=settings.gate,
                least=settings.least_uncertainty,
                initial=parameters.initial_uncertainty,
            )
        )
    prior = prior_beliefs(training, grid, parameters, num_causes, np.stack(uncertainty))
    certain = belief_masses.from_scores(feedback.score, 0.0, feedback.cause, num_causes)
    num_sets = len(np.unique(feedback.set_index))
    return np.stack(
        [
            combined(
                member_prior,
                feedback_beliefs(certain, grid.locate(member_points), grid, settings, num_sets),
            )
            for member_prior, member_points in zip(prior, points, strict=True)
        ]
    )


def feedback_beliefs(
    certain: np.ndarray,
    cells: np.ndarray,
    grid: Grid,
    settings: AdaptationParameters,
    num_sets: int,
) -> np.ndarray:
    """The feedback belief of every cell by G, (R*R, 3 + n_c); empty where there is none.

    Departure: n_f is by default the number of samples in the cell. Read literally, as the number of
    all sets, 40 of them leave an uncertainty of 5e-8, and a single sample wipes out the prior of
    its cell.

    Args:
        certain: Beliefs of the feedback segments, mu = 0, (M, 3 + n_c).
        cells: Cell of each, -1 for outside, (M,).
        grid: The grid.
        settings: beta, alpha, and what n_f counts.
        num_sets: Number of feedback sets.
    """
    count = np.bincount(cells[cells >= 0], minlength=grid.num_cells)
    num_feedback = count if settings.counts_per_cell else np.full(len(count), num_sets)
    # mu_v = beta exp(-alpha (n_f - 1))
    uncertainty = settings.first_uncertainty * np.exp(-settings.decay_rate * (num_feedback - 1.0))
    return belief_masses.average_cells(certain, cells, np.minimum(uncertainty, 1.0))


def combined(prior: np.ndarray, feedback: np.ndarray) -> np.ndarray:
    """F of both beliefs of each cell, (R*R, 3 + n_c); without feedback the prior as it is."""
    num_cells = len(prior)
    both = belief_masses.fuse_cells(
        np.concatenate([prior, feedback]),
        np.tile(np.arange(num_cells), 2),
        num_cells=num_cells,
        min_count=0,
    )
    has_feedback = feedback[:, belief_masses.UNCERTAINTY] < 1.0
    return np.where(has_feedback[:, None], both, prior)


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcomes:
    """How episodes were judged when they began, and how they ended.

    Attributes:
        logit: L of each, (M,).
        is_unsafe: Whether it ended unsafely, (M,).
    """

    logit: np.ndarray
    is_unsafe: np.ndarray

    def surplus(self, shift: float = 0.0) -> float:
        """Unsafe ends that sigma(L + shift) expects beyond those that there were."""
        from scipy.special import expit

        return float(np.sum(expit(self.logit + shift) - self.is_unsafe))


def fitted_shift(actual: Outcomes, nominal: Outcomes, *, prior_std: float) -> float:
    """The one number b for which sigma(L + b) is as right of the actual robot as L of the twins.

    On average sigma(L + b) exceeds the actual episodes' outcomes by as much as sigma(L) exceeds
    their twins'. What is hard to tell of a start is so for both of a pair and cancels, and so does
    what L is wrong about on the nominal plant, too. Only how pairs begin is compared: later a twin
    is in another state, and its end says nothing of where the actual robot is.

    Args:
        actual: The actual episodes.
        nominal: Their twins.
        prior_std: Standard deviation of b before any feedback.
    """
    from scipy.optimize import brentq

    expected = nominal.surplus()

    def slope(b: float) -> float:
        return actual.surplus(b) - expected + b / prior_std**2

    # The slope of the negative log posterior rises throughout; out there it has the sign of b.
    bound = 2.0 * (len(actual.logit) + len(nominal.logit)) * prior_std**2
    return float(brentq(slope, -bound, bound, xtol=1e-10))


def cell_shift(
    shift: float, feedback: FeedbackSegments, points: np.ndarray, grid: Grid
) -> np.ndarray:
    """b of every map's cells, (K, R*R): nowhere safer where most of the feedback was unsafe.

    Args:
        shift: b.
        feedback: The feedback.
        points: Psi(x) of it, (K, M, 2).
        grid: The grid.
    """
    cells = np.full((len(points), grid.num_cells), shift)
    if shift < 0.0:
        for row, member_points in zip(cells, points, strict=True):
            located = grid.locate(member_points)
            # Safe counts against unsafe: a majority of unsafe segments is above zero.
            vote = np.where(feedback.is_unsafe, 1.0, -1.0)[located >= 0]
            majority = np.bincount(located[located >= 0], vote, minlength=grid.num_cells)
            row[majority > 0.0] = 0.0
    return cells


def shifted_beliefs(
    training: TrainingScores,
    shift: np.ndarray,
    grid: Grid,
    parameters: AssessmentParameters,
    num_causes: int,
) -> np.ndarray:
    """Beliefs from training scores that are shifted as the logit is, (K, R*R, 3 + n_c).

    Departure: the paper learns where the nominal scores are unreliable and trusts them less there.
    That hardly moves the safe share of a cell, as F keeps the ratio of its masses, and the
    discrepancy has no sign. Shifting every score by sigma(L + b) - sigma(L) moves the boundary
    between safe and unsafe itself, and needs few pairs, as it is one number.

    Args:
        training: The training segments.
        shift: b of every map's cells, (K, R*R).
        grid: The grid.
        parameters: Of the assessment.
        num_causes: n_c.
    """
    if training.logit is None or training.nearest is None:
        raise ValueError("shifted_beliefs: the maps have no heads, and so no logit to shift")
    base = sigmoid(training.logit)
    fused = []
    for points, member_shift in zip(training.points, shift, strict=True):
        cells = grid.locate(points)
        is_inside = cells >= 0
        b = member_shift[cells[is_inside]]
        logit, score = training.logit[is_inside], training.score[is_inside]
        # Without a shift the difference is zero to the bit, and so are the scores the same.
        score = np.clip(score + (sigmoid(logit + b) - base[is_inside]), 0.0, 1.0)
        cause = training.cause[is_inside]
        # What has become possible has the cause that is nearest.
        cause = np.where(cause >= 0, cause, training.nearest[is_inside])
        masses = belief_masses.from_scores(score, parameters.initial_uncertainty, cause, num_causes)
        fused.append(
            belief_masses.fuse_cells(
                masses,
                cells[is_inside],
                num_cells=grid.num_cells,
                min_count=parameters.min_count,
            )
        )
    return np.stack(fused)
