import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from drake_safety.systems.policy_controller import ACTING, HELD
from gliding_task import evaluated
from system_doubles import controller


def started(system, command=(0.2, 0.4, 0.0), state=None):
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    state = np.eye(1, 17).ravel() if state is None else state
    system.GetInputPort("plant_state").FixValue(context, state)
    system.GetInputPort("command").FixValue(context, np.array(command))
    return simulator, context


def test_a_set_point_is_that_of_the_action_until_the_next_period():
    system = controller()
    simulator, context = started(system)
    simulator.AdvanceTo(0.01)
    # Actions 1.2 and 1.4, half a radian each, of the joints b and a.
    expected = np.float32([0.7, 0.6, 0, 0])
    np.testing.assert_allclose(evaluated(system, context, "desired_joint_state"), expected)
    simulator.AdvanceTo(0.0199)
    np.testing.assert_allclose(evaluated(system, context, "desired_joint_state"), expected)
    assert evaluated(system, context, "status")[0] == ACTING
    assert len(evaluated(system, context, "action_state")) == len(system.action_names) == 10


def test_a_cloned_context_goes_on_from_its_phase():
    system = controller()
    simulator, context = started(system)
    simulator.AdvanceTo(0.05)
    other = Simulator(system, context.Clone())
    for one in (simulator, other):
        one.AdvanceTo(0.13)
    for name in ("desired_joint_state", "action_state"):
        np.testing.assert_array_equal(
            evaluated(system, context, name), evaluated(system, other.get_context(), name)
        )
    _, fresh_context = started(system)
    system.set_state(fresh_context, system.state_of(context))
    np.testing.assert_array_equal(
        evaluated(system, fresh_context, "action_state"), evaluated(system, context, "action_state")
    )


@pytest.mark.parametrize("what", ["command", "state", "action"])
def test_what_is_not_finite_leaves_the_last_action_and_a_status(what):
    broken = []

    def evaluate(batch):
        return batch[:, :2] * np.nan if broken else batch[:, :2] + 1.0

    system = controller(evaluate)
    simulator, context = started(system)
    simulator.AdvanceTo(0.01)
    good = evaluated(system, context, "desired_joint_state").copy()
    if what == "command":
        system.GetInputPort("command").FixValue(context, [np.inf, 0, 0])
    elif what == "state":
        system.GetInputPort("plant_state").FixValue(context, np.full(17, np.nan))
    else:
        broken.append(True)
    simulator.AdvanceTo(0.05)
    np.testing.assert_array_equal(evaluated(system, context, "desired_joint_state"), good)
    assert evaluated(system, context, "status")[0] == HELD
