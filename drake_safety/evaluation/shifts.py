"""Catalogue of shifts: plants and faulty sensors unlike those of training, scaled to the robot."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drake_safety.control.kinematics import NUM_BASE_POSITIONS, RobotKinematics
from drake_safety.robots.robot import ObservationNoise, Payload, PlantVariation
from drake_safety.robots.robot_model import by_pattern
from drake_safety.robots.shift import Fault, JointShift, Shift
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.scenario import Scenario

_SLOPE_RAD = math.radians(10.0)
_SIDE_FORCE_SHARE = 0.1  # Of the weight.
_PAYLOAD_SHARE = 0.3  # Of the mass.
_MASS_SCALE = 1.5
_WEAK_SHARE = 0.9  # Of the joint's static torque in the standing posture.
_LOW_FRICTION = 0.1
_DELAY_PERIODS = 5  # Of the controller.
_HOLE_SHARE = 0.07  # Of the standing height.
_JOINT_BIAS_RAD = 0.05
_NOISE_FACTOR = 10.0
_FROZEN_AT_S = 0.4
_STALE_S = 0.2


@dataclass(frozen=True, kw_only=True)
class PlantShift:
    """A plant, or a fault of its sensors, that training does not have.

    Attributes:
        kind: "plant" or "sensor".
    """

    kind: str
    variation: PlantVariation
    options: Mapping[str, Any] = field(default_factory=dict)


def plant_shifts(scenario: Scenario, loop: ClosedLoop) -> dict[str, PlantShift]:
    """Shifts of plant and sensors from the nominal plant, and the scenario's variations, by name.

    Robots with legs have more.
    """
    own = {
        f"variation {name}": PlantShift(
            kind="plant",
            variation=variation,
            options=scenario.task_class().pairing_options(scenario, name),
        )
        for name, variation in scenario.variations.items()
        if name != "nominal"
    }
    if not isinstance(loop, LeggedLoop):
        return own
    kinematics, nominal = loop.kinematics, scenario.variation("nominal")
    robot, mass_kg = kinematics.robot, kinematics.total_mass
    q = kinematics.standing_positions()
    is_stance = np.ones(kinematics.num_contacts, dtype=bool)
    torques = np.abs(kinematics.gravity_torques(q, is_stance))
    loaded = int(np.argmax(torques))
    joint = kinematics.joint_names[loaded]
    foot = kinematics.foot_names[0]
    weak_scale = _WEAK_SHARE * torques[loaded] / _effort_limit(kinematics, joint)
    lateral_n = _SIDE_FORCE_SHARE * mass_kg * 9.81
    late_s = _whole(_DELAY_PERIODS * scenario.control_period_s, scenario.time_step_s)
    lasting = {
        "slope": Shift(slope_rad=_SLOPE_RAD),
        "side_force": Shift(base_force_n=[0.0, lateral_n, 0.0]),
        "weak_joint": Shift(joints={joint: JointShift(effort_scale=weak_scale)}),
        "locked_joint": Shift(joints={joint: JointShift(is_locked=True)}),
        "late_command": Shift(command_delay_s=late_s),
        "hole": Shift(holes_m={foot: _HOLE_SHARE * kinematics.standing_height}),
    }
    if by_pattern(robot.joint_gains, joint, "gains", robot.name) is not None:
        lasting["soft_joint"] = Shift(joints={joint: JointShift(stiffness_scale=0.5)})
    names = kinematics.plant.GetStateNames(add_model_instance_prefix=False)
    n_q, period_s = kinematics.num_positions, scenario.control_period_s
    positions, velocities = names[NUM_BASE_POSITIONS:n_q], names[n_q:]
    faults = {
        "joint_bias": Fault(kind="bias", entries=positions, value=_JOINT_BIAS_RAD),
        "dead_velocities": Fault(kind="zero", entries=velocities),
        "stale": Fault(kind="delay", value=_whole(_STALE_S, period_s)),
        "frozen": Fault(kind="freeze"),
        "frozen_later": Fault(kind="freeze", start_s=_FROZEN_AT_S),
    }
    noise = nominal.input_noise
    noisy = ObservationNoise(position=noise.position, velocity=_NOISE_FACTOR * noise.velocity)
    plants = {
        **{name: dataclasses.replace(nominal, shift=shift) for name, shift in lasting.items()},
        "payload": dataclasses.replace(nominal, payload=Payload(mass_kg=_PAYLOAD_SHARE * mass_kg)),
        "heavy": dataclasses.replace(nominal, mass_scale=_MASS_SCALE * nominal.mass_scale),
        "slippery": dataclasses.replace(nominal, foot_friction=_LOW_FRICTION),
    }
    sensors = {
        **{
            name: dataclasses.replace(nominal, shift=Shift(sensor_faults=[fault]))
            for name, fault in faults.items()
        },
        "noisy_velocities": dataclasses.replace(nominal, input_noise=noisy),
    }
    return {
        **{name: PlantShift(kind="plant", variation=one) for name, one in plants.items()},
        **own,
        **{name: PlantShift(kind="sensor", variation=one) for name, one in sensors.items()},
    }


def _whole(time_s: float, period_s: float) -> float:
    """The multiple of a period, at least one, that is nearest to a time."""
    return max(round(time_s / period_s), 1) * period_s


def _effort_limit(kinematics: RobotKinematics, joint: str) -> float:
    limit = by_pattern(kinematics.robot.effort_limits, joint, "effort limit", kinematics.robot.name)
    if limit is None:
        plant = kinematics.plant
        limit = next(
            plant.get_joint_actuator(i).effort_limit()
            for i in plant.GetJointActuatorIndices()
            if plant.get_joint_actuator(i).joint().name() == joint
        )
    return float(limit)


def shifted_scenario(scenario: Scenario, name: str, shift: PlantShift) -> Scenario:
    """The scenario with a shift as a further variation."""
    shifted = copy.copy(scenario)
    shifted.variations = {**scenario.variations, name: shift.variation}
    return shifted
