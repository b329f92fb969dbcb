"""Parameters of the balancing task, with defaults that scale with the robot's size."""

import math
from dataclasses import field
from typing import Any, ClassVar

import numpy as np

from drake_safety.control.kinematics import NUM_BASE_VELOCITIES, RobotKinematics
from drake_safety.control.recovery_step import RecoveryStepParameters
from drake_safety.control.safe_sets import BalanceLimits
from drake_safety.diagrams.balancing.sampling import PushSampling, StartSampling
from drake_safety.files.schema import NotNegative, Positive, schema
from drake_safety.models import load_robot
from drake_safety.plants.balls import Throw
from drake_safety.robots.robot_size import (
    BALANCING_REFERENCE,
    GRAVITY_M_S2,
    RobotSize,
    overlaid,
    scaled_defaults,
)


@schema(kw_only=True)
class RecoveryParameters:
    """Parameters of trigger and recovery steps."""

    threshold: float = 0.6  # Γ_thre, of the probability: the paper's value for b_safe.
    persistence_s: NotNegative = 0.02  # Time for which "don't know" lasts before a trigger.
    assessment_period_s: Positive = 0.02
    step: RecoveryStepParameters = field(default_factory=RecoveryStepParameters)


@schema(kw_only=True)
class BalancingParameters:
    """The task's part of the scenario file."""

    online: ClassVar = ("recovery", "demonstration")

    scale_to_robot: bool = False
    """Whether defaults scale with the robot's standing height, foot spacing and mass; values in the
    file do not. Unscaled defaults suit a robot 0.42 m high, of 25 kg."""
    safe_set: BalanceLimits = field(default_factory=BalanceLimits)
    start: StartSampling = field(default_factory=StartSampling)
    push: PushSampling = field(default_factory=PushSampling)
    recovery: RecoveryParameters = field(default_factory=RecoveryParameters)
    demonstration: list[Throw] = field(default_factory=list)  # Balls of `run --push ball`.

    @classmethod
    def completed(cls, stated: dict[str, Any], robot: str) -> dict[str, Any]:
        """Scales defaults to the robot's size if the scenario has ``scale_to_robot``."""
        if stated.get("scale_to_robot") is not True:
            return stated
        return fitted_to_robot(stated, RobotKinematics(load_robot(robot)))


_LEAST_TWIST_RAD = 0.2  # Feet that slip at a smaller twist cannot hold the heading.
# Physical quantity of each parameter that scales with the robot's size.
_QUANTITIES: dict[str, Any] = {
    "safe_set": {"support_clearance_m": "height", "height_m": "height", "fall_height_m": "height"},
    "start": {
        "foot_offset_m": "width",
        "base_offset_m": ["length", "width"],
        "base_height_m": "height",
        "velocity_std_m_s": ["speed_x", "speed_y", "speed_z"],
        "angular_velocity_std_rad_s": "rate",
        "target_offset_m": ["length", "width"],
        "target_height_m": "height",
        "plan_duration_s": "duration",
    },
    "push": {
        "mass_kg": "mass",
        "speed_m_s": "speed_y",
        "height_m": "height",
        "target_offset_m": ["length", "width"],
    },
    "recovery": {
        "step": {
            "step_duration_s": "duration",
            "lift_m": "height",
            "velocity_gain_s": "duration",
            "yaw_damping_s": "duration",
            "max_reach_m": "height",
            "min_lateral_m": "width",
            "settle_margin_m": "width",
            "resume_margin_m": "width",
            "return_duration_s": "duration",
        }
    },
}


def fitted_to_robot(stated: dict[str, Any], kinematics: RobotKinematics) -> dict[str, Any]:
    """Merges the file's parameters with defaults scaled to the robot."""
    half_length_m, half_width_m = np.abs(kinematics.nominal_contacts).max(axis=0).tolist()
    size = RobotSize(
        height_m=kinematics.standing_height,
        half_length_m=half_length_m,
        half_width_m=half_width_m,
        mass_kg=kinematics.total_mass,
    )
    factors = size.factors(BALANCING_REFERENCE)
    defaults = scaled_defaults(BalancingParameters(), _QUANTITIES, factors)
    if largest_twist(kinematics) < _LEAST_TWIST_RAD:
        # Such stiff legs make their feet slip, and a slipping foot does not catch the robot.
        defaults["recovery"]["step"]["max_twist_rad"] = 0.0
    return overlaid(defaults, stated)


def largest_twist(kinematics: RobotKinematics) -> float:
    """Largest yaw twist of the standing base by half of its legs before their feet slip [rad]."""
    robot = kinematics.robot
    stiffness = [getattr(robot.gains_of(name), "stiffness", 0.0) for name in kinematics.joint_names]
    J = kinematics.contact_jacobian(kinematics.standing_positions())
    joints_per_yaw = np.linalg.lstsq(J[:, NUM_BASE_VELOCITIES:], J[:, 2], rcond=None)[0]
    torque_per_yaw = 0.5 * float(np.square(joints_per_yaw) @ stiffness)
    radius_m = float(np.linalg.norm(kinematics.nominal_contacts, axis=1).mean())
    torque = robot.foot_friction * kinematics.total_mass * GRAVITY_M_S2 * radius_m
    return torque / torque_per_yaw if torque_per_yaw > 0 else math.inf
