from dataclasses import replace

import numpy as np
import pytest

from drake_safety.learning.change_detector import (
    FALSE_ALARMS_PER_HOUR,
    LEAST_MOTION_S,
    TIME_CONSTANTS_S,
    ChangeDetector,
    usual_rows,
)
from two_masses import INFO, MOTION_S, STEP_S, WATCHED, A, detector, motions, recorded

pytestmark = pytest.mark.train


def worst(rows, found=None):
    """Largest level at each row of consecutive motions."""
    return (found or detector()).levels_of(rows).max(axis=1)


def slowly(found, rows):
    """Levels and charts after each row of consecutive motions, one after another."""
    charts, levels = np.zeros((6, len(found.watched))), np.zeros(len(found.watched))
    seen = []
    for one in rows:
        x, state, repeats = one[:, found.columns], one[:, found.watched], 0
        for k in range(len(one)):
            repeats = repeats + 1 if k > 0 and np.array_equal(x[k], x[k - 1]) else 0
            if k > 1:
                z = found.innovation(x[k - 1], x[k - 2], state[k] - state[k - 1])
                charts = charts.copy()
                for i, memory_s in enumerate(TIME_CONSTANTS_S):
                    weight = min(STEP_S / memory_s, 1.0)
                    charts[i] += weight * (z - charts[i])
                    charts[i + 3] += weight * (z**2 - 1.0 - charts[i + 3])
                of_charts = np.vstack([np.abs(charts[:3]), charts[3:]]) / found.limits
                levels = np.maximum(of_charts.max(axis=0), repeats / found.longest_repeat)
            seen.append((levels, charts))
    return tuple(np.array(each) for each in zip(*seen, strict=True))


def test_levels_are_those_of_the_recursion_over_consecutive_motions():
    rows = motions(4, 20, force=(0.01, 0.0), duration_s=2.0)
    rows[1] = rows[1][:2]  # Too short for an innovation: the charts keep their values.
    rows[2][20:30] = rows[2][20]
    levels, charts = slowly(detector(), rows)
    np.testing.assert_allclose(detector().levels_of(rows), levels, rtol=1e-4, atol=1e-4)
    assert not levels[:2].any() and levels[2:].min() > 0.0
    one = [found[-1] for found in (charts, levels)]
    np.testing.assert_allclose(detector().levels(one[0]), one[1])
    assert not detector().levels_of([rows[1]]).any()


def test_hours_of_the_same_plant_raise_no_more_alarms_than_promised():
    hours = 3.0
    alarms = sum(worst([one]).max() > 1.0 for one in motions(round(hours * 3600 / MOTION_S), 2))
    assert alarms <= 1 + hours * FALSE_ALARMS_PER_HOUR


@pytest.mark.parametrize(
    ("change", "within_s"),
    [
        ({"force": (0.004, 0.0)}, 5.0),
        ({"force": (0.0, -0.01)}, 1.0),
        ({"plant": A - 0.05 * np.eye(4)[[0, 1, 3, 2]] * [0, 0, 1, 1]}, 5.0),
        ({"noise": 0.02}, 1.0),
    ],
)
def test_a_changed_plant_or_sensor_is_noticed(change, within_s):
    assert worst(motions(1, 3, duration_s=within_s, **change)).max() > 1.0


def test_one_impact_is_noticed_for_less_than_a_second():
    rows = motions(1, 4)
    rows[0][200:, 1:5] += [0.0, 0.0, 5.0, 0.0]
    rows[0][201:, 1:5] -= [0.0, 0.0, 5.0, 0.0]
    found = np.flatnonzero(worst(rows) > 1.0)
    assert len(found) and found.min() >= 200 and found.max() < 200 + 1.0 / STEP_S


def test_a_frozen_input_is_noticed_after_few_repeats():
    rows = motions(1, 5)
    rows[0][205:] = rows[0][205]
    first = int(np.argmax(worst(rows) > 1.0))
    assert 205 < first <= 205 + detector().longest_repeat + 1
    _, charts = slowly(detector(), [rows[0][:first]])
    assert detector().cause(charts[-1], detector().longest_repeat + 1, WATCHED) == "inputs frozen"


