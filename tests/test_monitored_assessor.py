import copy
import dataclasses

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_safety import AddSafetyAssessor, AssessmentParameters, SafetyAssessment
from lip_assessments import QUICK, worse
from lip_episodes import STEP_S, make_episodes
from toy_tasks import evaluated

pytestmark = pytest.mark.train

INPUTS = ("state", "desired_preview", "features", "margins")
NUM_FROZEN = 200


@pytest.fixture(scope="module")
def episodes():
    return make_episodes(240, noise=0.002)


@pytest.fixture(scope="module")
def assessment(episodes):
    parameters = AssessmentParameters(**{**QUICK, "epochs": 1})
    found = SafetyAssessment(parameters).fit(episodes)
    found.detector_ = dataclasses.replace(found.detector_, alarm_level=1.0)
    return found


@pytest.fixture
def inputs(episodes):
    safe = next(one for one in episodes if one.is_safe)
    return {name: getattr(safe, name)[0] for name in INPUTS}


def added(assessment, inputs, **options):
    """An assessor in a diagram beside another one, each connected by one call, and a simulator."""
    builder = DiagramBuilder()
    ports = {
        name: None
        if numbers is None
        else builder.AddNamedSystem(name, ConstantVectorSource(numbers)).get_output_port()
        for name, numbers in inputs.items()
    }
    assessor = AddSafetyAssessor(builder, assessment, **ports, **options)
    with pytest.raises(ValueError, match="has a 'safety_assessor'; pass another name"):
        AddSafetyAssessor(builder, assessment, **ports, **options)
    AddSafetyAssessor(builder, assessment, **ports, **options, name="second")
    simulator = Simulator(builder.Build())
    return assessor, simulator, assessor.GetMyContextFromRoot(simulator.get_context())


@pytest.mark.parametrize("level", [1.0, np.inf])
def test_it_warns_of_a_monitor_that_never_alarms(assessment, inputs, caplog, level):
    found = copy.copy(assessment)
    found.detector_ = dataclasses.replace(assessment.detector_, alarm_level=level)
    added(found, inputs, on_alarm=None)
    assert "never alarms" not in caplog.text
    added(found, inputs)
    assert ("AddSafetyAssessor: monitor: " in caplog.text) == np.isinf(level)


def test_one_call_adds_gamma_the_monitor_and_the_check_of_the_margins(assessment, inputs):
    assessor, simulator, context = added(assessment, inputs)
    simulator.Initialize()
    expected = assessment.predict_one(*(inputs[name] for name in INPUTS[:3]))
    np.testing.assert_array_equal(evaluated(assessor, context, "belief"), expected.belief)
    assert evaluated(assessor, context, "alarm") == 0.0
    simulator.AdvanceTo(NUM_FROZEN * STEP_S)
    # The inputs do not change at all, as those of a frozen sensor.
    assert evaluated(assessor, context, "alarm_cause") == "inputs frozen"
    np.testing.assert_array_equal(evaluated(assessor, context, "belief"), [0.0, 0.0, 1.0])
    outside, simulator, context = added(assessment, {**inputs, "margins": -inputs["margins"]})
    simulator.Initialize()
    assert evaluated(outside, context, "belief")[0] == 0.0


def test_less_is_said_by_an_argument(assessment, inputs):
    assessor, simulator, context = added(assessment, inputs, on_alarm="report")
    simulator.AdvanceTo(NUM_FROZEN * STEP_S)
    assert evaluated(assessor, context, "alarm") == 1.0
    assert evaluated(assessor, context, "belief")[2] < 1.0
    without, simulator, context = added(assessment, {**inputs, "margins": None}, on_alarm=None)
    assert without.monitor is None
    assert not without.HasOutputPort("alarm")
    assert not without.HasInputPort("margins")
    simulator.AdvanceTo(STEP_S)
    assert evaluated(without, context, "belief")[2] < 1.0


def test_a_port_that_is_needed_is_not_left_out_by_mistake(assessment, inputs):
    with pytest.raises(TypeError, match="margins"):
        added(assessment, {name: inputs[name] for name in INPUTS[:3]})
    with pytest.raises(RuntimeError, match=r"features.* is not connected"):
        without = {name: inputs[name] for name in INPUTS if name != "features"}
        added(assessment, without)[1].AdvanceTo(STEP_S)
    with pytest.raises(RuntimeError, match="ismatched vector sizes"):
        added(assessment, {**inputs, "state": np.zeros(1)})


def test_it_adopts_what_an_adapted_assessment_has_learned_and_the_alarm_ends(assessment, inputs):
    adapted = assessment.adapt(worse())
    assessor, simulator, context = added(assessment, inputs)
    simulator.AdvanceTo(NUM_FROZEN * STEP_S)
    assert evaluated(assessor, context, "alarm") == 1.0
    assessor.adopt(assessor.GetMyMutableContextFromRoot(simulator.get_mutable_context()), adapted)
    assert evaluated(assessor, context, "alarm") == 0.0
    simulator.AdvanceTo((NUM_FROZEN + 1) * STEP_S)
    expected = adapted.predict_one(*(inputs[name] for name in INPUTS[:3]))
    np.testing.assert_array_equal(evaluated(assessor, context, "belief"), expected.belief)
