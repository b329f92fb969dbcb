import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from drake_safety import AssessmentParameters, SafetyAssessment, load_assessment, load_scenario
from drake_safety.learning.innovation import KINDS
from drake_safety.systems.safety_assessor import SafetyAssessor
from lip_assessments import QUICK, worse
from lip_episodes import STEP_S, make_episodes

pytestmark = pytest.mark.train

INPUTS = ("state", "desired_preview", "features")


@pytest.fixture(scope="module")
def assessment():
    parameters = AssessmentParameters(**{**QUICK, "epochs": 1})
    return SafetyAssessment(parameters).fit(make_episodes(240, noise=0.002))


def long_motion(num_motions=6, seed=77, frozen=slice(0, 0)):
    """Safe motions of the nominal plant, one after another."""
    found = [one for one in make_episodes(60, seed=seed, noise=0.002) if one.is_safe]
    motion = {name: [getattr(one, name) for one in found[:num_motions]] for name in INPUTS}
    motion = {name: np.concatenate(rows) for name, rows in motion.items()}
    for rows in motion.values():
        rows[frozen] = rows[frozen.start]
    return motion


def running(assessment, inputs, hold=None):
    """A diagram that plays the inputs, row k at step k."""
    builder = DiagramBuilder()
    times = STEP_S * (np.arange(len(inputs["state"]) + 1) - 0.5)
    assessor = builder.AddSystem(SafetyAssessor(assessment, checks_margins=False))
    played = dict(inputs) if hold is None else {**inputs, "hold": hold}
    for name, rows in played.items():
        held = np.vstack([rows, rows[-1:]])
        source = builder.AddSystem(
            TrajectorySource(PiecewisePolynomial.ZeroOrderHold(times, held.T))
        )
        builder.Connect(source.get_output_port(), assessor.GetInputPort(name))
    return Simulator(builder.Build()), assessor.monitor, assessor


def history(assessment, inputs, **options):
    """Levels and alarm after each row, the cause, and the last belief."""
    simulator, monitor, assessor = running(assessment, inputs, **options)
    context = simulator.get_context()
    own = monitor.GetMyContextFromRoot(context)
    levels, alarm = [], []
    simulator.Initialize()
    for row in range(len(inputs["state"])):
        simulator.AdvanceTo((row + 0.25) * STEP_S)
        levels.append(monitor.GetOutputPort("levels").Eval(own).copy())
        alarm.append(monitor.GetOutputPort("alarm").Eval(own)[0])
    belief = assessor.GetOutputPort("belief").Eval(assessor.GetMyContextFromRoot(context)).copy()
    return np.array(levels), np.array(alarm), monitor.GetOutputPort("alarm_cause").Eval(own), belief


def test_its_levels_are_those_of_the_innovation(assessment):
    inputs = long_motion()
    levels, alarm, cause, _ = history(assessment, inputs)
    x = assessment.inputs_of(*(inputs[name] for name in INPUTS))
    # Each row with its own distance, as the limits were learned.
    expected = assessment.innovation_.levels([x], [assessment.novelty_.of(x)])
    np.testing.assert_allclose(levels, expected, rtol=1e-9, atol=1e-12)
    assert alarm.max() == 0.0
    assert cause == ""


def test_a_frozen_input_raises_an_alarm_that_stays_and_makes_the_belief_unknown(assessment):
    inputs = long_motion(frozen=slice(30, 60))
    _, alarm, cause, belief = history(assessment, inputs)
    first = int(np.argmax(alarm))
    assert 30 < first <= 30 + assessment.innovation_.longest_repeat + 2
    assert alarm[first:].min() == 1.0
    assert cause == "input frozen"
    np.testing.assert_array_equal(belief, [0.0, 0.0, 1.0])


def test_a_steady_push_raises_an_alarm_with_its_cause(assessment):
    inputs = long_motion()
    inputs["state"][:, 1] += 0.01 * np.arange(len(inputs["state"]))
    _, alarm, cause, _ = history(assessment, inputs)
    assert alarm[-1] == 1.0
    assert cause


def test_it_waits_while_it_is_held(assessment):
    inputs = long_motion(frozen=slice(30, 60))
    hold = np.zeros((len(inputs["state"]), 1))
    hold[28:62] = 1.0
    _, alarm, _, _ = history(assessment, inputs, hold=hold)
    assert alarm.max() == 0.0


def test_inputs_that_are_not_finite_are_left_out(assessment):
    inputs = long_motion()
    inputs["state"][40] = np.nan
    levels, alarm, _, _ = history(assessment, inputs)
    assert np.isfinite(levels).all()
    assert alarm.max() == 0.0


def test_a_reset_ends_the_alarm(assessment):
    inputs = long_motion(frozen=slice(5, None))
    simulator, monitor, _ = running(assessment, inputs)
    simulator.AdvanceTo(30 * STEP_S)
    own = monitor.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    assert monitor.GetOutputPort("alarm").Eval(own)[0] == 1.0
    monitor.reset(own)
    assert monitor.GetOutputPort("alarm").Eval(own)[0] == 0.0
    assert not monitor.GetOutputPort("levels").Eval(own).any()


def test_it_adopts_the_innovation_of_an_adapted_assessment(assessment):
    adapted = assessment.adapt(worse())
    inputs = long_motion(1)
    found = []
    for adopts in (False, True):
        simulator, monitor, _ = running(assessment, inputs)
        own = monitor.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        if adopts:
            monitor.adopt(own, adapted)
        simulator.AdvanceTo(20.25 * STEP_S)
        found.append(monitor.GetOutputPort("levels").Eval(own).copy())
    x = assessment.inputs_of(*(inputs[name][:21] for name in INPUTS))
    for one, levels in zip((assessment, adapted), found, strict=True):
        expected = one.innovation_.levels([x], [one.novelty_.of(x)])[-1]
        np.testing.assert_allclose(levels, expected, rtol=1e-9)
    assert not np.array_equal(*found)


@pytest.mark.parametrize("on_alarm", ["unknown", "report"])
def test_a_scenario_says_what_an_alarm_does(on_alarm):
    scenario = load_scenario("laikago_balancing")
    scenario.on_alarm = on_alarm
    loop = scenario.make_loop("nominal", assessment=load_assessment("laikago_balancing"))
    assert loop.GetOutputPort("alarm").size() == 1
    assert loop.GetOutputPort("levels").size() == len(KINDS) - 1
    evaluator = loop.GetSubsystemByName("safety_assessor").evaluator
    assert evaluator.HasInputPort("alarm") == (on_alarm == "unknown")
