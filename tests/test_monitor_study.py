import math
from types import SimpleNamespace

import numpy as np
import pytest

from cart_episodes import make_episode, make_info
from drake_safety import load_assessment, load_scenario
from drake_safety.evaluation import monitor_study
from drake_safety.evaluation.monitor_study import (
    false_alarms,
    monitor_estimates,
    monitored,
    run_monitored,
)
from drake_safety.evaluation.shift_study import CONFIDENT, assessment_judge
from drake_safety.learning.change_detector import Alarm
from drake_safety.learning.segments import Episodes

STEP_S = 0.5


class Detector:
    """Its level is the first state, and something more; an alarm lasts while it is above 1."""

    step_s = STEP_S

    def __init__(self, more=0.0):
        self.more = more

    def watch(self, motions):
        levels = self.more + np.concatenate(motions)[:, :1]
        ends = np.flatnonzero(np.diff(levels[:, 0] > 1.0, prepend=False, append=False))
        return levels, [Alarm(*pair, "seen") for pair in ends.reshape(-1, 2).tolist()]


def motion(index, num_rows, *, probability=0.5, alarm=(), is_safe=True):
    """One with an alarm at some rows, and of which Γ says a probability."""
    state = np.full((num_rows, 3), probability)
    state[:, 0] = 0.0
    state[list(alarm), 0] = 2.0
    ending = dict(is_safe=is_safe, cause="" if is_safe else "wall", first_step=0)
    margins = np.ones((num_rows, 2))
    info = make_info(step_s=STEP_S)
    return make_episode(index, info, num_rows, state=state, margins=margins, **ending)


def judge(state, preview, features, is_outside):
    return np.where(state[:, 1] > 1.0, np.nan, state[:, 1])


def test_a_minute_goes_on_with_the_next_motions_and_an_alarm_is_dont_know():
    # Γ is asked every second row, and speaks of the next five seconds.
    info = SimpleNamespace(step_s=1.0, num_steps=5)
    assessment = SimpleNamespace(detector_=Detector(), info_=info)
    motions = [
        motion(0, 20, probability=0.95, is_safe=False),
        motion(1, 20, probability=0.95, alarm=[4]),
        motion(2, 20, probability=CONFIDENT - 0.01, is_safe=False),
        motion(3, 20, probability=0.95, is_safe=False, alarm=range(12, 16)),
        motion(4, 20, probability=1.01, is_safe=False),
    ]
    found = monitored(motions, assessment, judge)
    np.testing.assert_array_equal(found["alarm_s"], [12.0, 2.0, 16.0, 6.0, 22.0])
    np.testing.assert_array_equal(found["leave_s"], [10.0, 20.0, 10.0, 10.0, 10.0])
    np.testing.assert_allclose(found["least"], [0.95, math.nan, CONFIDENT - 0.01, 0.95, 0.0])
    # The first is wrong for 5 s, the fourth for 5 s with and 3 s without the alarm.
    np.testing.assert_array_equal(found["silent_error_s"][:, 0], [5.0, 0.0, 0.0, 5.0, 0.0])
    np.testing.assert_array_equal(found["error_s"][:, 0], [5.0, 0.0, 0.0, 3.0, 0.0])
    np.testing.assert_array_equal(found["silent_error_s"][:, 1], [10.0] * 5)
    np.testing.assert_array_equal(found["error_s"][:, 1], [8.0] * 5)
    late = [motion(i, 100, is_safe=i != 1) for i in range(2)] + [motion(2, 100, alarm=[50])]
    found = monitored(late, assessment, judge)
    np.testing.assert_array_equal(found["alarm_s"], [math.inf, math.inf, 25.0])
    np.testing.assert_array_equal(found["leave_s"], [math.inf, 50.0, math.inf])


def test_estimates_are_of_all_minutes():
    found = monitor_estimates(
        {
            "alarm_s": np.array([30.0, 2.0, 1.0, np.inf]),
            "leave_s": np.array([40.0, np.inf, np.inf, np.inf]),
            "error_s": np.array([[6.0, 20.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]),
            "silent_error_s": np.array([[6.0, 20.0], [0.0, 4.0], [0.0, 0.0], [0.0, 0.0]]),
            "least": np.array([np.nan, np.nan, np.nan, np.nan]),
        }
    )
    assert found["monitor.alarmed"].value == 0.75
    assert found["monitor.leaves"].value == 0.25
    assert found["monitor.delay_s"].value == 30.0
    assert found["monitor.delay_s"].low <= 2.0 and found["monitor.delay_s"].high == math.inf
    assert found["monitor.delay_95_s"].value == math.inf
    assert found["monitor.confident_error_10s"].value == pytest.approx(0.6 / 4)
    assert found["monitor.confident_error_60s"].value == pytest.approx(20 / 60 / 4)
    assert found["monitor.silent_confident_error_60s"].value == pytest.approx(24 / 60 / 4)
    assert {one.n for one in found.values()} == {4}


def test_a_promise_is_missed_where_neither_threshold_nor_alarm_announces_the_end():
    found = {
        "alarm_s": np.array([30.0, 2.0, 1.0, np.inf, 9.0]),
        "leave_s": np.array([20.0, 4.0, 5.0, 60.0, 9.5]),
        "error_s": np.zeros((5, 2)),
        "silent_error_s": np.zeros((5, 2)),
        "least": np.array([0.8, 0.7, 0.3, 0.3, np.nan]),
    }
    assert "monitor.missed" not in monitor_estimates(found)
    estimates = monitor_estimates(found, SimpleNamespace(threshold=0.7))
    assert (estimates["monitor.silent_missed"].value, estimates["monitor.missed"].value) == (
        0.5,
        0.25,
    )
    assert estimates["monitor.missed"].n == 4


def test_false_alarms_are_those_of_undisturbed_motion():
    motions = [
        motion(0, 3600, alarm=[7]),
        motion(1, 1800, alarm=[*range(50, 90), *range(200, 240)]),
        motion(2, 1801, alarm=[1800], is_safe=False),  # As it leaves.
    ]
    found = false_alarms(Episodes(make_info(step_s=STEP_S), motions), Detector())
    assert found.value == pytest.approx(3.0)
    assert (found.low < 3.0 < found.high, found.n) == (True, 3)


@pytest.mark.train
def test_only_motions_without_an_alarm_are_simulated_to_the_end(monkeypatch):
    monkeypatch.setattr(monitor_study, "_FIRST_S", 0.4)
    monkeypatch.setattr(monitor_study, "SPANS_S", (0.5, 1.0))
    scenario, gamma = load_scenario("laikago_balancing"), load_assessment("laikago_balancing")
    quiet, alarmed = (
        run_monitored(scenario, "payload", 2, 5, Detector(more), num_workers=1)
        for more in (-10.0, 10.0)
    )
    assert [round(one.time_s[-1], 9) for one in quiet] == [1.0, 1.0]
    assert [round(one.time_s[-1], 9) for one in alarmed] == [0.4, 0.4]
    assert not np.array_equal(quiet[0].state, quiet[1].state)
    for one, other in zip(quiet, alarmed, strict=True):
        np.testing.assert_array_equal(one.state[: len(other.state)], other.state)
        assert np.ptp(one.features, axis=0).any()
    found = monitored(quiet, gamma, assessment_judge(gamma))
    assert monitor_estimates(found)["monitor.alarmed"].n == 2
