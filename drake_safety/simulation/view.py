"""Where pictures of a task are taken from."""

import math
from dataclasses import dataclass


@dataclass(kw_only=True)
class View:
    """A camera that follows a robot's base over the ground."""

    azimuth_rad: float = math.radians(-42.0)
    """Where it stands, as an angle from the world's x axis [rad]."""
    elevation_rad: float = math.radians(15.0)
    """How far above the robot it stands [rad]."""
    room: float = 0.95
    """How much more than the robot's own extent fits into a picture."""

    def __post_init__(self) -> None:
        if not abs(self.elevation_rad) < 0.5 * math.pi:
            raise ValueError(
                f"view: elevation_rad must be within a right angle; got {self.elevation_rad}"
            )
        if not self.room > 0:
            raise ValueError(f"view: room must be positive; got {self.room}")

    def mirrored(self) -> "View":
        """The view from the other side of the x-z plane."""
        return View(azimuth_rad=-self.azimuth_rad, elevation_rad=self.elevation_rad, room=self.room)
