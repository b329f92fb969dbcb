import numpy as np
import pytest

from drake_safety.systems.plan_features import PlanFeatures
from drake_safety.systems.safety_monitor import SafetyMonitor
from system_doubles import Bench


class BoxSafeSet:
    """|q| ≤ 1 and |v| ≤ 2; its features tell which argument they came from."""

    names = ("position", "speed")
    feature_names = ("q", "v", "first", "last")

    def margins(self, q, v):
        return np.array([1.0 - abs(q[0]), 2.0 - abs(v[0])])

    def features(self, q, v, preview):
        return np.array([q.sum(), v.sum(), preview[0].sum(), preview[-1].sum()])


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


@pytest.mark.parametrize("margin", [np.nan, np.inf, -np.inf])
def test_a_margin_that_is_not_finite_is_not_safe(margin):
    class Broken(BoxSafeSet):
        def margins(self, q, v):
            return np.array([margin, 1.0])

    assert Bench(SafetyMonitor(Broken(), 1, 1), plant_state=[0.0, 0.0]).get("safe") == 0


def test_features_are_of_the_split_state_and_of_a_preview_row_major_in_time():
    preview = [[1.0, 2.0, 3.0], [10.0, 20.0, 30.0]]
    system = PlanFeatures(BoxSafeSet(), 3, 2, horizon=2)
    assert system.feature_names == list(BoxSafeSet.feature_names)
    bench = Bench(system, plant_state=[1.0, 1.0, 1.0, 5.0, 6.0], desired_preview=preview)
    np.testing.assert_array_equal(bench.get("features"), [3.0, 11.0, 6.0, 60.0])
