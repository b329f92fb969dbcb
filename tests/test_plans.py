import copy
from dataclasses import replace

import numpy as np
import pytest

from drake_safety import SafetyAssessment, run_episodes
from drake_safety.evaluation.episode_study import promised_miss_rate
from drake_safety.evaluation.scorers import Scorer
from drake_safety.learning.calibration import PLAN, score_threshold
from drake_safety.learning.segments import DIVERGED, Episodes
from lip_assessments import calibration as promise
from shuttle_task import FAIR_X_M, shuttling
from studies.plans import (
    evaluate_plans,
    named_causes,
    plans_of,
    reachability_rule,
    recall_losses,
    scorer_rule,
)


def wall_margin(state, desired_preview, features):
    """A scorer that sees what happens: the nearer the end is to a wall, the less safe."""
    return 1.0 / (1.0 + np.exp(-40.0 * features.min(axis=1)))


RULES = {
    "sharpened": scorer_rule(Scorer(name="sharpened", probability=wall_margin)),
    "blind": scorer_rule(
        Scorer(name="blind", probability=lambda state, *_: np.full(len(state), 0.5))
    ),
    "stubborn": lambda plans: np.ones(len(plans.first)),
}


def episodes(num_episodes, seed, **options):
    return run_episodes(shuttling(), num_episodes, seed=seed, num_workers=1, **options)


@pytest.fixture(scope="module")
def assessment():
    return SafetyAssessment(shuttling().assessment).fit(episodes(80, 0))


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
    other = plans_of(shuttling().make_loop(side="right"), episodes(20, 1, side="right"))
    sets = {"plans": plans, "plans.other": other}
    given = {"stubborn": 0.5}
    return evaluate_plans(RULES, given, assessment, calibration, sets, ["plans.other"])


def test_a_plan_is_what_is_known_at_its_first_instant_and_where_it_leads(fresh, plans):
    assert plans.first.is_first.all()
    np.testing.assert_array_equal(plans.first.state, [episode.state[0] for episode in fresh])
    # Unsafe is exactly what leads beyond a wall.
    np.testing.assert_array_equal(plans.first.is_unsafe, (plans.goals[:, :2] > 1.0).any(axis=1))
    assert 0 < plans.is_fair.sum() < len(fresh)
    assert plans.goals[plans.is_fair, 0].min() >= FAIR_X_M
    broken = replace(fresh[0], is_safe=False, cause=DIVERGED)
    some = plans_of(shuttling().make_loop(), Episodes(fresh.info, [broken, *fresh[1:10]]))
    assert (len(some.first), len(some.episodes)) == (9, 10)


@pytest.mark.train
def test_rules_make_the_promise_of_a_calibrated_assessment(assessment, calibration, plans):
    calibrated, label = copy.copy(assessment), calibration.first.is_unsafe
    calibrated.calibrations_ = {PLAN: promise(miss_rate=0.2)}
    _, limits = evaluate_plans(RULES, {}, calibrated, calibration, {"plans": plans})
    for name, rule in RULES.items():
        assert limits[name] == score_threshold(rule(calibration), label, 0.2)


@pytest.mark.train
def test_thresholds_come_from_the_calibration_plans_and_miss_none_of_them(
    study, calibration, fresh, plans
):
    estimates, limits = study
    score, label = RULES["sharpened"](calibration), calibration.first.is_unsafe
    assert limits["sharpened"] == score_threshold(score, label, promised_miss_rate(label))
    assert (score[label] > limits["sharpened"]).all()
    assert limits["stubborn"] == 0.5
    assert estimates["plans.stubborn.unsafe_recall"].value == 1.0
    # Told as the safety probability below which a plan is refused.
    assert estimates["plans.sharpened.threshold"].value == 1.0 - limits["sharpened"]
    assert estimates["plans.sharpened.auc"].value == 1.0
    assert estimates["plans.sharpened.unsafe_recall"].n == plans.first.is_unsafe.sum()
    shares = [estimates[f"plans.outcomes.{name}"] for name in ("safe", "front", "flank", DIVERGED)]
    assert sum(one.value for one in shares) == pytest.approx(1.0)
    assert shares[0].value == fresh.num_safe / len(fresh)
    # One score for all: nothing is accepted rather than an unsafe plan.
    for name in ("stubborn", "blind"):
        assert estimates[f"plans.{name}.safe_recall"].value == 0.0


@pytest.mark.train
def test_causes_are_judged_on_the_correctly_refused_alone(study, assessment, plans):
    estimates, limits = study
    first, named = plans.first, named_causes(assessment, plans)
    said = assessment.predict(first.state, first.desired_preview, first.features)
    np.testing.assert_array_equal(named["right_cause"], said.predicted_margins.argmin(axis=1))
    rows = first.is_unsafe & (RULES["sharpened"](plans) > limits["sharpened"])
    for name, causes in named.items():
        right = np.mean((causes == first.cause)[rows])
        assert estimates[f"plans.causes.{name}"].value == right
        assert estimates[f"plans.causes.{name}"].n == rows.sum()
    assert sum(estimates[f"plans.causes.{name}"].n for name in ("front", "flank")) == rows.sum()


def test_reachability_answers_for_the_hand_that_reaches(plans):
    class Near:
        def is_reachable(self, points):
            return points[:, 0] < 1.0

    score = reachability_rule({"left": Near()})(replace(plans, hand="left"))
    np.testing.assert_array_equal(score, (plans.goals[:, 0] >= 1.0).astype(float))


def test_recall_losses_compare_the_pairs_alone(plans):
    first = plans.first
    unsafe = first.is_unsafe
    none_lost = recall_losses(first, unsafe, first, unsafe)
    assert {estimate.value for estimate in none_lost.values()} == {0.0}
    # Twins of the first half, of which one safe plan is refused.
    half = first.take(first.episode < 20)
    refused = half.is_unsafe.copy()
    num_safe = int((~half.is_unsafe).sum())
    refused[np.flatnonzero(~half.is_unsafe)[0]] = True
    found = recall_losses(first, unsafe, half, refused)
    assert found["safe_recall_loss"].value == pytest.approx(1 / num_safe)
    assert found["safe_recall_loss"].n == len(half)
    assert found["unsafe_recall_loss"].value == 0.0
    # What is refused among plans without a twin does not count.
    beyond = unsafe | (first.episode >= 20)
    assert recall_losses(first, beyond, half, refused) == found
