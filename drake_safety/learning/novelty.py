"""Novelty of an input: its distance from the inputs of training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

NUM_DISTANCES = 3
NUM_FOLDS = 5
"""Folds of the episodes for the limits: every distance is from the inputs of other episodes."""
_SMALLEST_SPREAD = 1e-2  # Of a column [unit of the column]; constant ones would be divided by zero.
# Variances of the standardised inputs along an axis:
_REDUNDANT_VARIANCE = 1e-7  # Below this, the axis is a redundancy of the inputs.
_LEAST_REDUNDANT_VARIANCE = 1e-8  # Lower bound along redundancies.
_LEAST_VARIANCE = 1e-2  # Lower bound for the range: an actual robot differs that much.
_LEAST_PLAN_VARIANCE = 1e-4  # The same for the plan alone, which no robot's reality changes.
_LEAST_LIMIT = 3.0  # Of the root mean square distance along the redundancies; against rounding.


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

    def whitenings(self, plan: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns W with (x - mean) W of unit covariance: range, redundancies and plan.

        The variance along the axes of the standardised inputs has a lower bound.

        Args:
            plan: The plan's columns of x, n_p of them.

        Returns:
            (n_x, n_x) for all axes, (n_x, m) for the m redundancies, and (n_x, n_p) for the axes of
            the plan alone.
        """
        scale = np.maximum(np.sqrt(np.diag(self.covariance)), _SMALLEST_SPREAD)
        variance, axes = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        axes = axes / scale[:, None]
        is_redundant = variance < _REDUNDANT_VARIANCE
        redundant = np.maximum(variance[is_redundant], _LEAST_REDUNDANT_VARIANCE)
        planned = np.zeros((len(scale), len(scale[plan])))
        own_variance, own_axes = np.linalg.eigh(
            self.covariance[plan, plan] / np.outer(scale[plan], scale[plan])
        )
        own_axes = own_axes / scale[plan][:, None]
        planned[plan] = own_axes / np.sqrt(np.maximum(own_variance, _LEAST_PLAN_VARIANCE))
        return (
            axes / np.sqrt(np.maximum(variance, _LEAST_VARIANCE)),
            axes[:, is_redundant] / np.sqrt(redundant),
            planned,
        )


