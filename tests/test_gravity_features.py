import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from drake_safety.control.mirror import Mirror
from drake_safety.control.observation import gravity_in_foot_plane
from drake_safety.control.safe_sets import BalanceLimits, BalanceSafeSet
from drake_safety.systems.assessor_inputs import AssessorInputs
from legged_robots import robot_kinematics
from system_doubles import Bench

DOWN = np.array([0.0, 0.0, -9.81])


def downhill(slope, direction):
    """Gravity on ground that falls in a direction."""
    along = math.sin(slope) * np.array([math.cos(direction), math.sin(direction)])
    return 9.81 * np.append(along, -math.cos(slope))


@pytest.mark.parametrize("name", ["laikago", "hexapod"])
def test_a_slope_is_its_sine_downhill_in_the_stance_frame_wherever_the_robot_stands(name):
    kinematics = robot_kinematics(name)
    level = gravity_in_foot_plane(kinematics, kinematics.standing_positions(), DOWN)
    np.testing.assert_allclose(level, 0.0, atol=1e-9)
    for yaw, direction in ((0.0, 0.4), (2.5, -1.0)):
        X_WB = RigidTransform(
            RotationMatrix.MakeZRotation(yaw), [3.0, -2.0, kinematics.standing_height]
        )
        q = kinematics.positions_at(X_WB, kinematics.posture)
        seen = gravity_in_foot_plane(kinematics, q, downhill(0.2, direction))
        expected = math.sin(0.2) * np.array([math.cos(direction - yaw), math.sin(direction - yaw)])
        np.testing.assert_allclose(seen, expected, atol=1e-9)


def test_the_mirrored_robot_sees_the_mirrored_slope():
    kinematics = robot_kinematics("atlas")
    seen = []
    for mirror in (None, Mirror(kinematics)):
        safe_set = BalanceSafeSet(kinematics, BalanceLimits())
        gravity = downhill(0.1, 0.7)
        system = AssessorInputs(kinematics, safe_set, gravity=gravity, mirror=mirror)
        q, v = kinematics.standing_positions(), np.zeros(kinematics.num_velocities)
        bench = Bench(system, plant_state=np.append(q, v), desired_outlook=np.zeros(15))
        seen.append(bench.get("features")[-2:])
    assert system.feature_names[-2:] == ["gravity_x", "gravity_y"]
    np.testing.assert_allclose(seen[0], 0.1 * np.array([math.cos(0.7), math.sin(0.7)]), atol=1e-3)
    np.testing.assert_allclose(seen[1], seen[0] * (1.0, -1.0))
