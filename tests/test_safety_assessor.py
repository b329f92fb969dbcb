"""SafetyAssessor: Γ inside a diagram, evaluated on time, with beliefs that live in the Context."""

import dataclasses
import re
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_safety.learning.novelty import Moments, Novelty
from drake_safety.learning.prediction import Assessment, Correction
from drake_safety.systems.safety_assessor import SafetyAssessor

PERIOD_S, NOVELTY = 0.04, 0.7
STATE, PREVIEW, FEATURES = np.array([0.25, 0.5]), np.arange(6.0), np.array([7.0, 8.0, 9.0])


def correction(size):
    """One of maps with three activations, for six cells."""
    return Correction(
        change=np.full(3, size),
        hidden=np.full((1, 4), size),
        hidden_range=np.array([-size, size]),
        guard=np.ones((1, 6)),
    )


class AssessmentDouble:
    """b_safe is the state's first entry times the first belief; it keeps what it was asked."""

    def __init__(self, uses_features=True):
        self.info_ = SimpleNamespace(
            state_names=["a", "b"],
            output_names=["x", "y", "z"],
            feature_names=["f", "g", "h"],
            constraint_names=["left", "right"],
            horizon=2,
        )
        self.beliefs_ = np.arange(1.0, 31.0).reshape(1, 6, 5)
        self.correction_ = correction(0.0)
        self.base_logit_ = object()
        self.novelty_ = Novelty(training=Moments.of(np.eye(3)), limits=np.ones(3), plan=slice(0))
        self.embedding_ = SimpleNamespace(is_same=lambda other: False)
        self.uses_features = uses_features
        self.asked, self.novelties = [], []

    def predict_one(self, state, desired_preview, features, *, beliefs, correction, novelty):
        self.novelties.append(novelty)
        self.asked.append((state.copy(), desired_preview.copy(), features, beliefs.copy()))
        if not np.isfinite(state).all():
            safe, belief = 0.0, [0.0, 0.0, 1.0]
        else:
            safe = state[0] * beliefs[0, 0, 0]
            belief = [safe, 0.9 - safe, 0.1]
        probability = safe + correction.hidden[0, 3] * correction.guard[0, 5]
        return Assessment(
            belief=np.array(belief),
            probability=probability,
            cause_probability=np.array([0.2, 0.3]),
            embedding=np.array([3.0, -4.0]),
            predicted_margins=np.array([0.01, np.nan]),
            novelty=NOVELTY,
        )


def running(assessment=None, features=FEATURES):
    assessment = assessment or AssessmentDouble()
    assessor = SafetyAssessor(assessment, period_s=PERIOD_S)
    simulator = Simulator(assessor)
    context = simulator.get_mutable_context()
    assessor.GetInputPort("state").FixValue(context, STATE)
    assessor.GetInputPort("desired_preview").FixValue(context, PREVIEW)
    if features is not None:
        assessor.GetInputPort("features").FixValue(context, features)
    return assessment, assessor, simulator, context


def value(assessor, context, name):
    return assessor.GetOutputPort(name).Eval(context)


def test_its_ports_have_the_sizes_the_assessment_was_learned_with():
    assessor = SafetyAssessor(AssessmentDouble(), period_s=PERIOD_S)
    inputs = {"state": 2, "desired_preview": 6, "features": 3}
    outputs = {
        "safety_probability": 1,
        "belief": 3,
        "embedding": 2,
        "cause_probability": 2,
        "predicted_margins": 2,
        "novelty": 1,
    }
    assert {n: assessor.GetInputPort(n).size() for n in inputs} == inputs
    assert {n: assessor.GetOutputPort(n).size() for n in outputs} == outputs
    assert assessor.num_output_ports() == len(outputs)
    assert assessor.constraint_names == ["left", "right"]


def test_no_input_feeds_through():
    assert not SafetyAssessor(AssessmentDouble(), period_s=PERIOD_S).HasAnyDirectFeedthrough()


def test_every_part_of_the_verdict_comes_out_at_its_own_port():
    _, assessor, simulator, context = running()
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
        np.testing.assert_allclose(value(assessor, context, name), numbers)


def test_before_the_first_evaluation_nothing_is_known():
    _, assessor, _, context = running()
    np.testing.assert_array_equal(value(assessor, context, "belief"), [0.0, 0.0, 1.0])
    assert value(assessor, context, "safety_probability") == [0.0]


def test_the_assessment_is_asked_with_what_stands_at_the_ports():
    assessment, _, simulator, _ = running()
    simulator.Initialize()
    state, preview, features, beliefs = assessment.asked[0]
    np.testing.assert_array_equal(state, STATE)
    np.testing.assert_array_equal(preview, PREVIEW)
    np.testing.assert_array_equal(features, FEATURES)
    np.testing.assert_array_equal(beliefs, assessment.beliefs_)


def test_an_assessment_without_features_needs_none():
    assessment, _, simulator, _ = running(AssessmentDouble(uses_features=False), features=None)
    simulator.Initialize()
    assert assessment.asked[0][2] is None


def test_missing_features_are_named_when_the_assessment_uses_them():
    _, _, simulator, _ = running(features=None)
    with pytest.raises(RuntimeError, match="features"):
        simulator.Initialize()


def test_the_verdict_is_held_for_a_period():
    _, assessor, simulator, context = running()
    simulator.AdvanceTo(0.01)
    assessor.GetInputPort("state").FixValue(context, [0.75, 0.0])
    simulator.AdvanceTo(0.039)
    assert value(assessor, context, "safety_probability")[0] == 0.25
    simulator.AdvanceTo(0.041)
    assert value(assessor, context, "safety_probability")[0] == 0.75


