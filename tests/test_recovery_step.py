import math

import numpy as np
import pytest

from drake_safety.control.recovery_step import (
    RecoveryStepParameters,
    capture_point,
    come_to_rest,
    first_group,
    foothold,
    gait_groups,
    swing_position,
)
from legged_robots import robot_kinematics

PARAMETERS = RecoveryStepParameters()
FRONT_LEFT = np.array([0.2, 0.13])


@pytest.mark.parametrize("name", ["laikago", "hexapod"])
def test_every_foot_swings_in_one_of_two_groups_and_never_with_its_neighbour(name):
    kinematics = robot_kinematics(name)
    contacts = kinematics.nominal_contacts
    feet = np.array([contacts[rows].mean(axis=0) for rows in kinematics.foot_slices])
    first, second = gait_groups(feet)
    assert sorted(first + second) == list(range(len(feet)))
    around = np.argsort(np.arctan2(feet[:, 1], feet[:, 0]))
    is_first = [foot in first for foot in around]
    assert all(a != b for a, b in zip(is_first, is_first[1:] + is_first[:1], strict=True))


def test_a_still_pendulum_is_captured_where_it_is_and_a_moving_one_ahead():
    p = np.array([0.1, 0.2, 9.81])
    np.testing.assert_allclose(capture_point(p, np.zeros(3)), [0.1, 0.2])
    np.testing.assert_allclose(capture_point(p, np.array([2.0, -1.0, 5.0])), [2.1, -0.8])
    assert np.isfinite(capture_point(np.array([0, 0, -1.0]), np.ones(3))).all()


def test_a_pendulum_over_its_capture_point_starts_as_it_was_and_comes_to_rest_there():
    p, v = np.array([0.1, 0.2, 0.5]), np.array([0.4, -0.3, 0.0])
    np.testing.assert_allclose(come_to_rest(p, v, 0.0), p)
    step_s = 1e-6
    np.testing.assert_allclose((come_to_rest(p, v, step_s) - p) / step_s, v, atol=1e-5)
    np.testing.assert_allclose(come_to_rest(p, v, 20.0), [*capture_point(p, v), 0.5])
    # On the way its acceleration is what a centre of pressure at the capture point gives.
    at = [come_to_rest(p, v, 0.1 + i * 1e-3) for i in (-1, 0, 1)]
    acceleration = (at[0] - 2 * at[1] + at[2])[:2] / 1e-6
    expected = 9.81 / 0.5 * (at[1][:2] - capture_point(p, v))
    np.testing.assert_allclose(acceleration, expected, rtol=1e-3)


def test_the_pair_away_from_the_capture_point_swings_first():
    feet = np.array([[1, -1], [1, 1], [-1, -1], [-1, 1]], float)
    groups = [[0, 3], [1, 2]]
    # On the line between feet 1 and 2: they carry, feet 0 and 3 swing.
    assert first_group(groups, feet, np.array([0.5, 0.5])) == 0
    assert first_group(groups, feet, np.array([0.5, -0.5])) == 1


@pytest.mark.parametrize(("num_steps", "growth"), [(0, 1.0), (5, 1.5)])
def test_a_slow_robot_steps_beyond_raiberts_neutral_point_more_with_every_step(num_steps, growth):
    v, remaining_s = np.array([0.4, 0.1, 0.0]), 0.05
    place = foothold(np.zeros(3), v, 0.0, FRONT_LEFT, remaining_s, PARAMETERS, num_steps)
    time = remaining_s + 0.5 * PARAMETERS.step_duration_s + growth * PARAMETERS.velocity_gain_s
    np.testing.assert_allclose(place, FRONT_LEFT + time * v[:2])


def rotated(yaw, vector):
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s], [s, c]]) @ vector


@pytest.mark.parametrize("seed", range(5))
def test_a_foothold_stays_in_reach_and_on_its_own_side(seed):
    rng = np.random.default_rng(seed)
    p, yaw, remaining_s = rng.normal(size=3), rng.uniform(-3, 3), rng.uniform(0, 0.12)
    v = 5.0 * rng.normal(size=3)
    for hip in (FRONT_LEFT, FRONT_LEFT * [1, -1]):
        place = foothold(p, v, yaw, hip, remaining_s, PARAMETERS)
        at_touchdown = p[:2] + remaining_s * v[:2]
        local = rotated(-yaw, place - at_touchdown)
        assert np.linalg.norm(local - hip) <= PARAMETERS.max_reach_m + 1e-12
        assert local[1] * np.sign(hip[1]) >= PARAMETERS.min_lateral_m - 1e-12


START, GOAL = np.array([0.0, 0.0, 0.02]), np.array([0.3, -0.1, 0.02])


def test_a_swing_leaves_its_start_at_rest_passes_over_the_middle_and_ends_at_rest_on_its_goal():
    for phase, end in ((-0.5, START), (0.0, START), (1.0, GOAL), (1.5, GOAL)):
        np.testing.assert_allclose(swing_position(START, GOAL, phase, 0.06), end, atol=1e-12)
    middle = 0.5 * (START + GOAL) + [0, 0, 0.06]
    np.testing.assert_allclose(swing_position(START, GOAL, 0.5, 0.06), middle)
    step = 1e-5
    for phase in (0.0, 1.0 - step):
        change = swing_position(START, GOAL, phase + step, 0.06)
        change -= swing_position(START, GOAL, phase, 0.06)
        assert np.linalg.norm(change) / step < 1e-3
