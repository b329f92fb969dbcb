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


def running(assessment=None, without=(), **options):
    assessment = assessment or AssessmentDouble()
    evaluator = SafetyAssessor(assessment, period_s=PERIOD_S, **options)
    given = {name: value for name, value in INPUTS.items() if name not in without}
    return assessment, Bench(evaluator, **given)


OF = {"probability": "safety_", "belief": ""}


def test_every_part_of_the_verdict_comes_out_at_its_own_port_and_before_it_nothing_is_known():
    _, bench = running()
    np.testing.assert_array_equal(bench.get("belief"), [0.0, 0.0, 1.0])
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
    }
    expected |= {f"{one}_without_alarm": expected[f"{of}{one}"] for one, of in OF.items()}
    for name, numbers in expected.items():
        np.testing.assert_allclose(bench.get(name), numbers)


def test_an_alarm_takes_nothing_from_what_a_recovery_reads():
    evaluator = SafetyAssessor(AssessmentDouble(), period_s=PERIOD_S)
    bench = Bench(evaluator, **INPUTS | {"alarm": np.ones(1)})
    bench.begin()
    assert bench.get("safety_probability") == [0.0]
    np.testing.assert_array_equal(bench.get("belief"), [0.0, 0.0, 1.0])
    assert bench.get("probability_without_alarm") == [0.25]
    np.testing.assert_allclose(bench.get("belief_without_alarm"), [0.25, 0.65, 0.1])
    bench = Bench(evaluator, **INPUTS | {"alarm": np.ones(1), "margins": np.array([0.1, -0.1])})
    bench.begin()
    assert bench.get("probability_without_alarm") == [0.0]
    np.testing.assert_allclose(bench.get("belief_without_alarm"), [0.0, 0.9, 0.1])


def test_the_assessment_is_asked_once_a_period_with_what_stands_at_the_ports():
    assessment, bench = running()
    bench.begin()
    expected = *list(INPUTS.values())[:3], assessment.beliefs_
    for found, value in zip(assessment.asked[0], expected, strict=True):
        np.testing.assert_array_equal(found, value)
    before = len(assessment.asked)
    bench.advance(10 * PERIOD_S + 0.001)
    assert len(assessment.asked) - before in (10, 11)


def test_an_assessment_without_features_needs_none():
    assessment, bench = running(AssessmentDouble(uses_features=False), ["features"])
    bench.begin()
    assert assessment.asked[0][2] is None


def test_who_wants_neither_check_nor_alarm_says_so():
    ports = ["margins", "alarm"]
    _, bench = running(without=ports, checks_margins=False, heeds_alarm=False)
    assert not any(map(bench.system.HasInputPort, ports))
    assert bench.begin().get("belief")[0] == 0.25


def test_new_beliefs_change_the_verdict_of_one_context_only():
    assessment, bench = running()
    other = Bench(bench.system, **INPUTS)
    bench.system.set_beliefs(bench.context, 2 * assessment.beliefs_)
    for one, factor in ((bench, 2), (other, 1)):
        assert one.begin().get("safety_probability")[0] == factor * 0.25
        beliefs = one.system.get_beliefs(one.context)
        np.testing.assert_array_equal(beliefs, factor * assessment.beliefs_)


def test_what_feedback_has_shown_is_adopted_while_the_simulation_runs():
    assessment, bench = running()
    bench.advance(0.01)
    adapted = AssessmentDouble()
    adapted.embedding_ = assessment.embedding_
    adapted.beliefs_ = 2 * assessment.beliefs_
    adapted.correction_ = correction(0.125)
    bench.system.adopt(bench.context, adapted)
    assert bench.get("safety_probability")[0] == 0.25
    bench.advance(PERIOD_S)
    assert bench.get("safety_probability")[0] == 0.625
    assert assessment.novelties[0] is assessment.novelty_
    assert assessment.novelties[-1] is adapted.novelty_


def test_what_was_learned_of_other_maps_and_beliefs_of_another_shape_are_refused():
    _, bench = running()
    with pytest.raises(ValueError, match="has other maps"):
        bench.system.adopt(bench.context, AssessmentDouble())
    with pytest.raises(ValueError, match=r"of shape \(1, 6, 5\); got"):
        bench.system.set_beliefs(bench.context, np.zeros((6, 5)))


