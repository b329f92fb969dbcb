"""Shifts: the catalogue, Γ's confident errors, and the minutes that its monitor watches."""

import math
from types import MappingProxyType, SimpleNamespace

import numpy as np
import pytest

from cart_episodes import make_episode, make_info
from drake_safety import load_assessment, load_scenario
from drake_safety.evaluation import shift_study
from drake_safety.evaluation.shift_study import (
    CONFIDENT,
    false_alarms,
    monitored,
    run_monitored,
    shift_estimates,
)
from drake_safety.evaluation.shifts import plant_shifts
from drake_safety.learning.change_detector import Alarm
from drake_safety.learning.segments import Episodes

STEP_S = 0.5


class Detector:
    """Its level is the first state, and something more; an alarm lasts while it is above 1."""

    step_s = STEP_S

    def __init__(self, more=0.0):
        self.more = more

    def watch(self, motions):
        levels = self.more + np.concatenate(motions)[:, :1]
        ends = np.flatnonzero(np.diff(levels[:, 0] > 1.0, prepend=False, append=False))
        return levels, [Alarm(*pair, "seen") for pair in ends.reshape(-1, 2).tolist()]


class Gamma:
    """An assessment whose probability is the second state, above one "don't know"."""

    used_ = ()
    calibrations_ = MappingProxyType(
        {kind: SimpleNamespace(kind=kind, threshold=0.9) for kind in ("plan", "motion")}
    )
    parameters = SimpleNamespace(initial_uncertainty=0.3)
    settings = SimpleNamespace(is_paper=False)
    detector_ = Detector()
    info_ = SimpleNamespace(step_s=1.0, num_steps=5)

    def predict(self, state, *others):
        probability = state[:, 1]
        known, unknown = (0.6, 0.1, 0.3), (0.2, 0.1, 0.7)
        belief = np.where(probability[:, None] > 1.0, unknown, known)
        return SimpleNamespace(probability=probability, belief=belief)


UNKNOWN = 1.01


def motion(index, num_rows, *, probability=0.5, alarm=(), is_safe=True):
    """A motion with an alarm at some rows, and of which Γ says a probability."""
    state = np.full((num_rows, 3), probability)
    state[:, 0] = 0.0
    state[list(alarm), 0] = 2.0
    ending = dict(is_safe=is_safe, cause="" if is_safe else "wall", first_step=0)
    margins = np.ones((num_rows, 2))
    info = make_info(step_s=STEP_S)
    return make_episode(index, info, num_rows, state=state, margins=margins, **ending)


def test_a_confident_error_is_a_row_called_safe_in_a_motion_that_ends_unsafely():
    motions = [
        motion(0, 10, probability=0.95, is_safe=False),  # Sure and wrong.
        motion(1, 20, probability=0.95),
        motion(2, 30, probability=CONFIDENT - 0.01, is_safe=False),
        motion(3, 40, probability=UNKNOWN, is_safe=False),
    ]
    found = shift_estimates({"gamma": Gamma()}, motions)
    assert found["gamma", "confident_error"].value == pytest.approx(0.1)
    assert found["gamma", "unknown"].value == pytest.approx(0.4)
    assert found["", "unsafe"].value == 0.75
    # Of the three unsafe motions one is called safe; "don't know" is no miss.
    for kind in ("plan", "motion"):
        missed = found["gamma", f"missed_{kind}"]
        assert (missed.value, missed.n) == (pytest.approx(1 / 3), 3)
    assert found["gamma", "confident_error"].n == 4
    # "Don't know" is the least safe: of 20 safe rows, each is above 70 and equal to 10.
    assert found["gamma", "auc"].value == pytest.approx((70 + 0.5 * 10) / 80)


def test_a_minute_goes_on_with_the_next_motions_and_an_alarm_is_dont_know():
    # Γ is asked every second row, and speaks of the next five seconds.
    motions = [
        motion(0, 20, probability=0.95, is_safe=False),
        motion(1, 20, probability=0.95, alarm=[4]),
        motion(2, 20, probability=CONFIDENT - 0.01, is_safe=False),
        motion(3, 20, probability=0.95, is_safe=False, alarm=range(12, 16)),
        motion(4, 20, probability=UNKNOWN, is_safe=False),
    ]
    found = monitored(motions, Gamma())
    assert [one.alarm_s for one in found] == [12.0, 2.0, 16.0, 6.0, 22.0]
    # The first is wrong for 5 s, the fourth for 5 s with and 3 s without the alarm.
    assert [one.error_s[0] for one in found] == [5.0, 0.0, 0.0, 3.0, 0.0]
    assert [one.error_s[1] for one in found] == [8.0] * 5
    late = [motion(i, 100, is_safe=i != 1) for i in range(2)] + [motion(2, 100, alarm=[50])]
    found = monitored(late, Gamma())
    assert [one.alarm_s for one in found] == [math.inf, math.inf, 25.0]


def test_false_alarms_are_those_of_undisturbed_motion():
    motions = [
        motion(0, 3600, alarm=[7]),
        motion(1, 1800, alarm=[*range(50, 90), *range(200, 240)]),
        motion(2, 1801, alarm=[1800], is_safe=False),  # As it leaves.
    ]
    found = false_alarms(Episodes(make_info(step_s=STEP_S), motions), Detector())
    assert found.value == pytest.approx(3.0)
    assert (found.low < 3.0 < found.high, found.n) == (True, 3)


@pytest.mark.train
def test_only_motions_without_an_alarm_are_simulated_to_the_end(monkeypatch):
    monkeypatch.setattr(shift_study, "_FIRST_S", 0.4)
    monkeypatch.setattr(shift_study, "SPANS_S", (0.5, 1.0))
    scenario, gamma = load_scenario("laikago_balancing"), load_assessment("laikago_balancing")
    quiet, alarmed = (
        run_monitored(scenario, "payload", 2, 5, Detector(more), options={}, num_workers=1)
        for more in (-10.0, 10.0)
    )
    assert [round(one.time_s[-1], 9) for one in quiet] == [1.0, 1.0]
    assert [round(one.time_s[-1], 9) for one in alarmed] == [0.4, 0.4]
    assert not np.array_equal(quiet[0].state, quiet[1].state)
    for one, other in zip(quiet, alarmed, strict=True):
        np.testing.assert_array_equal(one.state[: len(other.state)], other.state)
        assert np.ptp(one.features, axis=0).any()
    assert len(monitored(quiet, gamma)) == 2


def test_the_catalogue_is_scaled_to_the_robot():
    scenario = load_scenario("laikago_balancing")
    shifts = plant_shifts(scenario, scenario.make_loop())
    force_n = shifts["side_force"].variation.shift.base_force_n
    mass_kg = shifts["payload"].variation.payload.mass_kg / 0.3
    assert math.isclose(force_n[1], 0.1 * 9.81 * mass_kg)
    assert {"slope", "hole", "weak_joint", "frozen", "variation actual"} <= set(shifts)
    assert {"icy_foot", "weakening_motor", "gravity_and_payload", "joint_drift"} <= set(shifts)
    shifted = scenario.with_variation("slope", shifts["slope"].variation)
    assert "slope" in shifted.variations
    assert "slope" not in scenario.variations
    assert shifted.simulation_hash("slope") != scenario.simulation_hash("nominal")
    # A plant of its own has the scenario's variations alone.
    own = load_scenario("pendulum")
    shifts = plant_shifts(own, own.make_loop())
    assert list(shifts) == [f"variation {n}" for n in own.variations if n != "nominal"]
