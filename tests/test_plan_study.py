from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drake_safety import SafetyAssessment, run_episodes
from drake_safety.evaluation.plan_study import (
    PROMISED_UNSAFE_RECALL,
    SAFE,
    SAFE_RECALL,
    UNSAFE_RECALL,
    PlanRule,
    evaluate_plans,
    named_causes,
    outcome_estimates,
    plans_of,
    promised_miss_rate,
    reachability_rule,
    recall_losses,
    scorer_rule,
)
from drake_safety.evaluation.scorers import Scorer
from drake_safety.learning.calibration import score_threshold
from drake_safety.learning.segments import DIVERGED, Episodes
from drake_safety.simulation.scenario import parse_scenario
from gliding_task import SCENARIO as GLIDING
from shuttle_task import BOX, FAILING_Z_M, FAIR_X_M, shuttling


def wall_margin(state, desired_preview, features):
    """A scorer that sees what happens: the nearer the end is to a wall, the less safe."""
    return 1.0 / (1.0 + np.exp(-40.0 * features.min(axis=1)))


RULES = [
    scorer_rule(Scorer(name="sharpened", probability=wall_margin)),
    scorer_rule(Scorer(name="blind", probability=lambda state, *_: np.full(len(state), 0.5))),
    PlanRule(name="stubborn", unsafe_score=lambda plans: np.ones(len(plans)), threshold=0.5),
]


def episodes(num_episodes, seed, **options):
    return run_episodes(shuttling(), num_episodes, seed=seed, num_workers=1, **options)


@pytest.fixture(scope="module")
def assessment():
    scenario = shuttling()
    return SafetyAssessment(scenario.assessment).fit(episodes(80, 0))


@pytest.fixture(scope="module")
def fresh():
    return episodes(60, 1)


@pytest.fixture(scope="module")
def plans(fresh):
    return plans_of(shuttling().make_loop(), fresh)


@pytest.fixture(scope="module")
def calibration():
    return plans_of(shuttling().make_loop(), episodes(40, 2))


@pytest.fixture(scope="module")
def study(assessment, calibration, plans):
    loop = shuttling().make_loop(side="right")
    other = plans_of(loop, episodes(20, 3, side="right"))
    return evaluate_plans(RULES, assessment, calibration, {"plans": plans, "plans.other": other})


def test_a_plan_is_what_is_known_at_its_first_instant_and_where_it_leads(fresh, plans):
    assert len(plans) == len(fresh)
    assert plans.first.is_first.all()
    np.testing.assert_array_equal(plans.first.state, [episode.state[0] for episode in fresh])
    assert np.all((plans.goals >= BOX[0] - 1e-9) & (plans.goals <= BOX[1] + 1e-9))
    # Unsafe is exactly what leads beyond a wall.
    is_beyond = (plans.goals[:, :2] > 1.0).any(axis=1)
    np.testing.assert_array_equal(plans.is_unsafe, is_beyond)


def test_plans_without_a_goal_cannot_be_judged(fresh):
    loop = parse_scenario(GLIDING, name="gliding", folder=Path()).make_loop()
    with pytest.raises(ValueError, match="task 'Gliding' has no plans with a goal"):
        plans_of(loop, fresh)


def test_the_fair_set_is_what_the_loop_calls_fair(fresh, plans):
    fair = plans.fair()
    assert 0 < len(fair) < len(plans)
    assert fair.goals[:, 0].min() >= FAIR_X_M
    assert len(fair.outcomes) == len(fair) == plans.is_fair.sum()
    np.testing.assert_array_equal(fair.is_unsafe, plans.is_unsafe[plans.is_fair])


def test_episodes_that_diverged_are_counted_but_no_plans(fresh):
    broken = replace(fresh[0], is_safe=False, cause=DIVERGED)
    plans = plans_of(shuttling().make_loop(), Episodes(fresh.info, [broken, *fresh[1:10]]))
    assert (len(plans), len(plans.outcomes)) == (9, 10)
    estimates = outcome_estimates(plans)
    assert estimates["outcomes.diverged"].value == 0.1
    np.testing.assert_array_equal(plans.first.state[0], fresh[1].state[0])


def test_outcomes_and_controller_failures_are_counted(fresh, plans):
    estimates = outcome_estimates(plans)
    shares = [estimates[f"outcomes.{name}"] for name in (SAFE, "front", "flank", DIVERGED)]
    assert sum(share.value for share in shares) == pytest.approx(1.0)
    assert {share.n for share in shares} == {len(fresh)}
    assert shares[0].value == fresh.num_safe / len(fresh)
    # A failure is counted where the velocity says so, which the start point shifts a little.
    num_failing = np.sum(plans.goals[:, 2] - plans.first.state[:, 2] > FAILING_Z_M)
    assert estimates["controller_failures"].value == num_failing
    assert estimates["episodes_with_controller_failures"].value == num_failing / len(fresh)


@pytest.mark.train
def test_every_rule_has_every_figure_on_every_set(study):
    for prefix in ("plans", "plans.fair", "plans.other", "plans.other.fair"):
        for rule in RULES:
            for key in ("safe_recall", "unsafe_recall", "auc", "brier", "threshold"):
                assert f"{prefix}.{rule.name}.{key}" in study.estimates
        assert f"{prefix}.causes.right_cause" in study.estimates
        assert f"{prefix}.outcomes.safe" in study.estimates


@pytest.mark.train
def test_thresholds_come_from_the_calibration_plans_alone(study, calibration, plans, assessment):
    score = RULES[0].unsafe_score(calibration)
    miss_rate = promised_miss_rate(calibration)
    expected = score_threshold(score, calibration.is_unsafe, miss_rate)
    assert study.thresholds["sharpened"] == expected
    alone = evaluate_plans(RULES, assessment, calibration, {"plans": plans.fair()})
    assert alone.thresholds == study.thresholds
    # Told as the safety probability below which a plan is refused.
    assert study.estimates["plans.sharpened.threshold"].value == 1.0 - expected
    assert study.estimates["plans.sharpened.threshold"].n == len(calibration)


