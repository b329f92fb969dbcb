import numpy as np
import pytest

from drake_safety.systems.policy_controller import ACTING, HELD
from system_doubles import Bench, controller


def started(system):
    bench = Bench(system, plant_state=np.eye(1, 17), command=[0.2, 0.4, 0.0])
    bench.advance(0.01)
    return bench


def test_a_set_point_is_that_of_the_action():
    bench = started(controller())
    # Actions 1.2 and 1.4, half a radian each, of the joints b and a.
    np.testing.assert_allclose(bench.get("desired_joint_state"), np.float32([0.7, 0.6, 0, 0]))
    assert bench.get("status")[0] == ACTING
    assert len(bench.get("action_state")) == len(bench.system.action_names) == 10


def test_the_state_of_an_action_is_carried_to_another_context():
    bench = started(controller())
    bench.advance(0.12)
    other = started(bench.system)
    assert not np.array_equal(other.get("action_state"), bench.get("action_state"))
    bench.system.set_state(other.context, bench.system.state_of(bench.context))
    np.testing.assert_array_equal(other.get("action_state"), bench.get("action_state"))


@pytest.mark.parametrize("what", ["command", "plant_state", "action"])
def test_what_is_not_finite_leaves_the_last_action_and_a_status(what):
    broken = []
    system = controller(lambda batch, parts: (batch[:, :2] * (np.nan if broken else 1.0) + 1.0, {}))
    bench = started(system)
    good = bench.get("desired_joint_state")
    if what == "action":
        broken.append(True)
    else:
        bench.fix(**{what: {"command": [np.inf, 0, 0], "plant_state": np.full(17, np.nan)}[what]})
    bench.advance(0.04)
    np.testing.assert_array_equal(bench.get("desired_joint_state"), good)
    assert bench.get("status")[0] == HELD
    assert bench.get("num_failures")[0] == 2
    good = bench.get("memory")
    bench.system.set_state(bench.context, good)
    assert np.isfinite(good).all() and bench.get("num_failures")[0] == 2  # No part of the memory.
