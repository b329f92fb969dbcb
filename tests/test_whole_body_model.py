"""The whole-body model: feet by their shape, references over the stance, names that exist."""

import copy

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from drake_safety.control.kinematics import RobotKinematics, planar_pose
from drake_safety.control.whole_body_model import EQUALITY, PointReference, WholeBodyModel
from drake_safety.robots.robot_model import load_robot_file
from legged_robots import ROBOT_NAMES, edited, robot_kinematics, robot_model, write_biped


@pytest.fixture(params=ROBOT_NAMES)
def kinematics(request):
    return robot_kinematics(request.param)


@pytest.mark.parametrize(
    ("points", "num_rows"),
    [
        ([[0, 0, 0]], 3),
        ([[0, 0, 0], [0, 0, 0]], 3),
        ([[0, 0, 0], [0.1, 0, 0]], 5),
        ([[0, 0, 0], [0.1, 0.1, 0], [0.2, 0.2, 0]], 5),
        ([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], 6),
        ([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0.1]], 6),
    ],
)
def test_a_foot_is_held_by_as_many_rows_as_its_points_can_hold(points, num_rows):
    robot = copy.deepcopy(robot_model("biped"))
    robot.feet["left"].contact_points = points
    foot = WholeBodyModel(RobotKinematics(robot)).feet[0]
    assert foot.num_rows == num_rows
    # That many directions of the foot's motion move a point.
    motions = [np.hstack([-skew(np.array(p) - foot.center), np.eye(3)]) for p in points]
    assert np.linalg.matrix_rank(np.vstack(motions), tol=1e-9) == num_rows


def skew(p):
    return np.array([[0, -p[2], p[1]], [p[2], 0, -p[0]], [-p[1], p[0], 0]])


def test_the_reference_holds_the_centre_of_mass_over_the_stance(kinematics):
    model = WholeBodyModel(kinematics)
    q = kinematics.standing_positions()
    reference = model.reference(q)
    centroid = kinematics.contact_positions(q).mean(axis=0)
    com = reference.center_of_mass.position
    np.testing.assert_allclose(com[:2], centroid[:2], atol=1e-12)
    assert com[2] == pytest.approx(kinematics.center_of_mass(q)[2])
    np.testing.assert_array_equal(reference.posture, kinematics.posture)
    assert reference.is_stance.all()
    model.check_reference(reference)


def test_the_reference_goes_where_the_feet_are(kinematics):
    model = WholeBodyModel(kinematics)
    X = planar_pose(np.array([2.0, -1.0, 0.8]))
    q = kinematics.standing_positions()
    X_WB = X @ RigidTransform(q[4:7])
    here, there = model.reference(q), model.reference(kinematics.positions_at(X_WB, q[7:]))
    expected = X @ here.center_of_mass.position
    np.testing.assert_allclose(there.center_of_mass.position, expected, atol=1e-9)
    for before, after in zip(here.orientations, there.orientations, strict=True):
        turned = (X.rotation() @ before).matrix()
        np.testing.assert_allclose(after.matrix(), turned, rtol=0, atol=1e-9)


def test_the_bodies_of_the_reference_are_upright_however_the_robot_leans():
    kinematics = robot_kinematics("biped")
    X_WB = RigidTransform(RollPitchYaw(0.05, -0.04, 0.0), [0.0, 0.0, 0.6])
    q = kinematics.positions_at(X_WB, kinematics.posture)
    (R,) = WholeBodyModel(kinematics).reference(q).orientations
    np.testing.assert_allclose(R.matrix()[:, 2], [0.0, 0.0, 1.0], atol=1e-12)


def test_the_hand_of_the_reference_is_where_the_hand_is():
    kinematics = robot_kinematics("biped")
    q = kinematics.standing_positions()
    hand = WholeBodyModel(kinematics, "head").reference(q).reaching.position
    np.testing.assert_allclose(hand, q[4:7] + [0.0, 0.0, 0.25], atol=1e-12)


def test_base_and_unactuated_joints_are_the_equalities_of_the_equations_of_motion(tmp_path):
    path = edited(write_biped(tmp_path), effort_limits={"left_.*": 80.0, "right_(hip|knee).*": 7.0})
    kinematics = RobotKinematics(load_robot_file(path))
    stance = WholeBodyModel(kinematics).stance(np.ones(2, bool))
    n_v = kinematics.num_velocities
    passive = [name.startswith("right_ankle") for name in kinematics.joint_names]
    is_equality = stance.sense == EQUALITY
    np.testing.assert_array_equal(is_equality[:n_v], [True] * 6 + passive)
    np.testing.assert_array_equal(stance.lower[:n_v][is_equality[:n_v]], 0.0)
    right_hip = 6 + kinematics.joint_names.index("right_hip_x")
    assert (stance.lower[right_hip], stance.upper[right_hip]) == (-7.0, 7.0)


def test_an_unknown_hand_is_answered_with_the_hands_there_are():
    with pytest.raises(ValueError, match=r"robot 'biped' has no reaching frame 'tail'.*'head'"):
        WholeBodyModel(robot_kinematics("biped"), "tail")
    with pytest.raises(ValueError, match=r"the model has no hand, expected one of \[.head.\]"):
        WholeBodyModel(robot_kinematics("biped")).reaching_position(np.zeros(19))


POINTS = "points must be three finite numbers each"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"posture": np.zeros(3)}, "must have posture for .*left_knee.*got 3 entries"),
        ({"is_stance": np.ones(4)}, r"must have is_stance for \['left', 'right'\]; got 4 entries"),
        ({"orientations": []}, r"must have orientations for \['pelvis'\]; got 0 entries"),
        ({"reaching": None}, "must have reaching for the hand; got none"),
        ({"posture": np.full(12, np.nan)}, "posture must be finite"),
        ({"center_of_mass": PointReference(position=np.array([0.0, np.inf, 0.0]))}, POINTS),
        ({"reaching": PointReference(position=np.zeros(3), rate=np.zeros(2))}, POINTS),
    ],
)
def test_a_reference_that_does_not_fit_the_robot_is_refused(change, message):
    kinematics = robot_kinematics("biped")
    model = WholeBodyModel(kinematics, "head")
    reference = model.reference(kinematics.standing_positions())
    for name, value in change.items():
        setattr(reference, name, value)
    with pytest.raises(ValueError, match=f"robot 'biped': the whole-body reference.*{message}"):
        model.check_reference(reference)


def test_rest_is_what_a_point_does_that_is_given_no_rate():
    point = PointReference(position=np.ones(3))
    np.testing.assert_array_equal([point.rate, point.acceleration], np.zeros((2, 3)))
    with pytest.raises(ValueError, match="read-only"):
        point.rate[0] = 1.0  # Every point at rest shares it.