@pytest.mark.train
def test_with_few_unsafe_plans_the_promise_is_the_highest_that_can_be_kept(
    study, calibration, caplog
):
    num_unsafe = int(calibration.is_unsafe.sum())
    assert promised_miss_rate(calibration) == 1.0 / (num_unsafe + 1)
    assert f"{num_unsafe} unsafe calibration episodes promise an unsafe recall" in caplog.text
    assert "0.992 takes 124" in caplog.text
    promised = study.estimates["plans.promised_unsafe_recall"]
    assert (promised.value, promised.n) == (1.0 - 1.0 / (num_unsafe + 1), num_unsafe)
    safe = replace(calibration, first=calibration.first.take(~calibration.is_unsafe))
    with pytest.raises(ValueError, match=r"0 of .* calibration plans are unsafe; it takes 124"):
        promised_miss_rate(safe)


@pytest.mark.train
def test_no_unsafe_calibration_plan_is_missed_when_there_are_few(study, calibration):
    refused = RULES[0].unsafe_score(calibration) > study.thresholds["sharpened"]
    assert refused[calibration.is_unsafe].all()


@pytest.mark.train
def test_who_sees_what_happens_is_right_and_who_refuses_all_has_no_safe_recall(study, plans):
    estimates = study.estimates
    assert estimates["plans.sharpened.auc"].value == 1.0
    assert estimates["plans.sharpened.unsafe_recall"].n == plans.is_unsafe.sum()
    assert estimates["plans.stubborn.unsafe_recall"].value == 1.0
    assert estimates["plans.stubborn.safe_recall"].value == 0.0
    # One score for all: nothing is accepted rather than an unsafe plan.
    assert estimates["plans.blind.safe_recall"].value == 0.0


def test_the_mirrored_loop_sees_the_same_plans_as_the_loop_itself():
    left, right = (
        plans_of(shuttling().make_loop(side=side), episodes(12, 5, side=side))
        for side in ("left", "right")
    )
    np.testing.assert_allclose(right.goals, left.goals * [1.0, -1.0, 1.0], atol=1e-12)
    np.testing.assert_array_equal(right.is_fair, left.is_fair)
    for name in ("state", "desired_preview", "features"):
        np.testing.assert_allclose(
            getattr(right.first, name), getattr(left.first, name), atol=1e-12
        )


@pytest.mark.train
def test_the_cause_is_the_constraint_whose_predicted_margin_is_smallest(study, assessment, plans):
    named = named_causes(assessment, plans)
    said = assessment.predict(plans.first.state, plans.first.desired_preview, plans.first.features)
    np.testing.assert_array_equal(named["right_cause"], said.predicted_margins.argmin(axis=1))
    rows = plans.is_unsafe & (RULES[0].unsafe_score(plans) > study.thresholds["sharpened"])
    for name, causes in named.items():
        right = np.mean((causes == plans.first.cause)[rows])
        assert study.estimates[f"plans.causes.{name}"].value == right


@pytest.mark.train
def test_causes_are_judged_on_the_correctly_refused_alone(study, plans):
    is_refused = RULES[0].unsafe_score(plans) > study.thresholds["sharpened"]
    estimates = study.estimates
    of_all = estimates["plans.causes.right_cause"]
    assert of_all.n == np.sum(is_refused & plans.is_unsafe)
    by_cause = [estimates[f"plans.causes.{name}"] for name in plans.constraint_names]
    assert sum(estimate.n for estimate in by_cause) == of_all.n
    assert sum(f.value * f.n for f in by_cause) == pytest.approx(of_all.value * of_all.n)


def test_reachability_answers_for_the_hand_that_reaches_and_for_no_other(plans):
    class Near:
        def is_reachable(self, points):
            return points[:, 0] < 1.0

    rule = reachability_rule({"left": Near()})
    score = rule.unsafe_score(replace(plans, hand="left"))
    np.testing.assert_array_equal(score, (plans.goals[:, 0] >= 1.0).astype(float))
    for hand in (None, "right"):
        with pytest.raises(ValueError, match=rf"unknown hand '{hand}'; the hands are \['left'\]"):
            rule.unsafe_score(replace(plans, hand=hand))


def test_the_promise_leaves_room_above_the_papers_figure():
    assert SAFE_RECALL < UNSAFE_RECALL < PROMISED_UNSAFE_RECALL < 1.0


def test_recall_losses_compare_the_pairs_alone(plans):
    unsafe = plans.is_unsafe
    none_lost = recall_losses(plans, unsafe, plans, unsafe)
    assert {estimate.value for estimate in none_lost.values()} == {0.0}
    # Twins of the first half, of which one safe plan is refused.
    half = plans.first.take(plans.first.episode < 20)
    twins = replace(plans, first=half, goals=plans.goals[: len(half)])
    refused = half.is_unsafe.copy()
    num_safe = int((~half.is_unsafe).sum())
    refused[np.flatnonzero(~half.is_unsafe)[0]] = True
    found = recall_losses(plans, unsafe, twins, refused)
    assert found["safe_recall_loss"].value == pytest.approx(1 / num_safe)
    assert found["safe_recall_loss"].n == len(half)
    assert found["safe_recall_loss"].low <= 1 / num_safe <= found["safe_recall_loss"].high
    assert found["unsafe_recall_loss"].value == 0.0
    # What is refused among plans without a twin does not count.
    beyond = unsafe | (plans.first.episode >= 20)
    assert recall_losses(plans, beyond, twins, refused) == found
