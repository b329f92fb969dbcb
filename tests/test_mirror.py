"""The mirror: reflecting twice is nothing, and the mirrored robot is where its image is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.math import RigidTransform, RollPitchYaw

from drake_safety.control.kinematics import RobotKinematics, fit_stance, planar_pose
from drake_safety.control.mirror import Mirror
from drake_safety.control.observation import stance_state
from drake_safety.robots.robot_model import load_robot_file
from legged_robots import edited, robot_kinematics, write_hexapod


def law(test):
    """A law of symmetric robots, in states that follow from a few seeds."""
    few = settings(max_examples=5)(given(seed=st.integers(0, 2**32 - 1))(test))
    robots = [pytest.param(robot_kinematics(name), id=name) for name in ("atlas", "biped")]
    return pytest.mark.parametrize("kinematics", robots)(few)


def random_state(kinematics, rng, planted=True):
    """A state somewhere in the world; with planted feet its stance is the standing one."""
    joints = kinematics.posture.copy()
    if not planted:
        joints += rng.uniform(-0.3, 0.3, kinematics.num_joints)
    X_WB = RigidTransform(RollPitchYaw(rng.uniform(-0.5, 0.5, 3)), rng.normal(size=3))
    q = kinematics.positions_at(X_WB, joints)
    return q, rng.normal(size=kinematics.num_velocities)


def same_points(p, others):
    """Whether each point of one set is in the other."""
    distance = np.linalg.norm(p[:, np.newaxis] - others, axis=-1)
    return distance.min(axis=0).max() < 1e-6 and distance.min(axis=1).max() < 1e-6


@law
def test_reflecting_twice_changes_nothing_and_many_are_reflected_as_one_by_one(kinematics, seed):
    mirror, rng = Mirror(kinematics), np.random.default_rng(seed)
    q, v = random_state(kinematics, rng, planted=False)
    stance = rng.normal(size=3)
    twice = mirror.plant_state(*mirror.plant_state(q, v, stance), stance)
    np.testing.assert_allclose(np.concatenate(twice), np.concatenate([q, v]), atol=1e-12)
    states = np.tile(stance_state(kinematics, q, v), (3, 2, 1)) + rng.normal(size=(3, 2, 1))
    together = mirror.stance_state(states)
    np.testing.assert_array_equal(mirror.stance_state(together), states)
    np.testing.assert_array_equal(together[2, 1], mirror.stance_state(states[2, 1]))
    p = rng.normal(size=(4, 3))
    np.testing.assert_array_equal(mirror.points(mirror.points(p)), p)
    reflected = mirror.joints(kinematics.posture)
    np.testing.assert_allclose(reflected, kinematics.posture, atol=1e-9)


@law
def test_reflecting_the_robot_reflects_its_feet_their_velocities_and_its_hands(kinematics, seed):
    mirror, rng = Mirror(kinematics), np.random.default_rng(seed)
    q, v = random_state(kinematics, rng, planted=False)
    stance = np.array([*rng.normal(size=2), rng.uniform(-3, 3)])
    mirrored = mirror.plant_state(q, v, stance)
    X_WS = planar_pose(stance)
    R_WS = X_WS.rotation().matrix()

    def feet(q, v):
        rates = (kinematics.contact_jacobian(q) @ v).reshape(-1, 3)
        return kinematics.contact_positions(q), rates

    def reflected(p_W):
        return (X_WS @ mirror.points((X_WS.inverse() @ p_W.T).T).T).T

    p_W, rates = feet(q, v)
    expected = np.concatenate([reflected(p_W), mirror.points(rates @ R_WS) @ R_WS.T], axis=1)
    assert same_points(np.concatenate(feet(*mirrored), axis=1), expected)
    frames = kinematics.robot.reaching_frames
    for name in frames:
        hand = kinematics.reaching_position(q, frames[name])
        other = kinematics.reaching_position(mirrored[0], frames[mirror.hand(name)])
        np.testing.assert_allclose(other, reflected(hand), atol=1e-6)


@law
def test_the_state_of_the_mirrored_robot_is_the_mirrored_state_in_the_same_stance(kinematics, seed):
    mirror = Mirror(kinematics)
    for planted in (True, False):
        q, v = random_state(kinematics, np.random.default_rng(seed), planted)
        mirrored = mirror.plant_state(q, v)
        expected = mirror.stance_state(stance_state(kinematics, q, v))
        np.testing.assert_allclose(stance_state(kinematics, *mirrored), expected, atol=1e-6)
        stances = [
            fit_stance(kinematics.contact_positions(p), kinematics.nominal_contacts)
            for p in (q, mirrored[0])
        ]
        np.testing.assert_allclose(stances[0], stances[1], atol=1e-6)


def test_joints_that_are_not_each_others_reflection_are_refused(tmp_path):
    robot = load_robot_file(edited(write_hexapod(tmp_path), mirror={"(.*)_0": r"\1_1"}))
    with pytest.raises(ValueError, match="joint 'swing_0' with 'swing_1', which is not its"):
        Mirror(RobotKinematics(robot))
