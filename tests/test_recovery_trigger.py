import math

import numpy as np
import pytest

from drake_safety.systems.recovery_trigger import RecoveryTrigger
from system_doubles import Bench

PERIOD_S = 0.01
EMPTY = (0.0, 0.0, 1.0)
DANGER, CALM = {"safety_probability": 0.1}, {"safety_probability": 1.0}


class Triggered(Bench):
    """A trigger alone; `look` lets periods pass."""

    def __init__(self, probability=1.0, options=None, **inputs):
        trigger = RecoveryTrigger(**{"period_s": PERIOD_S} | (options or {}))
        super().__init__(trigger, safety_probability=probability, **inputs)

    def look(self, periods=1, **inputs):
        self.fix(**inputs)
        self.advance(periods * PERIOD_S)
        return self.is_active()

    def is_active(self):
        return bool(self.get("recovery_active")[0])


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
        (math.inf, 0.6, True),
    ],
)
def test_it_fires_below_the_threshold_and_when_nothing_is_known(probability, threshold, fires):
    assert RecoveryTrigger(period_s=PERIOD_S).threshold == 0.6
    assert Triggered(probability, {"threshold": threshold}).look() == fires


def test_with_a_persistence_dont_know_must_last_that_long_and_danger_fires_at_once():
    options = {"persistence_s": 2 * PERIOD_S}
    bench = Triggered(0.0, options, belief=EMPTY)
    assert [bench.look() for _ in range(3)] == [False, False, True]
    bench = Triggered(0.0, options, belief=EMPTY)
    bench.look(2)
    assert not bench.look(**CALM, belief=(0.7, 0.0, 0.3))
    bench.fix(safety_probability=0.0, belief=EMPTY)
    assert [bench.look() for _ in range(3)] == [False, False, True]
    # A belief that is mostly of empty cells is "don't know", as for whoever else asks.
    for mu, fires in ((0.3, True), (0.6, True), (0.7, False)):
        assert Triggered(0.0, options, belief=(0.1, 0.9 - mu, mu)).look() == fires
    # Without the port every probability is known.
    assert Triggered(0.0, options).look()


def test_it_latches_until_recovery_is_done_and_may_fire_again():
    bench = Triggered(0.1)
    assert not bench.is_active()
    assert bench.look()
    assert bench.look(20, **CALM)
    assert bench.look(20, recovery_done=0.0)
    assert not bench.look(recovery_done=1.0)
    assert bench.look(**DANGER, recovery_done=0.0)
    # Done means nothing before it fired.
    assert Triggered(0.1, recovery_done=1.0).look()


def test_it_looks_only_at_its_own_times():
    bench = Triggered(0.1, {"offset_s": 0.005})
    for time_s, fires in ((0.004, False), (0.006, True)):
        bench.simulator.AdvanceTo(time_s)
        assert bench.is_active() == fires
    # A dip between two looks is not seen.
    bench = Triggered()
    for probability, seconds in ((1.0, 0.001), (0.0, 0.008), (1.0, 0.05)):
        bench.fix(safety_probability=probability)
        bench.advance(seconds)
    assert not bench.is_active()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [("threshold", x, r"threshold .*must be in \[0, 1\]; got") for x in (-0.1, 1.1, math.nan)]
    + [("persistence_s", -0.1, "persistence_s must not be negative")],
)
def test_impossible_options_are_refused(name, value, message):
    with pytest.raises(ValueError, match=message):
        RecoveryTrigger(period_s=PERIOD_S, **{name: value})
