"""CrouchController: set points that approach a posture, near the measured joints."""

from types import SimpleNamespace

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_safety.systems.crouch_controller import CrouchController

POSTURE = np.array([1.0, -0.5])
KINEMATICS = SimpleNamespace(num_positions=9, num_velocities=8)


def set_points(joints):
    system = CrouchController(KINEMATICS, POSTURE, step_rad=0.3, period_s=0.02)
    simulator = Simulator(system)
    state = np.concatenate([[1.0], np.zeros(6), joints, np.zeros(8)])
    system.GetInputPort("plant_state").FixValue(simulator.get_mutable_context(), state)
    simulator.AdvanceTo(0.01)
    return system.GetOutputPort("desired_joint_state").Eval(simulator.get_context())


def test_a_set_point_is_at_most_a_step_from_the_joint():
    np.testing.assert_allclose(set_points([0.0, -0.4]), [0.3, -0.5, 0.0, 0.0])


def test_joints_that_are_not_finite_keep_the_last_set_point():
    np.testing.assert_allclose(set_points([np.nan, 0.0]), [*POSTURE, 0.0, 0.0])


def test_the_output_is_a_state_without_feedthrough():
    system = CrouchController(KINEMATICS, POSTURE, step_rad=0.3, period_s=0.02)
    assert not system.HasAnyDirectFeedthrough()
