"""When a motion went wrong, if it did."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(kw_only=True, eq=False)
class Mishap:
    """What every log of one motion tells of its end.

    Attributes:
        leave_time_s: When the robot left its safe set [s]; infinite if it did not.
        fall_time_s: When it fell [s]; infinite if it did not.
    """

    leave_time_s: float
    fall_time_s: float

    @property
    def has_left(self) -> bool:
        """Whether the robot left its safe set."""
        return math.isfinite(self.leave_time_s)

    @property
    def has_fallen(self) -> bool:
        """Whether the robot fell."""
        return math.isfinite(self.fall_time_s)
