"""The paper's update of beliefs from feedback; see `recalibration` for the sharpened mode's."""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_safety.learning import beliefs as belief_masses
from drake_safety.learning.assessment_parameters import AdaptationParameters, AssessmentParameters
from drake_safety.learning.feedback import FeedbackSegments
from drake_safety.learning.grid import Grid
from drake_safety.learning.training_scores import TrainingScores, prior_beliefs

_MOST_FITTED = 250
_CHUNK = 2048


@dataclass(frozen=True, kw_only=True)
class Adaptation:
    """Record of an adaptation, by `num_sets` pairs, of which `num_differing` ended differently."""

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
    settings, uncertainty = parameters.adaptation, []
    difference = np.abs(feedback.score - feedback.nominal_score)
    for member_points, training_points in zip(points, training.points, strict=True):
        mean, deviation = DiscrepancyFunction(member_points, difference).predict(training_points)
        mu = settings.least_uncertainty + mean * (1.0 - settings.least_uncertainty)
        uncertainty.append(np.where(deviation <= settings.gate, mu, parameters.initial_uncertainty))
    prior = prior_beliefs(training, grid, parameters, num_causes, np.stack(uncertainty))
    certain = belief_masses.from_scores(feedback.score, 0.0, feedback.cause, num_causes)
    beliefs, cells = [], np.tile(np.arange(grid.num_cells), 2)
    for own, member_points in zip(prior, points, strict=True):
        actual = feedback_beliefs(certain, grid.locate(member_points), grid, settings)
        both = np.concatenate([own, actual])
        fused = belief_masses.fuse_cells(both, cells, num_cells=grid.num_cells, min_count=0)
        has_feedback = actual[:, belief_masses.UNCERTAINTY, None] < 1.0
        beliefs.append(np.where(has_feedback, fused, own))
    return np.stack(beliefs)


class DiscrepancyFunction:
    """D(y), a Gaussian process regression of |lambda actual - lambda nominal| on Psi(x).

    The kernel's amplitude is fixed at one: a fitted one makes sigma small even without data. Length
    scale and noise are fitted on at most 250 points; the posterior is exact with all points.
    """

    def __init__(self, points: np.ndarray, difference: np.ndarray):
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

        is_finite = np.isfinite(points).all(axis=1)
        points, difference = points[is_finite].astype(float), difference[is_finite].astype(float)
        if not len(points):
            raise ValueError("DiscrepancyFunction: none of the feedback's points is finite")
        kernel = ConstantKernel(1.0, "fixed") * RBF(10.0, (3.0, 40.0))
        kernel += WhiteKernel(0.03, (1e-3, 0.08))
        rows = np.arange(len(points))
        if len(points) > _MOST_FITTED:
            rows = np.random.default_rng(0).choice(len(points), _MOST_FITTED, replace=False)
        with warnings.catch_warnings():
            # Hyperparameters may end at their bounds.
            warnings.simplefilter("ignore", ConvergenceWarning)
            kernel = GaussianProcessRegressor(kernel).fit(points[rows], difference[rows]).kernel_
        scale, noise = float(kernel.k1.k2.length_scale), float(kernel.k2.noise_level)
        # As `alpha`, the noise of the observations does not enter sigma.
        process = GaussianProcessRegressor(RBF(scale), alpha=noise, optimizer=None)
        self._process: Any = process.fit(points, difference)

    def predict(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predicts m in [0, 1] and sigma without noise, (M,) each; 0 and 1 where not finite."""
        mean, deviation = np.zeros(len(points)), np.ones(len(points))
        rows = np.flatnonzero(np.isfinite(points).all(axis=1))
        for start in range(0, len(rows), _CHUNK):
            chunk = rows[start : start + _CHUNK]
            mean[chunk], deviation[chunk] = self._process.predict(
                points[chunk].astype(float), return_std=True
            )
        return np.clip(mean, 0.0, 1.0), deviation


def feedback_beliefs(
    certain: np.ndarray, cells: np.ndarray, grid: Grid, settings: AdaptationParameters
) -> np.ndarray:
    """Computes the feedback belief of every cell by G, (R*R, 3 + n_c); empty without feedback.

    Departure: n_f is the number of segments in the cell. Read literally, as the number of all
    feedback, 40 leave an uncertainty of 5e-8, and one segment replaces its cell's prior.
    """
    num_feedback = np.bincount(cells[cells >= 0], minlength=grid.num_cells)
    # mu_v = beta exp(-alpha (n_f - 1))
    uncertainty = settings.first_uncertainty * np.exp(-settings.decay_rate * (num_feedback - 1.0))
    return belief_masses.average_cells(certain, cells, np.minimum(uncertainty, 1.0))
