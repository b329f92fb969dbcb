"""Kinematics: Jacobians are derivatives, ground forces carry the weight, the stance is planar."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant

from drake_safety.control.kinematics import RobotKinematics, fit_stance, planar_pose
from drake_safety.robots.robot import add_robot
from drake_safety.robots.robot_model import RobotModel, load_robot_file
from legged_robots import edited, robot_kinematics, robot_model, write_hexapod

G = 9.81


@pytest.fixture
def kinematics():
    return robot_kinematics("hexapod")


def random_positions(kinematics, rng):
    X_WB = RigidTransform(RollPitchYaw(rng.uniform(-0.5, 0.5, 3)), rng.normal(size=3))
    joints = kinematics.posture + rng.uniform(-0.2, 0.2, kinematics.num_joints)
    return kinematics.positions_at(X_WB, joints)


def test_the_contact_jacobian_is_the_derivative_of_the_contact_positions(kinematics):
    rng = np.random.default_rng(1)
    q = random_positions(kinematics, rng)
    J = kinematics.contact_jacobian(q)
    for _ in range(4):
        v = rng.normal(size=kinematics.num_velocities)
        kinematics.set_positions(q)  # The Context whose map turns v into q̇.
        qdot = kinematics.plant.MapVelocityToQDot(kinematics.context, v)
        step = 1e-6
        ahead = kinematics.contact_positions(q + step * qdot)
        difference = ahead - kinematics.contact_positions(q - step * qdot)
        np.testing.assert_allclose(J @ v, difference.ravel() / (2 * step), atol=1e-7)


def test_the_gravity_torques_and_ground_forces_carry_the_weight(kinematics):
    # Inverse dynamics: zero acceleration needs exactly these torques and a total force m g.
    q = kinematics.standing_positions()
    is_stance = np.ones(kinematics.num_contacts, bool)
    torques = kinematics.gravity_torques(q, is_stance)
    J = kinematics.contact_jacobian(q)
    plant, context = kinematics.plant, kinematics.context
    plant.SetPositions(context, q)
    residual = -plant.CalcGravityGeneralizedForces(context)
    residual[6:] -= torques
    forces, *_ = np.linalg.lstsq(J.T, residual, rcond=None)
    np.testing.assert_allclose(J.T @ forces, residual, atol=2e-2 * kinematics.total_mass)
    total = forces.reshape(-1, 3).sum(axis=0)
    np.testing.assert_allclose(total, [0, 0, kinematics.total_mass * G], atol=0.3)


def test_a_lifted_foot_pushes_nothing_and_in_the_air_none_does():
    kinematics = robot_kinematics("hexapod")
    q = kinematics.standing_positions()
    is_stance = np.ones(6, bool)
    is_stance[2] = False
    lifted, flying = (kinematics.gravity_torques(q, x) for x in (is_stance, np.zeros(6, bool)))
    kinematics.plant.SetPositions(kinematics.context, q)
    gravity = kinematics.plant.CalcGravityGeneralizedForces(kinematics.context)[6:]
    leg = [kinematics.joint_names.index(f"{name}_2") for name in ("swing", "lift", "knee")]
    np.testing.assert_allclose(lifted[leg], -gravity[leg], atol=1e-12)
    np.testing.assert_array_equal(flying, -gravity)


@pytest.mark.parametrize("entry", [0, 9])
def test_positions_that_are_not_finite_are_refused_not_fatal(kinematics, entry):
    q = kinematics.standing_positions()
    q[entry] = np.nan
    for call in (kinematics.contact_positions, kinematics.contact_jacobian):
        with pytest.raises(ValueError, match="robot 'hexapod': positions must be finite"):
            call(q)


def test_the_stance_is_the_least_squares_fit():
    rng = np.random.default_rng(7)
    nominal = robot_kinematics("hexapod").nominal_contacts
    p = np.column_stack([nominal + 0.05 * rng.normal(size=nominal.shape), np.zeros(len(nominal))])

    def cost(pose):
        fitted = (planar_pose(pose) @ np.column_stack([nominal, np.zeros(len(nominal))]).T).T
        return np.sum((fitted - p) ** 2)

    best = fit_stance(p, nominal)
    for _ in range(100):
        assert cost(best) <= cost(best + 0.01 * rng.normal(size=3)) + 1e-15


def test_a_base_that_does_not_float_is_refused(tmp_path):
    robot = load_robot_file(edited(write_hexapod(tmp_path), base="tibia_0"))
    with pytest.raises(ValueError, match="base 'tibia_0' must be the floating body"):
        RobotKinematics(robot)


def test_a_robot_alone_and_in_a_plant_agree_about_joint_order():
    robot: RobotModel = robot_model("biped")
    kinematics = robot_kinematics("biped")
    plant = MultibodyPlant(0.001)
    add_robot(plant, robot_model("hexapod"))
    instance = add_robot(plant, robot)
    plant.Finalize()
    joints = [plant.get_joint(i) for i in plant.GetJointIndices(instance)]
    joints = [joint for joint in joints if joint.num_velocities() == 1]
    joints.sort(key=lambda joint: joint.velocity_start())
    assert [joint.name() for joint in joints] == kinematics.joint_names
