"""Inverse kinematics puts feet where they are wanted, for legs of any shape."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from drake_safety.control.inverse_kinematics import solve_inverse_kinematics
from legged_robots import base_over, robot_kinematics, standing_feet


@pytest.mark.parametrize("name", ["laikago", "biped"])
@pytest.mark.parametrize("seed", range(3))
def test_the_feet_are_where_they_were_asked_for_and_the_answer_is_a_fixed_point(name, seed):
    kinematics = robot_kinematics(name)
    rng = np.random.default_rng(seed)
    R_WB = RollPitchYaw(rng.uniform(-0.08, 0.08, 3))
    X_WB = RigidTransform(R_WB, base_over(kinematics, shift=rng.uniform(-0.02, 0.02, 3)))
    if name == "biped":  # A stretched knee would be the only other way.
        X_WB.set_translation(X_WB.translation() - [0.0, 0.0, 0.02])
    p_WC = standing_feet(kinematics)
    joints = solve_inverse_kinematics(kinematics, X_WB, p_WC, kinematics.posture)
    reached = kinematics.contact_positions(kinematics.positions_at(X_WB, joints))
    np.testing.assert_allclose(reached, p_WC, atol=1e-4)
    np.testing.assert_array_equal(solve_inverse_kinematics(kinematics, X_WB, p_WC, joints), joints)


@pytest.mark.parametrize("height", [-0.5, 2.0])
def test_joints_stay_within_their_limits_when_the_goal_is_out_of_reach(height):
    kinematics = robot_kinematics("biped")
    X_WB = RigidTransform(base_over(kinematics, shift=(0.0, 0.0, height)))
    p_WC = standing_feet(kinematics)
    joints = solve_inverse_kinematics(kinematics, X_WB, p_WC, kinematics.posture)
    lowest, highest = kinematics.position_limits.T
    assert np.all((joints >= lowest) & (joints <= highest))
