import math

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from drake_safety.systems.recovery_trigger import RecoveryTrigger

PERIOD_S = 0.01
EMPTY = (0.0, 0.0, 1.0)


class Bench:
    """A trigger alone; `look` lets one period pass."""

    def __init__(self, probability=1.0, belief=None, **options):
        self.trigger = RecoveryTrigger(**{"period_s": PERIOD_S} | options)
        self.simulator = Simulator(self.trigger)
        self.context = self.simulator.get_mutable_context()
        self.set(probability, belief=belief)

    def set(self, probability, *, belief=None, done=None):
        self.trigger.GetInputPort("safety_probability").FixValue(self.context, [probability])
        if belief is not None:
            self.trigger.GetInputPort("belief").FixValue(self.context, belief)
        if done is not None:
            self.trigger.GetInputPort("recovery_done").FixValue(self.context, [done])

    def look(self, periods=1):
        self.simulator.AdvanceTo(self.context.get_time() + periods * PERIOD_S)
        return self.is_active()

    def is_active(self):
        return bool(self.trigger.GetOutputPort("recovery_active").Eval(self.context)[0])


@pytest.mark.parametrize(
    ("probability", "threshold", "fires"),
    [
        (1.0, 0.6, False),
        (0.6, 0.6, False),
        (np.nextafter(0.6, 0), 0.6, True),
        (0.0, 0.6, True),
        (math.nan, 0.6, True),
        (0.0, 0.0, False),
        (math.nan, 0.0, True),
    ],
)
def test_it_fires_below_the_threshold_and_when_nothing_is_known(probability, threshold, fires):
    assert RecoveryTrigger(period_s=PERIOD_S).threshold == 0.6
    assert Bench(probability, threshold=threshold).look() == fires


def test_with_a_persistence_dont_know_must_last_that_long_and_danger_fires_at_once():
    bench = Bench(0.0, belief=EMPTY, persistence_s=2 * PERIOD_S)
    assert [bench.look() for _ in range(3)] == [False, False, True]
    bench = Bench(0.0, belief=EMPTY, persistence_s=2 * PERIOD_S)
    bench.look(2)
    bench.set(1.0, belief=(0.7, 0.0, 0.3))
    assert not bench.look()
    bench.set(0.0, belief=EMPTY)
    assert [bench.look() for _ in range(3)] == [False, False, True]
    # A belief that is mostly of empty cells is "don't know", as for whoever else asks.
    for mu, fires in ((0.3, True), (0.6, True), (0.7, False)):
        belief = (0.1, 0.9 - mu, mu)
        assert Bench(0.0, belief=belief, persistence_s=2 * PERIOD_S).look() == fires
    # Without the port every probability is known.
    assert Bench(0.0, persistence_s=2 * PERIOD_S).look()


def test_it_latches_whatever_the_probability_does():
    bench = Bench(0.1)
    assert not bench.is_active()
    assert bench.look()
    bench.set(1.0)
    assert bench.look(20)
    bench.set(1.0, done=0.0)
    assert bench.look(20)


def test_it_lets_go_when_recovery_is_done_and_may_fire_again():
    bench = Bench(0.1)
    bench.look()
    bench.set(1.0, done=1.0)
    assert not bench.look()
    bench.set(0.1, done=0.0)
    assert bench.look()


def test_recovery_done_means_nothing_before_it_fired():
    bench = Bench(0.1)
    bench.set(0.1, done=1.0)
    assert bench.look()


def test_it_looks_only_at_its_own_times():
    bench = Bench(0.1, offset_s=0.005)
    bench.simulator.AdvanceTo(0.004)
    assert not bench.is_active()
    bench.simulator.AdvanceTo(0.006)
    assert bench.is_active()


def test_a_dip_between_two_looks_is_not_seen():
    bench = Bench(1.0)
    bench.simulator.AdvanceTo(0.001)
    bench.set(0.0)
    bench.simulator.AdvanceTo(0.009)
    bench.set(1.0)
    assert not bench.look(5)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [("threshold", x, r"threshold must be in \[0, 1\]; got") for x in (-0.1, 1.1, math.nan)]
    + [("persistence_s", -0.1, "persistence_s must not be negative")],
)
def test_impossible_options_are_refused(name, value, message):
    with pytest.raises(ValueError, match=message):
        RecoveryTrigger(period_s=PERIOD_S, **{name: value})
