import math

import numpy as np
import pytest

from drake_safety.diagrams.balancing import throw_study
from drake_safety.diagrams.balancing.throw_study import TriggerRule, evaluate_throws
from drake_safety.diagrams.balancing.throws import VIOLATIONS
from drake_safety.evaluation.scorers import Scorer
from drake_safety.simulation.motion import Motion
from studies.throws import choose_threshold, classifier_rules

IMPACT_S, LEAVE_S, FALL_S = 0.5, 0.8, 1.0
TIME_S = np.arange(0.0, 1.02, 0.02)


def log_of(index, *, leaves=False, falls=False):
    """A log in which the only state is how calm the robot is: 1 until the touch, then less."""
    lowest = 0.1 if falls else 0.3 if leaves else 0.9 - 0.01 * index
    calm = np.where(TIME_S < IMPACT_S - 1e-9, 1.0, lowest)
    rows = np.zeros((len(TIME_S), 1))
    ports = dict.fromkeys(("desired_preview", "features", "recovery_active"), rows)
    violations = np.zeros((len(TIME_S), len(VIOLATIONS)), dtype=bool)
    return Motion(
        index=index,
        push_time_s=IMPACT_S,
        time_s=TIME_S,
        ports={"state": calm[:, None], "violations": violations, **ports},
        fall_time_s=FALL_S if falls else math.inf,
        leave_time_s=LEAVE_S if leaves or falls else math.inf,
    )


def every_third_falls(scenario, indices, *, trigger_times_s=None, **options):
    """In place of `run_throws`: recovery saves whom it is in time."""
    logs = []
    times_s = [math.nan] * len(indices) if trigger_times_s is None else trigger_times_s
    for index, time_s in zip(indices, times_s, strict=True):
        falls = index % 3 == 0 and not time_s < IMPACT_S + 0.1
        logs.append(log_of(index, falls=falls))
    return logs


def rule(name, threshold, delay_rows=0):
    """Triggers on the robot's calm, some rows late."""

    def probability(state, *_):
        return np.concatenate([np.ones(delay_rows), state[: len(state) - delay_rows, 0]])

    return TriggerRule(scorer=Scorer(name=name, probability=probability), threshold=threshold)


CALM = Scorer(name="calm", probability=lambda state, *_: state[:, 0])


def test_a_rule_in_time_saves_every_throw_and_a_late_one_none(monkeypatch):
    monkeypatch.setattr(throw_study, "run_throws", every_third_falls)
    rules = [rule("prompt", 0.6), rule("late", 0.6, delay_rows=10)]
    found, logs = evaluate_throws(None, rules, num_throws=9, seed=1, progress=print)
    assert [log.index for log in logs] == list(range(9))
    assert found["throws", "", "falls_without_recovery"].value == 3 / 9
    assert found["throws", "prompt", "falls_with_recovery"].value == 0.0
    assert found["throws", "late", "falls_with_recovery"].value == 3 / 9
    assert found["throws", "late", "falls_missed"].value == 0.0
    assert found["throws", "prompt", "false_triggers"].value == 0.0
    assert found["throws", "prompt", "trigger_after_impact_s"].value == pytest.approx(0.0)
    assert found["throws", "late", "trigger_after_impact_s"].value == pytest.approx(0.2)
    assert found["throws", "late", "trigger_before_fall_s"].value == pytest.approx(0.3)


def test_the_chosen_threshold_is_the_highest_with_few_enough_false_triggers():
    logs = [log_of(index) for index in range(40)]
    lowest = np.array([log["state"][:, 0].min() for log in logs])
    for bound in (0.0, 0.1, 0.5):
        threshold = choose_threshold(logs, CALM, max_false_share=bound)
        assert (lowest < threshold).mean() <= bound
        assert (lowest < threshold + 0.0101).mean() > bound
    (one,) = classifier_rules([CALM], logs, 0.0)
    assert (one.scorer.name, one.threshold) == ("calm", choose_threshold(logs, CALM))
    with pytest.raises(ValueError, match="no calibration throw stays in the safe set"):
        choose_threshold([log_of(0, falls=True)], CALM)


def test_with_a_persistence_one_unknown_row_triggers_nothing_two_do_and_danger_does_at_once():
    log = log_of(0)

    def trigger(low, persistence_s, *, is_known=False):
        values = np.ones(len(TIME_S))
        values[low] = 0.0 if is_known else np.nan
        scorer = Scorer(name="given", probability=lambda *_: values)
        probability = throw_study.log_probability(log, scorer, persistence_s)
        return throw_study.trigger_time(log, probability, 0.6)

    assert trigger([0], 0.0) == TIME_S[0] and trigger([7], 0.0) == TIME_S[7]
    assert math.isnan(trigger([7], 0.02))
    assert trigger([7, 9, 10], 0.02) == TIME_S[10]
    assert trigger([0, 1], 0.02) == TIME_S[1]
    assert math.isnan(trigger([0, 1], 0.04))
    assert trigger([7], 0.02, is_known=True) == TIME_S[7]
    assert math.isnan(throw_study.trigger_time(log, np.full(len(TIME_S), 0.6), 0.6))
    assert throw_study.trigger_time(log, np.full(len(TIME_S), 0.59), 0.6) == TIME_S[0]
