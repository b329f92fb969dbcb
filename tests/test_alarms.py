import math

import numpy as np
import pytest

from drake_safety.simulation.motion import Motion
from studies.alarms import Alarm, evaluate_alarms, first_alarm, lowest_value, tilt

PUSH_S, LEAVE_S, FALL_S, END_S = 1.0, 1.4, 1.8, 3.6


def motion_of(index, values, *, leaves=False, falls=False, push_time_s=PUSH_S):
    """A motion of one number: `values` by the time from which each holds."""
    end_s = FALL_S if falls else END_S
    time_s = np.round(np.arange(0.0, end_s + 0.05, 0.1), 9)
    state = np.ones((len(time_s), 1))
    for start_s, value in values.items():
        state[time_s >= start_s - 1e-9] = value
    rows = np.zeros((len(time_s), 1))
    return Motion(
        index=index,
        push_time_s=push_time_s,
        time_s=time_s,
        ports={"state": state, "desired_preview": rows, "features": rows, "margins": rows},
        leave_time_s=LEAVE_S if leaves else math.inf,
        fall_time_s=FALL_S if falls else math.inf,
    )


SEEN = Alarm(name="sharpened", value=lambda motion: motion["state"][:, 0])
CALM = [motion_of(i, {1.1: 0.9 - 0.01 * i}) for i in range(20)]
TEST = [
    motion_of(0, {1.1: 0.2}, leaves=True, falls=True),
    motion_of(1, {1.3: 0.2}, leaves=True),
    motion_of(2, {1.5: 0.2}, leaves=True, falls=True),
    motion_of(3, {0.3: 0.2, 0.5: 1.0}, leaves=True),
    motion_of(4, {2.0: 0.2}),
    motion_of(5, {}),
]


def figures_of(motions, num_rows=1):
    found = evaluate_alarms([SEEN], CALM, motions, num_rows=num_rows)
    return {".".join(key[1:]): estimate.value for key, estimate in found.items()}


def test_an_alarm_between_push_and_leaving_is_a_detection_and_any_other_is_false():
    found = figures_of(TEST)
    # The first two in time, the third too late but before the fall, the fourth only too early.
    assert found["sharpened.detected"] == 2 / 4
    assert found["sharpened.lead_to_leaving_s"] == pytest.approx(0.0)
    assert found["motions.leave_safe_set"] == 4 / 6
    # One in two safe motions of 3.6 s each.
    assert found["sharpened.false_alarms_per_hour"] == pytest.approx(500)
    # Motions that leave before the push are left out.
    early = motion_of(6, {}, leaves=True, push_time_s=2.0)
    unpushed = motion_of(7, {}, leaves=True, push_time_s=math.inf)
    assert figures_of([*TEST, early, unpushed]) == found


def test_an_unknown_row_is_an_alarm():
    motion = motion_of(0, {2.0: np.nan})
    value = motion["state"][:, 0]
    assert first_alarm(motion, value, -1e9) == 2.0
    assert first_alarm(motion, value, 0.5, since_s=2.25) == pytest.approx(2.3)
    assert lowest_value(motion, value) == -math.inf
    assert first_alarm(motion_of(0, {}), np.ones(37), 1.0) == math.inf


def test_tilt_is_the_angle_to_the_vertical_whatever_the_yaw():
    about_x = np.array([0.3, 0.0, 0.0])
    yaw = np.array([0.0, 0.0, 2.0])
    # Half a turn about a horizontal axis, and about one at 45 degrees.
    upside_down = np.pi * np.array([0.6, 0.8, 0.0])
    sideways = np.pi * np.array([np.sqrt(0.5), 0.0, np.sqrt(0.5)])
    angles = tilt(np.array([about_x, yaw, upside_down, sideways, np.zeros(3)]))
    assert angles == pytest.approx([0.3, 0.0, np.pi, np.pi / 2, 0.0], abs=1e-7)
    assert np.isnan(tilt(np.full((1, 3), np.nan))).all()
