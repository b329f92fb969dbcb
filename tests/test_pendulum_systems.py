import math

import numpy as np
import pytest

from drake_safety.diagrams.pendulum.task import (
    PendulumController,
    PendulumObserver,
    PendulumParameters,
    PendulumSafeSet,
    bob_position,
)
from system_doubles import Bench

LENGTH_M = 0.5
PERIOD_S = 0.01


def observed(angle_from_hanging, rate):
    bench = Bench(PendulumObserver(LENGTH_M), pendulum_state=[angle_from_hanging, rate])
    return bench.get("plant_state"), bench.get("output")


def test_the_observer_counts_from_upright_and_places_the_bob():
    state, bob = observed(math.pi, 0.7)
    np.testing.assert_allclose(state, [0.0, 0.7], atol=1e-15)
    np.testing.assert_allclose(bob, [0.0, 0.0, LENGTH_M], atol=1e-15)
    state, bob = observed(math.pi + math.pi / 6, -1.0)
    np.testing.assert_allclose(state, [math.pi / 6, -1.0])
    np.testing.assert_allclose(bob, [0.25, 0.0, 0.5 * math.sqrt(0.75)])
    np.testing.assert_allclose(observed(0.0, 0.0)[1], [0.0, 0.0, -LENGTH_M], atol=1e-15)


def torque_of(parameters, state, angle=0.0, rate=0.0):
    """The torque that a controller holds after its update at time 0."""
    point = bob_position(angle, parameters.length_m)
    velocity = rate * parameters.length_m * np.array([math.cos(angle), 0.0, -math.sin(angle)])
    bench = Bench(PendulumController(parameters, PERIOD_S), plant_state=state)
    bench.fix(desired_output=point, desired_output_rate=velocity)
    bench.advance(0.1 * PERIOD_S)
    return bench.get("torque")[0]


def test_the_torque_is_that_of_both_errors_less_the_weights():
    parameters = PendulumParameters(effort_share=0.999)
    # 20 (0.1 - 0.05) + 3 (0.4 - 0.2) - 1 * 9.81 * 0.5 sin(0.05) [N·m].
    expected = 20.0 * 0.05 + 3.0 * 0.2 - 4.905 * math.sin(0.05)
    assert torque_of(parameters, [0.05, 0.2], 0.1, 0.4) == pytest.approx(expected, abs=1e-12)
    assert torque_of(parameters, [0.0, 0.0]) == 0.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_torque_stays_within_the_motors_limit(side):
    parameters = PendulumParameters(effort_share=0.35)
    limit = 0.35 * 9.81 * 0.5
    assert torque_of(parameters, [0.0, 0.0], side * 0.3) == pytest.approx(side * limit)


def test_margins_are_the_angles_left_to_either_side():
    safe_set = PendulumSafeSet(PendulumParameters(largest_angle_rad=0.6), 0.05)
    assert safe_set.names == ("front", "back")
    np.testing.assert_allclose(safe_set.margins(np.array([0.2]), np.array([9.0])), [0.4, 0.8])
    assert safe_set.margins(np.array([0.7]), np.zeros(1))[0] < 0


def test_features_of_a_plan_that_holds_still_are_worked_by_hand():
    parameters = PendulumParameters()
    safe_set = PendulumSafeSet(parameters, 0.05)
    preview = np.tile(bob_position(0.1, LENGTH_M), (5, 1))
    values = safe_set.features(np.array([0.02]), np.array([0.3]), preview)
    found = dict(zip(safe_set.feature_names, values, strict=True))
    hold, capture = math.asin(0.35), 0.02 + 0.3 * math.sqrt(0.5 / 9.81)
    assert found == pytest.approx(
        {
            "now_margin_front": 0.58,
            "now_margin_back": 0.62,
            "capture_reserve_front": hold - capture,
            "capture_reserve_back": hold + capture,
            "goal_reserve_front": hold - 0.1,
            "goal_reserve_back": hold + 0.1,
            "plan_reserve_front": hold - 0.1,
            "plan_reserve_back": hold + 0.1,
            "plan_capture_reserve_front": hold - 0.1,
            "plan_capture_reserve_back": hold + 0.1,
            "plan_effort_reserve_front": 0.35 - math.sin(0.1),
            "plan_effort_reserve_back": 0.35 + math.sin(0.1),
            "tracking_error": 0.08,
            "goal_from_capture": 0.1 - capture,
        },
        abs=1e-12,
    )
