import math
from types import SimpleNamespace

import numpy as np
import pytest

from cart_episodes import make_episode, make_info
from drake_safety import load_assessment, load_scenario
from drake_safety.evaluation import monitor_study
from drake_safety.evaluation.monitor_study import (
    Sequence60,
    false_alarms,
    monitor_estimates,
    run_monitored,
    sequences,
)
from drake_safety.evaluation.shift_study import CONFIDENT, Verdicts, assessment_judge
from drake_safety.learning.segments import Episodes

STEP_S = 0.5


class Detector:
    """The level is the first state, and something more."""

    step_s, alarm_level = STEP_S, 1.0

    def __init__(self, more=0.0):
        self.more = more

    def levels_of(self, motions):
        return self.more + np.concatenate(motions)[:, :1]


def motion(index, num_rows, *, probability=0.5, alarm=(), is_safe=True):
    """One whose level is 2 at some rows, and of which Γ says a probability."""
    state = np.full((num_rows, 3), probability)
    state[:, 0] = 0.0
    state[list(alarm), 0] = 2.0
    ending = dict(is_safe=is_safe, cause="" if is_safe else "wall", first_step=0)
    info = make_info(step_s=STEP_S)
    margins = np.ones((num_rows, 2))
    return make_episode(index, info, num_rows, state=state, margins=margins, **ending)


def judge(state, preview, features, is_outside):
    return Verdicts(probability=state[:, 1], is_unknown=state[:, 1] < 0.0)


def test_sequences_count_what_is_sure_and_wrong_until_the_alarm():
    # Γ is asked every second row, and speaks of the next five seconds.
    info = SimpleNamespace(step_s=1.0, num_steps=5)
    assessment = SimpleNamespace(detector_=Detector(), info_=info)
    motions = [
        motion(0, 20, probability=0.95, is_safe=False),
        motion(1, 20, probability=0.95, alarm=[4]),
        motion(2, 20, probability=CONFIDENT - 0.01, is_safe=False),
    ]
    first, second, third = sequences(motions, assessment, judge)
    assert (first.alarm_s, first.leave_s) == (12.0, 10.0)
    np.testing.assert_allclose(first.error_s, [5.0, 6.0, 7.0, 8.0, 9.0])
    assert (second.alarm_s, second.leave_s) == (2.0, 20.0)
    assert not len(second.error_s)
    assert (third.alarm_s, third.leave_s) == (22.0, 10.0)
    np.testing.assert_allclose(third.error_s, [15.0, 16.0, 17.0, 18.0, 19.0])
    # A sequence lasts a minute.
    quiet = [motion(i, 100) for i in range(2)] + [motion(2, 100, alarm=[50])]
    assert [one.alarm_s for one in sequences(quiet, assessment, judge)] == [
        math.inf,
        math.inf,
        25.0,
    ]


def test_estimates_are_of_all_sequences():
    errors = (np.arange(4.0, 24.0), np.array([]))
    found = monitor_estimates(
        [
            Sequence60(alarm_s=30.0, leave_s=40.0, error_s=errors[0]),
            Sequence60(alarm_s=2.0, leave_s=math.inf, error_s=errors[1]),
            Sequence60(alarm_s=1.0, leave_s=70.0, error_s=errors[1]),
            Sequence60(alarm_s=math.inf, leave_s=math.inf, error_s=errors[1]),
        ],
        step_s=1.0,
    )
    assert found["monitor.alarmed"].value == 0.75
    assert found["monitor.leaves"].value == 0.25
    assert found["monitor.delay_s"].value == 30.0
    assert found["monitor.delay_95_s"].value == math.inf
    assert found["monitor.delay_s"].low <= 2.0 and found["monitor.delay_s"].high == math.inf
    assert found["monitor.confident_error_10s"].value == pytest.approx(0.6 / 4)
    assert found["monitor.confident_error_60s"].value == pytest.approx(20 / 60 / 4)
    assert {one.n for one in found.values()} == {4}


def test_false_alarms_are_counted_once_a_motion_while_it_is_undisturbed():
    motions = [
        motion(0, 3600),
        motion(1, 1800, alarm=range(50, 90)),
        motion(2, 1801, alarm=[1800], is_safe=False),  # As it leaves.
    ]
    found = false_alarms(Episodes(make_info(step_s=STEP_S), motions), Detector())
    assert found.value == pytest.approx(1.0)
    assert (found.low < 1.0 < found.high, found.n) == (True, 3)


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
    found = sequences(quiet, gamma, assessment_judge(gamma))
    assert monitor_estimates(found, gamma.info_.step_s)["monitor.alarmed"].n == 2
