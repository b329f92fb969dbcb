"""Shift: lasting conditions of a plant or its sensors that training does not have."""

import math
from dataclasses import dataclass, field

from drake_safety.robots.reading import did_you_mean

FAULTS = {
    "bias": True,
    "drift": True,
    "zero": False,
    "scale": True,
    "swap": False,
    "noise": True,
    "delay": True,
    "half_rate": False,
    "freeze": False,
}
"""Kinds of faults, and whether they have a value."""


@dataclass(kw_only=True)
class JointShift:
    """A joint that answers differently from the published one."""

    effort_scale: float = 1.0
    """Factor on the motor's largest torque."""
    stiffness_scale: float = 1.0
    """Factor on the position servo's gains."""
    damping_scale: float = 1.0
    """Further factor on its damping."""
    is_locked: bool = False
    """Whether the joint keeps its initial position."""

    def __post_init__(self) -> None:
        for name in ("effort_scale", "stiffness_scale", "damping_scale"):
            if not getattr(self, name) > 0:
                raise ValueError(f"joint shift: {name} must be positive; got {getattr(self, name)}")


@dataclass(kw_only=True)
class Fault:
    """A fault of some entries of a vector signal; see `SensorFaults`.

    ============= ==============================================================================
    kind          the entries
    ============= ==============================================================================
    ``bias``      have ``value`` added
    ``drift``     have ``value`` times the elapsed time [s] added
    ``zero``      are 0
    ``scale``     are multiplied by ``value``
    ``swap``      are two, of which each shows the other
    ``noise``     have normal noise of standard deviation ``value`` added, new in every sample
    ``delay``     are those of ``value`` [s] ago, a multiple of the sampling period
    ``half_rate`` are renewed by every second sample
    ``freeze``    repeat the last sample before the fault
    ============= ==============================================================================
    """

    kind: str = "zero"
    entries: list[str] = field(default_factory=lambda: [".*"])
    """Names or patterns of the entries; all by default."""
    value: float | None = None
    start_s: float = 0.0
    """Time from which the fault lasts [s]."""

    def __post_init__(self) -> None:
        if self.kind not in FAULTS:
            raise ValueError(
                f"fault: kind must be one of {list(FAULTS)}; got '{self.kind}'"
                f"{did_you_mean(self.kind, FAULTS)}"
            )
        if (self.value is not None) != FAULTS[self.kind]:
            needs = "needs a value" if FAULTS[self.kind] else "has no value"
            raise ValueError(f"fault: '{self.kind}' {needs}; got {self.value}")
        lowest = 0.0 if self.kind in ("noise", "delay") else -math.inf
        if self.value is not None and not lowest <= self.value < math.inf:
            raise ValueError(f"fault: value of '{self.kind}' is out of range; got {self.value}")
        if not 0 <= self.start_s < math.inf:
            raise ValueError(f"fault: start_s must not be negative; got {self.start_s}")


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
    command_faults: list[Fault] = field(default_factory=list)
    """Faults of the command that the joints get. Entries are joints, their velocities end in
    ``_rate``; where the command is torques, they are actuators."""
    holes_m: dict[str, float] = field(default_factory=dict)
    """Depth of the ground under a foot [m]."""
    sensor_faults: list[Fault] = field(default_factory=list)
    """Faults of the measured ``[q; v]`` that the assessor reads; the motion does not depend on
    them. Entries have Drake's names, such as ``FR_calf_joint_q`` and ``FR_calf_joint_w``."""

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
