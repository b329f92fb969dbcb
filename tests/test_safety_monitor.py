import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from drake_safety.systems.safety_monitor import SafetyMonitor


class BoxSafeSet:
    """|q| ≤ 1 and |v| ≤ 2 for one coordinate."""

    names = ("position", "speed")

    def margins(self, q, v):
        return np.array([1.0 - abs(q[0]), 2.0 - abs(v[0])])


def monitored(state, safe_set=BoxSafeSet):
    monitor = SafetyMonitor(safe_set(), 1, 1)
    simulator = Simulator(monitor)
    context = simulator.get_mutable_context()
    monitor.GetInputPort("plant_state").FixValue(context, state)
    simulator.Initialize()
    return monitor, simulator, context


def outputs(monitor, context):
    safe = monitor.GetOutputPort("safe").Eval(context)
    return safe[0], monitor.GetOutputPort("margins").Eval(context)


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


def test_margins_are_those_of_the_state_that_there_is():
    monitor, simulator, context = monitored([0.0, 0.0])
    assert monitor.constraint_names == ["position", "speed"]
    simulator.AdvanceTo(0.05)
    for position, safe in ((5.0, 0), (0.5, 1)):
        monitor.GetInputPort("plant_state").FixValue(context, [position, 0.0])
        assert outputs(monitor, context)[0] == safe
        assert outputs(monitor, context)[1][0] == 1.0 - position


def test_a_margin_that_is_no_number_is_not_safe():
    class Broken(BoxSafeSet):
        def margins(self, q, v):
            return np.array([np.nan, 1.0])

    monitor, _, context = monitored([0.0, 0.0], Broken)
    assert outputs(monitor, context)[0] == 0
