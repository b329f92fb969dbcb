import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from drake_safety.systems.safety_monitor import SafetyMonitor


class BoxSafeSet:
    """|q| ≤ 1 and |v| ≤ 2 for one coordinate."""

    names = ("position", "speed")

    def margins(self, q, v):
        return np.array([1.0 - abs(q[0]), 2.0 - abs(v[0])])


def monitored(state):
    monitor = SafetyMonitor(BoxSafeSet(), 1, 1)
    simulator = Simulator(monitor)
    context = simulator.get_mutable_context()
    monitor.GetInputPort("plant_state").FixValue(context, state)
    simulator.Initialize()
    return monitor, simulator, context


def outputs(monitor, context):
    safe = monitor.GetOutputPort("safe").Eval(context)
    return safe[0], monitor.GetOutputPort("margins").Eval(context)


def test_its_ports_have_the_promised_sizes():
    monitor = SafetyMonitor(BoxSafeSet(), 5, 4)
    assert monitor.GetInputPort("plant_state").size() == 9
    assert monitor.GetOutputPort("safe").size() == 1
    assert monitor.GetOutputPort("margins").size() == 2
    assert monitor.constraint_names == ["position", "speed"]


@pytest.mark.parametrize(
    ("state", "safe", "margins"),
    [
        ([0.25, -0.5], 1, [0.75, 1.5]),
        ([1.5, 0.0], 0, [-0.5, 2.0]),
        ([0.0, -3.0], 0, [1.0, -1.0]),
        ([1.0, 2.0], 1, [0.0, 0.0]),
    ],
)
def test_it_is_safe_exactly_while_no_margin_is_negative(state, safe, margins):
    monitor, _, context = monitored(state)
    assert outputs(monitor, context)[0] == safe
    np.testing.assert_allclose(outputs(monitor, context)[1], margins)


def test_the_state_at_the_start_is_already_judged():
    monitor, _, context = monitored([9.0, 0.0])
    assert outputs(monitor, context)[0] == 0


def test_margins_are_those_of_the_state_that_there_is():
    monitor, simulator, context = monitored([0.0, 0.0])
    simulator.AdvanceTo(0.05)
    for position, safe in ((5.0, 0), (0.5, 1)):
        monitor.GetInputPort("plant_state").FixValue(context, [position, 0.0])
        assert outputs(monitor, context)[0] == safe
        assert outputs(monitor, context)[1][0] == 1.0 - position


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("entry", [0, 1])
def test_a_state_that_is_not_finite_is_unsafe_by_minus_infinity(value, entry):
    state = np.zeros(2)
    state[entry] = value
    monitor, _, context = monitored(state)
    safe, margins = outputs(monitor, context)
    assert safe == 0
    np.testing.assert_array_equal(margins, [-np.inf, -np.inf])


def test_a_margin_that_is_no_number_is_not_safe():
    class Broken(BoxSafeSet):
        def margins(self, q, v):
            return np.array([np.nan, 1.0])

    monitor = SafetyMonitor(Broken(), 1, 1)
    simulator = Simulator(monitor)
    monitor.GetInputPort("plant_state").FixValue(simulator.get_mutable_context(), [0.0, 0.0])
    simulator.Initialize()
    assert outputs(monitor, simulator.get_context())[0] == 0
