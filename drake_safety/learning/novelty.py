"""Novelty of an input: its distance from the inputs of training, in which all maps were learned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

NUM_FOLDS = 5
"""Folds of the episodes for the limit: every distance is from a Gaussian of other episodes."""
_SMALLEST_SPREAD = 1e-4  # Of a column; constant ones would be divided by zero.
_SMALLEST_VARIANCE = 1e-5  # Of the standardised inputs along an axis; they are redundant.


@dataclass(frozen=True, kw_only=True, eq=False)
class Gaussian:
    """A Gaussian of the inputs x, whose distance is that of Mahalanobis.

    x is redundant: features and preview follow from state and plan. A contradiction between them
    lies along the axes of least variance, which the maps ignore.

    Attributes:
        mean: Mean of the inputs, (n_x,).
        precision_root: W with (x - mean) W of unit covariance, (n_x, n_x).
    """

    mean: np.ndarray
    precision_root: np.ndarray

    @classmethod
    def of(cls, x: np.ndarray) -> Gaussian:
        """The Gaussian of inputs (N, n_x)."""
        mean = x.mean(axis=0)
        scale = np.maximum(x.std(axis=0), _SMALLEST_SPREAD)
        standardized = (x - mean) / scale
        variance, axes = np.linalg.eigh(standardized.T @ standardized / len(x))
        root = axes / np.sqrt(np.maximum(variance, _SMALLEST_VARIANCE))
        return cls(mean=mean, precision_root=root / scale[:, None])

    def distance(self, x: np.ndarray) -> np.ndarray:
        """Returns the distances of inputs (N, n_x), (N,); infinite if an input is not finite."""
        with np.errstate(invalid="ignore"):
            whitened = (x - self.mean) @ self.precision_root
        squared = np.einsum("ij,ij->i", whitened, whitened)
        return np.sqrt(np.where(np.isnan(squared), np.inf, squared))

    def contradictions(self, x: np.ndarray) -> np.ndarray:
        """Returns how far each column is from what the other columns say, (n_x,).

        The unit is the standard deviation of that prediction by linear regression.

        Args:
            x: One input, (n_x,).
        """
        precision = self.precision_root @ self.precision_root.T
        return precision @ (x - self.mean) / np.sqrt(np.diag(precision))


@dataclass(frozen=True, kw_only=True, eq=False)
class Novelty:
    """Says which inputs are beyond those of training.

    Attributes:
        gaussian: The Gaussian of the training inputs.
        limit: Largest distance of a known input.
    """

    gaussian: Gaussian
    limit: float

    @classmethod
    def fit(cls, x: np.ndarray, episode: np.ndarray, is_unsafe: np.ndarray, rate: float) -> Novelty:
        """Fits the Gaussian to training inputs and chooses the limit.

        The limit is exceeded somewhere in at most a share of `rate` of the safe episodes, judged by
        Gaussians that were fitted to other episodes. Unsafe ones do not count: they lead out of
        what is known.

        Args:
            x: Inputs, (N, n_x).
            episode: Episode of each, (N,).
            is_unsafe: Whether it ended unsafely, (N,).
            rate: Share of safe episodes with a novel input, in (0, 1).
        """
        fold = np.unique(episode, return_inverse=True)[1] % NUM_FOLDS
        distance = np.empty(len(x))
        for part in range(NUM_FOLDS):
            is_part = fold == part
            if is_part.any() and not is_part.all():
                distance[is_part] = Gaussian.of(x[~is_part]).distance(x[is_part])
            else:
                distance[is_part] = np.inf
        counted = ~is_unsafe if not is_unsafe.all() else np.ones(len(x), dtype=bool)
        _, position = np.unique(episode[counted], return_inverse=True)
        farthest = np.zeros(position.max() + 1)
        np.maximum.at(farthest, position, distance[counted])
        limit = np.quantile(farthest, 1.0 - rate, method="higher")
        return cls(gaussian=Gaussian.of(x), limit=float(limit))

    def of(self, x: np.ndarray) -> np.ndarray:
        """Returns the distances of inputs (N, n_x) in units of the limit, (N,); novel above 1."""
        return self.gaussian.distance(x) / self.limit
