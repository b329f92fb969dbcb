"""FollowingCamera: Meshcat's camera and ground around a robot on legs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from pydrake.geometry import Meshcat, Rgba
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from drake_safety.simulation.legged_loop import LeggedLoop

WORLD = "/drake"
"""Path of the world in Meshcat's scene."""

_OWN = ("/Grid", "/Axes")  # Meshcat's own, which are hidden.
_GROUND, _GRID = f"{WORLD}/visualizer/ground", f"{WORLD}/grid"
_DISTANCE = 1.55  # From the camera to the robot, by the robot's size.
_TICK_S, _FOLLOWED = 0.04, 0.2  # The camera goes this share of the way to the robot in a tick.
_CELL_M, _NUM_CELLS = 0.5, 7  # Of the grid: size, and number from its middle.


class FollowingCamera:
    """Keeps a robot on legs in the middle of the picture, and the ground below it.

    Attributes:
        size_m: Size of the robot: twice the height of its base, or the extent of its feet [m].
    """

    def __init__(self, loop: LeggedLoop, meshcat: Meshcat):
        self.meshcat = meshcat
        self._state_port = loop.GetOutputPort("plant_state")
        self._target, self._time_s = np.zeros(2), np.inf
        q = loop.kinematics.standing_positions()
        contacts = loop.kinematics.contact_positions(q)
        self.size_m = float(max(2 * q[6], *np.ptp(contacts, axis=0)))
        self._height_m = 0.7 * float(q[6])
        for path in _OWN:
            meshcat.SetProperty(path, "visible", False)
        self._draw_grid()
        meshcat.SetCameraPose(_DISTANCE * self.size_m * loop.view.direction(), np.zeros(3))

    def follow(self, context: Context) -> None:
        """Moves the world so that the robot stays in the picture, at once if time went back."""
        elapsed_s, self._time_s = context.get_time() - self._time_s, context.get_time()
        share = 1.0 - (1.0 - _FOLLOWED) ** (elapsed_s / _TICK_S) if elapsed_s >= 0 else 1.0
        base = self._state_port.Eval(context)[4:6]
        self._target = self._target + share * (base - self._target)
        # The ground has no end: its disc and whole cells of its grid stay below the robot.
        cells = _CELL_M * np.round(self._target / _CELL_M)
        poses = {WORLD: [*-self._target, -self._height_m]}
        poses |= {_GROUND: [*self._target, 0.0], _GRID: [*cells, 0.0]}
        for path, place in poses.items():
            self.meshcat.SetTransform(path, RigidTransform(place), self._time_s)

    def _draw_grid(self) -> None:
        """Draws a round grid a little above the ground, by which one sees the robot move."""
        # In pieces: some browsers do not draw a line that begins behind the camera.
        n = _NUM_CELLS
        x, y = (part.ravel() for part in np.mgrid[-n : n + 1.0, -n : n + 0.0])
        is_near = np.hypot(x, np.maximum(np.abs(y), np.abs(y + 1.0))) <= n
        x, y, z = x[is_near], y[is_near], np.full(is_near.sum(), 0.004 / _CELL_M)
        starts = np.hstack([[x, y, z], [y, x, z]])
        ends = np.hstack([[x, y + 1.0, z], [y + 1.0, x, z]])
        self.meshcat.SetLineSegments(
            _GRID, _CELL_M * starts, _CELL_M * ends, 1.0, Rgba(0.65, 0.67, 0.7)
        )


def follow(loop: object, meshcat: Meshcat) -> Callable[[Context], None] | None:
    """Aims at a robot on legs; returns what makes the camera follow it, called with a Context."""
    if not isinstance(loop, LeggedLoop):
        return None
    camera = FollowingCamera(loop, meshcat)
    camera.follow(loop.CreateDefaultContext())
    return camera.follow
