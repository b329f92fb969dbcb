import copy
import math

import numpy as np
import pytest
from pydrake.math import RotationMatrix

from drake_safety.control.observation import quaternion_of
from drake_safety.diagrams.balancing.throws import VIOLATIONS, run_throw, run_throws
from drake_safety.plants.balls import Throw
from drake_safety.simulation.scenario import load_scenario

HARD = Throw(time_s=0.3, mass_kg=3.0, speed_m_s=8.0, direction_rad=math.pi / 2)
SOFT = Throw(time_s=0.3, mass_kg=2.0, speed_m_s=2.5, direction_rad=math.pi / 2)


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("laikago_balancing")


@pytest.fixture(scope="module")
def balancing(scenario):
    return scenario.make_loop("actual", ball=True)


@pytest.fixture(scope="module")
def recovering(scenario):
    return scenario.make_loop("actual", ball=True, recovery=True)


def test_a_hard_throw_makes_balancing_fall_and_the_log_ends_there(balancing):
    log = run_throw(balancing, 0, seed=5, throws=[HARD], duration_s=2.5)
    assert log.has_left and log.has_fallen
    assert HARD.time_s < log.leave_time_s < log.fall_time_s == pytest.approx(log.time_s[-1])
    fall = balancing.constraint_names.index(balancing.fall_name)
    assert log["margins"][-1, fall] < 0 <= log["margins"][-2, fall]


def test_a_soft_throw_is_survived_inside_the_safe_set(balancing):
    log = run_throw(balancing, 0, seed=5, throws=[SOFT], duration_s=1.5)
    assert not log.has_left and not log.has_fallen
    speed = np.abs(log["state"][:, balancing.state_names.index("velocity_y")])
    before, after = log.time_s < SOFT.time_s - 0.01, log.time_s > SOFT.time_s + 0.01
    assert speed[after].max() > 0.15 > speed[before].max()


def test_before_the_trigger_recovery_changes_nothing_at_all(balancing, recovering):
    trigger_s = 0.34
    alone = run_throw(balancing, 3, seed=5, throws=[HARD], duration_s=0.6)
    saved = run_throw(
        recovering, 3, seed=5, throws=[HARD], duration_s=0.6, trigger_time_s=trigger_s
    )
    rows = alone.time_s <= trigger_s + 1e-9
    for name in ("plant_state", "state", "features", "margins"):
        np.testing.assert_array_equal(alone[name][rows], saved[name][rows])
    assert not np.array_equal(alone["plant_state"][-1], saved["plant_state"][-1])


def test_a_trigger_between_two_updates_of_a_slow_controller_is_not_missed(scenario):
    slow = copy.copy(scenario)
    slow.control_period_s = 0.05
    loop = slow.make_loop("actual", ball=True, recovery=True)
    log = run_throw(loop, 0, seed=5, throws=[HARD], duration_s=0.14, trigger_time_s=0.063)
    assert log["recovery_active"][-1] == 1.0


def test_recovery_steps_save_the_robot_without_cheating(recovering):
    for direction in (math.pi / 2, -math.pi / 4, math.pi):
        throw = Throw(time_s=0.3, mass_kg=3.0, speed_m_s=8.0, direction_rad=direction)
        log = run_throw(recovering, 1, seed=5, throws=[throw], duration_s=3.5, trigger_time_s=0.32)
        assert not log.has_fallen
        assert log["recovery_active"][-1] == 0, "the robot has handed over to balancing"
        ((start_s, end_s),) = log.recovery_intervals_s
        assert start_s == pytest.approx(0.34, abs=1e-9)  # The first row after the trigger.
        assert start_s < end_s < log.time_s[-1]
        assert log["margins"][-1].min() > 0, "it balances inside its safe set again"
        assert log["violations"].shape == (len(log.time_s), len(VIOLATIONS))
        assert not log["violations"].any()


def test_recovery_intervals_hold_the_active_rows_and_no_other(balancing):
    log = run_throw(balancing, 0, seed=5, throws=[SOFT], duration_s=0.1)
    assert log.recovery_intervals_s == []
    log.ports["recovery_active"] = np.array([[1.0, 1.0, 0.0, 0.0, 1.0, 1.0]]).T
    t = log.time_s
    assert log.recovery_intervals_s == [(t[0], t[1]), (t[4], t[5])]


def test_footholds_stay_on_their_own_side_and_within_reach(recovering):
    log = run_throw(recovering, 1, seed=5, throws=[HARD], duration_s=2.0, trigger_time_s=0.32)
    kinematics = recovering.kinematics
    stretched = 0.25 + 0.25 + 0.037
    for plant_state in log["plant_state"]:
        feet = kinematics.contact_positions(plant_state[: kinematics.num_positions])
        hips = [
            kinematics.plant.CalcPointsPositions(
                kinematics.context,
                kinematics.plant.GetFrameByName(f"{foot}_hip"),
                np.zeros(3),
                kinematics.world_frame,
            ).ravel()
            for foot in kinematics.foot_names
        ]
        assert np.linalg.norm(feet - hips, axis=1).max() <= stretched + 1e-6
        # The left feet stay to the left of the right ones, so that legs never cross.
        sideways = RotationMatrix(quaternion_of(plant_state)).matrix()[:2, 1]
        right, left = feet[0::2, :2], feet[1::2, :2]
        assert np.all((left - right) @ sideways > 0.05)


def test_throws_do_not_depend_on_the_workers_and_keep_their_order(scenario):
    one = run_throws(scenario, [2, 0, 1], seed=9, num_workers=1)
    two = run_throws(scenario, [0, 1, 2], seed=9, num_workers=2)
    assert [log.index for log in one] == [2, 0, 1]
    for log in one:
        other = next(found for found in two if found.index == log.index)
        assert log.push_time_s == other.push_time_s
        np.testing.assert_array_equal(log["plant_state"], other["plant_state"])
