"""Novelty of an input: its distance from the inputs of training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

NUM_FOLDS = 5
"""Folds of the episodes for the limit: every distance is from the inputs of other episodes."""
_SMALLEST_SPREAD = 1e-4  # Of a column; constant ones would be divided by zero.
_SMALLEST_VARIANCE = 1e-5  # Of the standardised inputs along an axis; they are redundant.


@dataclass(frozen=True, kw_only=True, eq=False)
class Moments:
    """Mean and covariance of inputs x.

    Attributes:
        count: Number of inputs.
        mean: Their mean, (n_x,).
        covariance: Their covariance, (n_x, n_x).
    """

    count: int
    mean: np.ndarray
    covariance: np.ndarray

    @classmethod
    def of(cls, x: np.ndarray) -> Moments:
        """The moments of inputs (N, n_x)."""
        mean = x.mean(axis=0)
        return cls(count=len(x), mean=mean, covariance=(x - mean).T @ (x - mean) / len(x))

    def joined(self, other: Moments) -> Moments:
        """The moments of both sets of inputs."""
        count = self.count + other.count
        share, shift = other.count / count, other.mean - self.mean
        within = (1.0 - share) * self.covariance + share * other.covariance
        between = share * (1.0 - share) * np.outer(shift, shift)
        return Moments(count=count, mean=self.mean + share * shift, covariance=within + between)

    def precision_root(self) -> np.ndarray:
        """Returns W with (x - mean) W of unit covariance, (n_x, n_x).

        The variance along axes of the standardised inputs has a lower bound: they are redundant.
        """
        scale = np.maximum(np.sqrt(np.diag(self.covariance)), _SMALLEST_SPREAD)
        variance, axes = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        return axes / np.sqrt(np.maximum(variance, _SMALLEST_VARIANCE)) / scale[:, None]


class Novelty:
    """Says which inputs are beyond those of training, by their Mahalanobis distance.

    x is redundant: features and preview follow from state and plan. A contradiction between them
    lies along the axes of least variance, which the maps ignore. The object is immutable.

    Args:
        training: Moments of the training inputs.
        limit: Largest distance of a known input.
        feedback: Moments of an actual robot's inputs, which are known as well; None before
            adaptation.
    """

    def __init__(self, *, training: Moments, limit: float, feedback: Moments | None = None):
        self.training, self.limit, self.feedback = training, limit, feedback
        known = training if feedback is None else training.joined(feedback)
        self._mean, self._precision_root = known.mean, known.precision_root()

    def __deepcopy__(self, memo: dict[int, Any]) -> Novelty:
        return self

    @classmethod
    def fit(cls, x: np.ndarray, episode: np.ndarray, is_unsafe: np.ndarray, rate: float) -> Novelty:
        """Computes the moments of training inputs and chooses the limit.

        The limit is exceeded somewhere in at most a share of `rate` of the safe episodes, each
        judged by the moments of other episodes. Unsafe ones do not count: they lead out of what is
        known.

        Args:
            x: Inputs, (N, n_x).
            episode: Episode of each, (N,).
            is_unsafe: Whether it ended unsafely, (N,).
            rate: Share of safe episodes with a novel input, in (0, 1).
        """
        fold = np.unique(episode, return_inverse=True)[1] % NUM_FOLDS
        distance = np.full(len(x), np.inf)
        for part in range(NUM_FOLDS):
            is_part = fold == part
            if is_part.any() and not is_part.all():
                others = cls(training=Moments.of(x[~is_part]), limit=1.0)
                distance[is_part] = others.of(x[is_part])
        counted = ~is_unsafe if not is_unsafe.all() else np.ones(len(x), dtype=bool)
        _, position = np.unique(episode[counted], return_inverse=True)
        farthest = np.zeros(position.max() + 1)
        np.maximum.at(farthest, position, distance[counted])
        limit = np.quantile(farthest, 1.0 - rate, method="higher")
        return cls(training=Moments.of(x), limit=float(limit))

    def with_feedback(self, x: np.ndarray) -> Novelty:
        """Returns the novelty for which an actual robot's inputs (N, n_x) are known as well.

        They replace those of earlier feedback.
        """
        return Novelty(training=self.training, limit=self.limit, feedback=Moments.of(x))

    def of(self, x: np.ndarray) -> np.ndarray:
        """Returns the distances of inputs (N, n_x) in units of the limit, (N,); novel above 1.

        The distance of an input that is not finite is infinite.
        """
        with np.errstate(invalid="ignore"):
            whitened = (x - self._mean) @ self._precision_root
        squared = np.einsum("ij,ij->i", whitened, whitened)
        return np.sqrt(np.where(np.isnan(squared), np.inf, squared)) / self.limit

    def contradictions(self, x: np.ndarray) -> np.ndarray:
        """Returns how far each column is from what the other columns say, (n_x,).

        The unit is the standard deviation of that prediction by linear regression.

        Args:
            x: One input, (n_x,).
        """
        precision = self._precision_root @ self._precision_root.T
        return precision @ (x - self._mean) / np.sqrt(np.diag(precision))
