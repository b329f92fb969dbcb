from dataclasses import replace

import numpy as np
import pytest

import naive
from drake_safety.learning.change_detector import (
    FALSE_ALARMS_PER_HOUR,
    LEAST_MOTION_S,
    TIME_CONSTANTS_S,
    ChangeDetector,
    usual_rows,
)
from sprung_motions import INFO, MOTION_S, STEP_S, learned, motion, recorded

pytestmark = pytest.mark.train

ALWAYS = slice(0, None)


def worst(rows, detector=None):
    """Largest level at each row of a motion."""
    return (detector or learned()).watch([rows])[0].max(axis=1)


@pytest.mark.parametrize("monitored", [None, ["knee_rate"]])
def test_levels_are_those_of_the_recursion_over_consecutive_motions(monitored):
    detector = learned()
    if monitored is not None:
        info = replace(INFO, monitored_states=monitored, monitored_features=None)
        detector = ChangeDetector.fit(recorded([motion(5.0, seed) for seed in range(2)], info))
    rows = [motion(2.0, seed, ALWAYS) for seed in range(4)]
    rows[1] = rows[1][:2]  # Too short for an innovation: the charts keep their values.
    rows[2][20:30] = rows[2][20]
    levels, charts = naive.charts(detector, rows)
    np.testing.assert_allclose(detector.watch(rows)[0], levels, rtol=1e-4, atol=1e-4)
    assert levels.shape[1] == len(monitored or INFO.state_names)
    assert not levels[:2].any() and levels[2:].min() > 0.0
    np.testing.assert_allclose(detector.levels(charts[-1]), levels[-1])
    assert not detector.watch([rows[1]])[0].any()


def test_hours_of_the_same_plant_raise_no_more_alarms_than_promised():
    hours = 3.0
    usual = (motion(MOTION_S, 1000 + seed) for seed in range(round(hours * 3600 / MOTION_S)))
    alarms = sum(len(learned().watch([rows])[1]) for rows in usual)
    assert alarms <= 1 + hours * FALSE_ALARMS_PER_HOUR


@pytest.mark.parametrize(
    ("change", "within_s"),
    [
        ({"pushed": ALWAYS, "force": 0.02}, 5.0),
        ({"pushed": ALWAYS, "force": -0.1}, 1.0),
        ({"damping": 4.0}, 1.0),
        ({"noise": 0.05}, 1.0),
    ],
)
def test_a_changed_plant_or_sensor_is_noticed(change, within_s):
    assert worst(motion(within_s, 3, **change)).max() > 1.0


def test_one_impact_is_no_lasting_change():
    rows = motion(20.0, 4)
    rows[200, 1] += 5.0
    found = np.flatnonzero(worst(rows) > 1.0)
    assert 200 <= found.min() <= found.max() < 200 + 3.0 / STEP_S


def test_a_frozen_input_is_noticed_after_few_repeats():
    rows = motion(20.0, 5)
    rows[215:] = rows[215]
    (alarm,) = learned().watch([rows])[1]
    assert 215 < alarm.begin <= 215 + learned().longest_repeat + 1
    assert alarm.end == len(rows)
    _, charts = naive.charts(learned(), [rows])
    repeats = learned().longest_repeat + 1
    assert learned().cause(charts[-1], repeats, INFO.state_names) == "inputs frozen"


def test_the_cause_names_the_state_that_is_pushed():
    _, charts = naive.charts(learned(), [motion(5.0, 6, ALWAYS, -0.03)])
    said = learned().cause(charts[-1], 0.0, INFO.state_names)
    assert said.startswith("joint knee answers unlike in training (knee_rate -")


@pytest.mark.parametrize(
    ("names", "value", "is_square", "said"),
    [
        (["base_x", "velocity_y"], [0.0, 7.0], False, "pushed steadily to the left (velocity_y +7"),
        (["base_x", "velocity_y"], [-9.0, 7.0], False, "pushed steadily backward (base_x -9.0 sta"),
        (["base_x", "velocity_y"], [0.0, 8.0], True, "velocity_y changes unlike in training (velo"),
        (["knee", "knee_rate"], [0.0, 8.0], True, "joint knee answers unlike in training (knee_r"),
        (["angle", "speed"], [0.0, -7.0], False, "speed changes unlike in training (speed -7.0 st"),
    ],
)
def test_an_alarm_says_what_it_saw(names, value, is_square, said):
    charts = np.zeros((6, 2))
    charts[3 * is_square + 1] = value
    cause = replace(learned(), limits=np.ones((6, 2))).cause(charts, 0.0, names)
    assert cause.startswith(said) and cause.endswith(f"over {2 * TIME_CONSTANTS_S[1]:g} s)")
    assert not is_square or "3.0 times as irregular" in cause


def test_too_little_motion_gives_levels_and_no_alarm():
    rows = [motion(0.1 * LEAST_MOTION_S, seed) for seed in range(6)]
    detector = ChangeDetector.fit(recorded(rows))
    assert np.isinf(detector.alarm_level) and learned().alarm_level == 1.0
    levels, alarms = detector.watch([motion(5.0, 12, ALWAYS)])
    assert levels.max() > 1.0 and alarms == []
    assert "never alarms" in detector.describe()
    assert "extrapolated to one false alarm in" in learned().describe()
    with pytest.raises(ValueError, match="1 motions have three rows; two are needed"):
        ChangeDetector.fit(recorded([one[: 2 + i] for i, one in enumerate(rows[:2])]))


def test_what_an_actual_robot_does_is_no_alarm_after_its_motion_is_known():
    adapted = learned().with_motions([motion(MOTION_S, seed, ALWAYS, 0.1) for seed in range(4)])
    same, other = motion(300.0, 9, ALWAYS, 0.1), motion(5.0, 10, ALWAYS, -0.1)
    assert worst(same).max() > 1.0
    assert worst(same, adapted).max() < 1.0
    assert worst(other, adapted).max() > 1.0
    assert np.all(adapted.limits >= learned().limits)
    assert learned().with_motions([same[:2]]) is learned()
    # Three rows tell next to nothing.
    few = learned().with_motions([same[:3]])
    assert worst(same, few).max() > 1.0 and np.isfinite(few.limits).all()


def test_motion_counts_from_its_first_step_until_shortly_before_it_leaves():
    rows = motion(5.0, 14)
    (kept,) = usual_rows(recorded([rows], first_step=3))
    np.testing.assert_array_equal(kept, rows[3:])
    (kept,) = usual_rows(recorded([rows], is_safe=False, cause="reach"))
    assert 0.1 < STEP_S * (len(rows) - len(kept)) < 2.0
    np.testing.assert_array_equal(kept, rows[: len(kept)])


def test_a_detector_is_made_of_its_arrays():
    arrays, rows = learned().arrays(), motion(5.0, 15)
    again = ChangeDetector.from_arrays(arrays)
    np.testing.assert_array_equal(worst(rows, again), worst(rows))
    assert again.describe() == learned().describe()
    assert (again.alarm_level, again.longest_repeat) == (1.0, learned().longest_repeat)


@pytest.mark.parametrize("name", ["monitored_states", "monitored_features"])
def test_names_that_are_none_of_the_loops_are_refused(name):
    info = replace(INFO, **{name: ["wing"]})
    with pytest.raises(ValueError, match=rf"{name} has \['wing'\], which are none of"):
        ChangeDetector.fit(recorded([motion(1.0, seed) for seed in range(2)], info))
