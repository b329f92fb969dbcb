"""ReachingSafeSet: margins are zero where they say they are, features are what they are called."""

import math

import numpy as np
import pytest
import yaml
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_safety.control.inverse_kinematics import solve_inverse_kinematics
from drake_safety.control.kinematics import RobotKinematics, fit_stance, planar_pose
from drake_safety.control.mirror import Mirror
from drake_safety.control.whole_body_model import WholeBodyModel
from drake_safety.diagrams.reaching.safe_set import ReachingLimits, ReachingSafeSet
from drake_safety.plants.obstacles import Clearance, Obstacle
from drake_safety.robots.robot_model import load_robot_file
from legged_robots import edited, robot_kinematics, robot_model, write_porter

SHELF_MODEL = "package://drake_safety_models/scenes/bookshelf.urdf"
SHELF = Obstacle(model=SHELF_MODEL, position=[0.9, 0.0, 0.0])
RANGE_M = 0.1
NAMES = ("support_polygon", "collision", "joint_limits", "fall")
ROBOTS = ("porter", "atlas")


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


@pytest.mark.parametrize("name", ROBOTS)
def test_a_standing_robot_is_safe_by_every_margin(name):
    of = safe_set(name, obstacles=[SHELF])
    assert of.names == NAMES
    assert of.fall_name in of.names
    assert min(margins(of, of.kinematics.standing_positions()).values()) > 0


@pytest.mark.parametrize("name", ROBOTS)
def test_the_joint_margin_is_zero_at_its_distance_before_any_stop(name):
    of = safe_set(name, joint_margin_rad=0.05)
    kinematics = of.kinematics
    for i, (lowest, highest) in enumerate(kinematics.position_limits):
        if not math.isfinite(lowest):
            continue
        for stop, inwards in ((lowest, 1), (highest, -1)):
            for distance in (0.05, 0.06, 0.02, -0.01):
                q = kinematics.standing_positions()
                q[7 + i] = stop + inwards * distance
                assert margins(of, q)["joint_limits"] == pytest.approx(distance - 0.05, abs=1e-12)


def test_a_joint_without_stops_never_limits():
    of = safe_set()
    kinematics = of.kinematics
    (wrist, *_) = np.flatnonzero(np.isinf(kinematics.position_limits[:, 0]))
    q = kinematics.standing_positions()
    before = margins(of, q)["joint_limits"]
    q[7 + wrist] = 50.0
    assert margins(of, q)["joint_limits"] == before
    path = straight(of.model.reaching_position(q), [0.3, 0.2, 0.6])
    values = of.features(q, np.zeros(kinematics.num_velocities), in_stance(kinematics, q, path))
    assert np.isfinite(values).all()


@pytest.mark.parametrize(("name", "share"), [("porter", 1.2), ("atlas", 0.5)])
def test_the_support_margin_is_the_distance_to_the_edge_of_the_feet(name, share):
    of = safe_set(name)
    kinematics = of.kinematics
    base = kinematics.standing_positions()[4:7]
    contacts = kinematics.contact_positions(kinematics.standing_positions())[:, :2]
    lowest, highest = contacts.min(axis=0), contacts.max(axis=0)  # The feet stand in a rectangle.
    for target in base[:2] + np.linspace(0.0, share, 6)[:, np.newaxis] * (highest - base[:2]):
        q = leaning(kinematics, np.append(target - base[:2], -0.05))
        expected = min((target - lowest).min(), (highest - target).min())
        if (target > highest).any():
            expected = -np.linalg.norm(np.maximum(target - highest, 0.0))
        assert margins(of, q)["support_polygon"] == pytest.approx(expected, abs=5e-4)


def test_only_feet_on_the_ground_support():
    of = safe_set(support_clearance_m=0.03)
    kinematics = of.kinematics
    q = kinematics.standing_positions()
    both = margins(of, q)["support_polygon"]
    q[7 + kinematics.joint_names.index("left_knee")] += 0.5
    one = margins(of, q)["support_polygon"]
    edge = kinematics.contact_positions(q)[4:, 1].max()  # Of the right foot's contact points.
    assert one == pytest.approx(edge, abs=1e-9)
    assert one < 0 < both
    q = kinematics.standing_positions()
    q[6] += 0.5
    none = margins(of, q)["support_polygon"]
    assert math.isfinite(none)
    assert none < 0


