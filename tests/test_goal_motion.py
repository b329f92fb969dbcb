import math

import numpy as np
import pytest

from drake_safety.plants.pushes import Push
from drake_safety.simulation.rollouts import run_to_goal
from drake_safety.simulation.scenario import load_scenario

SCENARIO = "atlas_reaching"
PUSH = Push(body="utorso", force_n=[0.0, 300.0, 0.0], time_s=0.1, duration_s=0.05)


@pytest.fixture(scope="module")
def loop():
    return load_scenario(SCENARIO).make_loop("actual")


@pytest.fixture(scope="module")
def goal(loop):
    return np.array(loop.named_targets["blue_box"])


@pytest.fixture(scope="module")
def calm(loop, goal):
    return run_to_goal(loop, goal, duration_s=0.3, ports=("safe",))


def test_a_motion_begins_standing_and_has_a_row_every_step(loop, calm, goal):
    np.testing.assert_allclose(calm.time_s, 0.02 * np.arange(16), atol=1e-12)
    standing = loop.kinematics.standing_positions().copy()
    standing[6] -= loop.scenario.parameters.start.sink_m
    np.testing.assert_array_equal(calm["plant_state"][0, : loop.kinematics.num_positions], standing)
    assert np.all(calm["safe"] == 1.0)
    assert (calm.has_left, calm.has_fallen, calm.cause) == (False, False, "")
    # It has hardly begun.
    assert np.linalg.norm(calm["output"][-1] - goal) == pytest.approx(
        np.linalg.norm(calm["output"][0] - goal), rel=0.1
    )


def test_noise_follows_from_the_seed_alone(loop, calm, goal):
    again = run_to_goal(loop, goal, duration_s=0.1)
    np.testing.assert_array_equal(again["plant_state"], calm["plant_state"][: len(again.time_s)])
    other = run_to_goal(loop, goal, duration_s=0.1, seed=1)
    assert not np.array_equal(other["plant_state"], again["plant_state"])


def test_a_push_changes_nothing_before_it_begins_and_moves_the_robot_its_way(loop, calm, goal):
    pushed = run_to_goal(loop, goal, push=PUSH, duration_s=0.3)
    is_before = calm.time_s <= PUSH.time_s
    np.testing.assert_array_equal(pushed["plant_state"][is_before], calm["plant_state"][is_before])
    y = 5  # Of the base, among the positions.
    assert np.all(pushed["plant_state"][-3:, y] > calm["plant_state"][-3:, y])
    # It is over: the next motion is not pushed.
    after = run_to_goal(loop, goal, duration_s=0.3)
    np.testing.assert_array_equal(after["plant_state"], calm["plant_state"])


@pytest.mark.slow
def test_a_motion_that_leaves_the_safe_set_is_watched_until_the_robot_falls(loop):
    goal = np.array(loop.named_targets["red_can"])
    motion = run_to_goal(loop, goal, duration_s=4.5)
    assert motion.has_left and motion.has_fallen
    assert motion.leave_time_s < motion.fall_time_s == motion.time_s[-1] < 4.5
    row = int(np.argmin(np.abs(motion.time_s - motion.leave_time_s)))
    assert motion["margins"][:row].min() >= 0
    assert loop.constraint_names[int(np.argmin(motion["margins"][row]))] == motion.cause
    assert motion["margins"][-1, loop.constraint_names.index(loop.fall_name)] < 0


@pytest.mark.slow
def test_the_named_target_that_is_safe_is_reached_inside_the_safe_set(goal):
    motion = run_to_goal(load_scenario(SCENARIO).make_loop(), goal, duration_s=3.5)
    assert not motion.has_left
    assert math.isinf(motion.leave_time_s)
    assert np.linalg.norm(motion["output"][-1] - goal) < 0.02
