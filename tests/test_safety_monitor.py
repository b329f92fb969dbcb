import numpy as np

from drake_safety.systems.safety_monitor import SafetyMonitor
from system_doubles import Bench


class BoxSafeSet:
    """|q| ≤ 1 and |v| ≤ 2."""

    names = ("position", "speed")

    def margins(self, q, v):
        return np.array([1.0 - abs(q[0]), 2.0 - abs(v[0])])


def test_it_is_safe_exactly_while_no_margin_of_the_present_state_is_negative():
    bench = Bench(SafetyMonitor(BoxSafeSet(), 1, 1), plant_state=[0.0, 0.0])
    assert bench.system.constraint_names == ["position", "speed"]
    bench.advance(0.05)
    for state, safe, margins in (
        ([0.25, -0.5], 1, [0.75, 1.5]),
        ([1.5, 0.0], 0, [-0.5, 2.0]),
        ([0.0, -3.0], 0, [1.0, -1.0]),
        ([1.0, 2.0], 1, [0.0, 0.0]),
    ):
        bench.fix(plant_state=state)
        assert bench.get("safe") == safe
        np.testing.assert_allclose(bench.get("margins"), margins)
