import re
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from drake_safety import Fault, SensorFaults

NAMES = ["slow", "fast_1", "fast_2"]
PERIOD_S = 0.1
RATES = np.array([1.0, 10.0, -20.0])
SHIFTS_PAGE = Path(__file__).resolve().parents[1] / "docs/shifts.md"


class Bench:
    """A signal ``5 + RATES t`` with faults."""

    def __init__(self, *faults, period_s=PERIOD_S):
        builder = DiagramBuilder()
        line = PiecewisePolynomial.FirstOrderHold([0.0, 9.0], 5.0 + np.outer(RATES, [0.0, 9.0]))
        source = builder.AddSystem(TrajectorySource(line))
        self.system = builder.AddSystem(SensorFaults(NAMES, faults, period_s=period_s))
        builder.Connect(source.get_output_port(), self.system.GetInputPort("input"))
        builder.ExportOutput(self.system.GetOutputPort("output"), "output")
        self.simulator = Simulator(builder.Build())
        self.context = self.simulator.get_mutable_context()
        self.own = self.system.GetMyMutableContextFromRoot(self.context)

    def at(self, time_s):
        """Input and output at a later time, as a system with an event then reads them."""
        self.simulator.AdvanceTo(time_s)
        output = self.system.get_output_port().Eval(self.own)
        return self.system.GetInputPort("input").Eval(self.own), output


def true(time_s):
    return 5.0 + RATES * time_s


@pytest.mark.parametrize(
    "faults",
    [
        [],
        [Fault(kind=kind, value=1.0, start_s=8.0) for kind in ("bias", "drift", "scale")],
        [Fault(kind="delay", value=0.5, start_s=8.0), Fault(kind="delay", value=0.0)],
        [Fault(kind=kind, start_s=8.0) for kind in ("zero", "freeze")],
    ],
)
def test_without_faults_and_before_their_start_the_bits_pass(faults):
    bench = Bench(*faults)
    for time_s in (0.0, 0.05, 0.1, 1.0, 1.03, 7.9):
        sent, passed = bench.at(time_s)
        assert passed.tobytes() == sent.tobytes()


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (Fault(kind="bias", value=0.5), true(1.25) + 0.5),
        (Fault(kind="drift", value=0.5, start_s=1.0), true(1.25) + 0.125),
        (Fault(kind="zero"), np.zeros(3)),
        (Fault(kind="scale", value=2.0, entries=["slow"]), true(1.25) * [2.0, 1.0, 1.0]),
        # Samples at multiples of 0.1 s; a reader between two finds the earlier one.
        (Fault(kind="delay", value=0.3), true(1.0)),
        (Fault(kind="freeze", start_s=0.85), true(0.8)),
        (Fault(kind="fade", value=2.5, entries=["slow"]), true(1.25) * [0.5, 1.0, 1.0]),
        (Fault(kind="fade", value=1.0), np.zeros(3)),
    ],
)
def test_each_fault_by_hand(fault, expected):
    np.testing.assert_allclose(Bench(fault).at(1.25)[1], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("fault", "ages"),
    [
        (Fault(kind="delay", value=0.1), [0, 1, 1, 1, 1]),
        (Fault(kind="delay", value=0.3), [0, 1, 2, 3, 3]),
        (Fault(kind="delay", value=0.3, start_s=0.2), [0, 0, 2, 3, 3]),
        (Fault(kind="freeze", start_s=0.2), [0, 0, 1, 2, 3]),
    ],
)
def test_at_the_samples_a_fault_shows_an_input_of_exact_age(fault, ages):
    bench = Bench(fault)
    for k, age in enumerate(ages):
        np.testing.assert_allclose(bench.at(k * PERIOD_S)[1], true((k - age) * PERIOD_S))


def test_a_delay_between_two_samples_and_an_entry_that_is_not_there_are_refused():
    with pytest.raises(ValueError, match="no entry 'slov'; they are"):
        Bench(Fault(kind="zero", entries=["slov"]))
    delay = Fault(kind="delay", value=0.004)
    with pytest.raises(ValueError, match=r"multiple of the period 0\.01 s"):
        Bench(delay, period_s=0.01)
    np.testing.assert_allclose(Bench(delay, period_s=0.002).at(1.0)[1], true(0.996))


def test_a_fade_ends_at_the_rest():
    system = SensorFaults(NAMES, [Fault(kind="fade", value=4.0)], period_s=PERIOD_S)
    context = system.CreateDefaultContext()
    context.SetTime(1.0)
    system.GetInputPort("input").FixValue(context, np.zeros(3))
    system.GetInputPort("rest").FixValue(context, RATES)
    np.testing.assert_allclose(system.get_output_port().Eval(context), 0.25 * RATES)
    with pytest.raises(ValueError, match="value of 'fade' must be positive; got 0"):
        Fault(kind="fade", value=0.0)


def test_faults_act_one_after_the_other():
    add, double = Fault(kind="bias", value=1.0), Fault(kind="scale", value=2.0)
    np.testing.assert_allclose(Bench(add, double).at(1.0)[1], 2.0 * (true(1.0) + 1.0))
    np.testing.assert_allclose(Bench(double, add).at(1.0)[1], 2.0 * true(1.0) + 1.0)
    late = Bench(Fault(kind="drift", value=1.0), Fault(kind="delay", value=0.2)).at(1.0)[1]
    np.testing.assert_allclose(late, true(0.8) + 0.8)


def test_the_example_of_the_documentation_runs():
    page = SHIFTS_PAGE.read_text(encoding="utf-8")
    names = {}
    exec(re.search(r"```python\n(.*?)```", page, re.DOTALL)[1], names)
    simulator = Simulator(names["diagram"])
    context = simulator.get_mutable_context()
    names["diagram"].get_input_port().FixValue(context, [0.0])
    names["cart"].GetMyMutableContextFromRoot(context).SetContinuousState([0.0, 0.5])
    simulator.AdvanceTo(0.98)
    seen = names["diagram"].get_output_port().Eval(context)
    # Speed 0.5 m/s; of the position the drift since 0.4 s is left, and the speed is 0.1 s old.
    np.testing.assert_allclose(seen, [0.5 * 0.98 + 0.02 * 0.58, 0.5], atol=1e-9)
