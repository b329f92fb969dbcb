"""Novelty of an input: its distance from the inputs of training."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

NUM_QUADRATIC = 3  # Distances that are quadratic forms.
_NUM_FOLDS = 5  # Folds of the episodes: every distance is from inputs of other episodes.
_SMALLEST_SPREAD = 1e-2  # Least scale of a column [its unit]: a column may be constant.
# Variances of the standardised inputs along an axis:
_REDUNDANT_VARIANCE = 1e-7  # Below this, the axis is a redundancy of the inputs.
_LEAST_REDUNDANT_VARIANCE = 1e-8  # Lower bound along redundancies.
_LEAST_VARIANCE = 1e-2  # Lower bound for the range: an actual robot differs that much.
_LEAST_PLAN_VARIANCE = 1e-4  # The same for the plan alone, which no robot's reality changes.
_LEAST_LIMIT = 3.0  # Least root mean square along the redundancies; against rounding.
_LEAST_HALF_WIDTH = 5e-2  # Half-width of a column's range [its unit].


@dataclass(frozen=True, kw_only=True, eq=False)
class Moments:
    """Mean (n_x,), covariance (n_x, n_x) and range, `least` to `largest` (n_x,), of inputs x."""

    count: int
    mean: np.ndarray
    covariance: np.ndarray
    least: np.ndarray
    largest: np.ndarray

    @classmethod
    def of(cls, x: np.ndarray) -> Moments:
        """The moments of inputs (N, n_x)."""
        mean = x.mean(axis=0)
        return cls(
            count=len(x),
            mean=mean,
            covariance=(x - mean).T @ (x - mean) / len(x),
            least=x.min(axis=0),
            largest=x.max(axis=0),
        )

    def joined(self, other: Moments) -> Moments:
        """The moments of both sets of inputs."""
        count = self.count + other.count
        share, shift = other.count / count, other.mean - self.mean
        within = (1.0 - share) * self.covariance + share * other.covariance
        between = share * (1.0 - share) * np.outer(shift, shift)
        return Moments(
            count=count,
            mean=self.mean + share * shift,
            covariance=within + between,
            least=np.minimum(self.least, other.least),
            largest=np.maximum(self.largest, other.largest),
        )

    @property
    def scale(self) -> np.ndarray:
        """Standard deviations of the columns, with a lower bound, (n_x,)."""
        return np.maximum(np.sqrt(np.diag(self.covariance)), _SMALLEST_SPREAD)

    def axes(self, columns: slice) -> tuple[np.ndarray, np.ndarray]:
        """Returns variances (n,) and axes (n, n) of n standardised columns of x."""
        scale = self.scale[columns]
        variance, axes = np.linalg.eigh(self.covariance[columns, columns] / np.outer(scale, scale))
        return variance, axes


class Distances:
    """Squared Mahalanobis distances whose variances have a lower bound along each axis.

    Axes with less than the bound v share it: Σ (aᵢ·z)²/max(vᵢ, v) = |z|²/v - Σ (aᵢ·z)² (1/v - 1/vᵢ)
    over the axes with vᵢ > v, of a standardised offset z. That takes a third of the products.
    `terms` weigh the squares of an offset's entries and of its projections on `axes` (n_x, m),
    (n_x + m, 3).
    """

    def __init__(self, known: Moments, plan: slice):
        variance, axes = known.axes(slice(None))
        is_redundant = variance < _REDUNDANT_VARIANCE
        redundant = np.maximum(variance[is_redundant], _LEAST_REDUNDANT_VARIANCE)
        own_variance, own_axes = known.axes(plan)
        planned = np.zeros((len(axes), len(own_axes)))
        planned[plan] = own_axes
        parts = [
            _above(variance, axes, _LEAST_VARIANCE),
            axes[:, is_redundant] / np.sqrt(redundant),
            _above(own_variance, planned, _LEAST_PLAN_VARIANCE),
        ]
        self.mean = known.mean
        self.axes = np.concatenate(parts, axis=1) / known.scale[:, None]
        start, squared_scale = len(axes), known.scale**2
        self.terms = np.zeros((start + self.axes.shape[1], NUM_QUADRATIC))
        self.terms[:start, 0] = 1.0 / (_LEAST_VARIANCE * squared_scale)
        self.terms[plan, 2] = 1.0 / (_LEAST_PLAN_VARIANCE * squared_scale[plan])
        for distance, (part, sign) in enumerate(zip(parts, (-1.0, 1.0, -1.0), strict=True)):
            self.terms[start : start + part.shape[1], distance] = sign
            start += part.shape[1]

    def squared(self, x: np.ndarray, terms: np.ndarray) -> np.ndarray:
        """Squared distances (N, 3) of x (N, n_x): all axes, redundancies, plan; by `terms`.

        One product for each row: a product of many rows would round differently.
        """
        num_inputs = len(self.mean)
        entries = np.empty((len(x), 1, len(self.terms)))
        offset = np.subtract(x, self.mean, out=entries[:, 0, :num_inputs])
        np.matmul(offset[:, None], self.axes, out=entries[:, :, num_inputs:])
        np.multiply(entries, entries, out=entries)
        return (entries @ terms)[:, 0]


def _above(variance: np.ndarray, axes: np.ndarray, least: float) -> np.ndarray:
    is_above = variance > least
    return axes[:, is_above] * np.sqrt(1.0 / least - 1.0 / variance[is_above])


class Novelty:
    """Flags inputs unlike the training inputs, by three Mahalanobis distances and the range.

    The first distance is along all axes of the training inputs, with a tolerance. The second is
    along their redundancies: an input that contradicts itself, such as features of another plan,
    is novel though every entry is within its range. (Process monitoring: T^2 and SPE.) The third
    is the plan's. The range of each column, in half widths from its centre, exposes one extreme
    entry that the sum over many others would hide. `limits` are the largest of the four for a known
    input, in this order; the moments of `feedback`, an actual robot's inputs, are known as well.
    """

    def __init__(
        self, *, training: Moments, limits: np.ndarray, plan: slice, feedback: Moments | None = None
    ):
        self.training, self.limits, self.feedback = training, np.asarray(limits), feedback
        self.plan = plan
        known = training if feedback is None else training.joined(feedback)
        self.quadratic = Distances(known, plan)
        half_width = 0.5 * (known.largest - known.least)
        self.centre = known.least + half_width
        self.inverse_half_width = 1.0 / np.maximum(half_width, _LEAST_HALF_WIDTH)
        # Without other episodes to choose them from, the limits are infinite.
        self.inverse_limits = 1.0 / np.square(self.limits)
        self._shares = self.quadratic.terms * self.inverse_limits[:NUM_QUADRATIC]
        self._range_share = self.inverse_half_width / self.limits[-1]

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
        range_limit: float,
        plan: slice,
    ) -> Novelty:
        """Computes the moments of training inputs x (N, n_x) and chooses the limits.

        At most a share `rate` of the episodes' first inputs, and of the safe episodes anywhere,
        exceeds a limit, judged by the moments of other episodes. The range of a column is widened
        by as much as one fold of the episodes exceeds the others.
        """
        fold = np.unique(episode, return_inverse=True)[1] % _NUM_FOLDS
        distances, growth = np.full((len(x), NUM_QUADRATIC), np.inf), np.ones(x.shape[1])
        for part in range(_NUM_FOLDS):
            is_part = fold == part
            if is_part.any() and not is_part.all():
                known = Moments.of(x[~is_part])
                others = cls(training=known, limits=np.ones(NUM_QUADRATIC + 1), plan=plan)
                distances[is_part] = others.distances(x[is_part])[:, :NUM_QUADRATIC]
                growth = np.maximum(growth, others.offsets(x[is_part]).max(axis=0))
        first = np.unique(episode, return_index=True)[1]
        limits = np.quantile(distances[first], 1.0 - rate, axis=0, method="higher")
        if not is_unsafe.all():
            _, position = np.unique(episode[~is_unsafe], return_inverse=True)
            farthest = np.zeros((position.max() + 1, NUM_QUADRATIC))
            np.maximum.at(farthest, position, distances[~is_unsafe])
            of_safe = np.quantile(farthest, 1.0 - rate, axis=0, method="higher")
            limits = np.maximum(limits, of_safe)
        training, least, largest = Moments.of(x), x.min(axis=0), x.max(axis=0)
        added = 0.5 * (growth - 1.0) * np.maximum(largest - least, 2.0 * _LEAST_HALF_WIDTH)
        training = replace(training, least=least - added, largest=largest + added)
        num_redundancies = np.sum(training.axes(slice(None))[0] < _REDUNDANT_VARIANCE)
        smallest = [1.0, max(1.0, _LEAST_LIMIT * np.sqrt(num_redundancies)), 1.0]
        of_range = range_limit if fold.any() else np.inf
        limits = np.append(np.maximum(limits, smallest), of_range)
        return cls(training=training, limits=limits, plan=plan)

    def with_feedback(self, x: np.ndarray, rate: float) -> Novelty:
        """Returns the novelty for which an actual robot's inputs are known as well.

        They replace earlier feedback. If at most a share of `rate` of them is beyond the
        training inputs, as of a robot without a reality gap, these alone describe the robot.
        """
        own: dict[str, Any] = dict(training=self.training, limits=self.limits, plan=self.plan)
        alone = Novelty(**own)
        is_enough = np.mean(alone.of(x) > 1.0) <= rate
        return alone if is_enough else Novelty(**own, feedback=Moments.of(x))

    def distances(self, x: np.ndarray) -> np.ndarray:
        """Distances of inputs (N, n_x) in the order of `limits`, (N, 4); infinite if not finite."""
        with np.errstate(invalid="ignore", over="ignore"):
            # Rounding may make a small square negative.
            quadratic = np.sqrt(np.maximum(self.quadratic.squared(x, self.quadratic.terms), 0.0))
            every = np.column_stack([quadratic, self.offsets(x).max(axis=1)])
            return np.fmin(every, np.inf)  # It chooses the number beside NaN.

    def offsets(self, x: np.ndarray) -> np.ndarray:
        """Returns how far inputs are from the centre of the range, in half widths, (N, n_x)."""
        return np.abs((x - self.centre) * self.inverse_half_width)

    def of(self, x: np.ndarray) -> np.ndarray:
        """Largest distance of inputs (N, n_x) by its limit, (N,); novel above 1, inf for NaN."""
        with np.errstate(invalid="ignore", over="ignore"):
            largest = np.maximum.reduce(self.quadratic.squared(x, self._shares), axis=1)
            offset = (x - self.centre) * self._range_share
            offset *= offset
            largest = np.maximum(largest, np.maximum.reduce(offset, axis=1))
            return np.fmin(np.sqrt(np.maximum(largest, 0.0)), np.inf)

    def contradictions(self, x: np.ndarray) -> np.ndarray:
        """Errors of each column's linear regression on the others [standard deviation], (n_x,)."""
        known, axes = self.quadratic, self.quadratic.axes
        # The matrix of the sum of the three distances as a quadratic form of the offset.
        of_entries, of_axes = np.split(known.terms.sum(axis=1), [len(known.mean)])
        precision = np.diag(of_entries) + (axes * of_axes) @ axes.T
        return precision @ (x - known.mean) / np.sqrt(np.diag(precision))
