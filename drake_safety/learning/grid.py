"""The square grid of cells over the two-dimensional embedding space."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

OUTSIDE = -1
"""Cell of a point outside the grid, and of NaN."""

_FILL = 1.1
"""Ratio of the grid's half width to the largest coordinate of the points it is scaled for."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A grid of resolution x resolution square cells, centred at the origin.

    Cell (i, j) has the index i * resolution + j, where i counts along the first coordinate. A cell
    contains its lower edges but not its upper ones.

    Attributes:
        resolution: Number of cells a side, R.
        cell_length: Side of a cell, in units of the embedding.
    """

    resolution: int
    cell_length: float

    def __post_init__(self) -> None:
        if self.resolution < 1:
            raise ValueError(f"Grid: resolution is {self.resolution}, expected >= 1")
        if not self.cell_length > 0.0:
            raise ValueError(f"Grid: cell_length is {self.cell_length}, expected > 0")

    @property
    def num_cells(self) -> int:
        """R * R."""
        return self.resolution**2

    @cached_property
    def half_width(self) -> float:
        """Largest coordinate of the grid."""
        return 0.5 * self.resolution * self.cell_length

    @property
    def centres(self) -> np.ndarray:
        """Centre of every cell, (R*R, 2)."""
        axis = (np.arange(self.resolution) + 0.5) * self.cell_length - self.half_width
        first, second = np.meshgrid(axis, axis, indexing="ij")
        return np.column_stack([first.ravel(), second.ravel()])

    def scale(self, points: np.ndarray) -> np.ndarray:
        """Centres points (N, 2) and scales them to 1.1 * max|y| = half width.

        Departure: the extent of a t-SNE embedding grows with the number of points, so a cell length
        in its units is not comparable across data sets.

        Raises:
            ValueError: The points are not finite or all coincide.
        """
        centred = points - points.mean(axis=0)
        extent = float(np.abs(centred).max())
        if not (math.isfinite(extent) and extent > 0.0):
            raise ValueError(f"Grid.scale: the points' extent is {extent}, expected finite and > 0")
        return centred * (self.half_width / (_FILL * extent))

    def locate(self, points: np.ndarray) -> np.ndarray:
        """Returns L, the cell of each point (..., 2), or `OUTSIDE`."""
        position = (np.asarray(points, dtype=float) + self.half_width) / self.cell_length
        is_inside = _is_within(position, self.resolution)
        index = np.where(is_inside, position, 0.0).astype(int)
        cells = index[..., 0] * self.resolution + index[..., 1]
        return np.where(is_inside[..., 0], cells, OUTSIDE)

    def bilinear(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns bilinear weights between the centres of the four cells around each point.

        Between the outermost centres and the grid's edge only the nearest existing centres count.

        Args:
            points: (..., 2).

        Returns:
            Cells (..., 4) and their weights (..., 4), which sum to one; outside the grid the cells
            are `OUTSIDE` and the weights zero.
        """
        position = (np.asarray(points, dtype=float) + self.half_width) / self.cell_length
        is_inside = _is_within(position, self.resolution)
        last = self.resolution - 1
        position = np.where(is_inside, position - 0.5, 0.0).clip(0.0, last)
        lower = np.minimum(position.astype(int), max(last - 1, 0))
        fraction = position - lower
        # Two neighbours along each axis give four cells.
        index = np.stack([lower, np.minimum(lower + 1, last)], axis=-2)
        weight = np.stack([1.0 - fraction, fraction], axis=-2)
        cells = index[..., :, None, 0] * self.resolution + index[..., None, :, 1]
        weights = weight[..., :, None, 0] * weight[..., None, :, 1]
        shape = (*is_inside.shape[:-1], 4)
        return (
            np.where(is_inside, cells.reshape(shape), OUTSIDE),
            np.where(is_inside, weights.reshape(shape), 0.0),
        )


def _is_within(position: np.ndarray, resolution: int) -> np.ndarray:
    """Whether positions (..., 2) in units of cells lie in the grid, (..., 1); false for NaN."""
    return np.all((position >= 0.0) & (position < resolution), axis=-1, keepdims=True)
