import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from drake_safety.systems.inverse_kinematics_controller import InverseKinematicsController
from legged_robots import base_over, robot_kinematics, standing_feet
from system_doubles import Bench

PERIOD_S = 0.01
STIFFNESS = 250.0


class Commanded(Bench):
    """A controller alone, of a robot that stands at a stance pose."""

    def __init__(self, name, stiffness=STIFFNESS, desired=None, stance_pose=(0.0, 0.0, 0.0)):
        self.kinematics = k = robot_kinematics(name)
        gains = np.full(k.num_joints, stiffness)
        super().__init__(InverseKinematicsController(k, gains, period_s=PERIOD_S))
        R_WB = RotationMatrix.MakeZRotation(stance_pose[2])
        q = k.positions_at(RigidTransform(R_WB, base_over(k, stance_pose)), k.posture)
        self.fix(plant_state=np.append(q, np.zeros(k.num_velocities)))
        self.fix(desired_output=base_over(k) if desired is None else desired)

    def command(self):
        """The commanded joint positions and rates."""
        return np.split(self.get("desired_joint_state"), 2)


def test_the_command_of_standing_is_the_posture_and_the_static_offset():
    bench = Commanded("biped")
    kinematics = bench.kinematics
    bench.simulator.AdvanceTo(0.1)
    position, rate = bench.command()
    q = kinematics.positions_at(RigidTransform(base_over(kinematics)), kinematics.posture)
    torque = kinematics.gravity_torques(q, np.ones(kinematics.num_contacts, bool))
    np.testing.assert_allclose(position, kinematics.posture + torque / STIFFNESS, atol=1e-6)
    np.testing.assert_allclose(rate, np.zeros(kinematics.num_joints), atol=1e-9)


@pytest.mark.parametrize("name", ["laikago", "hexapod"])
def test_the_set_point_carries_the_base_over_the_feet_wherever_they_stand(name):
    kinematics, stance_pose = robot_kinematics(name), (3.0, -2.0, 2.5)
    shift = (0.01, -0.01, -0.02)
    desired = base_over(kinematics, stance_pose, shift)
    # So stiff that there is no offset.
    bench = Commanded(name, stiffness=1e9, desired=desired, stance_pose=stance_pose)
    feet = standing_feet(kinematics, stance_pose)
    bench.simulator.Initialize()
    # The feet of the first state are kept.
    standing = kinematics.standing_positions()
    bench.fix(plant_state=np.append(standing, np.zeros(kinematics.num_velocities)))
    bench.simulator.Initialize()
    position, _ = bench.command()
    X_WB = RigidTransform(RotationMatrix.MakeZRotation(stance_pose[2]), desired)
    reached = kinematics.contact_positions(kinematics.positions_at(X_WB, position))
    np.testing.assert_allclose(reached, feet, atol=1.1e-4)


@pytest.mark.parametrize(("lift_m", "yaw"), [(0.04, 0.0), (0.03, 0.0), (0.0, 0.1)])
def test_given_or_connected_feet_override_those_seen_and_a_yaw_that_of_the_feet(lift_m, yaw):
    bench = Commanded("laikago", stiffness=1e9)
    kinematics = bench.kinematics
    feet = standing_feet(kinematics) + np.array([0.0, 0.0, lift_m])
    if lift_m == 0.03:
        bench.system.set_foot_positions(bench.context, feet)
    elif lift_m:
        bench.fix(desired_foot_positions=feet)
    else:
        bench.fix(desired_yaw=yaw)
    bench.simulator.Initialize()
    X_WB = RigidTransform(RotationMatrix.MakeZRotation(yaw), base_over(kinematics))
    q = kinematics.positions_at(X_WB, bench.command()[0])
    np.testing.assert_allclose(kinematics.contact_positions(q), feet, atol=1.1e-4)


def test_the_commanded_rate_is_the_set_points_change_over_a_period():
    bench = Commanded("laikago", stiffness=1e9)
    bench.simulator.Initialize()
    before, _ = bench.command()
    bench.fix(desired_output=base_over(bench.kinematics, shift=(0.0, 0.0, -0.002)))
    bench.simulator.AdvanceTo(0.001)
    after, rate = bench.command()
    np.testing.assert_allclose(rate, (after - before) / PERIOD_S, atol=1e-4)
    assert np.abs(rate).max() > 0.1


@pytest.mark.parametrize("height", [-0.3, 0.5])
def test_commands_stay_within_the_joints_limits(height):
    kinematics, name = robot_kinematics("laikago"), "laikago"
    desired = base_over(kinematics, shift=(0.3, 0.3, height))
    bench = Commanded(name, stiffness=20.0, desired=desired)
    bench.simulator.AdvanceTo(0.05)
    position, rate = bench.command()
    lowest, highest = kinematics.position_limits.T
    assert np.all((position >= lowest) & (position <= highest))
    assert np.all(np.abs(rate) <= kinematics.velocity_limits)
