"""The whole-body model: rows of a foot, the reference of standing, and what is refused."""

import copy

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from drake_safety.control.kinematics import RobotKinematics, planar_pose
from drake_safety.control.whole_body_model import PointReference, WholeBodyModel
from legged_robots import robot_kinematics, robot_model


@pytest.mark.parametrize(
    ("points", "num_rows"),
    [
        ([[0, 0, 0], [0, 0, 0]], 3),
        ([[0, 0, 0], [0.1, 0.1, 0], [0.2, 0.2, 0]], 5),
        ([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0.1]], 6),
    ],
)
def test_a_foot_is_held_by_as_many_rows_as_its_points_can_hold(points, num_rows):
    robot = copy.deepcopy(robot_model("biped"))
    robot.feet["left"].contact_points = points
    foot = WholeBodyModel(RobotKinematics(robot), "head").feet[0]
    assert foot.num_rows == num_rows
    # That many directions of the foot's motion move a point.
    arms = np.array(points) - foot.center
    motions = [np.hstack([np.cross(np.eye(3), arm), np.eye(3)]) for arm in arms]
    assert np.linalg.matrix_rank(np.vstack(motions), tol=1e-9) == num_rows


def test_the_reference_holds_the_centre_of_mass_over_the_stance_and_goes_with_the_feet():
    kinematics = robot_kinematics("biped")
    model = WholeBodyModel(kinematics, "head")
    q = kinematics.standing_positions()
    here = model.reference(q)
    centroid = kinematics.contact_positions(q).mean(axis=0)
    expected = [*centroid[:2], kinematics.center_of_mass(q)[2]]
    np.testing.assert_allclose(here.center_of_mass.position, expected, atol=1e-12)
    np.testing.assert_array_equal(here.posture, kinematics.posture)
    model.check_reference(here)
    X = planar_pose(np.array([2.0, -1.0, 0.8]))
    there = model.reference(kinematics.positions_at(X @ RigidTransform(q[4:7]), q[7:]))
    np.testing.assert_allclose(there.center_of_mass.position, X @ expected, atol=1e-9)
    for before, after in zip(here.orientations, there.orientations, strict=True):
        turned = (X.rotation() @ before).matrix()
        np.testing.assert_allclose(after.matrix(), turned, rtol=0, atol=1e-9)


def test_bodies_of_the_reference_are_upright_though_the_robot_leans_and_the_hand_stays():
    kinematics = robot_kinematics("biped")
    X_WB = RigidTransform(RollPitchYaw(0.05, -0.04, 0.0), [0.0, 0.0, 0.6])
    q = kinematics.positions_at(X_WB, kinematics.posture)
    reference = WholeBodyModel(kinematics, "head").reference(q)
    (R,) = reference.orientations
    np.testing.assert_allclose(R.matrix()[:, 2], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(reference.reaching.position, X_WB @ [0.0, 0.0, 0.25], atol=1e-12)
    with pytest.raises(ValueError, match=r"robot 'biped' has no reaching frame 'tail'.*'head'"):
        WholeBodyModel(kinematics, "tail")


@pytest.mark.parametrize(
    "change",
    [
        {"posture": np.zeros(3)},
        {"reaching": PointReference(position=np.zeros(3), rate=np.zeros(2))},
        {"posture": np.full(12, np.nan)},
    ],
)
def test_a_reference_that_does_not_fit_the_robot_is_refused(change):
    kinematics = robot_kinematics("biped")
    model = WholeBodyModel(kinematics, "head")
    reference = model.reference(kinematics.standing_positions())
    for name, value in change.items():
        setattr(reference, name, value)
    with pytest.raises(ValueError, match="robot 'biped': the whole-body reference needs finite"):
        model.check_reference(reference)
