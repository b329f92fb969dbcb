"""The square grid of cells over the two-dimensional embedding space."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

OUTSIDE = -1
"""Cell of a point that no cell contains; NaN lies outside too."""

_FILL = 1.1
"""Ratio of the grid's half width to the largest coordinate of the points it is scaled for."""


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Resolution x resolution square cells, centred at the origin.

    Cell (i, j) has the index i * resolution + j, where i counts along the first coordinate. A cell
    contains its lower edges and not its upper ones.

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

    @classmethod
    def from_points(cls, points: np.ndarray, resolution: int) -> Grid:
        """The grid that holds centred points (N, 2), with a tenth of their extent to spare."""
        extent = float(np.abs(points).max())
        return cls(resolution=resolution, cell_length=2.0 * _FILL * extent / resolution)

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
        """Centres points (N, 2) and rescales them to fill the grid.

        Departure: the extent of a t-SNE embedding grows with the number of points, so a cell length
        in its units has no meaning across data sets. Afterwards 1.1 * max|y| is the half width.

        Raises:
            ValueError: The points are not finite or all coincide.
        """
        centred = points - points.mean(axis=0)
        extent = float(np.abs(centred).max())
        if not (math.isfinite(extent) and extent > 0.0):
            raise ValueError(f"Grid.scale: the points' extent is {extent}, expected finite and > 0")
        return centred * (self.half_width / (_FILL * extent))

    def locate(self, points: np.ndarray) -> np.ndarray:
        """L: the cell of each point (..., 2), or `OUTSIDE`."""
        position = (np.asarray(points, dtype=float) + self.half_width) / self.cell_length
        is_inside = np.all((position >= 0.0) & (position < self.resolution), axis=-1)
        index = np.where(is_inside[..., None], position, 0.0).astype(int)
        return np.where(is_inside, index[..., 0] * self.resolution + index[..., 1], OUTSIDE)

    def bilinear(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weights that interpolate between the centres of the four cells around each point.

        Between the outermost centres and the grid's edge only the nearest existing centres count.

        Args:
            points: (..., 2).

        Returns:
            Cells (..., 4) and their weights (..., 4), which sum to one; a point that lies outside
            the grid has cells `OUTSIDE` and weights zero.
        """
        points = np.asarray(points, dtype=float)
        is_inside = self.locate(points) != OUTSIDE
        position = (points + self.half_width) / self.cell_length - 0.5
        position = np.clip(
            np.where(is_inside[..., None], position, 0.0), 0.0, self.resolution - 1.0
        )
        lower = np.minimum(position.astype(int), max(self.resolution - 2, 0))
        upper = np.minimum(lower + 1, self.resolution - 1)
        fraction = position - lower
        cells, weights = [], []
        for first, w_first in ((lower, 1.0 - fraction), (upper, fraction)):
            for second, w_second in ((lower, 1.0 - fraction), (upper, fraction)):
                cells.append(first[..., 0] * self.resolution + second[..., 1])
                weights.append(w_first[..., 0] * w_second[..., 1])
        return (
            np.where(is_inside[..., None], np.stack(cells, axis=-1), OUTSIDE),
            np.where(is_inside[..., None], np.stack(weights, axis=-1), 0.0),
        )

    def bilinear_one(self, first: float, second: float) -> tuple[list[int], list[float]] | None:
        """`bilinear` of one point in plain floats, for the online run; None outside."""
        size, half = self.resolution, self.half_width
        u = (first + half) / self.cell_length
        v = (second + half) / self.cell_length
        if not (0.0 <= u < size and 0.0 <= v < size):
            return None
        last = size - 1
        u = min(max(u - 0.5, 0.0), last)
        v = min(max(v - 0.5, 0.0), last)
        i, j = min(int(u), max(last - 1, 0)), min(int(v), max(last - 1, 0))
        u -= i
        v -= j
        row, next_row, next_j = i * size, min(i + 1, last) * size, min(j + 1, last)
        return (
            [row + j, row + next_j, next_row + j, next_row + next_j],
            [(1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v],
        )

    def locate_one(self, first: float, second: float) -> int:
        """`locate` of one point in plain floats, for the online run."""
        size, half = self.resolution, self.half_width
        u = (first + half) / self.cell_length
        v = (second + half) / self.cell_length
        if not (0.0 <= u < size and 0.0 <= v < size):
            return OUTSIDE
        return int(u) * size + int(v)
