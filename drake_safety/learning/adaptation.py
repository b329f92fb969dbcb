"""The paper's update of beliefs from feedback; see `recalibration` for the sharpened mode's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_safety.learning import beliefs as belief_masses
from drake_safety.learning.assessment_parameters import AdaptationParameters, AssessmentParameters
from drake_safety.learning.discrepancy import DiscrepancyFunction, updated_uncertainty
from drake_safety.learning.feedback import FeedbackSegments
from drake_safety.learning.grid import Grid
from drake_safety.learning.training_scores import TrainingScores, prior_beliefs


@dataclass(frozen=True, kw_only=True)
class Adaptation:
    """Record of an adaptation.

    Attributes:
        method: "paper" or "recalibration".
        variation: Plant variation of the actual episodes.
        num_sets: Number of pairs of episodes.
        num_differing: Number of those that ended differently.
    """

    method: str
    variation: str
    num_sets: int
    num_differing: int


def paper_beliefs(
    training: TrainingScores,
    feedback: FeedbackSegments,
    points: np.ndarray,
    grid: Grid,
    parameters: AssessmentParameters,
    num_causes: int,
) -> np.ndarray:
    """Beliefs by the paper's adaptation, (K, R*R, 3 + n_c), of feedback at Psi(x) (K, M, 2)."""
    settings = parameters.adaptation
    difference = np.abs(feedback.score - feedback.nominal_score)
    uncertainty = [
        updated_uncertainty(
            *DiscrepancyFunction().fit(member_points, difference).predict(training_points),
            gate=settings.gate,
            least=settings.least_uncertainty,
            initial=parameters.initial_uncertainty,
        )
        for member_points, training_points in zip(points, training.points, strict=True)
    ]
    prior = prior_beliefs(training, grid, parameters, num_causes, np.stack(uncertainty))
    certain = belief_masses.from_scores(feedback.score, 0.0, feedback.cause, num_causes)
    return np.stack(
        [
            combined(
                member_prior, feedback_beliefs(certain, grid.locate(member_points), grid, settings)
            )
            for member_prior, member_points in zip(prior, points, strict=True)
        ]
    )


def feedback_beliefs(
    certain: np.ndarray, cells: np.ndarray, grid: Grid, settings: AdaptationParameters
) -> np.ndarray:
    """Computes the feedback belief of every cell by G, (R*R, 3 + n_c); empty without feedback.

    Departure: n_f is by default the number of segments in the cell. Read literally, as the number
    of all feedback, 40 leave an uncertainty of 5e-8, and one segment replaces its cell's prior.

    Args:
        certain: Beliefs of the feedback segments, mu = 0, (M, 3 + n_c).
        cells: Cell of each, -1 for outside, (M,).
    """
    num_feedback = np.bincount(cells[cells >= 0], minlength=grid.num_cells)
    if settings.count == "segments":
        num_feedback = np.full(grid.num_cells, len(certain))
    # mu_v = beta exp(-alpha (n_f - 1))
    uncertainty = settings.first_uncertainty * np.exp(-settings.decay_rate * (num_feedback - 1.0))
    return belief_masses.average_cells(certain, cells, np.minimum(uncertainty, 1.0))


def combined(prior: np.ndarray, feedback: np.ndarray) -> np.ndarray:
    """Fuses prior and feedback of each cell, (R*R, 3 + n_c); without feedback, the prior."""
    num_cells = len(prior)
    both = belief_masses.fuse_cells(
        np.concatenate([prior, feedback]),
        np.tile(np.arange(num_cells), 2),
        num_cells=num_cells,
        min_count=0,
    )
    has_feedback = feedback[:, belief_masses.UNCERTAINTY] < 1.0
    return np.where(has_feedback[:, None], both, prior)
