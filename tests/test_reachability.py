import numpy as np
import pytest

from drake_safety.control.kinematics import NUM_BASE_POSITIONS, RobotKinematics
from drake_safety.control.mirror import Mirror
from drake_safety.models import load_robot
from studies.reachability import Reachability


@pytest.fixture(scope="module")
def robot():
    return load_robot("atlas")


@pytest.fixture(scope="module")
def kinematics(robot):
    return RobotKinematics(robot)


@pytest.fixture(scope="module")
def reachability(robot):
    return {hand: Reachability(robot, hand) for hand in robot.reaching_frames}


def test_what_forward_kinematics_gets_to_inverse_kinematics_gets_to(
    robot, kinematics, reachability
):
    rng = np.random.default_rng(0)
    chain = [kinematics.joint_names.index(name) for name in reachability["left"].joint_names]
    low, high = kinematics.position_limits[chain].T
    points = []
    for _ in range(20):
        q = kinematics.standing_positions()
        q[NUM_BASE_POSITIONS + np.array(chain)] = rng.uniform(low, high)
        points.append(kinematics.reaching_position(q, robot.reaching_frame("left")))
    # A local search may fail at a rare point; that few is what the comparison can bear.
    assert reachability["left"].is_reachable(np.array(points)).mean() >= 0.9


def test_the_joints_between_base_and_hand_move_and_no_other(robot, kinematics, reachability):
    legs = {name for foot in robot.feet.values() for name in foot.joints}
    for hand, frame in robot.reaching_frames.items():
        names = set(reachability[hand].joint_names)
        assert set(frame.joints) < names and not names & legs
        point = kinematics.reaching_position(kinematics.standing_positions(), frame)
        assert reachability[hand].miss(point) < 1e-4
    left, right = (set(reachability[hand].joint_names) for hand in ("left", "right"))
    assert left & right == left - set(robot.reaching_frame("left").joints)


def test_a_point_that_is_too_far_is_missed_by_as_much_more_as_it_is_further(reachability):
    near, far = (reachability["left"].miss(np.array([x, 0.3, 1.2])) for x in (3.0, 4.0))
    assert near > 1.0
    assert far - near == pytest.approx(1.0, abs=0.05)


def test_the_other_hand_reaches_the_mirror_image(kinematics, reachability):
    rng = np.random.default_rng(1)
    points = rng.uniform([0.45, -0.3, 0.5], [1.0, 1.3, 1.6], (12, 3))
    images = Mirror(kinematics).points(points)
    left, right = reachability["left"], reachability["right"]
    forward = [left.miss(point) for point in points]
    np.testing.assert_allclose(forward, [right.miss(point) for point in images], atol=5e-3)
    # An answer does not depend on what was asked before.
    assert [left.miss(point) for point in points[:3][::-1]] == forward[:3][::-1]
    np.testing.assert_array_equal(left.is_reachable(points), right.is_reachable(images))


def test_a_free_base_reaches_further_and_the_feet_stay_where_they_are(robot, kinematics):
    fixed, free = (Reachability(robot, "left", is_base_free=is_free) for is_free in (False, True))
    standing = kinematics.standing_positions()
    hand = kinematics.reaching_position(standing, robot.reaching_frame("left"))
    assert free.miss(hand) < 1e-3
    ahead = np.array([1.4, 0.3, 0.9])
    assert free.miss(ahead) < fixed.miss(ahead) - 0.05
    assert free.miss(np.array([4.0, 0.3, 1.2])) > 1.0
    assert set(fixed.joint_names) < set(free.joint_names)
    free.miss(ahead)
    feet = kinematics.contact_positions(standing)
    found = kinematics.contact_positions(free._plant.GetPositions(free._context))
    np.testing.assert_allclose(found, feet, atol=3e-3)
