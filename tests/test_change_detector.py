from dataclasses import replace

import numpy as np
import pytest

import naive
from drake_safety import SafetyAssessment
from drake_safety.learning.change_detector import (
    FALSE_ALARMS_PER_HOUR,
    LEAST_MOTION_S,
    TIME_CONSTANTS_S,
    ChangeDetector,
    usual_rows,
)
from sprung_motions import INFO, MOTION_S, STEP_S, learned, motion, recorded, same_detector

pytestmark = pytest.mark.train

ALWAYS = slice(0, None)


def worst(rows, detector=None):
    """Largest level at each row of a motion."""
    return (detector or learned()).watch([rows])[0].max(axis=1)


def test_levels_are_those_of_the_recursion_over_consecutive_motions():
    rows = [motion(2.0, seed, ALWAYS) for seed in range(4)]
    rows[1] = rows[1][:2]  # Too short for an innovation: the charts keep their values.
    rows[2][20:30] = rows[2][20]
    levels, charts = naive.charts(learned(), rows)
    np.testing.assert_allclose(learned().watch(rows)[0], levels, rtol=1e-4, atol=1e-4)
    assert not levels[:2].any() and levels[2:].min() > 0.0
    np.testing.assert_allclose(learned().levels(charts[-1]), levels[-1])
    assert not learned().watch([rows[1]])[0].any()


def test_hours_of_the_same_plant_raise_no_more_alarms_than_promised():
    hours = 2.0
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
def test_changed_plant_or_sensor_is_noticed(change, within_s):
    assert worst(motion(within_s, 3, **change)).max() > 1.0


def test_one_impact_is_no_lasting_change():
    rows = motion(20.0, 4)
    rows[200, 1] += 5.0
    alarms = np.flatnonzero(worst(rows) > 1.0)
    assert 200 <= alarms.min() <= alarms.max() < 200 + 3.0 / STEP_S


def test_frozen_input_is_noticed_after_few_repeats():
    rows = motion(20.0, 5)
    rows[215:] = rows[215]
    (alarm,) = learned().watch([rows])[1]
    repeats = learned().longest_repeat + 1
    assert 215 < alarm.begin <= 215 + repeats and alarm.end == len(rows)
    _, charts = naive.charts(learned(), [rows])
    assert learned().cause(charts[-1], repeats, INFO.state_names) == "inputs frozen"


@pytest.mark.parametrize(
    ("names", "value", "is_square", "cause"),
    [
        (["base_x", "velocity_y"], [0.0, 7.0], False, "pushed steadily to the left (velocity_y +7"),
        (["knee", "knee_rate"], [0.0, 8.0], True, "joint knee answers unlike in training (knee_r"),
        (["angle", "speed"], [0.0, -7.0], False, "speed changes unlike in training (speed -7.0 st"),
    ],
)
def test_cause_of_an_alarm(names, value, is_square, cause):
    charts = np.zeros((6, 2))
    charts[3 * is_square + 1] = value
    text = replace(learned(), limits=np.ones((6, 2))).cause(charts, 0.0, names)
    assert text.startswith(cause) and text.endswith(f"over {2 * TIME_CONSTANTS_S[1]:g} s)")
    assert not is_square or "3.0 times as irregular" in text


def test_too_little_motion_gives_levels_and_no_alarm():
    rows = [motion(0.1 * LEAST_MOTION_S, seed) for seed in range(6)]
    detector = ChangeDetector.fit(recorded(rows))
    assert np.isinf(detector.alarm_level) and learned().alarm_level == 1.0
    levels, alarms = detector.watch([motion(5.0, 12, ALWAYS)])
    assert levels.max() > 1.0 and alarms == []
    assert "extrapolated to one false alarm in" in learned().describe()
    with pytest.raises(ValueError, match="1 motions have three rows"):
        ChangeDetector.fit(recorded([few[: 2 + i] for i, few in enumerate(rows[:2])]))


def test_actual_robot_raises_no_alarm_after_its_motion_is_known():
    adapted = learned().with_motions([motion(MOTION_S, seed, ALWAYS, 0.1) for seed in range(7)])
    same, other = motion(300.0, 9, ALWAYS, 0.1), motion(5.0, 10, ALWAYS, -0.1)
    assert worst(same).max() > 1.0
    assert worst(same, adapted).max() < 1.0
    assert worst(other, adapted).max() > 1.0
    assert np.all(adapted.limits >= learned().limits)
    assert learned().with_motions([same[:2]]) is learned()
    # Three rows tell next to nothing.
    few = learned().with_motions([same[:3]])
    assert worst(same, few).max() > 1.0 and np.isfinite(few.limits).all()


