import math

import numpy as np
import pytest

from drake_safety.systems.recovery_trigger import RecoveryTrigger
from system_doubles import Bench

PERIOD_S = 0.01
EMPTY = (0.0, 0.0, 1.0)
DANGER, SAFE = {"safety_probability": 0.1}, {"safety_probability": 1.0}


class Triggered(Bench):
    """A trigger alone; `after` lets periods pass."""

    def __init__(self, probability=1.0, options=None, **inputs):
        trigger = RecoveryTrigger(**{"period_s": PERIOD_S} | (options or {}))
        super().__init__(trigger, safety_probability=probability, **inputs)

    def after(self, periods=1, **inputs):
        self.fix(**inputs)
        self.advance(periods * PERIOD_S)
        return bool(self.get("recovery_active")[0])


@pytest.mark.parametrize(
    ("probability", "threshold", "fires"),
    [
        (0.6, 0.6, False),
        (np.nextafter(0.6, 0), 0.6, True),
        (0.0, 0.0, False),
        (math.nan, 0.0, True),
        (math.inf, 0.6, True),
    ],
)
def test_it_fires_below_the_threshold_and_when_nothing_is_known(probability, threshold, fires):
    assert RecoveryTrigger(period_s=PERIOD_S).threshold == 0.6
    assert Triggered(probability, {"threshold": threshold}).after() == fires


def test_with_a_persistence_dont_know_must_last_that_long_and_danger_fires_at_once():
    options = {"persistence_s": 2 * PERIOD_S}
    bench = Triggered(0.0, options, belief=EMPTY)
    bench.after(2)
    assert not bench.after(**SAFE, belief=(0.7, 0.0, 0.3))
    bench.fix(safety_probability=0.0, belief=EMPTY)
    assert [bench.after() for _ in range(3)] == [False, False, True]
    # A belief that is mostly of empty cells is "don't know", as for whoever else asks.
    for mu, fires in ((0.3, True), (0.6, True), (0.7, False)):
        assert Triggered(0.0, options, belief=(0.1, 0.9 - mu, mu)).after() == fires
    # Without the port every probability is known.
    assert Triggered(0.0, options).after()


def test_it_latches_until_recovery_is_done_and_may_fire_again():
    bench = Triggered(0.1)
    assert bench.after()
    assert bench.after(20, **SAFE)
    assert bench.after(20, recovery_done=0.0)
    assert not bench.after(recovery_done=1.0)
    assert bench.after(**DANGER, recovery_done=0.0)
    # Done means nothing before it fired.
    assert Triggered(0.1, recovery_done=1.0).after()
