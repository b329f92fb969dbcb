import copy

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from drake_safety import load_assessment, load_scenario
from drake_safety.learning.beliefs import empty
from system_doubles import HORIZON, LIMITS, OUTLOOK, Bench, SlowIsSafe, guard


def passed_on(assessment, command, state=0.0, is_acting=True):
    bench = Bench(guard(assessment), command=command, state=state, features=np.zeros(3))
    bench.system.set_acting(bench.context, is_acting)
    return bench.begin().outputs()


def test_an_accepted_command_passes_unchanged():
    seen, command = SlowIsSafe(), [1.2, 0.3, 0.0]
    out = passed_on(seen, command)
    np.testing.assert_array_equal(out["desired_output"], command)
    assert (out["is_changed"][0], out["safety_probability"][0]) == (0.0, 1.0)
    assert seen.seen == [1]  # No other command is evaluated.
    np.testing.assert_array_equal(out["desired_preview"], np.tile(command, HORIZON))
    np.testing.assert_array_equal(out["desired_outlook"], np.tile(command, OUTLOOK))


def test_a_refused_command_is_replaced_by_the_nearest_accepted_one():
    out = passed_on(SlowIsSafe(fastest=1.5), [2.5, 0.4, 0.0])
    # Shares of 2.5 are .5 apart, and the other entries stay.
    np.testing.assert_allclose(out["desired_output"], [1.5, 0.4, 0.0])
    assert (out["is_changed"][0], out["safety_probability"][0]) == (1.0, 0.0)


@pytest.mark.parametrize(
    ("assessment", "state"),
    [(SlowIsSafe(novelty=2.0), 0.0), (SlowIsSafe(fastest=-9.0), 0.0), (SlowIsSafe(), np.nan)],
)
def test_where_nothing_is_accepted_the_command_stays_within_the_ranges(assessment, state):
    out = passed_on(assessment, [2.5, 0.4, -3.0], state)
    np.testing.assert_array_equal(out["desired_output"], [1.0, 0.4, -1.0])
    assert out["safety_probability"][0] == 0.0


def test_candidates_are_sorted_by_distance_and_contain_standing():
    asked = np.array([2.0, -1.0, 3.0])
    candidates = guard(SlowIsSafe()).candidates(asked)
    scale = np.subtract(LIMITS.highest, LIMITS.lowest)
    distance = np.linalg.norm((candidates - asked) / scale, axis=1)
    assert np.all(np.diff(distance) >= -1e-12)
    np.testing.assert_allclose(candidates[0], asked)
    assert np.any(np.all(candidates == 0.0, axis=1))


def test_a_threshold_outside_zero_and_one_is_refused():
    with pytest.raises(ValueError, match=r"threshold must be in \[0, 1\]; got 1.5"):
        guard(SlowIsSafe(), threshold=1.5)


def test_a_guard_that_does_not_act_passes_on_everything():
    out = passed_on(SlowIsSafe(fastest=1.5), [2.5, 0.4, 0.0], is_acting=False)
    np.testing.assert_array_equal(out["desired_output"], [2.5, 0.4, 0.0])
    assert out["safety_probability"][0] == 0.0


@pytest.mark.parametrize("state", [0.0, np.nan])
def test_a_guard_that_does_not_act_passes_on_what_it_cannot_judge(state):
    out = passed_on(SlowIsSafe(), [2.5, 0.4, 0.0], state, is_acting=False)
    np.testing.assert_array_equal(out["desired_output"], [2.5, 0.4, 0.0])


@pytest.mark.parametrize("what", ["beliefs", "an alarm"])
def test_a_guard_judges_by_what_the_assessor_has_adopted_and_during_an_alarm_by_nothing(what):
    assessment = load_assessment("go2_walking")
    loop = load_scenario("go2_walking").make_loop(assessment=assessment, guard=True)
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    loop.reset_standing(context, np.array([0.3, 0.0, 0.0]))
    guard_system = loop.GetSubsystemByName("command_guard")
    assessor = loop.GetSubsystemByName("safety_assessor")

    def probability():
        port = guard_system.GetOutputPort("safety_probability")
        return port.Eval(guard_system.GetMyContextFromRoot(context))[0]

    simulator.AdvanceTo(0.01)
    assert probability() > 0.5
    if what == "beliefs":
        adapted = copy.copy(assessment)
        adapted.beliefs_ = empty(assessment.beliefs_.shape[:-1], assessment.beliefs_.shape[-1] - 3)
        assessor.adopt(assessor.GetMyMutableContextFromRoot(context), adapted)
    else:
        port = assessor.assessor.GetInputPort("alarm")
        port.FixValue(assessor.assessor.GetMyMutableContextFromRoot(context), [1.0])
    simulator.AdvanceTo(0.12)
    assert loop.GetOutputPort("safety_probability").Eval(context) == 0.0
    assert probability() == 0.0