def test_the_cause_names_the_state_that_is_pushed():
    _, charts = slowly(detector(), motions(1, 6, force=(0.0, -0.005), duration_s=5.0))
    said = detector().cause(charts[-1], 0.0, WATCHED)
    assert said.startswith("joint b answers unlike in training (b_rate -")


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
    two = replace(detector(), limits=np.ones((6, 2)), watched=np.arange(2))
    charts = np.zeros((6, 2))
    charts[3 * is_square + 1] = value
    cause = two.cause(charts, 0.0, names)
    assert cause.startswith(said)
    assert cause.endswith(f"over {2 * TIME_CONSTANTS_S[1]:g} s)")
    assert not is_square or "3.0 times as irregular" in cause


def test_too_little_motion_gives_levels_and_no_alarm():
    found = ChangeDetector.fit(recorded(motions(6, 11, duration_s=0.2 * LEAST_MOTION_S)))
    assert not found.has_limits and detector().has_limits
    assert worst(motions(1, 12, force=(0.05, 0.0)), found).max() > 1.0
    assert np.isinf(found.alarm_level)
    assert "never alarms" in found.describe()
    assert "at most one false alarm in" in detector().describe()
    with pytest.raises(ValueError, match="1 motions have three rows; two are needed"):
        ChangeDetector.fit(recorded([one[: 2 + i] for i, one in enumerate(motions(2, 13))]))


def test_what_an_actual_robot_does_is_no_alarm_after_its_motion_is_known():
    change = {"force": (0.01, 0.0)}
    adapted = detector().with_motions(motions(4, 8, **change))
    same, other = motions(5, 9, **change), motions(1, 10, force=(0.0, 0.02))
    assert worst(same).max() > 1.0
    assert worst(same, adapted).max() < 1.0
    assert worst(other, adapted).max() > 1.0
    assert np.all(adapted.limits >= detector().limits)
    assert detector().with_motions([one[:2] for one in same]) is detector()
    # Three rows tell next to nothing.
    few = detector().with_motions([same[0][:3]])
    assert worst(same, few).max() > 1.0 and np.isfinite(few.limits).all()


def test_motion_counts_from_its_first_step_until_shortly_before_it_leaves():
    (rows,) = motions(1, 14)
    state = slice(0, len(INFO.state_names))
    kept = usual_rows(recorded([rows], first_step=3))
    np.testing.assert_array_equal(kept[0][:, state], rows[3:, state])
    (kept,) = usual_rows(recorded([rows], is_safe=False, cause="edge"))
    lost_s = STEP_S * (len(rows) - len(kept))
    assert 0.1 < lost_s < 2.0
    np.testing.assert_array_equal(kept, rows[: len(kept)])


def test_a_detector_is_made_of_its_arrays_and_damaged_ones_are_refused():
    arrays, rows = detector().arrays(), motions(1, 15)
    again = ChangeDetector.from_arrays(arrays)
    np.testing.assert_array_equal(again.levels_of(rows), detector().levels_of(rows))
    assert again.describe() == detector().describe()
    assert (again.alarm_level, again.longest_repeat) == (1.0, detector().longest_repeat)
    for name in ("limits", "settings", "predictor.mean", "predictor.hidden.1.bias"):
        with pytest.raises(ValueError, match=f"the shape of its detector.{name} is"):
            ChangeDetector.from_arrays(arrays | {name: arrays[name][..., :-1]})


@pytest.mark.parametrize("name", ["monitored_states", "monitored_features"])
def test_names_that_are_none_of_the_loops_are_refused(name):
    info = replace(INFO, **{name: ["wing"]})
    with pytest.raises(ValueError, match=rf"{name} has \['wing'\], which are none of"):
        ChangeDetector.fit(recorded(motions(2, 16, duration_s=1.0), info))
