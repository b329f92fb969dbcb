from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from drake_safety import ChangeMonitor, load_assessment, load_scenario
from drake_safety.systems.change_monitor import RECOVERY_S
from two_masses import INFO, NUM_SEEN, NUM_STATES, STEP_S, detector, motions

pytestmark = pytest.mark.train


class Played:
    """A diagram that plays rows of (state, desired preview, features), row k at step k."""

    def __init__(self, rows, found=None, hold=None):
        builder = DiagramBuilder()
        learned = SimpleNamespace(info_=INFO, detector_=found or detector())
        self.monitor = builder.AddSystem(ChangeMonitor(learned))
        times = STEP_S * (np.arange(len(rows) + 1) - 0.5)
        parts = np.split(rows, [NUM_STATES, NUM_SEEN], axis=1)
        inputs = dict(zip(("state", "desired_preview", "features"), parts, strict=True))
        if hold is not None:
            inputs["hold"] = hold[:, None]
        for name, values in inputs.items():
            held = np.vstack([values, values[-1:]]).T
            source = TrajectorySource(PiecewisePolynomial.ZeroOrderHold(times, held))
            port = builder.AddSystem(source).get_output_port()
            builder.Connect(port, self.monitor.GetInputPort(name))
        self.simulator = Simulator(builder.Build())
        self.context = self.monitor.GetMyMutableContextFromRoot(
            self.simulator.get_mutable_context()
        )
        self.num_rows = len(rows)

    def told(self, port):
        return np.copy(self.monitor.GetOutputPort(port).Eval(self.context))

    def history(self):
        """Levels, alarm and cause after each row."""
        seen = []
        for row in range(self.num_rows):
            self.simulator.AdvanceTo((row + 0.25) * STEP_S)
            seen.append((self.told("levels"), self.told("alarm")[0], str(self.told("alarm_cause"))))
        return tuple(np.array(each) for each in zip(*seen, strict=True))


def nominal(duration_s, **frozen):
    """Rows of the nominal plant, and as if its inputs were frozen from a time to another [s]."""
    (rows,) = motions(1, 77, duration_s=duration_s)
    if frozen:
        start, end = (round(time_s / STEP_S) for time_s in frozen.values())
        rows[start:end] = rows[start]
    return rows


def test_its_levels_are_those_of_the_detector():
    rows = nominal(3.0, since_s=0.0, until_s=0.3)
    rows[30:, 1] += 0.02  # An offset of a sensor.
    levels, _, _ = Played(rows).history()
    np.testing.assert_allclose(levels, detector().levels_of([rows]), rtol=1e-4, atol=1e-4)
    assert not levels[:2].any() and levels[30:].max() > 1.0


def test_an_alarm_ends_when_all_levels_were_below_their_limits_long_enough():
    levels, alarm, cause = Played(nominal(16.0, since_s=3.5, until_s=4.0)).history()
    is_over, calm = levels.max(axis=1) > 1.0, round(RECOVERY_S / STEP_S)
    first, last = np.flatnonzero(is_over)[[0, -1]]
    assert 3.5 < first * STEP_S < 4.0
    assert not alarm[:first].any() and alarm[first : last + calm - 1].all()
    assert not alarm[last + calm + 2 :].any() and last + calm + 2 < len(alarm)
    # It says what was seen first, though by then the charts have changed.
    assert len(set(cause)) == 2
    np.testing.assert_array_equal(cause != "", alarm == 1.0)


def test_it_waits_while_it_is_held():
    rows, hold = nominal(6.0, since_s=2.0, until_s=4.0), np.zeros(120)
    hold[40:81] = 1.0
    levels, alarm, _ = Played(rows, hold=hold).history()
    assert not alarm.any()
    np.testing.assert_array_equal(levels[40:83], np.tile(levels[39], (43, 1)))
    assert not np.array_equal(levels[83], levels[39])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_inputs_that_are_not_finite_are_left_out(value):
    rows = nominal(4.0)
    rows[40, 3] = value
    levels, alarm, _ = Played(rows).history()
    assert np.isfinite(levels).all() and not alarm.any()
    np.testing.assert_array_equal(levels[40:43], np.tile(levels[39], (3, 1)))
    assert not np.array_equal(levels[43], levels[39])


def test_a_reset_ends_the_alarm_and_empties_the_charts():
    played = Played(nominal(4.0, since_s=0.2, until_s=4.0))
    played.simulator.AdvanceTo(2.0)
    assert played.told("alarm") == 1.0 and played.told("levels").any()
    played.monitor.reset(played.context)
    assert played.told("alarm") == 0.0 and not played.told("levels").any()
    assert played.told("alarm_cause") == ""


def test_it_adopts_the_detector_of_an_adapted_assessment():
    (rows,) = motions(1, 78, force=(0.01, 0.0), duration_s=3.0)
    adapted = detector().with_motions(motions(2, 79, force=(0.01, 0.0)))
    played = Played(rows)
    played.monitor.adopt(played.context, SimpleNamespace(detector_=adapted))
    levels, alarm, _ = played.history()
    np.testing.assert_allclose(levels, adapted.levels_of([rows]), rtol=1e-4, atol=1e-4)
    assert not alarm.any() and Played(rows).history()[1].any()


def test_without_limits_it_reports_levels_and_never_alarms():
    unlimited = replace(detector(), alarm_level=np.inf)
    levels, alarm, _ = Played(nominal(3.0, since_s=1.0, until_s=3.0), unlimited).history()
    assert levels.max() > 1.0 and not alarm.any()


@pytest.mark.parametrize("on_alarm", ["unknown", "report"])
def test_a_scenario_says_what_an_alarm_does(on_alarm):
    scenario = load_scenario("laikago_balancing")
    scenario.on_alarm = on_alarm
    loop = scenario.make_loop("nominal", assessment=load_assessment("laikago_balancing"))
    assert loop.GetOutputPort("alarm").size() == 1
    assert loop.GetOutputPort("levels").size() == len(loop.state_names)
    evaluator = loop.GetSubsystemByName("safety_assessor").evaluator
    assert evaluator.HasInputPort("alarm") == (on_alarm == "unknown")
