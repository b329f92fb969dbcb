import math
from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RotationMatrix

from balancing_loops import packaged_loop
from drake_safety import load_assessment
from drake_safety.control.observation import quaternion_of
from drake_safety.diagrams.balancing import throw_study
from drake_safety.diagrams.balancing.throw_study import TriggerRule, evaluate_throws
from drake_safety.diagrams.balancing.throws import VIOLATIONS, run_throw, run_throws
from drake_safety.evaluation.scorers import Scorer
from drake_safety.plants.balls import Throw
from drake_safety.robots.robot import PlantVariation
from drake_safety.simulation.motion import Motion
from drake_safety.simulation.scenario import load_scenario
from studies.throws import choose_threshold, classifier_rules

HARD = Throw(time_s=0.3, mass_kg=3.0, speed_m_s=8.0, direction_rad=math.pi / 2)
HARDER = Throw(time_s=0.4, mass_kg=3.0, speed_m_s=8.0, direction_rad=-1.2)
IMPACT_S, LEAVE_S, FALL_S = 0.5, 0.8, 1.0
TIME_S = np.arange(0.0, 1.02, 0.02)
CALM = Scorer(name="calm", probability=lambda state, *_: state[:, 0])


def test_a_hard_throw_makes_balancing_fall_and_the_log_ends_there():
    balancing = packaged_loop("actual", ball=True)
    log = run_throw(balancing, 0, seed=5, throws=[HARD], duration_s=2.5)
    assert log.has_left and log.has_fallen
    assert HARD.time_s < log.leave_time_s < log.fall_time_s == pytest.approx(log.time_s[-1])
    fall = balancing.constraint_names.index(balancing.fall_name)
    assert log["margins"][-1, fall] < 0 <= log["margins"][-2, fall]


def test_before_the_trigger_recovery_changes_no_bit():
    balancing = packaged_loop("actual", ball=True)
    recovering = packaged_loop("actual", ball=True, recovery=True)
    options = {"seed": 5, "throws": [HARD], "duration_s": 0.6}
    alone = run_throw(balancing, 3, **options)
    saved = run_throw(recovering, 3, trigger_time_s=0.34, **options)
    rows = alone.time_s <= 0.34 + 1e-9
    for name in ("plant_state", "state", "features", "margins"):
        np.testing.assert_array_equal(alone[name][rows], saved[name][rows])
    assert not np.array_equal(alone["plant_state"][-1], saved["plant_state"][-1])


@pytest.mark.parametrize("direction", [math.pi / 2, -math.pi / 4])
def test_recovery_steps_save_the_robot_without_violations(direction):
    recovering = packaged_loop("actual", ball=True, recovery=True)
    throw = replace(HARD, direction_rad=direction)
    log = run_throw(recovering, 1, seed=5, throws=[throw], duration_s=3.5, trigger_time_s=0.32)
    assert not log.has_fallen
    ((start_s, end_s),) = log.recovery_intervals_s
    assert start_s == pytest.approx(0.34, abs=1e-9)  # The first row after the trigger.
    step = recovering.scenario.parameters.recovery.step
    assert end_s - start_s < 13 * step.step_duration_s + step.return_duration_s
    assert log["margins"][-1].min() > 0, "it balances inside its safe set again"
    assert log["violations"].shape == (len(log.time_s), len(VIOLATIONS))
    assert not log["violations"].any()
    kinematics = recovering.kinematics
    for plant_state in log["plant_state"]:
        feet = kinematics.contact_positions(plant_state[: kinematics.num_positions])
        # The left feet stay to the left of the right ones, so that legs never cross.
        sideways = RotationMatrix(quaternion_of(plant_state)).matrix()[:2, 1]
        assert np.all((feet[1::2, :2] - feet[0::2, :2]) @ sideways > 0.05)


def test_throws_do_not_depend_on_the_workers_and_keep_their_order():
    scenario = load_scenario("laikago_balancing")
    alone = run_throws(scenario, [2, 0, 1], seed=9, num_workers=1)
    workers = {log.index: log for log in run_throws(scenario, [0, 1, 2], seed=9, num_workers=2)}
    assert [log.index for log in alone] == [2, 0, 1]
    for log in alone:
        assert log.push_time_s == workers[log.index].push_time_s
        np.testing.assert_array_equal(log["plant_state"], workers[log.index]["plant_state"])


def log_of(index, *, leaves=False, falls=False):
    """A log in which the only state is how calm the robot is: 1 until the impact, then less."""
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
    """In place of `run_throws`: recovery in time saves the robot."""
    pairs = zip(indices, trigger_times_s or [math.nan] * len(indices), strict=True)
    return [log_of(i, falls=i % 3 == 0 and not time_s < IMPACT_S + 0.1) for i, time_s in pairs]


def rule(name, threshold, delay_rows=0):
    """Triggers on the robot's calm, some rows late."""

    def probability(state, *_):
        return np.concatenate([np.ones(delay_rows), state[: len(state) - delay_rows, 0]])

    return TriggerRule(scorer=Scorer(name=name, probability=probability), threshold=threshold)


