"""What a scenario file says of the pendulum."""

import math
from dataclasses import dataclass, field, fields

import numpy as np

GRAVITY = 9.81
"""Of Drake's pendulum [m/s^2]."""


@dataclass(kw_only=True)
class PendulumParameters:
    """The task's part of the scenario file. Angles are from upright, positive to the front."""

    mass_kg: float = 1.0
    length_m: float = 0.5
    damping: float = 0.05
    """Of the hinge [N·m·s/rad]."""
    effort_share: float = 0.35
    """The motor's torque, as a share of what holds the pendulum when it is horizontal."""
    stiffness: float = 20.0
    """Gain of the angle's error [N·m/rad]."""
    rate_gain: float = 3.0
    """Gain of the rate's error [N·m·s/rad]."""
    largest_angle_rad: float = 0.6
    """Beyond this angle the pendulum has left the safe set."""
    start_angle_rad: float = 0.6
    """Half-width of the angles at which episodes begin."""
    start_rate_rad_s: float = 2.0
    """Half-width of the rates at which episodes begin."""
    plan_angle_rad: float = 0.3
    """Half-width of the angles at which plans begin and end."""
    plan_duration_s: list[float] = field(default_factory=lambda: [0.5, 1.5])
    """Shortest and longest duration of the planned motion."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not np.all(np.isfinite(value)) or np.min(value) <= 0:
                raise ValueError(f"pendulum: {entry.name} must be finite and positive; got {value}")
        if len(self.plan_duration_s) != 2 or self.plan_duration_s[0] > self.plan_duration_s[1]:
            raise ValueError(
                f"pendulum: plan_duration_s must be [shortest, longest]; got {self.plan_duration_s}"
            )
        if self.start_angle_rad > self.largest_angle_rad:
            raise ValueError(
                f"pendulum: start_angle_rad must not exceed largest_angle_rad "
                f"{self.largest_angle_rad}, or episodes begin outside the safe set; got "
                f"{self.start_angle_rad}"
            )
        if not self.effort_share < 1:
            raise ValueError(
                f"pendulum: effort_share must be below 1, or nothing can go wrong; got "
                f"{self.effort_share}"
            )

    @property
    def hold_angle_rad(self) -> float:
        """The largest angle that the motor can hold."""
        return math.asin(self.effort_share)

    def effort_limit(self) -> float:
        """The motor's largest torque [N·m]."""
        return self.effort_share * self.mass_kg * GRAVITY * self.length_m
