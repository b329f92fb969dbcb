"""ReachingSafeSet: margins are zero at their limits, features have their names' meaning."""

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.linalg import null_space

from drake_safety.control.inverse_kinematics import solve_inverse_kinematics
from drake_safety.control.kinematics import fit_stance, planar_pose
from drake_safety.control.mirror import Mirror
from drake_safety.control.whole_body_model import PointReference, WholeBodyModel
from drake_safety.control.whole_body_qp import task_errors
from drake_safety.diagrams.reaching.kinematic_preview import KinematicPreview
from drake_safety.diagrams.reaching.safe_set import ReachingLimits, ReachingSafeSet
from drake_safety.plants.obstacles import Clearance, Obstacle
from legged_robots import robot_kinematics, robot_model

SHELF_MODEL = "package://drake_safety_models/scenes/bookshelf.urdf"
SHELF = Obstacle(model=SHELF_MODEL, position=[0.9, 0.0, 0.0])
RANGE_M = 0.1


def safe_set(name="porter", hand="left", obstacles=(), is_mirrored=False, **limits):
    clearance = Clearance(robot_model(name), list(obstacles), range_m=RANGE_M)
    model = WholeBodyModel(robot_kinematics(name), hand)
    return ReachingSafeSet(model, clearance, ReachingLimits(**limits), is_mirrored=is_mirrored)


def margins(of, q):
    values = of.margins(q, np.zeros(of.kinematics.num_velocities))
    return dict(zip(of.names, values, strict=True))


def features(of, q, preview, v=None):
    v = np.zeros(of.kinematics.num_velocities) if v is None else v
    values = of.features(q, v, preview)
    return dict(zip(of.feature_names, values, strict=True))


def leaning(kinematics, offset, rpy=(0.0, 0.0, 0.0)):
    """A posture with the feet where they stand and the base moved over them."""
    standing = kinematics.standing_positions()
    X_WB = RigidTransform(RollPitchYaw(rpy), standing[4:7] + offset)
    p_WC = kinematics.contact_positions(standing)
    joints = solve_inverse_kinematics(kinematics, X_WB, p_WC, kinematics.posture)
    q = kinematics.positions_at(X_WB, joints)
    np.testing.assert_allclose(kinematics.contact_positions(q), p_WC, atol=2e-4)
    return q


def in_stance(kinematics, q, p_WP):
    """Points of the world as seen from the stance."""
    X_WS = planar_pose(fit_stance(kinematics.contact_positions(q), kinematics.nominal_contacts))
    return np.asarray(X_WS.inverse() @ np.atleast_2d(p_WP).T).T


def straight(start, goal, num=31):
    return start + np.linspace(0.0, 1.0, num)[:, np.newaxis] * (np.asarray(goal) - start)


def held_still(of, q):
    hand = of.model.reaching_position(q)
    return in_stance(of.kinematics, q, straight(hand, hand))


def test_the_joint_margin_is_zero_at_its_distance_before_any_stop():
    of = safe_set(joint_margin_rad=0.05)
    limits = of.kinematics.position_limits
    for i, (lowest, highest) in enumerate(limits):
        for stop, inwards in ((lowest, 1), (highest, -1)) if math.isfinite(lowest) else ():
            for distance in (0.06, 0.02, -0.01):
                q = of.kinematics.standing_positions()
                q[7 + i] = stop + inwards * distance
                assert margins(of, q)["joint_limits"] == pytest.approx(distance - 0.05, abs=1e-12)
    # A joint without stops never limits.
    (wrist, *_) = np.flatnonzero(np.isinf(limits[:, 0]))
    q = of.kinematics.standing_positions()
    before = margins(of, q)["joint_limits"]
    q[7 + wrist] = 50.0
    assert margins(of, q)["joint_limits"] == before
    assert np.isfinite([*features(of, q, held_still(of, q)).values()]).all()


def test_the_support_margin_is_the_distance_to_the_edge_of_the_feet_on_the_ground():
    of = safe_set(support_clearance_m=0.03)
    kinematics = of.kinematics
    standing = kinematics.standing_positions()
    base, contacts = standing[4:7], kinematics.contact_positions(standing)[:, :2]
    lowest, highest = contacts.min(axis=0), contacts.max(axis=0)  # The feet stand in a rectangle.
    for target in base[:2] + np.linspace(0.0, 1.2, 4)[:, np.newaxis] * (highest - base[:2]):
        q = leaning(kinematics, np.append(target - base[:2], -0.05))
        expected = min((target - lowest).min(), (highest - target).min())
        if (target > highest).any():
            expected = -np.linalg.norm(np.maximum(target - highest, 0.0))
        assert margins(of, q)["support_polygon"] == pytest.approx(expected, abs=5e-4)
    q = standing.copy()
    q[7 + kinematics.joint_names.index("left_knee")] += 0.5
    edge = kinematics.contact_positions(q)[4:, 1].max()  # Of the right foot's contact points.
    assert margins(of, q)["support_polygon"] == pytest.approx(edge, abs=1e-9) and edge < 0
    standing[6] += 0.5
    assert -np.inf < margins(of, standing)["support_polygon"] < 0


