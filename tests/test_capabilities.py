from dataclasses import fields

import pytest

from drake_safety import check_contract, load_scenario
from drake_safety.diagrams.balancing.throws import HasBall
from drake_safety.simulation.capabilities import (
    CanBePushed,
    CanFall,
    CanStartAnywhere,
    FollowsCommands,
    HasGoals,
    MovesUndisturbed,
)
from drake_safety.simulation.closed_loop import ASSESSMENT_PORTS

OF_LEGS = {CanFall, CanStartAnywhere, MovesUndisturbed}
ASKED = (HasGoals, HasBall, CanBePushed, FollowsCommands, *OF_LEGS)
HAS = {
    "laikago_balancing": {HasBall, *OF_LEGS},
    "atlas_reaching": {HasGoals, CanBePushed, *OF_LEGS},
    "go2_walking": {HasGoals, CanBePushed, FollowsCommands, *OF_LEGS},
    "pendulum": {CanStartAnywhere},
}


@pytest.mark.parametrize("name", HAS)
def test_a_task_of_the_package_keeps_the_contract_and_has_its_capabilities(name):
    scenario = load_scenario(name)
    loop = scenario.make_loop()
    assert {capability for capability in ASKED if isinstance(loop, capability)} == HAS[name]
    assert all(finding.is_ok for finding in check_contract(loop))
    assert not loop.fall_name or loop.fall_name in loop.constraint_names
    assert not any(loop.HasOutputPort(port) for port in ASSESSMENT_PORTS)
    # What the hash leaves out are parameters that the task has.
    parameters = scenario.parameters
    assert set(getattr(parameters, "online", ())) <= {field.name for field in fields(parameters)}
