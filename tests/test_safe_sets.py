"""Safe sets: signed margins agree with brute force, with hand-worked cases and with geometry."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

import naive
from drake_safety.control.mirror import Mirror
from drake_safety.control.observation import gravity_in_foot_plane
from drake_safety.control.safe_sets import (
    BalanceLimits,
    BalanceSafeSet,
    convex_hull,
    signed_distance_to_polygon,
)
from drake_safety.systems.assessor_inputs import AssessorInputs
from legged_robots import robot_kinematics
from system_doubles import Bench

SQUARE = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]


@given(st.integers(0, 2**32 - 1), st.integers(3, 9))
def test_a_hull_turns_left_holds_every_point_and_is_as_far_as_brute_force_says(seed, num_points):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(num_points, 2))
    polygon = convex_hull(points)
    edges = np.roll(polygon, -1, axis=0) - polygon
    following = np.roll(edges, -1, axis=0)
    assert np.all(edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0] > 0)
    assert all(signed_distance_to_polygon(p, polygon) > -1e-12 for p in points)
    for point in rng.normal(size=(3, 2)):
        expected = naive.hull_distance(point, points)
        assert signed_distance_to_polygon(point, polygon) == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize(
    ("point", "distance"),
    [((0.5, 0.5), 0.5), ((0.5, 0.9), 0.1), ((0.5, 1.2), -0.2), ((2.0, 2.0), -math.sqrt(2))]
    + [((0.0, 0.5), 0.0), ((1.0, 1.0), 0.0)],
)
def test_distances_to_the_unit_square(point, distance):
    assert signed_distance_to_polygon(np.array(point), SQUARE) == pytest.approx(distance)


def test_points_on_a_line_make_a_segment_that_holds_nothing():
    corners = convex_hull(np.array([[0.0, 0], [2, 0], [1, 0], [0.5, 0]]))
    assert sorted(corners) == [(0, 0), (2, 0)]
    assert convex_hull(np.array(SQUARE + SQUARE + [(0.5, 0.0)])) == convex_hull(np.array(SQUARE))
    assert signed_distance_to_polygon(np.array([1.0, 0.3]), corners) == pytest.approx(-0.3)
    assert signed_distance_to_polygon(np.array([1.0, 0.0]), corners) == 0
    assert signed_distance_to_polygon(np.array([3.0, 0.0]), corners) == pytest.approx(-1)
    point = convex_hull([[1.0, 1.0]] * 4)
    assert signed_distance_to_polygon(np.array([1.0, 3.0]), point) == pytest.approx(-2)
    assert signed_distance_to_polygon(np.zeros(2), []) == -math.inf


def safe_set_of(name, **limits):
    kinematics = robot_kinematics(name)
    height = kinematics.standing_height
    limits = {"height_m": [0.7 * height, 1.3 * height], "fall_height_m": 0.4 * height} | limits
    return kinematics, BalanceSafeSet(kinematics, BalanceLimits(**limits))


def state(kinematics, shift=(0, 0, 0), rotation=(0, 0, 0), joints=None):
    p = np.array([0.0, 0.0, kinematics.standing_height]) + shift
    joints = kinematics.posture if joints is None else joints
    q = kinematics.positions_at(RigidTransform(RollPitchYaw(rotation), p), joints)
    return q, np.zeros(kinematics.num_velocities)


@pytest.mark.parametrize("name", ["laikago", "hexapod"])
def test_standing_is_safe_and_each_margin_is_what_geometry_says(name):
    kinematics, safe_set = safe_set_of(name)
    q, v = state(kinematics)
    support, height, fall = safe_set.margins(q, v)
    feet = kinematics.contact_positions(q)[:, :2]
    assert support == pytest.approx(naive.hull_distance(q[4:6], feet), abs=1e-3)
    standing = kinematics.standing_height
    assert height == pytest.approx(0.3 * standing)
    tilt_reserve = standing * (1 - math.cos(safe_set.limits.fall_tilt_rad))
    assert fall == pytest.approx(min(0.6 * standing, tilt_reserve))
    assert min(support, height, fall) > 0


def test_a_foot_in_the_air_leaves_the_support_polygon():
    kinematics, safe_set = safe_set_of("laikago")
    q, v = state(kinematics)
    lifted = kinematics.posture.copy()
    lifted[:3] += [0.0, 0.3, -0.6]
    q_lifted, _ = state(kinematics, joints=lifted)
    p_WC = kinematics.contact_positions(q_lifted)
    on_ground = p_WC[:, 2] - kinematics.foot_radii < 0.03
    assert on_ground.sum() == 3
    support = safe_set.margins(q_lifted, v)[0]
    expected = naive.hull_distance(q[4:6], p_WC[on_ground, :2])
    assert support == pytest.approx(expected, abs=1e-3)
    assert support < safe_set.margins(q, v)[0]


def features(safe_set, q, v, preview):
    return dict(zip(safe_set.feature_names, safe_set.features(q, v, preview), strict=True))


@pytest.mark.parametrize("name", ["laikago", "hexapod"])
def test_features_and_margins_do_not_depend_on_the_place_and_each_feature_has_a_name(name):
    kinematics, safe_set = safe_set_of(name)
    preview = np.tile([0.01, 0.02, kinematics.standing_height], (5, 1))
    X_WB = RigidTransform(RollPitchYaw(0.05, 0.1, 0.0), [0, 0, kinematics.standing_height])
    v = np.random.default_rng(0).normal(size=kinematics.num_velocities)
    q = kinematics.positions_at(X_WB, kinematics.posture)
    here = safe_set.features(q, v, preview)
    assert here.shape == (len(safe_set.feature_names),)
    assert len(set(safe_set.feature_names)) == len(safe_set.feature_names)
    R = RotationMatrix.MakeZRotation(-2.5)
    moved = RigidTransform(R, [3.0, -4.0, 0.0]) @ X_WB
    v_moved = v.copy()
    v_moved[:3], v_moved[3:6] = R.matrix() @ v[:3], R.matrix() @ v[3:6]
    q_moved = kinematics.positions_at(moved, kinematics.posture)
    np.testing.assert_allclose(safe_set.features(q_moved, v_moved, preview), here, atol=1e-9)
    moved, unmoved = safe_set.margins(q_moved, v_moved), safe_set.margins(q, v)
    np.testing.assert_allclose(moved, unmoved, atol=1e-9)


def test_a_velocity_moves_the_capture_point_by_the_pendulums_time_constant():
    kinematics, safe_set = safe_set_of("laikago")
    q, v = state(kinematics)
    still = features(safe_set, q, v, np.zeros((3, 3)))
    v[3] = 0.5
    pushed = features(safe_set, q, v, np.zeros((3, 3)))
    point = "capture_point_margin_0deg"
    assert pushed[point] - still[point] == pytest.approx(-0.5 * math.sqrt(q[6] / 9.81))
    assert pushed["base_margin_0deg"] == still["base_margin_0deg"]


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
        place = [3.0, -2.0, kinematics.standing_height]
        X_WB = RigidTransform(RotationMatrix.MakeZRotation(yaw), place)
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
