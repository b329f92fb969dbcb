import math

import numpy as np
import pytest

from drake_safety.evaluation import throw_study
from drake_safety.evaluation.scorers import Scorer
from drake_safety.evaluation.throw_study import (
    ThrowStudy,
    TriggerRule,
    choose_threshold,
    evaluate_throws,
)
from drake_safety.evaluation.throws_figure import OUTCOMES
from drake_safety.plants.balls import Throw
from drake_safety.simulation.throws import ThrowLog

IMPACT_S, LEAVE_S, FALL_S = 0.5, 0.8, 1.0
TIME_S = np.arange(0.0, 1.02, 0.02)


def log_of(index, *, leaves=False, falls=False, trigger_time_s=math.nan):
    """A log in which the only state is how calm the robot is: 1 until the touch, then less."""
    lowest = 0.1 if falls else 0.3 if leaves else 0.9 - 0.01 * index
    calm = np.where(TIME_S < IMPACT_S - 1e-9, 1.0, lowest)
    rows = np.zeros((len(TIME_S), 1))
    return ThrowLog(
        index=index,
        throw=Throw(time_s=IMPACT_S),
        time_s=TIME_S,
        state=calm[:, None],
        desired_preview=rows,
        features=rows,
        margins=rows,
        plant_state=rows,
        trigger_time_s=trigger_time_s,
        fall_time_s=FALL_S if falls else math.inf,
        leave_time_s=LEAVE_S if leaves or falls else math.inf,
        recovery_active=np.zeros(len(TIME_S)),
        violations={"legs_collide": 0},
    )


class Simulation:
    """In place of `run_throws`: every third throw falls, and recovery saves whom it is in time."""

    def __init__(self):
        self.calls = []

    def __call__(self, scenario, indices, *, trigger_times_s=None, progress=None, **options):
        self.calls.append((tuple(indices), trigger_times_s))
        logs = []
        for index in indices:
            time_s = math.nan if trigger_times_s is None else trigger_times_s[index]
            falls = index % 3 == 0 and not time_s < IMPACT_S + 0.1
            logs.append(log_of(index, falls=falls, trigger_time_s=time_s))
            if progress is not None:
                progress(len(logs), len(indices))
        return logs


@pytest.fixture
def simulation(monkeypatch):
    simulation = Simulation()
    monkeypatch.setattr(throw_study, "run_throws", simulation)
    return simulation


def rule(name, threshold, delay_rows=0):
    """Triggers on the robot's calm, some rows late."""

    def probability(state, *_):
        return np.concatenate([np.ones(delay_rows), state[: len(state) - delay_rows, 0]])

    return TriggerRule(
        name=name, scorer=Scorer(name=name, probability=probability), threshold=threshold
    )


def study_of(rules, **options):
    numbers = {"num_throws": 9, "num_calibration": 6, "seed": 1, "calibration_seed": 2}
    return evaluate_throws(None, rules, **numbers | options)


def test_a_rule_in_time_saves_every_throw_and_a_late_one_none(simulation):
    study = study_of([rule("prompt", 0.6), rule("late", 0.6, delay_rows=10)])
    assert study.estimates["throws.falls_without_recovery"].value == 3 / 9
    assert study.estimates["throws.prompt.falls_with_recovery"].value == 0.0
    assert study.estimates["throws.late.falls_with_recovery"].value == 3 / 9
    assert study.estimates["throws.late.falls_missed"].value == 0.0
    assert study.estimates["throws.prompt.trigger_after_impact_s"].value == pytest.approx(0.0)
    assert study.estimates["throws.late.trigger_after_impact_s"].value == pytest.approx(0.2)
    assert study.estimates["throws.late.trigger_before_fall_s"].value == pytest.approx(0.3)
    assert study.outcomes("prompt") == 3 * ["recovered", "survived", "survived"]
    assert study.outcomes("late") == study.outcomes() == 3 * ["fell", "survived", "survived"]


