"""Inverse kinematics puts feet where they are wanted, for legs of any shape."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from drake_safety.control.inverse_kinematics import solve_inverse_kinematics
from legged_robots import robot_kinematics

NAMES = ["laikago", "biped"]


def standing_contacts(kinematics):
    return np.column_stack([kinematics.nominal_contacts, kinematics.foot_radii])


def base_pose(kinematics, rotation=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0)):
    p = np.append(kinematics.nominal_base_offset, kinematics.standing_height)
    return RigidTransform(RollPitchYaw(rotation), p + shift)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", range(3))
def test_the_feet_are_where_they_were_asked_for_and_the_answer_is_a_fixed_point(name, seed):
    kinematics = robot_kinematics(name)
    rng = np.random.default_rng(seed)
    X_WB = base_pose(kinematics, rng.uniform(-0.08, 0.08, 3), rng.uniform(-0.02, 0.02, 3))
    if name == "biped":  # A stretched knee would be the only other way.
        X_WB.set_translation(X_WB.translation() - [0.0, 0.0, 0.02])
    p_WC = standing_contacts(kinematics)
    joints = solve_inverse_kinematics(kinematics, X_WB, p_WC, kinematics.posture)
    reached = kinematics.contact_positions(kinematics.positions_at(X_WB, joints))
    np.testing.assert_allclose(reached, p_WC, atol=1e-4)
    np.testing.assert_array_equal(solve_inverse_kinematics(kinematics, X_WB, p_WC, joints), joints)


def test_from_the_last_ticks_answer_one_step_suffices():
    kinematics = robot_kinematics("laikago")
    p_WC = standing_contacts(kinematics)
    X_WB = base_pose(kinematics, shift=(0.003, -0.003, 0.003))  # 0.3 m/s for 10 ms.
    joints = solve_inverse_kinematics(kinematics, X_WB, p_WC, kinematics.posture, max_iterations=1)
    reached = kinematics.contact_positions(kinematics.positions_at(X_WB, joints))
    np.testing.assert_allclose(reached, p_WC, atol=2e-4)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("height", [-0.5, 2.0])
def test_joints_stay_within_their_limits_when_the_target_is_out_of_reach(name, height):
    kinematics = robot_kinematics(name)
    X_WB = base_pose(kinematics, shift=(0.0, 0.0, height))
    p_WC = standing_contacts(kinematics)
    joints = solve_inverse_kinematics(kinematics, X_WB, p_WC, kinematics.posture)
    lowest, highest = kinematics.position_limits.T
    assert np.all((joints >= lowest) & (joints <= highest))


def test_a_target_out_of_reach_ends_stretched_towards_it():
    kinematics = robot_kinematics("laikago")
    X_WB = base_pose(kinematics, shift=(0.0, 0.0, 0.3))
    p_WC = standing_contacts(kinematics)
    joints = solve_inverse_kinematics(
        kinematics, X_WB, p_WC, kinematics.posture, max_iterations=200
    )
    error = kinematics.contact_positions(kinematics.positions_at(X_WB, joints)) - p_WC
    before = kinematics.contact_positions(kinematics.positions_at(X_WB, kinematics.posture)) - p_WC
    assert np.linalg.norm(error, axis=1).max() < np.linalg.norm(before, axis=1).min()
    calves = [i for i, name in enumerate(kinematics.joint_names) if "calf" in name]
    assert np.allclose(joints[calves], kinematics.position_limits[calves, 1], atol=1e-6)


def test_a_guess_outside_the_limits_is_brought_inside_and_left_as_it_was():
    kinematics = robot_kinematics("hexapod")
    guess = kinematics.posture + 10.0
    kept = guess.copy()
    joints = solve_inverse_kinematics(
        kinematics, base_pose(kinematics), standing_contacts(kinematics), guess, max_iterations=0
    )
    assert np.all(joints <= kinematics.position_limits[:, 1])
    np.testing.assert_array_equal(guess, kept)
