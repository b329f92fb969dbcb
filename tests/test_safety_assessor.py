"""SafetyAssessor: a port for each part of a prediction; alarms, margins, NaN and adoption."""

import numpy as np
import pytest

from drake_safety import load_assessment
from drake_safety.systems.safety_assessor import SafetyAssessor
from system_doubles import NOVELTY, AssessmentDouble, Bench, correction

PERIOD_S = 0.04
INPUTS = {
    "state": np.array([0.25, 0.5]),
    "desired_preview": np.arange(6.0),
    "features": np.array([7.0, 8.0, 9.0]),
    "margins": np.ones(2),
    "alarm": np.zeros(1),
}
UNKNOWN = [0.0, 0.0, 1.0]


def running(assessment=None, **values):
    assessment = assessment or AssessmentDouble()
    return assessment, Bench(SafetyAssessor(assessment, period_s=PERIOD_S), **INPUTS | values)


def test_each_part_of_the_prediction_has_a_port_and_nothing_is_known_before_it():
    assessment, bench = running()
    np.testing.assert_array_equal(bench.get("belief"), UNKNOWN)
    assert bench.get("safety_probability") == [0.0]
    bench.begin()
    expected = {
        "safety_probability": [0.25],
        "belief": [0.25, 0.65, 0.1],
        "embedding": [3.0, -4.0],
        "cause_probability": [0.2, 0.3],
        "predicted_margins": [0.01, np.nan],
        "novelty": [NOVELTY],
        "fall_probability": [0.125],
        "probability_without_alarm": [0.25],
        "belief_without_alarm": [0.25, 0.65, 0.1],
    }
    for name, numbers in expected.items():
        np.testing.assert_allclose(bench.get(name), numbers)
    asked = *list(INPUTS.values())[:3], assessment.beliefs_
    for value, given in zip(assessment.asked[0], asked, strict=True):
        np.testing.assert_array_equal(value, given)
    before = len(assessment.asked)
    bench.advance(10 * PERIOD_S + 0.001)
    assert len(assessment.asked) - before in (10, 11)


def test_features_margins_and_alarm_may_be_missing():
    assessment = AssessmentDouble(uses_features=False)
    options = {"period_s": PERIOD_S, "checks_margins": False, "heeds_alarm": False}
    given = {name: INPUTS[name] for name in ("state", "desired_preview")}
    bench = Bench(SafetyAssessor(assessment, **options), **given)
    assert not any(map(bench.system.HasInputPort, ["margins", "alarm"]))
    assert bench.begin().get("belief")[0] == 0.25
    assert assessment.asked[0][2] is None


@pytest.mark.parametrize("alarm", [1.0, np.nan, -np.inf])
def test_an_alarm_makes_the_belief_unknown_but_not_what_a_recovery_reads(alarm):
    _, bench = running(alarm=alarm)
    bench.begin()
    np.testing.assert_array_equal(bench.get("belief"), UNKNOWN)
    for name in ("safety_probability", "cause_probability"):
        assert not bench.get(name).any()
    assert bench.get("novelty") == NOVELTY
    assert bench.get("probability_without_alarm") == [0.25]
    np.testing.assert_allclose(bench.get("belief_without_alarm"), [0.25, 0.65, 0.1])
    _, bench = running(alarm=alarm, margins=[0.1, -0.1])
    bench.begin()
    assert bench.get("probability_without_alarm") == [0.0]
    np.testing.assert_allclose(bench.get("belief_without_alarm"), [0.0, 0.9, 0.1])


@pytest.mark.parametrize(
    ("margins", "cause"),
    [
        ([0.1, -0.02], 1),
        ([-1.0, -2.0], 1),  # The mass goes to the most violated constraint,
        ([-1.0, np.nan], 1),  # but first to one that is not finite.
        ([np.inf, 0.1], 0),
        ([np.nan, np.nan], 0),
    ],
)
def test_outside_the_safe_set_nothing_is_safe_until_it_has_been_entered_again(margins, cause):
    _, bench = running(margins=margins)
    bench.begin()
    np.testing.assert_allclose(bench.get("belief"), [0.0, 0.9, 0.1])
    assert bench.get("safety_probability") == 0.0
    np.testing.assert_allclose(bench.get("cause_probability") - [0.2, 0.3], 0.25 * np.eye(2)[cause])
    bench.fix(margins=[0.1, 0.2])
    bench.advance(PERIOD_S)
    np.testing.assert_allclose(bench.get("belief"), [0.25, 0.65, 0.1])


def test_an_adapted_assessment_is_adopted_in_one_context_while_the_simulation_runs():
    assessment, bench = running()
    other = Bench(bench.system, **INPUTS)
    bench.advance(0.01)
    adapted = AssessmentDouble()
    with pytest.raises(ValueError, match="has other maps"):
        bench.system.adopt(bench.context, adapted)
    adapted.embedding_ = assessment.embedding_
    adapted.beliefs_ = 2 * assessment.beliefs_
    adapted.correction_ = correction(0.125)
    bench.system.adopt(bench.context, adapted)
    assert bench.get("safety_probability")[0] == 0.25
    bench.advance(PERIOD_S)
    assert bench.get("safety_probability")[0] == 0.625
    assert assessment.novelties[0] is assessment.novelty_
    assert assessment.novelties[-1] is adapted.novelty_
    for one, factor in ((bench, 2), (other, 1)):
        beliefs = one.system.GetOutputPort("learned").Eval(one.context)["beliefs"]
        np.testing.assert_array_equal(beliefs, factor * assessment.beliefs_)
    assert other.begin().get("safety_probability")[0] == 0.25


@pytest.mark.parametrize("entry", ["state", "desired_preview", "features", "beliefs"])
def test_an_input_that_is_not_finite_is_unknown_and_may_fall(entry):
    assessment = load_assessment("go2_walking" if entry == "features" else "laikago_balancing")
    names = ("state", "desired_preview", "features")
    given = {name: np.zeros(assessment.info_.widths[name]) for name in names}
    if entry in given:
        given[entry][-1] = np.nan
    system = SafetyAssessor(assessment, period_s=0.02, checks_margins=False, heeds_alarm=False)
    bench = Bench(system, **given)
    if entry == "beliefs":
        beliefs = np.full(assessment.beliefs_.size, np.nan)
        bench.context.get_mutable_numeric_parameter(0).SetFromVector(beliefs)
    bench.begin()
    np.testing.assert_array_equal(bench.get("belief"), UNKNOWN)
    assert bench.get("safety_probability") == 0.0
    is_learned = assessment.fall_logit_ is not None and entry != "beliefs"
    assert bench.get("fall_probability") == 1.0 if is_learned else True


@pytest.mark.parametrize("mode", ["paper", "sharpened"])
def test_the_fall_probability_of_an_assessment_without_falls_is_nan(mode):
    assessment = load_assessment("laikago_balancing", mode)
    assessment.fall_logit_ = None
    names = ("state", "desired_preview", "features")
    rows = {name: np.zeros(assessment.info_.widths[name]) for name in names}
    expected = assessment.predict_one(*rows.values()).fall_probability
    system = SafetyAssessor(assessment, period_s=0.02, checks_margins=False, heeds_alarm=False)
    assert np.isnan([expected, *Bench(system, **rows).begin().get("fall_probability")]).all()