def test_a_robot_has_fallen_below_its_height_and_beyond_its_tilt():
    of = safe_set(fall_height_share=0.6, fall_tilt_rad=0.5)
    kinematics, height = of.kinematics, of.kinematics.standing_height
    q = kinematics.standing_positions()
    for share in (0.59, 0.61):
        q[6] = share * height
        assert margins(of, q)["fall"] == pytest.approx((share - 0.6) * height, abs=1e-12)
    for roll, pitch, yaw in ((0.5, 0.0, 0.0), (0.0, -0.5, 2.0)):
        for share, sign in ((0.98, 1), (1.0, 0), (1.02, -1)):
            rotation = RotationMatrix(RollPitchYaw(share * roll, share * pitch, yaw))
            q = kinematics.positions_at(RigidTransform(rotation, [0, 0, height]), q[7:])
            q[:4] *= -1.5  # The same orientation.
            fall = margins(of, q)["fall"]
            assert abs(fall) < 1e-12 if sign == 0 else np.sign(fall) == sign


def test_features_of_state_and_plan_have_the_meaning_of_their_names():
    of = safe_set(obstacles=[SHELF])
    kinematics = of.kinematics
    q = leaning(kinematics, [0.01, -0.02, -0.05], [0.02, 0.01, -0.03])
    hand, center_of_mass = of.model.reaching_position(q), kinematics.center_of_mass(q)
    path = straight(hand + [0.01, 0.02, -0.01], hand + [0.1, 0.05, 0.1])
    preview = in_stance(kinematics, q, path)
    values, now = features(of, q, preview), margins(of, q)
    for constraint in of.names[:3]:
        assert values[f"now_{constraint}"] == now[constraint]
    np.testing.assert_array_equal([values[f"goal_{axis}"] for axis in "xyz"], preview[-1])
    error = in_stance(kinematics, q, path[0]) - in_stance(kinematics, q, hand)
    tracking_error = [values[f"tracking_error_{axis}"] for axis in "xyz"]
    np.testing.assert_allclose(tracking_error, error[0], atol=1e-12)
    assert values["center_of_mass_height"] == center_of_mass[2] and values["base_height"] == q[6]
    on_path = of.clearance.of_points(path, kinematics.robot.reaching_frame("left").radius_m)
    assert values["plan_clearance"] == pytest.approx(on_path.min(), abs=1e-12)
    assert values["goal_clearance"] == pytest.approx(on_path[-1], abs=1e-12)
    contacts = kinematics.contact_positions(q)
    edges = (
        in_stance(kinematics, q, contacts)[:, :2] - in_stance(kinematics, q, center_of_mass)[0, :2]
    )
    extents = [edges.max(axis=0)[0], edges.max(axis=0)[1], -edges.min(axis=0)[0]]
    for angle, expected in zip((0, 90, 180), extents, strict=True):
        assert values[f"center_of_mass_margin_{angle}deg"] == pytest.approx(expected, abs=1e-9)
    shoulder = kinematics.plant.GetJointByName(kinematics.robot.reaching_frame("left").joints[0])
    kinematics.set_positions(q)
    p_WS = shoulder.frame_on_parent().CalcPoseInWorld(kinematics.context).translation()
    at_shoulder = features(of, q, in_stance(kinematics, q, straight(hand, p_WS)))
    assert at_shoulder["goal_distance"] == pytest.approx(0.0, abs=1e-9)


def test_features_of_motion_are_velocities_and_the_margins_that_they_lead_to():
    of = safe_set()
    kinematics = of.kinematics
    q = leaning(kinematics, [0.01, -0.02, -0.05])
    preview = held_still(of, q)
    v = 0.2 * np.random.default_rng(1).normal(size=kinematics.num_velocities)
    values, at_rest = features(of, q, preview, v), features(of, q, preview)
    kinematics.set_positions(q)
    rate = 1e-6 * kinematics.plant.MapVelocityToQDot(kinematics.context, v)
    R_SW = in_stance(kinematics, q, np.eye(3)) - in_stance(kinematics, q, np.zeros(3))
    bodies = {"center_of_mass": kinematics.center_of_mass, "hand": of.model.reaching_position}
    for point, of_body in bodies.items():
        expected = (of_body(q + rate) - of_body(q - rate)) / 2e-6 @ R_SW
        velocity = [values[f"{point}_velocity_{axis}"] for axis in "xyz"]
        np.testing.assert_allclose(velocity, expected, atol=1e-6)
    pendulum_s = np.sqrt(values["center_of_mass_height"] / 9.81)
    for angle, axis, sign in ((0, "x", 1), (90, "y", 1), (180, "x", -1)):
        here, there = (
            values[f"{point}_margin_{angle}deg"] for point in ("center_of_mass", "capture_point")
        )
        speed = sign * values[f"center_of_mass_velocity_{axis}"]
        assert here - there == pytest.approx(pendulum_s * speed, abs=1e-9)
    soon = q.copy()
    soon[7:] += 0.1 * v[6:]
    assert values["soon_joint_limits"] == pytest.approx(margins(of, soon)["joint_limits"])
    assert at_rest["soon_joint_limits"] == at_rest["now_joint_limits"]
    assert values["capture_point_support"] != at_rest["capture_point_support"]


