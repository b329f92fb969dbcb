import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform

from drake_safety.control.kinematics import NUM_BASE_VELOCITIES
from drake_safety.diagrams.balancing.sampling import (
    PushSampling,
    StartSampling,
    calm_start,
    resting_feet,
    undisturbed_start,
)
from legged_robots import ROBOT_NAMES, robot_kinematics


def sampling_for(kinematics):
    """The default ranges, about the robot's own height."""
    height = kinematics.standing_height
    band = [0.9 * height, height]
    return StartSampling(base_height_m=band, target_height_m=band, foot_offset_m=0.01)


def contact_velocities(kinematics, start):
    return kinematics.contact_jacobian(start.q) @ start.v


@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_the_base_moves_and_the_feet_stand_on_the_ground_at_rest(name):
    kinematics = robot_kinematics(name)
    sampling = sampling_for(kinematics)
    sampling.joint_std_rad = 0.0  # It would lift the feet, by design.
    sampling.foot_offset_m = 0.0  # Points of one foot move on their own: no flat foot fits them.
    start = sampling.sample(kinematics, np.random.default_rng(0))
    feet = start.foot_positions
    np.testing.assert_allclose(kinematics.contact_positions(start.q), feet, atol=2e-3)
    np.testing.assert_array_equal(feet[:, 2], kinematics.foot_radii)
    assert np.abs(start.v[:NUM_BASE_VELOCITIES]).max() > 0.05
    np.testing.assert_allclose(contact_velocities(kinematics, start), 0.0, atol=1e-6)


def test_the_plan_begins_at_the_base_and_ends_in_the_ranges():
    kinematics = robot_kinematics(ROBOT_NAMES[0])
    sampling = sampling_for(kinematics)
    sampling.foot_offset_m = 0.0
    for seed in range(5):
        start = sampling.sample(kinematics, np.random.default_rng(seed))
        # With the feet in their nominal places the stance frame is the world's.
        np.testing.assert_allclose(start.plan.value(0.0).ravel(), start.q[4:7], atol=1e-9)
        low, high = sampling.plan_duration_s
        assert low <= start.plan.end_time() <= high
        goal = start.plan.value(start.plan.end_time()).ravel()
        offset = np.abs(goal[:2] - kinematics.nominal_base_offset)
        assert np.all(offset <= sampling.target_offset_m)
        assert sampling.target_height_m[0] <= goal[2] <= sampling.target_height_m[1]


def test_a_calm_start_is_a_point_of_its_motion_with_the_motions_velocity():
    kinematics = robot_kinematics(ROBOT_NAMES[0])
    options = {"half_widths_m": [0.05, 0.03], "plan_duration_s": [1.0, 1.0]}
    for elapsed_s in (0.0, 0.4, 2.0):
        rng = np.random.default_rng(1)
        start = calm_start(kinematics, rng, elapsed_s=elapsed_s, **options)
        assert start.plan.start_time() == -elapsed_s
        np.testing.assert_allclose(start.q[4:7], start.plan.value(0.0).ravel())
        np.testing.assert_array_equal(start.v[:3], 0.0)
        np.testing.assert_allclose(contact_velocities(kinematics, start), 0.0, atol=1e-6)
        is_moving = np.linalg.norm(start.v[3:6]) > 1e-3
        assert is_moving == (0.0 < elapsed_s < 1.0)


def test_undisturbed_motions_follow_each_other_with_rests_in_half_of_the_ranges():
    kinematics = robot_kinematics(ROBOT_NAMES[0])
    sampling = sampling_for(kinematics)
    start = undisturbed_start(kinematics, np.random.default_rng(1), sampling, 30.0)
    assert not start.v.any() and start.plan.start_time() == 0.0 and start.plan.end_time() >= 30.0
    values = start.plan.vector_values(np.arange(0.0, 30.0, 0.02)).T
    half = 0.5 * np.array(sampling.target_offset_m)
    assert np.all(np.abs(values[:, :2] - kinematics.nominal_base_offset) <= half + 1e-9)
    rest = np.all(np.diff(values, axis=0) == 0.0, axis=1)
    # It moves most of the time, without jumps, and rests between two motions.
    assert 0.1 < rest.mean() < 0.7
    assert np.count_nonzero(np.diff(rest.astype(int)) == 1) >= 5
    assert np.abs(np.diff(values, axis=0)).max() < 0.02
    np.testing.assert_allclose(values[0, 2], kinematics.standing_height)
    low, high = np.quantile(sampling.target_height_m, [0.25, 0.75])
    later = values[300:, 2]  # After the motion from standing.
    assert low - 1e-9 <= later.min() < later.max() <= high + 1e-9


def test_feet_at_rest_need_no_joint_rates_when_the_base_is_at_rest():
    kinematics = robot_kinematics(ROBOT_NAMES[0])
    start = sampling_for(kinematics).sample(kinematics, np.random.default_rng(2))
    X_WB = RigidTransform(Quaternion(start.q[:4]), start.q[4:7])
    v = resting_feet(kinematics, X_WB, start.q[7:], np.zeros(NUM_BASE_VELOCITIES))
    np.testing.assert_array_equal(v, 0.0)


def test_random_throws_lie_in_their_ranges():
    push = PushSampling(offset_m=0.05)
    rng = np.random.default_rng(3)
    throws = [push.sample(rng, 0.7) for _ in range(200)]
    for name, (low, high) in {
        "mass_kg": push.mass_kg,
        "speed_m_s": push.speed_m_s,
        "offset_m": (-0.05, 0.05),
        "height_m": (-push.height_m, push.height_m),
        "direction_rad": (-np.pi, np.pi),
    }.items():
        values = np.array([getattr(throw, name) for throw in throws])
        assert low <= values.min() and values.max() <= high
        assert values.max() - values.min() > 0.9 * (high - low)
    assert {throw.time_s for throw in throws} == {0.7}