def test_it_is_evaluated_once_a_period():
    assessment, _, simulator, _ = running()
    simulator.Initialize()
    before = len(assessment.asked)
    simulator.AdvanceTo(10 * PERIOD_S + 0.001)
    assert len(assessment.asked) - before in (10, 11)


def test_new_beliefs_change_the_verdict_of_one_context_only():
    assessment, assessor, simulator, context = running()
    other = Simulator(assessor)
    other_context = other.get_mutable_context()
    for name, numbers in (("state", STATE), ("desired_preview", PREVIEW), ("features", FEATURES)):
        assessor.GetInputPort(name).FixValue(other_context, numbers)
    assessor.set_beliefs(context, 2 * assessment.beliefs_)
    simulator.Initialize()
    other.Initialize()
    assert value(assessor, context, "safety_probability")[0] == 0.5
    assert value(assessor, other_context, "safety_probability")[0] == 0.25
    np.testing.assert_array_equal(assessor.get_beliefs(context), 2 * assessment.beliefs_)
    np.testing.assert_array_equal(assessor.get_beliefs(other_context), assessment.beliefs_)


def test_what_feedback_has_shown_is_adopted_while_the_simulation_runs():
    assessment, assessor, simulator, context = running()
    simulator.AdvanceTo(0.01)
    adapted = AssessmentDouble()
    adapted.embedding_ = assessment.embedding_
    adapted.beliefs_ = 2 * assessment.beliefs_
    adapted.correction_ = correction(0.125)
    assessor.adopt(context, adapted)
    assert value(assessor, context, "safety_probability")[0] == 0.25
    simulator.AdvanceTo(PERIOD_S + 0.001)
    assert value(assessor, context, "safety_probability")[0] == 0.625
    assert assessment.novelties[0] is assessment.novelty_
    assert assessment.novelties[-1] is adapted.novelty_
    found = assessor.get_correction(context)
    for name in ("change", "hidden", "hidden_range", "guard"):
        np.testing.assert_array_equal(getattr(found, name), getattr(adapted.correction_, name))
    assert np.all(assessor.get_correction(assessor.CreateDefaultContext()).hidden == 0.0)


def test_beliefs_over_other_maps_and_corrections_of_another_shape_are_refused():
    _, assessor, _, context = running()
    with pytest.raises(ValueError, match="has other maps"):
        assessor.adopt(context, AssessmentDouble())
    wrong = {"guard": np.zeros(6), "change": np.ones(2), "hidden": np.ones((2, 4))}
    expected = {"guard": "(1, 6)", "change": "(3,)", "hidden": "(1, 4)"}
    for name, values in wrong.items():
        asked = dataclasses.replace(correction(1.0), **{name: values})
        message = f"correction's {name} must have shape {expected[name]}; got {values.shape}"
        with pytest.raises(ValueError, match=re.escape(message)):
            assessor.set_correction(context, asked)
    np.testing.assert_array_equal(assessor.get_correction(context).hidden, 0.0)


def test_beliefs_of_another_shape_are_refused_with_both_named():
    _, assessor, _, context = running()
    with pytest.raises(ValueError, match=r"must have shape \(1, 6, 5\); got \(6, 5\)"):
        assessor.set_beliefs(context, np.zeros((6, 5)))


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_state_that_is_not_finite_is_not_known_to_be_anything(number):
    _, assessor, simulator, context = running()
    assessor.GetInputPort("state").FixValue(context, [number, 0.0])
    simulator.Initialize()
    np.testing.assert_array_equal(value(assessor, context, "belief"), [0, 0, 1])
    assert value(assessor, context, "safety_probability")[0] == 0


def test_it_is_usable_alone_in_any_diagram():
    builder = DiagramBuilder()
    assessor = builder.AddNamedSystem(
        "safety_assessor", SafetyAssessor(AssessmentDouble(), period_s=PERIOD_S)
    )
    for name, numbers in (("state", STATE), ("desired_preview", PREVIEW), ("features", FEATURES)):
        source = builder.AddSystem(ConstantVectorSource(numbers))
        builder.Connect(source.get_output_port(), assessor.GetInputPort(name))
    builder.ExportOutput(assessor.GetOutputPort("safety_probability"), "safety_probability")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.1)
    assert diagram.GetOutputPort("safety_probability").Eval(simulator.get_context())[0] == 0.25


def test_an_alarm_makes_the_belief_unknown():
    _, assessor, simulator, context = running()
    assessor.GetInputPort("alarm").FixValue(context, [1.0])
    simulator.Initialize()
    np.testing.assert_array_equal(value(assessor, context, "belief"), [0.0, 0.0, 1.0])
    for name in ("safety_probability", "cause_probability"):
        assert not value(assessor, context, name).any()
    assert value(assessor, context, "novelty") == NOVELTY


@pytest.mark.parametrize("margins", [[0.1, -0.02], [-1.0, -2.0]])
def test_outside_the_safe_set_nothing_is_safe_until_it_has_been_entered_again(margins):
    _, assessor, simulator, context = running()
    port = assessor.GetInputPort("margins")
    port.FixValue(context, margins)
    simulator.Initialize()
    np.testing.assert_allclose(value(assessor, context, "belief"), [0.0, 0.9, 0.1])
    # The mass goes to the most violated constraint.
    np.testing.assert_allclose(value(assessor, context, "cause_probability"), [0.2, 0.55])
    assert value(assessor, context, "safety_probability") == 0.0
    port.FixValue(context, [0.1, 0.2])
    simulator.AdvanceTo(PERIOD_S)
    np.testing.assert_allclose(value(assessor, context, "belief"), [0.25, 0.65, 0.1])
