"""Shift: lasting conditions of a plant or its sensors that training does not have."""

import math
from dataclasses import field
from typing import Annotated, Literal

from pydantic import Field, FiniteFloat

from drake_safety.files.schema import NotNegative, Pattern, Positive, Triple, schema

FAULTS = {one: True for one in ("bias", "drift", "scale", "delay", "fade")}
FAULTS |= {"zero": False, "freeze": False}
"""Kinds of faults, and whether they have a value."""


@schema(kw_only=True)
class JointShift:
    """A joint that answers differently from the published one."""

    effort_scale: Positive = 1.0  # Factor on the motor's largest torque.
    stiffness_scale: Positive = 1.0  # Factor on the position servo's gains.
    is_locked: bool = False  # Whether the joint keeps its initial position.


@schema(kw_only=True)
class Fault:
    """A fault of some entries of a vector signal; ``docs/shifts.md`` lists the kinds.

    Example: ``fault = Fault(kind="bias", entries=["angle"], value=0.05, start_s=1.0)``
    """

    kind: Literal[*FAULTS] = "zero"  # type: ignore[valid-type]
    # By name or pattern; by default all.
    entries: list[str] = field(default_factory=lambda: [".*"])
    value: FiniteFloat | None = None
    start_s: NotNegative = 0.0  # Time from which the fault lasts [s].

    def __post_init__(self) -> None:
        if (self.value is not None) != FAULTS[self.kind]:
            needs = "needs a value" if FAULTS[self.kind] else "has no value"
            raise ValueError(f"'{self.kind}' {needs}; got {self.value}")
        value = self.value or 0.0
        if (self.kind == "delay" and value < 0) or (self.kind == "fade" and value <= 0):
            least = "be positive" if self.kind == "fade" else "not be negative"
            raise ValueError(f"value of '{self.kind}' must {least}; got {self.value}")


@schema(kw_only=True)
class Shift:
    """Conditions that training does not have; see `PlantVariation` for others."""

    # Inclination of the ground, simulated as gravity that is not normal to it [rad].
    slope_rad: Annotated[float, Field(gt=-0.5 * math.pi, lt=0.5 * math.pi)] = 0.0
    slope_direction_rad: float = 0.0  # Direction in which the ground falls, from the x axis [rad].
    gravity_scale: Positive = 1.0  # Factor on gravity.
    # Steady force on the base's origin, in the world, (3,) [N].
    base_force_n: Triple = field(default_factory=lambda: [0.0, 0.0, 0.0])
    joints: dict[Pattern, JointShift] = field(default_factory=dict)  # By name or pattern.
    command_delay_s: NotNegative = 0.0  # Age of the command that the joints get [s].
    # Faults of the command that the joints get. Entries are joints, their velocities end in
    # ``_rate``; where the command is torques, they are actuators.
    command_faults: list[Fault] = field(default_factory=list)
    holes_m: dict[str, Positive] = field(default_factory=dict)  # Depth of ground under a foot [m].
    # Friction coefficient of some feet on the ground.
    foot_friction: dict[str, Positive] = field(default_factory=dict)
    # Faults of the measured ``[q; v]`` that the assessor reads; the motion does not depend on
    # them. Entries have Drake's names, such as ``FR_calf_joint_q`` and ``FR_calf_joint_w``.
    sensor_faults: list[Fault] = field(default_factory=list)
