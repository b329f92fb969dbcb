"""A plane of starts: two state variables, all else fixed, on which the truth can be simulated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drake_safety.simulation.episode_start import EpisodeStart


@dataclass(frozen=True, kw_only=True)
class StatePlane:
    """Where two state variables lie, and what begins there.

    Attributes:
        axes: What the two variables are, with their units.
        lowest: Of both.
        highest: Of both.
        start: From a point (2,) of the plane to a start.
    """

    axes: tuple[str, str]
    lowest: tuple[float, float]
    highest: tuple[float, float]
    start: Callable[[np.ndarray], EpisodeStart]

    def points(self, resolution: int) -> np.ndarray:
        """A grid with its border, (resolution, resolution, 2); the first variable varies first.

        Args:
            resolution: Points along either variable.

        Raises:
            ValueError: There are fewer than two of them.
        """
        if resolution < 2:
            raise ValueError(f"state plane: resolution must be at least 2; got {resolution}")
        x, y = (
            np.linspace(low, high, resolution)
            for low, high in zip(self.lowest, self.highest, strict=True)
        )
        return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