@pytest.mark.parametrize("name", ROBOTS)
def test_the_collision_margin_is_the_clearance_of_the_arms(name):
    of = safe_set(name, obstacles=[SHELF])
    kinematics = of.kinematics
    seen = []
    for x in np.linspace(0.0, 0.6, 9):
        q = kinematics.standing_positions()
        q[4] += x
        seen.append(margins(of, q)["collision"])
        assert seen[-1] == of.clearance.of_arms(q)
    assert seen[0] == RANGE_M
    assert min(seen) < 0


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_has_fallen_below_its_height_and_beyond_its_tilt(name):
    of = safe_set(name, fall_height_share=0.6, fall_tilt_rad=0.5)
    kinematics = of.kinematics
    height = kinematics.standing_height
    q = kinematics.standing_positions()
    for share in (0.59, 0.6, 0.61):
        q[6] = share * height
        assert margins(of, q)["fall"] == pytest.approx((share - 0.6) * height, abs=1e-12)
    for roll, pitch, yaw in ((0.5, 0.0, 0.0), (0.0, -0.5, 2.0), (-0.5, 0.0, 1.0)):
        for share, sign in ((0.98, 1), (1.0, 0), (1.02, -1)):
            rotation = RotationMatrix(RollPitchYaw(share * roll, share * pitch, yaw))
            q = kinematics.positions_at(RigidTransform(rotation, [0, 0, height]), q[7:])
            q[:4] *= -1.5  # The same orientation.
            fall = margins(of, q)["fall"]
            assert abs(fall) < 1e-12 if sign == 0 else np.sign(fall) == sign