def test_an_alarm_makes_the_belief_unknown():
    _, bench = running()
    bench.fix(alarm=1.0)
    bench.begin()
    np.testing.assert_array_equal(bench.get("belief"), [0.0, 0.0, 1.0])
    for name in ("safety_probability", "cause_probability"):
        assert not bench.get(name).any()
    assert bench.get("novelty") == NOVELTY


@pytest.mark.parametrize("margins", [[0.1, -0.02], [-1.0, -2.0]])
def test_outside_the_safe_set_nothing_is_safe_until_it_has_been_entered_again(margins):
    _, bench = running()
    bench.fix(margins=margins)
    bench.begin()
    np.testing.assert_allclose(bench.get("belief"), [0.0, 0.9, 0.1])
    # The mass goes to the most violated constraint.
    np.testing.assert_allclose(bench.get("cause_probability"), [0.2, 0.55])
    assert bench.get("safety_probability") == 0.0
    bench.fix(margins=[0.1, 0.2])
    bench.advance(PERIOD_S)
    np.testing.assert_allclose(bench.get("belief"), [0.25, 0.65, 0.1])


@pytest.mark.parametrize(
    ("margins", "cause"),
    [
        ([0.1, np.nan], 1),
        ([np.nan, -1.0], 0),
        ([-1.0, np.nan], 1),
        ([np.inf, 0.1], 0),
        ([0.1, -np.inf], 1),
        ([-1.0, np.inf], 1),
        ([np.nan, np.nan], 0),
    ],
)
def test_a_margin_that_is_not_finite_is_outside_the_safe_set_and_the_cause(margins, cause):
    _, bench = running()
    bench.fix(margins=margins)
    bench.begin()
    np.testing.assert_allclose(bench.get("belief"), [0.0, 0.9, 0.1])
    assert bench.get("safety_probability") == 0.0
    np.testing.assert_allclose(bench.get("cause_probability") - [0.2, 0.3], 0.25 * np.eye(2)[cause])


@pytest.mark.parametrize("alarm", [1.0, np.nan, np.inf, -np.inf])
def test_an_alarm_that_is_not_finite_is_one(alarm):
    _, bench = running()
    bench.fix(alarm=alarm)
    np.testing.assert_array_equal(bench.begin().get("belief"), [0.0, 0.0, 1.0])


@pytest.mark.parametrize("entry", ["state", "desired_preview", "features", "beliefs"])
def test_what_is_not_finite_is_not_known_and_may_fall(entry):
    assessment = load_assessment("go2_walking" if entry == "features" else "laikago_balancing")
    info = assessment.info_
    widths = {"state": len(info.state_names), "features": len(info.feature_names)}
    widths["desired_preview"] = info.horizon * len(info.output_names)
    given = {name: np.zeros(width) for name, width in widths.items()}
    evaluator = SafetyAssessor(assessment, period_s=0.02, checks_margins=False, heeds_alarm=False)
    if entry in given:
        given[entry][-1] = np.nan
    bench = Bench(evaluator, **given)
    if entry == "beliefs":
        beliefs = np.full_like(assessment.beliefs_, np.nan)
        with pytest.raises(ValueError, match="must be finite numbers"):
            evaluator.set_beliefs(bench.context, beliefs)
        bench.context.get_mutable_numeric_parameter(0).SetFromVector(beliefs.ravel())
    bench.begin()
    np.testing.assert_array_equal(bench.get("belief"), [0.0, 0.0, 1.0])
    assert bench.get("safety_probability") == 0.0
    is_learned = assessment.fall_logit_ is not None and entry != "beliefs"
    assert bench.get("fall_probability") == 1.0 if is_learned else True


@pytest.mark.parametrize("mode", ["paper", "sharpened"])
def test_where_no_falls_were_learned_their_probability_is_not_a_number(mode):
    assessment = load_assessment("laikago_balancing", mode)
    assessment.fall_logit_ = None
    info = assessment.info_
    rows = [np.zeros(info.widths[name]) for name in ("state", "desired_preview", "features")]
    expected = assessment.predict_one(*rows).fall_probability
    names = ("state", "desired_preview", "features")
    system = SafetyAssessor(assessment, period_s=0.02, checks_margins=False, heeds_alarm=False)
    bench = Bench(system, **dict(zip(names, rows, strict=True)))
    for found in (expected, bench.get("fall_probability"), bench.begin().get("fall_probability")):
        assert np.isnan(found)
