"""Motors whose torque falls with speed."""

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant

from drake_safety import load_scenario
from drake_safety.models import load_robot
from drake_safety.robots.robot import add_robot
from drake_safety.simulation.motion import End, simulate
from drake_safety.simulation.rollouts import episode_rng
from drake_safety.systems.motor_curves import MotorCurves

NAMES = ["FR_hip_joint", "FR_calf_joint"]


@pytest.fixture(scope="module")
def laikago():
    plant = MultibodyPlant(0.001)
    instance = add_robot(plant, load_robot("laikago"))
    plant.Finalize()
    return plant, instance, MotorCurves(plant, instance, NAMES)


def torques(laikago, wanted, actual):
    """Torques of the servos for a desired and an actual state, (2,)."""
    plant, instance, curves = laikago
    joints = [plant.GetJointByName(name, instance) for name in NAMES]
    motors = map(plant.get_joint_actuator, plant.GetJointActuatorIndices(instance))
    motors = {motor.joint().name(): motor for motor in motors}
    gains = [motors[name].get_controller_gains() for name in NAMES]
    limits = np.array([motors[name].effort_limit() for name in NAMES])
    speeds = np.array([joint.velocity_upper_limit() for joint in joints])
    (q_wanted, v_wanted), (q, v) = np.split(curves.limited(wanted, actual), 2), np.split(actual, 2)
    p, d = np.array([[one.p, one.d] for one in gains]).T
    return p * (q_wanted - q) + d * (v_wanted - v), limits, speeds


def test_below_the_curve_the_command_passes_to_the_last_bit(laikago):
    wanted, actual = np.array([0.1, -0.9, 0.0, 0.0]), np.array([0.11, -0.91, 0.2, -0.1])
    assert laikago[2].limited(wanted, actual).tobytes() == wanted.tobytes()


@pytest.mark.parametrize(
    ("share", "along", "against"), [(0.0, 1.0, 1.0), (0.5, 0.5, 1.0), (1.0, 0.0, 1.0), (2.0, 0, 1)]
)
def test_the_torque_falls_with_speed_along_the_motion_alone(laikago, share, along, against):
    for sign in (1.0, -1.0):
        for pull, expected in ((sign, along), (-sign, against)):
            _, limits, speeds = torques(laikago, np.zeros(4), np.zeros(4))
            actual = np.concatenate([np.zeros(2), sign * share * speeds])
            torque, *_ = torques(laikago, np.append(pull * np.full(2, 50.0), [0.0, 0.0]), actual)
            np.testing.assert_allclose(torque, pull * expected * limits, atol=1e-9)


@pytest.mark.parametrize("engine", ["drake", "mujoco"])
def test_no_motor_accelerates_a_joint_beyond_its_speed(engine):
    changes = {"variations.nominal.engine": engine, "robot": "laikago"}
    slow = {"variations.nominal.motors": "dc"}
    fastest = {}
    for name, added in (("constant", {}), ("dc", slow)):
        scenario = load_scenario("laikago_balancing", changes | added)
        loop = scenario.make_loop(ball=False)
        limits = loop.kinematics.velocity_limits
        motion = simulate(
            loop,
            lambda context, loop=loop: loop.reset(context, episode_rng(3, 2)),
            ["plant_state", "margins"],
            End(duration_s=0.3),
            step_s=0.0025,
        )
        assert ("motor_curves" in {s.get_name() for s in loop.GetSystems()}) == (name == "dc")
        fastest[name] = (np.abs(motion["plant_state"][:, -12:]) / limits).max()
    assert fastest["dc"] <= fastest["constant"] + 1e-3


def test_a_robot_without_servos_is_refused():
    scenario = load_scenario("atlas_reaching", {"variations.nominal.motors": "dc"})
    with pytest.raises(ValueError, match="position servos"):
        scenario.make_loop()
