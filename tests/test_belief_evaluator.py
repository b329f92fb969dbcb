import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from drake_safety.systems.belief_evaluator import BeliefEvaluator
from gliding_task import evaluated
from system_doubles import NOVELTY, AssessmentDouble, correction

PERIOD_S = 0.04
STATE, PREVIEW, FEATURES = np.array([0.25, 0.5]), np.arange(6.0), np.array([7.0, 8.0, 9.0])
INPUTS = {
    "state": STATE,
    "desired_preview": PREVIEW,
    "features": FEATURES,
    "margins": np.ones(2),
    "alarm": np.zeros(1),
}


def fix(evaluator, context, without=()):
    for name in INPUTS.keys() - set(without):
        evaluator.GetInputPort(name).FixValue(context, INPUTS[name])


def running(assessment=None, without=()):
    assessment = assessment or AssessmentDouble()
    evaluator = BeliefEvaluator(assessment, period_s=PERIOD_S)
    simulator = Simulator(evaluator)
    context = simulator.get_mutable_context()
    fix(evaluator, context, without)
    return assessment, evaluator, simulator, context


def test_every_part_of_the_verdict_comes_out_at_its_own_port():
    _, evaluator, simulator, context = running()
    simulator.Initialize()
    expected = {
        "safety_probability": [0.25],
        "belief": [0.25, 0.65, 0.1],
        "embedding": [3.0, -4.0],
        "cause_probability": [0.2, 0.3],
        "predicted_margins": [0.01, np.nan],
        "novelty": [NOVELTY],
    }
    for name, numbers in expected.items():
        np.testing.assert_allclose(evaluated(evaluator, context, name), numbers)


def test_before_the_first_evaluation_nothing_is_known():
    _, evaluator, _, context = running()
    np.testing.assert_array_equal(evaluated(evaluator, context, "belief"), [0.0, 0.0, 1.0])
    assert evaluated(evaluator, context, "safety_probability") == [0.0]


def test_the_assessment_is_asked_with_what_stands_at_the_ports():
    assessment, _, simulator, _ = running()
    simulator.Initialize()
    state, preview, features, beliefs = assessment.asked[0]
    np.testing.assert_array_equal(state, STATE)
    np.testing.assert_array_equal(preview, PREVIEW)
    np.testing.assert_array_equal(features, FEATURES)
    np.testing.assert_array_equal(beliefs, assessment.beliefs_)


def test_an_assessment_without_features_needs_none():
    assessment, _, simulator, _ = running(
        AssessmentDouble(uses_features=False), without=["features"]
    )
    simulator.Initialize()
    assert assessment.asked[0][2] is None


def test_who_wants_neither_check_nor_alarm_says_so():
    evaluator = BeliefEvaluator(
        AssessmentDouble(), period_s=PERIOD_S, checks_margins=False, heeds_alarm=False
    )
    assert not evaluator.HasInputPort("margins")
    assert not evaluator.HasInputPort("alarm")
    simulator = Simulator(evaluator)
    fix(evaluator, simulator.get_mutable_context(), without=["margins", "alarm"])
    simulator.Initialize()
    assert evaluated(evaluator, simulator.get_context(), "belief")[0] == 0.25


def test_it_is_evaluated_once_a_period():
    assessment, _, simulator, _ = running()
    simulator.Initialize()
    before = len(assessment.asked)
    simulator.AdvanceTo(10 * PERIOD_S + 0.001)
    assert len(assessment.asked) - before in (10, 11)


def test_new_beliefs_change_the_verdict_of_one_context_only():
    assessment, evaluator, simulator, context = running()
    other = Simulator(evaluator)
    other_context = other.get_mutable_context()
    fix(evaluator, other_context)
    evaluator.set_beliefs(context, 2 * assessment.beliefs_)
    simulator.Initialize()
    other.Initialize()
    assert evaluated(evaluator, context, "safety_probability")[0] == 0.5
    assert evaluated(evaluator, other_context, "safety_probability")[0] == 0.25
    np.testing.assert_array_equal(evaluator.get_beliefs(context), 2 * assessment.beliefs_)
    np.testing.assert_array_equal(evaluator.get_beliefs(other_context), assessment.beliefs_)


def test_what_feedback_has_shown_is_adopted_while_the_simulation_runs():
    assessment, evaluator, simulator, context = running()
    simulator.AdvanceTo(0.01)
    adapted = AssessmentDouble()
    adapted.embedding_ = assessment.embedding_
    adapted.beliefs_ = 2 * assessment.beliefs_
    adapted.correction_ = correction(0.125)
    evaluator.adopt(context, adapted)
    assert evaluated(evaluator, context, "safety_probability")[0] == 0.25
    simulator.AdvanceTo(PERIOD_S + 0.001)
    assert evaluated(evaluator, context, "safety_probability")[0] == 0.625
    assert assessment.novelties[0] is assessment.novelty_
    assert assessment.novelties[-1] is adapted.novelty_


def test_what_was_learned_of_other_maps_is_refused():
    _, evaluator, _, context = running()
    with pytest.raises(ValueError, match="has other maps"):
        evaluator.adopt(context, AssessmentDouble())


def test_beliefs_of_another_shape_are_refused_with_both_named():
    _, evaluator, _, context = running()
    with pytest.raises(ValueError, match=r"must have shape \(1, 6, 5\); got \(6, 5\)"):
        evaluator.set_beliefs(context, np.zeros((6, 5)))


def test_an_alarm_makes_the_belief_unknown():
    _, evaluator, simulator, context = running()
    evaluator.GetInputPort("alarm").FixValue(context, [1.0])
    simulator.Initialize()
    np.testing.assert_array_equal(evaluated(evaluator, context, "belief"), [0.0, 0.0, 1.0])
    for name in ("safety_probability", "cause_probability"):
        assert not evaluated(evaluator, context, name).any()
    assert evaluated(evaluator, context, "novelty") == NOVELTY


@pytest.mark.parametrize("margins", [[0.1, -0.02], [-1.0, -2.0]])
def test_outside_the_safe_set_nothing_is_safe_until_it_has_been_entered_again(margins):
    _, evaluator, simulator, context = running()
    port = evaluator.GetInputPort("margins")
    port.FixValue(context, margins)
    simulator.Initialize()
    np.testing.assert_allclose(evaluated(evaluator, context, "belief"), [0.0, 0.9, 0.1])
    # The mass goes to the most violated constraint.
    np.testing.assert_allclose(evaluated(evaluator, context, "cause_probability"), [0.2, 0.55])
    assert evaluated(evaluator, context, "safety_probability") == 0.0
    port.FixValue(context, [0.1, 0.2])
    simulator.AdvanceTo(PERIOD_S)
    np.testing.assert_allclose(evaluated(evaluator, context, "belief"), [0.25, 0.65, 0.1])