def wild(duration_s, seed):
    """Motion with a rare shove, rows that repeat, and more noise than the nominal plant's."""
    rows = motion(duration_s, seed, slice(30, 36), 3.0, noise=0.02)
    rows[100:105] = rows[100]
    return rows


@pytest.mark.parametrize("num_pieces", [1, 30])
def test_little_motion_of_an_actual_robot_widens_no_limit(num_pieces):
    duration_s = 0.8 * LEAST_MOTION_S
    pieces = [wild(duration_s / num_pieces, seed) for seed in range(num_pieces)]
    adapted = learned().with_motions(pieces)
    for name in ("limits", "deviation", "longest_repeat", "alarm_level"):
        np.testing.assert_array_equal(getattr(adapted, name), getattr(learned(), name))
    assert "4 min of an actual robot's correct its prediction, 6 are needed" in adapted.describe()
    assert worst(motion(5.0, 10, ALWAYS, -0.4), adapted).max() > 1.0


def test_adapted_detector_is_read_to_the_bit():
    adapted = learned().with_motions([wild(MOTION_S, seed) for seed in range(8)])
    assert adapted.longest_repeat == 4 + 3  # As of a fitted one.
    text = adapted.describe()
    again = ChangeDetector.from_arrays(adapted.arrays())
    assert again.describe() == text and again.nominal.describe() == learned().describe()
    rows = [motion(MOTION_S, seed, ALWAYS, 0.1) for seed in range(8)]
    np.testing.assert_array_equal(worst(rows[0], again), worst(rows[0], adapted))
    assert same_detector(again.with_motions(rows), learned().with_motions(rows))


def lively(first_seed, num=40, info=INFO, **changes):
    """Episodes that begin with an impact, before their first row without a disturbance."""
    rows = [motion(3.0, first_seed + i, slice(0, 3), 9.0, noise=0.03) for i in range(num)]
    return recorded(rows, info, first_step=6, **changes)


def test_monitor_learns_safe_episodes_that_are_livelier_than_its_motion():
    assert not learned().describe_alarms(lively(2000))[1]
    undisturbed = recorded([motion(MOTION_S, seed) for seed in range(10)])
    both = ChangeDetector.fit(undisturbed, episodes=lively(1000, 60))
    assert both.describe_alarms(lively(2000))[1]
    assert worst(motion(5.0, 10, ALWAYS, -0.8), both).max() > 1.0
    # Unsafe episodes do not count.
    unsafe = lively(1000, 3, is_safe=False, cause="reach")
    expected = ("monitor: alarms in 0 of 0 safe episodes", True)
    assert learned().describe_alarms(unsafe) == expected


def test_motions_of_another_diagram_and_unknown_names_are_refused():
    def fit(**changes):
        motions = recorded([motion(3.0, 0), motion(3.0, 1)], replace(INFO, **changes))
        SafetyAssessment().fit(lively(0, 3), motions=motions)

    with pytest.raises(ValueError, match="motions and episodes differ in step_s"):
        fit(step_s=0.1)
    with pytest.raises(ValueError, match=r"monitored_states has \['wing'\], which are none of"):
        fit(monitored_states=["wing"])


def test_fit_warns_of_a_monitor_that_never_alarms(monkeypatch, caplog):
    monkeypatch.setattr(SafetyAssessment, "_learned", lambda *given: {})
    SafetyAssessment().fit(lively(0, 3), detector=learned())
    assert "never alarms" not in caplog.text
    SafetyAssessment().fit(lively(0, 3))
    assert "6 are needed: it reports levels and never alarms" in caplog.text


def test_motion_counts_from_its_first_step_until_shortly_before_it_leaves():
    rows = motion(5.0, 14)
    (kept,) = usual_rows(recorded([rows], first_step=3))
    np.testing.assert_array_equal(kept, rows[3:])
    (kept,) = usual_rows(recorded([rows], is_safe=False, cause="reach"))
    assert 0.1 < STEP_S * (len(rows) - len(kept)) < 2.0
    np.testing.assert_array_equal(kept, rows[: len(kept)])
