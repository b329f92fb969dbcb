"""Catalogue of shifts: plants and faulty sensors absent from training, scaled to the robot."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from drake_safety.control.kinematics import NUM_BASE_POSITIONS
from drake_safety.robots.robot import ObservationNoise, Payload, PlantVariation
from drake_safety.robots.robot_model import as_pattern
from drake_safety.robots.robot_size import GRAVITY_M_S2
from drake_safety.robots.shift import Fault, JointShift, Shift
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.scenario import Scenario


@dataclass(frozen=True, kw_only=True)
class PlantShift:
    """A plant, or a fault of its sensors, that training does not have."""

    kind: Literal["plant", "sensor"]
    variation: PlantVariation
    options: Mapping[str, Any] = field(default_factory=dict)  # Options of its diagram.


def plant_shifts(scenario: Scenario, loop: ClosedLoop) -> dict[str, PlantShift]:
    """The scenario's variations and, for robots with legs, shifts of plant and sensors, by name."""
    own = {
        f"variation {name}": PlantShift(
            kind="plant", variation=variation, options=scenario.options_for("pairs", name)
        )
        for name, variation in scenario.variations.items()
        if name != "nominal"
    }
    if not isinstance(loop, LeggedLoop):
        return own
    kinematics, nominal = loop.kinematics, scenario.variation("nominal")
    robot, mass_kg, plant = kinematics.robot, kinematics.total_mass, kinematics.plant
    is_stance = np.ones(kinematics.num_contacts, dtype=bool)
    torques = np.abs(kinematics.gravity_torques(kinematics.standing_positions(), is_stance))
    motors = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
    limits = {name: limit for name, limit in kinematics.effort_limits.items() if limit > 0.0}
    loads = dict(zip(kinematics.joint_names, torques.tolist(), strict=True))
    joint = max((name for name in loads if name in limits), key=loads.__getitem__)
    key, period_s = as_pattern(joint), scenario.control_period_s
    # A servo has a desired position and velocity, another motor a torque.
    actuators = [one.name() for one in motors if one.joint().name() == joint]
    motor = ["|".join(map(as_pattern, [joint, f"{joint}_rate", *actuators]))]
    lasting = {
        "slope": Shift(slope_rad=math.radians(10.0)),
        "side_force": Shift(base_force_n=[0.0, 0.1 * mass_kg * GRAVITY_M_S2, 0.0]),
        "locked_joint": Shift(joints={key: JointShift(is_locked=True)}),
        "late_command": Shift(command_delay_s=_whole(5 * period_s, scenario.time_step_s)),
        "icy_foot": Shift(foot_friction={kinematics.foot_names[0]: 0.1}),
        "weakening_motor": Shift(command_faults=[Fault(kind="fade", entries=motor, value=40.0)]),
        "hole": Shift(holes_m={kinematics.foot_names[0]: 0.07 * kinematics.standing_height}),
    }
    if 0.0 < (weak_scale := 0.9 * loads[joint] / limits[joint]):  # Too weak to stand.
        lasting["weak_joint"] = Shift(joints={key: JointShift(effort_scale=weak_scale)})
    if robot.gains_of(joint) is not None:
        lasting["soft_joint"] = Shift(joints={key: JointShift(stiffness_scale=0.5)})
    names = [*map(as_pattern, plant.GetStateNames(add_model_instance_prefix=False))]
    n_q = kinematics.num_positions
    faults = {
        "joint_bias": Fault(kind="bias", entries=names[NUM_BASE_POSITIONS:n_q], value=0.05),
        "joint_drift": Fault(kind="drift", entries=names[NUM_BASE_POSITIONS:n_q], value=0.02),
        "dead_velocities": Fault(kind="zero", entries=names[n_q:]),
        "stale": Fault(kind="delay", value=_whole(0.2, period_s)),
        "frozen": Fault(kind="freeze"),
        "frozen_later": Fault(kind="freeze", start_s=0.4),
    }
    noise = nominal.input_noise
    noisy = ObservationNoise(position=noise.position, velocity=10.0 * noise.velocity)
    plants = {
        **{name: replace(nominal, shift=shift) for name, shift in lasting.items()},
        "payload": replace(nominal, payload=Payload(mass_kg=0.3 * mass_kg)),
        "heavy": replace(nominal, mass_scale=1.5 * nominal.mass_scale),
        "slippery": replace(nominal, foot_friction=0.1),
        "gravity_and_payload": replace(
            nominal, payload=Payload(mass_kg=0.15 * mass_kg), shift=Shift(gravity_scale=1.1)
        ),
    }
    sensors = {n: replace(nominal, shift=Shift(sensor_faults=[f])) for n, f in faults.items()}
    sensors["noisy_velocities"] = replace(nominal, input_noise=noisy)
    return {
        **{name: PlantShift(kind="plant", variation=one) for name, one in plants.items()},
        **own,
        **{name: PlantShift(kind="sensor", variation=one) for name, one in sensors.items()},
    }


def _whole(time_s: float, period_s: float) -> float:
    """The multiple of a period, at least one, that is nearest to a time."""
    return max(round(time_s / period_s), 1) * period_s
