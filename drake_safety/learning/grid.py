"""The square grid of cells over the two-dimensional embedding space."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drake_safety.learning.assessment_parameters import AssessmentParameters

OUTSIDE = -1  # Cell of a point outside the grid, and of NaN.
_FILL = 1.1  # Ratio of the grid's half width to the largest coordinate of scaled points.


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A grid of R x R square cells, R the resolution, centred at the origin.

    Cell (i, j) has the index i * R + j, where i counts along the first coordinate. A cell contains
    its lower edges but not its upper edges.

    Departure ("sharpened" only): `read` interpolates between the cells' centres; the paper reads
    the cell that contains Psi(x).
    """

    resolution: int
    cell_length: float
    interpolates: bool = True

    @classmethod
    def of(cls, parameters: AssessmentParameters) -> Grid:
        """Makes the grid of an assessment."""
        return cls(
            resolution=parameters.resolution,
            cell_length=parameters.cell_length,
            interpolates=parameters.mode != "paper",
        )

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

        Departure: the extent of a t-SNE embedding grows with the number of points.
        """
        centred = points - points.mean(axis=0)
        extent = float(np.abs(centred).max())
        if not (math.isfinite(extent) and extent > 0.0):
            raise ValueError(f"Grid.scale: the points' extent is {extent}, expected finite and > 0")
        return centred * (self.half_width / (_FILL * extent))

    def locate(self, points: np.ndarray) -> np.ndarray:
        """Returns L, the cell of each point (..., 2), or `OUTSIDE`."""
        position = (np.asarray(points, dtype=float) + self.half_width) / self.cell_length
        is_inside = np.all((position >= 0.0) & (position < self.resolution), axis=-1)
        index = np.where(is_inside[..., None], position, 0.0).astype(int)
        cells = index[..., 0] * self.resolution + index[..., 1]
        return np.where(is_inside, cells, OUTSIDE)

    def read(self, points: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Reads values of the cells at points; see `interpolate`."""
        return (self.interpolate if self.interpolates else self.look_up)(points, values)

    def interpolate(self, points: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interpolates values of the cells bilinearly between the cells' centres.

        Points are (K, N, 2), values of all cells of K grids (K, R*R, C). Returns values (K, N, C),
        zero outside the grid, and whether points are inside, (K, N). The bits of a point do not
        depend on the others.
        """
        last = self.resolution - 1.0
        position = points / self.cell_length
        position += 0.5 * last
        is_within = (position >= -0.5) & (position < last + 0.5)
        is_inside = is_within[..., 0] & is_within[..., 1]
        # These choose the number of a number and NaN.
        np.fmin(np.fmax(position, 0.0, out=position), last, out=position)
        # The weight of a row or column of cells falls linearly with the distance from its centre.
        weight = position[..., None] - np.arange(self.resolution)
        np.subtract(1.0, np.abs(weight, out=weight), out=weight)
        np.maximum(weight, 0.0, out=weight)
        weight *= is_inside[..., None, None]
        num_grids, width = len(values), values.shape[2]
        table = values.reshape(num_grids, 1, self.resolution, self.resolution * width)
        columns = (weight[..., :1, :] @ table).reshape(*is_inside.shape, self.resolution, width)
        return (weight[..., 1:, :] @ columns)[..., 0, :], is_inside

    def look_up(self, points: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Reads values of the cells that contain points; see `interpolate`."""
        cells = self.locate(points)
        is_inside = cells != OUTSIDE
        of_cells = np.take_along_axis(values, np.maximum(cells, 0)[..., None], axis=1)
        return of_cells * is_inside[..., None], is_inside
