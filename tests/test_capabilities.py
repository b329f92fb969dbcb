from dataclasses import fields

import pytest

from drake_safety import check_contract, load_scenario
from drake_safety.simulation.capabilities import (
    CanBePushed,
    CanFall,
    CanStartAnywhere,
    FollowsCommands,
    HasBall,
    HasGoals,
    MovesUndisturbed,
    require,
)
from drake_safety.simulation.closed_loop import ASSESSMENT_PORTS
from drake_safety.simulation.rollouts import run_episode
from gliding_task import Gliding, gliding
from shuttle_task import Shuttling, shuttling

OF_LEGS = {CanFall, CanStartAnywhere, MovesUndisturbed}
ASKED = (HasGoals, HasBall, CanBePushed, FollowsCommands, *OF_LEGS)
HAS = {
    "laikago_balancing": {HasBall, *OF_LEGS},
    "atlas_reaching": {HasGoals, CanBePushed, *OF_LEGS},
    "go2_walking": {HasGoals, CanBePushed, FollowsCommands, *OF_LEGS},
    "pendulum": {CanStartAnywhere},
}


@pytest.mark.parametrize("name", HAS)
def test_a_task_of_the_package_has_what_it_says_and_no_more(name):
    loop = load_scenario(name).make_loop()
    assert {one for one in ASKED if isinstance(loop, one)} == HAS[name]
    assert [finding for finding in check_contract(loop) if not finding.is_ok] == []
    assert CanFall not in HAS[name] or loop.fall_name in loop.constraint_names
    assert not any(loop.HasOutputPort(port) for port in ASSESSMENT_PORTS)


@pytest.mark.parametrize("name", HAS)
def test_what_the_hash_of_a_task_leaves_out_are_parameters_that_it_has(name):
    parameters = load_scenario(name).parameters
    assert set(getattr(parameters, "online", ())) <= {one.name for one in fields(parameters)}


def test_the_safe_set_is_sampled_by_the_control_period_unless_the_task_has_another():
    assert gliding().watch_period_s == gliding().control_period_s
    reaching = load_scenario("atlas_reaching")
    reaching.parameters.monitor_period_s = 0.05
    assert reaching.watch_period_s == 0.05 > reaching.control_period_s


def test_a_task_is_asked_for_what_it_has_and_is_handed_back():
    loop = Shuttling(shuttling())
    for capability in (HasGoals, CanBePushed, CanFall):
        assert require(loop, capability) is loop


@pytest.mark.parametrize(
    ("capability", "lacked"),
    [(HasBall, "ball to throw"), (CanStartAnywhere, "episodes from a given start")],
)
def test_what_a_task_lacks_is_told_with_what_was_asked_and_what_it_has(capability, lacked):
    with pytest.raises(ValueError, match=f"^run: task 'Shuttling' has no {lacked}; it has plans "):
        require(Shuttling(shuttling()), capability, "run")
    with pytest.raises(
        ValueError, match=f"^task 'Gliding' has no {lacked}; it has no optional features"
    ):
        require(Gliding(gliding()), capability)


def test_asking_for_what_a_task_has_evaluates_none_of_its_properties():
    class Counting(Shuttling):
        @property
        def target_box(self):
            raise AssertionError("evaluated")

    assert isinstance(Counting(shuttling()), HasGoals)


def test_a_task_that_says_nothing_of_itself_has_the_plain_answers():
    loop = Gliding(gliding())
    assert loop.angular_constraints == ()
    for purpose in ("evaluation", "paper", "pairs"):
        assert loop.scenario.options_for(purpose, "actual") == {}
    assert run_episode(loop).num_controller_failures == 0