class Novelty:
    """Says which inputs are beyond those of training, by three Mahalanobis distances.

    One is along all axes of the training inputs, with a tolerance: an input outside their range is
    novel. The second is along their redundancies alone. Features and preview follow from state and
    plan, in an actual robot as in the nominal one; an input that contradicts itself, such as the
    features of another plan, is novel though every entry is within its range, and the maps ignore
    these axes. The two are known in process monitoring as T^2 and SPE. The third is that of the
    plan alone: a planner asks for what it always did, or for something new, whatever the state.
    The object is immutable.

    Args:
        training: Moments of the training inputs.
        limits: Largest distances of a known input: of all of it, along redundancies, and of the
            plan, (3,).
        plan: The plan's columns of x.
        feedback: Moments of an actual robot's inputs, which are known as well; None before
            adaptation.
    """

    def __init__(
        self,
        *,
        training: Moments,
        limits: np.ndarray,
        plan: slice,
        feedback: Moments | None = None,
    ):
        self.training, self.limits, self.feedback = training, np.asarray(limits), feedback
        self.plan = plan
        known = training if feedback is None else training.joined(feedback)
        self._mean, self._whitenings = known.mean, known.whitenings(plan)

    def __deepcopy__(self, memo: dict[int, Any]) -> Novelty:
        return self

    @classmethod
    def fit(
        cls,
        x: np.ndarray,
        episode: np.ndarray,
        is_unsafe: np.ndarray,
        rate: float,
        *,
        plan: slice,
    ) -> Novelty:
        """Computes the moments of training inputs and chooses the limits.

        Each limit is exceeded by at most a share of `rate` of the first inputs, which are as drawn,
        and somewhere in at most that share of the safe episodes, each judged by the moments of
        other episodes. Later inputs of unsafe episodes do not count: they lead out of what is
        known.

        Args:
            x: Inputs, those of an episode in the order of time, (N, n_x).
            episode: Episode of each, (N,).
            is_unsafe: Whether it ended unsafely, (N,).
            rate: Share of episodes with a novel input, in (0, 1).
            plan: The plan's columns of x.
        """
        fold = np.unique(episode, return_inverse=True)[1] % NUM_FOLDS
        distances = np.full((len(x), NUM_DISTANCES), np.inf)
        for part in range(NUM_FOLDS):
            is_part = fold == part
            if is_part.any() and not is_part.all():
                others = cls(
                    training=Moments.of(x[~is_part]), limits=np.ones(NUM_DISTANCES), plan=plan
                )
                distances[is_part] = others.distances(x[is_part])
        first = np.unique(episode, return_index=True)[1]
        limits = np.quantile(distances[first], 1.0 - rate, axis=0, method="higher")
        if not is_unsafe.all():
            _, position = np.unique(episode[~is_unsafe], return_inverse=True)
            farthest = np.zeros((position.max() + 1, NUM_DISTANCES))
            np.maximum.at(farthest, position, distances[~is_unsafe])
            of_safe = np.quantile(farthest, 1.0 - rate, axis=0, method="higher")
            limits = np.maximum(limits, of_safe)
        whole = cls(training=Moments.of(x), limits=np.ones(NUM_DISTANCES), plan=plan)
        num_redundancies = whole._whitenings[1].shape[1]
        least = [1.0, max(1.0, _LEAST_LIMIT * np.sqrt(num_redundancies)), 1.0]
        return cls(training=whole.training, limits=np.maximum(limits, least), plan=plan)

    def with_feedback(self, x: np.ndarray, rate: float) -> Novelty:
        """Returns the novelty for which an actual robot's inputs are known as well.

        They replace those of earlier feedback. If at most a share of `rate` of them is beyond the
        training inputs, these alone describe the robot.

        Args:
            x: Inputs, (N, n_x).
            rate: Largest share of novel inputs of a robot without a reality gap, in (0, 1).
        """
        alone = Novelty(training=self.training, limits=self.limits, plan=self.plan)
        if np.mean(alone.of(x) > 1.0) <= rate:
            return alone
        return Novelty(
            training=self.training, limits=self.limits, plan=self.plan, feedback=Moments.of(x)
        )

    def distances(self, x: np.ndarray) -> np.ndarray:
        """Returns the distances of inputs (N, n_x): all of it, redundancies, plan, (N, 3).

        Those of an input that is not finite are infinite.
        """
        offset = x - self._mean
        found = []
        for whitening in self._whitenings:
            with np.errstate(invalid="ignore"):
                whitened = offset @ whitening
            squared = np.einsum("ij,ij->i", whitened, whitened)
            found.append(np.sqrt(np.where(np.isnan(squared), np.inf, squared)))
        return np.stack(found, axis=1)

    def of(self, x: np.ndarray) -> np.ndarray:
        """Returns the largest distance of inputs (N, n_x) in units of its limit, (N,).

        An input is novel above 1; that of an input that is not finite is infinite.
        """
        distances = self.distances(x)
        # Without other episodes to choose them from, the limits are infinite as well.
        share = np.divide(
            distances, self.limits, out=np.full_like(distances, np.inf), where=distances < np.inf
        )
        return share.max(axis=1)

    def contradictions(self, x: np.ndarray) -> np.ndarray:
        """Returns how far each column is from what the other columns say, (n_x,).

        The unit is the standard deviation of that prediction by linear regression.

        Args:
            x: One input, (n_x,).
        """
        whitening = np.concatenate(self._whitenings, axis=1)
        precision = whitening @ whitening.T
        return precision @ (x - self._mean) / np.sqrt(np.diag(precision))
