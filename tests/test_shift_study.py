"""Confident errors, "don't know" and alarms under shifts are counted as they are defined."""

import dataclasses
import math

import numpy as np
import pytest

from drake_safety import AssessmentParameters, SafetyAssessment, load_assessment, load_scenario
from drake_safety.evaluation.shift_study import (
    CONFIDENT,
    Verdicts,
    assessment_judge,
    detector_judges,
    evaluate_shift,
    false_alarms,
)
from drake_safety.evaluation.shifted_motions import (
    Motion,
    ShiftedSet,
    junk,
    of_episodes,
    run_changed_starts,
    shifted_scenario,
)
from drake_safety.evaluation.shifts import POSTURES, STARTS, plant_shifts
from drake_safety.evaluation.shifts_figure import shifts_figure
from drake_safety.learning.calibration import PLAN, Calibration
from lip_assessments import QUICK
from lip_episodes import make_episodes


@pytest.fixture(scope="module")
def training():
    return make_episodes(240, noise=0.002)


@pytest.fixture(scope="module")
def assessment(training):
    found = SafetyAssessment(AssessmentParameters(**QUICK)).fit(training)
    found.calibrations_[PLAN] = Calibration(
        kind=PLAN,
        miss_rate=0.1,
        false_alarm_rate=0.1,
        confidence=None,
        threshold=0.6,
        unsafe_below=0.4,
        num_unsafe=50,
        num_safe=50,
        num_missed=4,
        num_accepted=40,
        seed=1,
        scenario_hash="",
    )
    return found


@pytest.fixture(scope="module")
def nominal():
    return of_episodes("nominal", make_episodes(80, seed=5, noise=0.002))


def motion(num_rows, probability, *, is_unsafe, is_outside=False):
    """A motion whose state is the probability that the double below returns."""
    return Motion(
        state=np.full((num_rows, 6), float(probability)),
        desired_preview=np.zeros((num_rows, 30)),
        features=np.zeros((num_rows, 5)),
        is_outside=np.full(num_rows, is_outside),
        is_unsafe=is_unsafe,
    )


def told(state, preview, features, is_outside):
    probability = state[:, 0].copy()
    is_unknown = probability < 0.0
    return Verdicts(probability=np.where(is_unknown, 0.0, probability), is_unknown=is_unknown)


@pytest.mark.train
def test_a_confident_error_is_a_row_called_safe_in_a_motion_that_ends_unsafely(assessment):
    motions = [
        motion(10, 0.95, is_unsafe=True),  # sure and wrong
        motion(20, 0.95, is_unsafe=False),
        motion(30, CONFIDENT - 0.01, is_unsafe=True),
        motion(40, -1.0, is_unsafe=True),  # don't know
    ]
    result = evaluate_shift(ShiftedSet(kind="plan", motions=motions), assessment, {"gamma": told})
    found = result.estimates
    assert found["gamma.confident_error"].value == pytest.approx(0.1)
    assert found["gamma.unknown"].value == pytest.approx(0.4)
    assert found["gamma.first.confident_error"].value == 0.25
    assert found["unsafe"].value == 0.75
    assert found["gamma.confident_error"].n == 4
    # Of three unsafe plans, two have at least the promise's threshold.
    assert found["missed"].value == pytest.approx(2 / 3)
    assert "monitor.delay_s" not in found


@pytest.mark.train
def test_a_threshold_that_follows_outcomes_misses_less_and_accepts_less(assessment):
    rng = np.random.default_rng(0)
    is_unsafe = rng.random(400) < 0.5
    # Under this shift unsafe plans look as safe as the threshold, and a little more.
    probability = np.where(is_unsafe, rng.uniform(0.5, 0.9, 400), rng.uniform(0.7, 1.0, 400))
    motions = [motion(1, p, is_unsafe=bool(u)) for p, u in zip(probability, is_unsafe, strict=True)]
    shifted = ShiftedSet(kind="plan", motions=motions)
    found = evaluate_shift(shifted, assessment, {"gamma": told}).estimates
    assert found["fixed.missed"].value > 0.6
    assert found["fixed.accepted"].value == 1.0
    assert found["adaptive.missed"].value == pytest.approx(0.1, abs=0.05)
    assert 0.2 < found["adaptive.accepted"].value < 0.6
    assert found["adaptive.missed"].n == pytest.approx(is_unsafe.sum() / 2, abs=1)


@pytest.mark.train
def test_outside_the_safe_set_gamma_is_not_safe_but_the_grid_alone_may_be(assessment, nominal):
    rows = nominal.motions[0]
    given = (rows.state, rows.desired_preview, rows.features)
    outside = np.ones(len(rows.state), dtype=bool)
    assert not assessment_judge(assessment)(*given, outside).probability.any()
    alone = assessment_judge(assessment, is_novelty_used=False)
    np.testing.assert_array_equal(
        alone(*given, outside).probability, alone(*given, ~outside).probability
    )


@pytest.mark.train
def test_junk_is_dont_know_and_keeps_what_it_says_it_keeps(assessment, nominal):
    found = junk(nominal.motions[:20], seed=3)
    assert set(found) == {
        "columns shuffled",
        "gaussian",
        "state of another row",
        "plan of another row",
        "features of another row",
    }
    plain = np.concatenate([one.state for one in nominal.motions[:20]])
    shuffled = np.concatenate([one.state for one in found["columns shuffled"].motions])
    np.testing.assert_array_equal(np.sort(shuffled, axis=0), np.sort(plain, axis=0))
    kept = np.concatenate([one.state for one in found["plan of another row"].motions])
    np.testing.assert_array_equal(kept, plain)
    # Noise makes every row unique: none is taken from its own motion.
    for own, changed in zip(
        nominal.motions[:20], found["state of another row"].motions, strict=True
    ):
        assert not np.isin(changed.state[:, 0], own.state[:, 0]).any()
    judges = {"gamma": assessment_judge(assessment)}
    result = evaluate_shift(found["columns shuffled"], assessment, judges).estimates
    assert result["gamma.unknown"].value > 0.9
    assert result["gamma.confident_error"].value < 0.05


