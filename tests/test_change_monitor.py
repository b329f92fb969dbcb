from types import SimpleNamespace

import numpy as np
import pytest

from drake_safety import ChangeMonitor
from sprung_motions import HORIZON, INFO, STEP_S, learned, motion
from system_doubles import Played

pytestmark = pytest.mark.train

PUSHED = slice(100, 140)


class Monitored(Played):
    """A monitor to which rows of (state, desired preview, features) are played."""

    def __init__(self, rows, **hold):
        parts = np.split(rows, [2, 2 + HORIZON], axis=1)
        inputs = dict(zip(("state", "desired_preview", "features"), parts, strict=True))
        assessment = SimpleNamespace(info_=INFO, detector_=learned())
        super().__init__(ChangeMonitor(assessment), STEP_S, **inputs, **hold)

    def history(self):
        """Returns the levels, the alarm and its cause after each row."""
        levels, alarm, cause = super().history("levels", "alarm", "alarm_cause").values()
        return levels, alarm[:, 0], cause.tolist()


def test_a_diagram_and_rows_have_the_same_levels_and_alarms():
    rows = np.concatenate([motion(30.0, 50, PUSHED), motion(2.0, 51, slice(0, None))])
    levels, alarm, cause = Monitored(rows).history()
    expected, alarms = learned().watch([rows], INFO.state_names)
    np.testing.assert_allclose(levels, expected, atol=1e-4)  # Single precision in one of them.
    assert not levels[:2].any() and len(alarms) >= 2
    begin, end, said = alarms[-2]
    assert 100 < begin < 140 < end < 600 and "joint knee answers unlike in training" in said
    assert alarms[-1].end == len(rows)
    expected = np.zeros(len(rows))
    for each in alarms:
        expected[each.begin : each.end] = 1.0
        assert {*cause[each.begin : each.end]} == {each.cause} != {""}
    np.testing.assert_array_equal(alarm, expected)
    frozen = np.tile(rows[0], (6, 1))
    levels, _, _ = Monitored(frozen).history()
    np.testing.assert_allclose(levels, learned().watch([frozen])[0], atol=1e-5)


def test_it_waits_while_it_is_held():
    hold = np.zeros((300, 1))
    hold[PUSHED] = 1.0
    rows = motion(15.0, 50)
    rows[PUSHED] = rows[100]  # Frozen.
    levels, alarm, _ = Monitored(rows, hold=hold).history()
    assert not alarm.any()
    # And for half a second, ten rows, after it.
    np.testing.assert_array_equal(levels[100:151], np.tile(levels[99], (51, 1)))
    assert not np.array_equal(levels[151], levels[99])


@pytest.mark.parametrize(
    ("intervals", "waits"),
    [
        ([(5.0, 6.95)], [(100, 151)]),
        ([(1.0, 1.5), (2.2, 2.3)], [(20, 58)]),  # Before the first has settled, which is extended.
        ([(-1.0, 0.0)], [(0, 12)]),  # As a push at the start.
    ],
)
def test_it_waits_during_disturbances_that_are_announced(intervals, waits):
    played = Monitored(motion(10.0, 50))
    for interval in intervals:
        played.system.expect_disturbance(played.context, *interval)
    levels, _, _ = played.history()
    is_same = (levels[1:] == levels[:-1]).all(axis=1)
    for begin, end in waits:
        assert is_same[begin : end - 1].all() and not is_same[end - 1]
    assert is_same.sum() == sum(end - max(begin, 1) for begin, end in waits) + (waits[0][0] > 0)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_inputs_that_are_not_finite_are_left_out(value):
    rows = motion(4.0, 50)
    rows[40, 1] = value
    levels, alarm, _ = Monitored(rows).history()
    assert np.isfinite(levels).all() and not alarm.any()
    np.testing.assert_allclose(levels, learned().watch([rows])[0], atol=1e-4)
    share = 1.0 - learned().rates[-1]
    assert levels[42].min() == pytest.approx(2.0 * (1.0 - share**3))


@pytest.mark.parametrize(
    ("lost", "share", "is_blind"),
    [(slice(2, None, 5), 0.4, True), (slice(0, None, 15), 0.8, False)],
)
def test_a_monitor_that_judges_too_few_inputs_raises_an_alarm(lost, share, is_blind):
    rows = motion(10.0, 50)
    rows[lost, 2 + HORIZON] = np.nan  # A feature.
    played = Monitored(rows)
    levels, alarm, cause = played.history()
    assert alarm[-1] == is_blind and cause[-1].startswith("blind: " * is_blind)
    judged = played.system.GetOutputPort("judged_share").Eval(played.context)[0]
    assert judged == pytest.approx(share, abs=0.08)
    expected, alarms = learned().watch([rows], INFO.state_names)
    np.testing.assert_allclose(levels, expected, atol=1e-4)
    assert [each.cause for each in alarms] == [cause[-1]] * is_blind


def test_a_bias_is_seen_between_missing_inputs():
    rows = motion(20.0, 50, slice(0, None))
    rows[::8, 1] = np.nan
    _, alarm, cause = Monitored(rows).history()
    assert alarm[-1] and "joint knee answers unlike in training" in cause[-1]


def test_it_adopts_the_detector_of_an_adapted_assessment():
    known = [motion(60.0, seed, slice(0, None)) for seed in range(7)]
    adapted, rows = learned().with_motions(known), motion(3.0, 79, slice(0, None))
    played = Monitored(rows)
    played.system.adopt(played.context, SimpleNamespace(detector_=adapted))
    levels, alarm, _ = played.history()
    np.testing.assert_allclose(levels, adapted.watch([rows])[0], atol=1e-4)
    assert not alarm.any() and Monitored(rows).history()[1].any()
