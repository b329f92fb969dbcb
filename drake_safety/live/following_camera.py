"""FollowingCamera: Meshcat's camera and ground around a robot on legs."""

from collections.abc import Callable

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from drake_safety.simulation.legged_loop import LeggedLoop

WORLD = "/drake"
"""Path of the world in Meshcat's scene."""

_GROUND = f"{WORLD}/visualizer/ground"
_DISTANCE = 1.55  # From the camera to the robot, by the robot's size.
_TICK_S, _FOLLOWED = 0.04, 0.2  # The camera goes this share of the way to the robot in a tick.
_CELL_M = 0.5  # Cell of Meshcat's grid.


class FollowingCamera:
    """Keeps a robot on legs in the middle of the picture, and the ground below it."""

    def __init__(self, loop: LeggedLoop, meshcat: Meshcat):
        self.meshcat = meshcat
        self._state_port = loop.GetOutputPort("plant_state")
        self._target, self._time_s = np.zeros(2), np.inf
        q = loop.kinematics.standing_positions()
        contacts = loop.kinematics.contact_positions(q)
        # Twice the height of the base, or the extent of the feet.
        self.size_m = float(max(2 * q[6], *np.ptp(contacts, axis=0)))
        self._height_m = 0.7 * float(q[6])
        meshcat.SetProperty("/Axes", "visible", False)
        meshcat.SetCameraPose(_DISTANCE * self.size_m * loop.view.direction(), np.zeros(3))

    def follow(self, context: Context) -> None:
        """Moves the world so that the robot stays in the picture, at once if time went back."""
        elapsed_s, self._time_s = context.get_time() - self._time_s, context.get_time()
        share = 1.0 - (1.0 - _FOLLOWED) ** (elapsed_s / _TICK_S) if elapsed_s >= 0 else 1.0
        base = self._state_port.Eval(context)[4:6]
        self._target = self._target + share * (base - self._target)
        # The ground has no end: its disc and whole cells of Meshcat's grid stay below the robot.
        cells = _CELL_M * np.round(self._target / _CELL_M) - self._target
        poses = {WORLD: [*-self._target, -self._height_m], _GROUND: [*self._target, 0.0]}
        poses["/Grid"] = [*cells, 0.004 - self._height_m]
        for path, place in poses.items():
            self.meshcat.SetTransform(path, RigidTransform(place), self._time_s)


def follow(loop: object, meshcat: Meshcat) -> Callable[[Context], None] | None:
    """Aims at a robot on legs; returns what makes the camera follow it, called with a Context."""
    if not isinstance(loop, LeggedLoop):
        return None
    camera = FollowingCamera(loop, meshcat)
    camera.follow(loop.CreateDefaultContext())
    return camera.follow