@pytest.mark.parametrize("name", ROBOTS)
def test_features_of_the_state_are_what_they_are_called(name):
    of = safe_set(name, obstacles=[SHELF])
    kinematics = of.kinematics
    q = leaning(kinematics, [0.01, -0.02, -0.05], [0.02, 0.01, -0.03])
    hand = of.model.reaching_position(q)
    path = straight(hand + [0.01, 0.02, -0.01], hand + [0.1, 0.05, 0.1])
    preview = in_stance(kinematics, q, path)
    found = features(of, q, preview)
    now = margins(of, q)
    for constraint in of.names[:3]:
        assert found[f"now_{constraint}"] == now[constraint]
    np.testing.assert_array_equal([found[f"goal_{axis}"] for axis in "xyz"], preview[-1])
    error = in_stance(kinematics, q, path[0]) - in_stance(kinematics, q, hand)
    seen = [found[f"tracking_error_{axis}"] for axis in "xyz"]
    np.testing.assert_allclose(seen, error[0], atol=1e-12)
    assert found["center_of_mass_height"] == kinematics.center_of_mass(q)[2]
    assert found["base_height"] == q[6]
    radius = kinematics.robot.reaching_frame("left").radius_m
    on_path = of.clearance.of_points(path, radius)
    assert found["plan_clearance"] == pytest.approx(on_path.min(), abs=1e-12)
    assert found["goal_clearance"] == pytest.approx(on_path[-1], abs=1e-12)
    from_shoulder = [found[f"goal_from_shoulder_{axis}"] for axis in "xyz"]
    assert found["goal_distance"] == pytest.approx(np.linalg.norm(from_shoulder), abs=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
def test_features_of_motion_are_velocities_and_where_they_lead(name):
    of = safe_set(name)
    kinematics = of.kinematics
    q = leaning(kinematics, [0.01, -0.02, -0.05])
    hand = of.model.reaching_position(q)
    preview = in_stance(kinematics, q, straight(hand, hand))
    v = 0.2 * np.random.default_rng(1).normal(size=kinematics.num_velocities)
    found = features(of, q, preview, v)

    def moved(duration_s):
        kinematics.set_positions(q)
        return q + duration_s * kinematics.plant.MapVelocityToQDot(kinematics.context, v)

    tiny_s = 1e-6
    before, after = moved(-tiny_s), moved(tiny_s)
    R_SW = in_stance(kinematics, q, np.eye(3)) - in_stance(kinematics, q, np.zeros(3))
    bodies = {"center_of_mass": kinematics.center_of_mass, "hand": of.model.reaching_position}
    for point, of_body in bodies.items():
        rate = (of_body(after) - of_body(before)) / (2 * tiny_s) @ R_SW
        seen = [found[f"{point}_velocity_{axis}"] for axis in "xyz"]
        np.testing.assert_allclose(seen, rate, atol=1e-6)
    pendulum_s = np.sqrt(found["center_of_mass_height"] / 9.81)
    for angle, axis, sign in ((0, "x", 1), (90, "y", 1), (180, "x", -1), (270, "y", -1)):
        here, there = (
            found[f"{of}_margin_{angle}deg"] for of in ("center_of_mass", "capture_point")
        )
        speed = sign * found[f"center_of_mass_velocity_{axis}"]
        assert here - there == pytest.approx(pendulum_s * speed, abs=1e-9)
    soon = q.copy()
    soon[7:] += 0.1 * v[6:]
    assert found["soon_joint_limits"] == pytest.approx(margins(of, soon)["joint_limits"])
    at_rest = features(of, q, preview)
    assert at_rest["soon_joint_limits"] == at_rest["now_joint_limits"]
    assert at_rest["capture_point_support"] != found["capture_point_support"]


@pytest.mark.parametrize("name", ROBOTS)
def test_the_goal_is_seen_from_the_shoulder(name):
    of = safe_set(name)
    kinematics = of.kinematics
    q = leaning(kinematics, [0.01, -0.02, -0.05])
    kinematics.set_positions(q)
    shoulder = kinematics.plant.GetJointByName(kinematics.robot.reaching_frame("left").joints[0])
    p_WS = shoulder.frame_on_parent().CalcPoseInWorld(kinematics.context).translation()
    found = features(of, q, in_stance(kinematics, q, straight(of.model.reaching_position(q), p_WS)))
    assert found["goal_distance"] == pytest.approx(0.0, abs=1e-9)


def test_the_stance_reaches_past_the_centre_of_mass_as_far_as_its_edges_are():
    of = safe_set()
    kinematics = of.kinematics
    q = leaning(kinematics, [0.02, 0.03, -0.05])
    contacts = kinematics.contact_positions(q)[:, :2]
    ahead, left = contacts.max(axis=0) - kinematics.center_of_mass(q)[:2]
    behind, right = kinematics.center_of_mass(q)[:2] - contacts.min(axis=0)
    found = features(of, q, in_stance(kinematics, q, of.model.reaching_position(q)))
    for angle, expected in ((0, ahead), (90, left), (180, behind), (270, right)):
        seen = found[f"center_of_mass_margin_{angle}deg"]
        assert seen == pytest.approx(expected, abs=1e-4)  # The legs' inverse kinematics.


@pytest.mark.parametrize("name", ROBOTS)
def test_previewed_margins_are_those_of_the_previewed_bodies(name):
    # Of a plan that holds still the preview's last body is the one that all its samples near.
    of = safe_set(name, obstacles=[SHELF])
    kinematics = of.kinematics
    q = leaning(kinematics, [0.0, 0.0, -0.05])
    hold = straight(*[of.model.reaching_position(q)] * 2)
    found = features(of, q, in_stance(kinematics, q, hold))
    assert found["preview_last_miss"] < 5e-3
    num_stops = sum(name.startswith("preview_last_stop") for name in of.feature_names)
    stops = [found[f"preview_last_stop_{i}"] for i in range(num_stops)]
    assert min(stops) >= found["preview_last_joint_limits"]
    for constraint in of.names[:3]:
        lowest, last = (found[f"preview_{when}_{constraint}"] for when in ("lowest", "last"))
        assert lowest <= last
        assert last == pytest.approx(found[f"now_{constraint}"], abs=0.05)


def test_a_goal_behind_an_obstacle_has_a_plan_that_is_not_clear():
    of = safe_set("atlas", obstacles=[SHELF])
    kinematics = of.kinematics
    q = kinematics.standing_positions()
    hand = of.model.reaching_position(q)
    board_m = 0.925
    into = straight(hand, [0.9, 0.2, board_m])
    found = features(of, q, in_stance(kinematics, q, into))
    radius = kinematics.robot.reaching_frame("left").radius_m
    assert found["plan_clearance"] == found["goal_clearance"]
    assert found["goal_clearance"] == pytest.approx(-0.025 - radius, abs=1e-9)
    above = straight(hand, [0.6, 0.2, board_m + 0.15])
    found = features(of, q, in_stance(kinematics, q, above))
    assert found["plan_clearance"] == pytest.approx(RANGE_M, abs=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
def test_features_do_not_depend_on_where_in_the_world_the_robot_stands(name):
    of = safe_set(name)
    kinematics = of.kinematics
    q = leaning(kinematics, [0.01, 0.02, -0.05], [0.02, 0.0, 0.03])
    hand = of.model.reaching_position(q)
    preview = in_stance(kinematics, q, straight(hand, hand + [0.1, 0.0, 0.1]))
    v = np.zeros(kinematics.num_velocities)
    X_WM = RigidTransform(RotationMatrix.MakeZRotation(1.2), [3.0, -2.0, 0.0])
    X_WB = RigidTransform(RotationMatrix(RollPitchYaw(0.02, 0.0, 0.03)), q[4:7])
    moved = kinematics.positions_at(X_WM @ X_WB, q[7:])
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
    for _ in range(5):
        q = leaning(kinematics, rng.uniform(-0.03, 0.0, 3), rng.uniform(-0.05, 0.05, 3))
        q[7:] += rng.uniform(-0.05, 0.05, kinematics.num_joints)
        v = 0.3 * rng.normal(size=kinematics.num_velocities)
        hand = left.model.reaching_position(q)
        path = straight(hand, hand + rng.uniform(0.0, 0.3, 3))
        preview = in_stance(kinematics, q, path)
        expected = left.features(q, v, preview)
        found = right.features(*mirror.plant_state(q, v, np.zeros(3)), mirror.points(preview))
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=atol)


@pytest.mark.parametrize("where", ["q", "v", "preview"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_has_features_that_are_no_numbers(where, value):
    of = safe_set()
    q = of.kinematics.standing_positions()
    hold = in_stance(of.kinematics, q, straight(*[of.model.reaching_position(q)] * 2))
    arguments = {"q": q, "v": np.zeros(of.kinematics.num_velocities), "preview": hold}
    arguments[where].flat[4] = value
    found = of.features(**arguments)
    assert found.shape == (len(of.feature_names),)
    assert np.isnan(found).all()


@pytest.mark.parametrize("distance_m", [1e2, 1e6])
def test_a_goal_as_far_as_no_hand_reaches_has_features_all_the_same(distance_m):
    of = safe_set("atlas")
    q = of.kinematics.standing_positions()
    path = straight(of.model.reaching_position(q), [distance_m, 0.0, 0.0])
    found = features(of, q, in_stance(of.kinematics, q, path))
    assert np.isfinite(list(found.values())).all()
    assert found["preview_last_miss"] > 0.5 * distance_m


def test_a_hand_has_the_size_of_its_own_frame_whatever_else_its_body_carries(tmp_path):
    path = write_porter(tmp_path)
    hands = yaml.safe_load(path.read_text())["reaching_frames"]
    hands = {"fingertip": hands["left"] | {"radius_m": 0.01}, **hands}
    kinematics = RobotKinematics(load_robot_file(edited(path, reaching_frames=hands)))
    clearance = Clearance(kinematics.robot, [SHELF], range_m=RANGE_M)
    q = kinematics.standing_positions()
    path = in_stance(kinematics, q, straight([0.3, 0.2, 1.0], [0.66, 0.2, 0.925]))
    found = {}
    for hand in ("fingertip", "left"):
        of = ReachingSafeSet(WholeBodyModel(kinematics, hand), clearance, ReachingLimits())
        found[hand] = features(of, q, path)["goal_clearance"]
    assert found["fingertip"] - found["left"] == pytest.approx(hands["left"]["radius_m"] - 0.01)


@pytest.mark.parametrize(
    ("name", "hand", "message"),
    [
        ("porter", None, r"'porter': the model must have a hand, one of \['left'"),
        ("biped", "head", "'biped', reaching frame 'head': joints must be those of"),
    ],
)
def test_a_model_without_a_hand_and_a_hand_that_no_joint_carries_are_refused(name, hand, message):
    with pytest.raises(ValueError, match=message):
        safe_set(name, hand)
