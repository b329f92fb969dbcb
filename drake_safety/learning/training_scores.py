"""The beliefs of the grid's cells, from the unsafety scores of the training segments."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drake_safety.learning import beliefs as belief_masses
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.grid import Grid
from drake_safety.learning.prediction import Evaluation
from drake_safety.learning.segments import Segments

_KEPT_IN_CELL = 500


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingScores:
    """N embedded training segments, from which the cells' beliefs are computed."""

    points: np.ndarray  # Psi(x), (K, N, 2).
    score: np.ndarray  # lambda
    cause: np.ndarray  # Column of the constraint that ended the episode, -1 when safe.
    heads: np.ndarray | None = None  # By `BaseLogit.heads`.
    nearest: np.ndarray | None = None  # Column of the smallest predicted margin.
    multiplicity: np.ndarray | None = None  # Segments that each stands for; None: 1.
    count: np.ndarray | None = None  # All segments in the cells, if some were left out.

    @classmethod
    def of(cls, segments: Segments, evaluation: Evaluation) -> TrainingScores:
        """Returns the scores of training segments, rounded as files store them."""
        heads = nearest = None
        if evaluation.heads is not None:
            heads = _single(evaluation.heads)
            nearest = evaluation.margins.argmin(axis=1)
        return cls(
            points=evaluation.maps.embedding.astype(np.float32),
            score=_single(segments.score),
            cause=segments.cause,
            heads=heads,
            nearest=nearest,
        )

    @property
    def times(self) -> np.ndarray:
        """Number of segments that each stands for, (N,)."""
        return np.ones(len(self.score)) if self.multiplicity is None else self.multiplicity

    def thinned(self, grid: Grid, seed: int) -> TrainingScores:
        """Draws segments of crowded cells, so that a file does not grow with the number of all.

        A segment is kept with probability p = min(1, c / n), n the number of segments in its cell
        and c = 500; with several maps, the largest p. It then stands for 1 / p segments, so that
        sums over cells keep their expectations (Horvitz and Thompson, 1952).
        """
        probability, count = np.zeros(len(self.score)), []
        for points in self.points:
            cells = grid.locate(points)
            count.append(np.bincount(cells[cells >= 0], minlength=grid.num_cells))
            # A point outside the grid is in no cell.
            own = np.where(cells >= 0, _KEPT_IN_CELL / np.maximum(count[-1][cells], 1), 0.0)
            probability = np.maximum(probability, np.minimum(own, 1.0))
        kept = np.random.default_rng(seed).random(len(self.score)) < probability
        return replace(
            self,
            points=self.points[:, kept],
            score=self.score[kept],
            cause=self.cause[kept],
            heads=None if self.heads is None else self.heads[kept],
            nearest=None if self.nearest is None else self.nearest[kept],
            multiplicity=_single(1.0 / probability[kept]),
            count=np.stack(count),
        )


def _single(values: np.ndarray) -> np.ndarray:
    """Rounds values to single precision, in which files store one number for every segment."""
    return values.astype(np.float32).astype(float)


def prior_beliefs(
    training: TrainingScores,
    grid: Grid,
    parameters: AssessmentParameters,
    num_causes: int,
    uncertainty: np.ndarray | None = None,
) -> np.ndarray:
    """Beliefs of every map's cells, (K, R*R, 3 + n_c); `uncertainty` is mu, (K, N)."""
    if uncertainty is None:
        uncertainty = np.full(training.points.shape[:2], parameters.initial_uncertainty)
    beliefs = []
    for points, mu in zip(training.points, uncertainty, strict=True):
        masses = belief_masses.from_scores(training.score, mu, training.cause, num_causes)
        fused = belief_masses.fuse_cells(
            masses,
            grid.locate(points),  # L(x) is the cell of Psi(x), not of its point in t-SNE.
            num_cells=grid.num_cells,
            min_count=parameters.min_count,
            multiplicity=training.times,
        )
        beliefs.append(fused)
    return np.stack(beliefs)