def test_features_do_not_depend_on_where_in_the_world_the_robot_stands():
    of = safe_set()
    q = leaning(of.kinematics, [0.01, 0.02, -0.05], [0.02, 0.0, 0.03])
    preview, v = held_still(of, q), np.zeros(of.kinematics.num_velocities)
    X_WM = RigidTransform(RotationMatrix.MakeZRotation(1.2), [3.0, -2.0, 0.0])
    X_WB = RigidTransform(RotationMatrix(RollPitchYaw(0.02, 0.0, 0.03)), q[4:7])
    moved = of.kinematics.positions_at(X_WM @ X_WB, q[7:])
    here, there = of.features(q, v, preview), of.features(moved, v, preview)
    np.testing.assert_allclose(there, here, atol=1e-7)


# The torso that Atlas was published with is not quite symmetric.
@pytest.mark.parametrize(("name", "atol"), [("porter", 1e-6), ("atlas", 5e-3)])
def test_mirrored_features_of_the_mirrored_robot_are_those_of_the_other_hand(name, atol):
    left = safe_set(name, "left", [SHELF])
    right = safe_set(name, "right", [SHELF], is_mirrored=True)
    assert left.feature_names == right.feature_names
    mirror, kinematics = Mirror(left.kinematics), left.kinematics
    rng = np.random.default_rng(0)
    for _ in range(2):
        q = leaning(kinematics, rng.uniform(-0.03, 0.0, 3), rng.uniform(-0.05, 0.05, 3))
        q[7:] += rng.uniform(-0.05, 0.05, kinematics.num_joints)
        v = 0.3 * rng.normal(size=kinematics.num_velocities)
        hand = left.model.reaching_position(q)
        preview = in_stance(kinematics, q, straight(hand, hand + rng.uniform(0.0, 0.3, 3)))
        mirrored = right.features(*mirror.plant_state(q, v, np.zeros(3)), mirror.points(preview))
        np.testing.assert_allclose(mirrored, left.features(q, v, preview), rtol=0.0, atol=atol)


def easy_paths(preview, num=5, seed=0):
    """Straight paths of six samples to goals in front of the robot, on its hand's side."""
    model, rng = preview.model, np.random.default_rng(seed)
    start = model.reaching_position(model.kinematics.standing_positions())
    outwards = np.sign(start[1])
    for _ in range(num):
        step = rng.uniform([-0.05, -0.1, -0.05], [0.1, 0.05, 0.1]) * [1.0, outwards, 1.0]
        yield start + np.linspace(1 / 6, 1.0, 6)[:, np.newaxis] * step


def gradient(preview, reference, q):
    """Of half the cost in the motions that leave the feet still, and the hand's share of it."""
    model, kinematics = preview.model, preview.model.kinematics
    J_feet = kinematics.contact_jacobian(q)
    J, error = task_errors(model, reference)
    slope = (model.task_weights * J).T @ error
    slope[6:] += model.parameters.posture.weight * (reference.posture - q[7:])
    still = null_space(J_feet, rcond=1e-9)
    hand = (model.task_weights * J)[-3:].T @ np.full(3, 0.01)  # As a centimetre amiss would pull.
    return np.linalg.norm(still.T @ slope), np.linalg.norm(still.T @ hand)


@pytest.mark.parametrize(("name", "hand"), [("porter", "right"), ("atlas", "left")])
def test_the_hand_arrives_with_fixed_feet_where_the_cost_is_minimal(name, hand):
    preview = KinematicPreview(WholeBodyModel(robot_kinematics(name), hand))
    kinematics = preview.model.kinematics
    q = kinematics.standing_positions()
    before, feet = q.copy(), kinematics.contact_positions(q)
    reference = preview.model.reference(q)
    for path in easy_paths(preview, num=3):
        positions = preview.follow(q, path)
        for ahead in positions:
            np.testing.assert_allclose(kinematics.contact_positions(ahead), feet, atol=1e-4)
        np.testing.assert_allclose(np.linalg.norm(positions[:, :4], axis=1), 1.0, atol=1e-12)
        reached = preview.model.reaching_position(positions[-1])
        assert np.linalg.norm(reached - path[-1]) < 5e-3
        # No motion that leaves the feet still lowers the cost, to first order.
        reference.reaching = PointReference(position=path[-1])
        slope, one_centimetre = gradient(preview, reference, positions[-1])
        assert slope < 0.02 * one_centimetre
        longer = preview.follow(q, np.vstack([path, np.repeat(path[-1:], 30, axis=0)]))
        slope, one_centimetre = gradient(preview, reference, longer[-1])
        assert slope < 1e-4 * one_centimetre
    np.testing.assert_array_equal(q, before)