def test_a_rule_in_time_saves_every_throw_and_a_late_one_none(monkeypatch):
    monkeypatch.setattr(throw_study, "run_throws", every_third_falls)
    rules = [rule("prompt", 0.6), rule("late", 0.6, delay_rows=10)]
    estimates, logs = evaluate_throws(None, rules, num_throws=9, seed=1, progress=print)
    assert [log.index for log in logs] == list(range(9))
    expected = {
        ("", "falls_without_recovery"): 3 / 9,
        ("prompt", "falls_with_recovery"): 0.0,
        ("late", "falls_with_recovery"): 3 / 9,
        ("late", "falls_missed"): 0.0,
        ("prompt", "false_triggers"): 0.0,
        ("prompt", "trigger_after_impact_s"): 0.0,
        ("late", "trigger_after_impact_s"): 0.2,
        ("late", "trigger_before_fall_s"): 0.3,
    }
    values = {key: estimates["throws", *key].value for key in expected}
    assert values == pytest.approx(expected)


def test_the_chosen_threshold_is_the_highest_with_few_enough_false_triggers():
    logs = [log_of(index) for index in range(40)]
    lowest = np.array([log["state"][:, 0].min() for log in logs])
    for bound in (0.0, 0.5):
        threshold = choose_threshold(logs, CALM, max_false_share=bound)
        assert (lowest < threshold).mean() <= bound < (lowest < threshold + 0.0101).mean()
    (chosen,) = classifier_rules([CALM], logs, 0.0)
    assert (chosen.scorer.name, chosen.threshold) == ("calm", choose_threshold(logs, CALM))
    with pytest.raises(ValueError, match="no calibration throw stays in the safe set"):
        choose_threshold([log_of(0, falls=True)], CALM)


@pytest.mark.parametrize(
    ("rows", "persistence_s", "value", "triggered"),
    [
        ([0], 0.0, np.nan, 0),
        ([7], 0.02, np.nan, None),
        ([7, 9, 10], 0.02, np.nan, 10),
        ([0, 1], 0.04, np.nan, None),
        ([7], 0.02, 0.0, 7),
    ],
)
def test_unknown_rows_trigger_after_their_persistence_and_danger_at_once(
    rows, persistence_s, value, triggered
):
    values = np.ones(len(TIME_S))
    values[rows] = value
    scorer = Scorer(name="given", probability=lambda *_: values)
    probability = throw_study.log_probability(log_of(0), scorer, persistence_s)
    time_s = throw_study.trigger_time(log_of(0), probability, 0.6)
    assert math.isnan(time_s) if triggered is None else time_s == TIME_S[triggered]


def test_gamma_in_the_diagram_is_gamma_on_the_log():
    scenario, assessment = load_scenario("laikago_balancing"), load_assessment("laikago_balancing")
    # Without measurement noise, of which every reading at an instant may be a fresh draw.
    scenario.variations["quiet"] = PlantVariation(joint_friction_nm=0.4)
    loop = scenario.make_loop("quiet", assessment=assessment, recovery=False, ball=True)
    ports = ("safety_probability", "belief")
    log = run_throw(loop, 0, seed=8, throws=[HARDER], duration_s=1.0, ports=ports)
    result = assessment.predict(log["state"], log["desired_preview"], log["features"])
    # Outside the safe set nothing is safe.
    is_outside = log["margins"].min(axis=1) < 0.0
    assert is_outside.any() and not is_outside.all()
    belief = result.belief.copy()
    belief[is_outside, 1] += belief[is_outside, 0]
    belief[is_outside, 0] = 0.0
    probability = result.probability[:, None] * ~is_outside[:, None]
    # A row shows the state before the updates of its instant: Γ of a row is published in the next.
    np.testing.assert_allclose(log["safety_probability"][1:], probability[:-1], atol=1e-5)
    np.testing.assert_allclose(log["belief"][1:], belief[:-1], atol=1e-5)
    assert np.ptp(result.belief[:, 0]) > 0.35


@pytest.mark.slow
def test_gamma_falls_at_the_hit_and_recovery_saves_the_robot():
    scenario, assessment = load_scenario("laikago_balancing"), load_assessment("laikago_balancing")
    alone = scenario.make_loop("actual", assessment=assessment, recovery=False, ball=True)
    log = run_throw(alone, 0, seed=8, throws=[HARDER], duration_s=2.5)
    assert log.has_fallen
    loop = scenario.make_loop("actual", assessment=assessment, ball=True)
    log = run_throw(loop, 0, seed=8, throws=[HARDER], duration_s=3.0)
    assert not log.has_fallen
    assert HARDER.time_s < log.recovery_intervals_s[0][0] < HARDER.time_s + 0.1
    violated = dict(zip(VIOLATIONS, log["violations"].any(axis=0), strict=True))
    assert not (violated["legs_collide"] or violated["joint_position"] or violated["joint_effort"])