@pytest.mark.train
def test_a_steady_push_is_noticed_and_the_same_plant_is_not(assessment, nominal):
    assert false_alarms(nominal.motions, assessment).value == 0.0
    pushed = [
        dataclasses.replace(one, state=one.state + 0.004 * np.arange(len(one.state))[:, None])
        for one in nominal.motions
    ]
    judges = {"gamma": assessment_judge(assessment)}
    found = evaluate_shift(ShiftedSet(kind="plant", motions=pushed), assessment, judges).estimates
    assert found["monitor.delay_s"].value < 5.0
    assert found["monitor.delay_95_s"].value >= found["monitor.delay_s"].value
    assert found["monitor.alarmed"].value == 1.0
    assert found["monitor.confident_error_60s"].value <= found["gamma.confident_error"].value
    assert false_alarms(pushed, assessment).value > 100.0


@pytest.mark.train
def test_published_detectors_refuse_about_as_many_safe_episodes(assessment, training, nominal):
    judges = detector_judges(assessment, training)
    assert set(judges) == {"isolation_forest", "deep_knn"}
    plain = assessment_judge(assessment, is_novelty_used=False)
    for judge in judges.values():
        unknown = []
        for one in nominal.motions:
            if one.is_unsafe:
                continue
            given = (one.state, one.desired_preview, one.features, one.is_outside)
            unknown.append(np.any(judge(*given).is_unknown & ~plain(*given).is_unknown))
        assert np.mean(unknown) < 0.2


def test_the_catalogue_is_scaled_to_the_robot():
    scenario = load_scenario("laikago_balancing")
    shifts = plant_shifts(scenario, scenario.make_loop())
    force_n = shifts["side_force"].variation.shift.base_force_n
    mass_kg = shifts["payload"].variation.payload.mass_kg / 0.3
    assert math.isclose(force_n[1], 0.1 * 9.81 * mass_kg)
    assert {"slope", "hole", "weak_joint", "frozen", "variation actual"} <= set(shifts)
    assert all(one.kind in ("plant", "sensor") for one in shifts.values())
    shifted = shifted_scenario(scenario, "slope", shifts["slope"])
    assert "slope" in shifted.variations
    assert "slope" not in scenario.variations
    assert shifted.simulation_hash("slope") != scenario.simulation_hash("nominal")


def test_a_plant_of_its_own_has_the_scenarios_variations_alone():
    scenario = load_scenario("pendulum")
    shifts = plant_shifts(scenario, scenario.make_loop())
    assert list(shifts) == [f"variation {n}" for n in scenario.variations if n != "nominal"]
    assert run_changed_starts(scenario, 2, seed=1) == {}


@pytest.mark.train
def test_the_ranking_is_that_of_all_rows_and_of_those_that_gamma_knows(assessment):
    # The only known safe motion lies above both unsafe ones; the unknown ones are safe.
    motions = [
        motion(4, 0.8, is_unsafe=False),
        *(motion(2, -1.0, is_unsafe=False) for _ in range(2)),
        *(motion(4, 0.5, is_unsafe=True) for _ in range(2)),
    ]

    def other(state, preview, features, is_outside):
        probability = np.where(state[:, 0] < 0.0, 0.9, 1.0 - state[:, 0])
        return Verdicts(probability=probability, is_unknown=np.zeros(len(state), dtype=bool))

    shifted = ShiftedSet(kind="plan", motions=motions)
    found = evaluate_shift(shifted, assessment, {"gamma": told, "other": other}).estimates
    assert found["gamma.known_auc"].value == 1.0
    assert found["gamma.auc"].value == pytest.approx(0.5)
    assert found["other.known_auc"].value == 0.0
    assert found["other.auc"].value == pytest.approx(0.5)


def test_postures_and_falls_are_never_called_safe():
    scenario, gamma = load_scenario("laikago_balancing"), load_assessment("laikago_balancing")
    sets = run_changed_starts(scenario, 6, seed=77, num_workers=1)
    assert {*STARTS, *POSTURES} <= set(sets)
    judge = assessment_judge(gamma)
    for name in sets:
        if sets[name].kind != "posture":
            continue
        for one in sets[name].motions:
            verdicts = judge(one.state, one.desired_preview, one.features, one.is_outside)
            assert verdicts.probability.max() < CONFIDENT, name
            if name in POSTURES:
                assert verdicts.is_unknown.all(), name


@pytest.mark.train
def test_the_picture_has_a_row_for_each_shift(assessment, nominal):
    judges = {
        "gamma": assessment_judge(assessment),
        "without_novelty": assessment_judge(assessment, is_novelty_used=False),
    }
    results = {
        name: evaluate_shift(one, assessment, judges)
        for name, one in {
            "nominal": nominal,
            "side_force": ShiftedSet(kind="plant", motions=nominal.motions[:30]),
        }.items()
    }
    labels = [text.get_text() for text in shifts_figure(results).axes[0].get_yticklabels()]
    assert labels == ["nominal", "side force"]
