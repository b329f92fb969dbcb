"""Shift: lasting conditions of a plant or its sensors that training does not have."""

import math
from dataclasses import dataclass, field


@dataclass(kw_only=True)
class JointShift:
    """A joint that answers differently from the published one."""

    effort_scale: float = 1.0
    """Factor on the motor's largest torque."""
    stiffness_scale: float = 1.0
    """Factor on the position servo's gains."""
    is_locked: bool = False
    """Whether the joint keeps its initial position."""

    def __post_init__(self) -> None:
        for name in ("effort_scale", "stiffness_scale"):
            if not getattr(self, name) > 0:
                raise ValueError(f"joint shift: {name} must be positive; got {getattr(self, name)}")


@dataclass(kw_only=True)
class InputShift:
    """A fault of the measurement that the assessor reads; the motion does not depend on it."""

    joint_bias_rad: float = 0.0
    """Added to every measured joint position [rad]."""
    velocity_scale: float = 1.0
    """Factor on every measured velocity; 0 for dead ones."""
    frozen_at_s: float | None = None
    """Time after which the measurement repeats itself [s]; never by default."""
    delay_s: float = 0.0
    """Age of the measurement [s]."""

    def __post_init__(self) -> None:
        for name in ("delay_s", "frozen_at_s"):
            value = getattr(self, name)
            if value is not None and not value >= 0:
                raise ValueError(f"input shift: {name} must not be negative; got {value}")


@dataclass(kw_only=True)
class Shift:
    """Conditions that training does not have; see `PlantVariation` for others."""

    slope_rad: float = 0.0
    """Inclination of the ground, simulated as gravity that is not normal to it [rad]."""
    slope_direction_rad: float = 0.0
    """Direction in which the ground falls, from the x axis [rad]."""
    base_force_n: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Steady force on the base's origin, in the world, (3,) [N]."""
    joints: dict[str, JointShift] = field(default_factory=dict)
    """Joints that answer differently, by name or pattern."""
    command_delay_s: float = 0.0
    """Age of the command that the joints get [s]."""
    holes_m: dict[str, float] = field(default_factory=dict)
    """Depth of the ground under a foot [m]."""
    inputs: InputShift = field(default_factory=InputShift)
    """What the assessor reads."""

    def __post_init__(self) -> None:
        if not abs(self.slope_rad) < 0.5 * math.pi:
            raise ValueError(f"shift: slope_rad must be within a right angle; got {self.slope_rad}")
        if len(self.base_force_n) != 3 or not all(map(math.isfinite, self.base_force_n)):
            raise ValueError(f"shift: base_force_n is three numbers [N]; got {self.base_force_n}")
        if not self.command_delay_s >= 0:
            raise ValueError(
                f"shift: command_delay_s must not be negative; got {self.command_delay_s}"
            )
        for foot, depth in self.holes_m.items():
            if not depth > 0:
                raise ValueError(f"shift: holes_m of foot '{foot}' must be positive; got {depth}")