def test_a_recovery_that_rules_agree_on_is_simulated_once(simulation):
    same = [rule("one", 0.6), rule("other", 0.5), rule("late", 0.5, delay_rows=2)]
    reports = []
    study = study_of(same, progress=lambda *report: reports.append(report))
    recoveries = [times for _, times in simulation.calls if times is not None]
    # Three throws are triggered at two instants each; a round has every throw once.
    assert [sorted(times) for times in recoveries] == [[0, 3, 6], [0, 3, 6]]
    for index in (0, 3, 6):
        assert study.recovered["one"][index] is study.recovered["other"][index]
        assert study.recovered["late"][index].trigger_time_s == pytest.approx(IMPACT_S + 0.04)
    done = [report for report in reports if report[0] == "throws, with recovery"]
    assert done == [("throws, with recovery", count, 6) for count in range(1, 7)]


def test_thresholds_left_open_are_chosen_on_other_throws(simulation):
    study = study_of([rule("given", 0.6), rule("open", None)])
    assert study.thresholds["given"] == 0.6
    assert study.thresholds["open"] == study.estimates["throws.open.threshold"].value > 0.6
    assert simulation.calls[0] == ((0, 1, 2, 3, 4, 5), None)
    assert [log.index for log in study.calibration_logs] == [0, 1, 2, 3, 4, 5]


def test_throws_that_are_judged_are_not_those_that_thresholds_are_chosen_on(simulation):
    with pytest.raises(ValueError, match="seed and calibration seed are both 1; they must differ"):
        study_of([rule("open", None)], calibration_seed=1)


def test_the_chosen_threshold_is_the_highest_with_few_enough_false_triggers():
    logs = [log_of(index) for index in range(40)]
    probabilities = [log.state[:, 0] for log in logs]
    lowest = np.array([p.min() for p in probabilities])
    for bound in (0.0, 0.1, 0.5):
        threshold = choose_threshold(logs, probabilities, max_false_share=bound)
        assert (lowest < threshold).mean() <= bound
        assert (lowest < threshold + 0.0101).mean() > bound
    with pytest.raises(ValueError, match="no calibration throw stays in the safe set"):
        choose_threshold([log_of(0, falls=True)], [np.ones(3)])


def test_outcomes_are_told_in_the_words_of_the_figure():
    logs = [log_of(0), log_of(1), log_of(2, leaves=True), log_of(3, falls=True)]
    study = ThrowStudy(
        estimates={},
        logs=logs,
        trigger_times_s={},
        recovered={"rule": {1: log_of(1), 2: log_of(2, leaves=True)}},
        thresholds={},
    )
    assert study.outcomes("rule") == ["survived", "false trigger", "recovered", "fell"]
    assert study.outcomes() == ["survived", "survived", "survived", "fell"]
    assert set(study.outcomes("rule")) == set(OUTCOMES)


def test_a_probability_that_is_not_known_triggers():
    log = log_of(0)
    unknown = Scorer(name="lost", probability=lambda state, *_: np.full(len(state), np.nan))
    probability = throw_study.log_probability(log, unknown)
    assert throw_study.trigger_time(log, probability, 0.1) == TIME_S[0]


def test_with_a_persistence_one_unknown_row_triggers_nothing_two_do_and_danger_does_at_once():
    log = log_of(0)

    def trigger(low, persistence_s, *, is_known=False):
        values = np.ones(len(TIME_S))
        values[low] = 0.0 if is_known else np.nan
        scorer = Scorer(name="given", probability=lambda *_: values)
        probability = throw_study.log_probability(log, scorer, persistence_s)
        return throw_study.trigger_time(log, probability, 0.6)

    assert trigger([7], 0.0) == TIME_S[7]
    assert math.isnan(trigger([7], 0.02))
    assert trigger([7, 9, 10], 0.02) == TIME_S[10]
    assert trigger([0, 1], 0.02) == TIME_S[1]
    assert math.isnan(trigger([0, 1], 0.04))
    assert trigger([7], 0.02, is_known=True) == TIME_S[7]
