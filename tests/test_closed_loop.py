from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

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
from drake_safety.simulation.closed_loop import ASSESSMENT_PORTS, REQUIRED_PORTS, ClosedLoop
from toy_tasks import Gliding, gliding, shuttling

NAMES = ("state_names", "output_names", "feature_names", "constraint_names")
WHOLE = {"desired_preview": 10}


class Constant(ClosedLoop):
    """Ports of given sizes, by default one, that say the same for ever."""

    def __init__(self, sizes=WHOLE, value=1.0, *, ports=REQUIRED_PORTS, start=0):
        super().__init__(gliding(), "nominal", None)
        self.start = start
        builder = DiagramBuilder()
        for name in ports:
            source = builder.AddSystem(ConstantVectorSource(np.full(sizes.get(name, 1), value)))
            builder.ExportOutput(source.get_output_port(), name)
        self.state_names = self.output_names = ["x"]
        self.feature_names = self.constraint_names = ["x"]
        builder.BuildInto(self)

    def reset(self, context, rng):
        return self.start


def problems(diagram):
    return {finding.item: finding for finding in check_contract(diagram) if not finding.is_ok}


@pytest.mark.parametrize("make", [gliding, shuttling])
def test_a_task_that_keeps_the_contract_has_no_problem(make):
    assert problems(make().make_loop()) == {}


@pytest.mark.parametrize(
    ("options", "item", "message"),
    [
        ({"ports": REQUIRED_PORTS[1:]}, "ports", "'Constant' exports no port ['state']; it"),
        ({"sizes": WHOLE | {"state": 2}}, "ports", "sizes {'state': 2}; by their names expected"),
        ({"value": np.nan}, "values at the start", "'features'"),
        ({"start": None}, "reset", "returns None"),
    ],
)
def test_what_breaks_the_contract_is_named_with_a_remedy(options, item, message):
    problem = problems(Constant(**options))[item]
    assert message in problem.message and problem.remedy


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"horizon": 7}, "differ in horizon: .* with 7, the diagram has 10"),
        ({"state_names": ["x"]}, r"state_names: .* with \['x'\], the diagram has \['x', 'v'\]"),
        ({"scenario_hash": "0" * 64}, "differ in scenario_hash: .* with 0000"),
    ],
)
def test_an_assessment_of_another_diagram_is_refused_with_both_sides_named(change, message):
    loop = Gliding(gliding())
    scenario = loop.scenario
    info = {"scenario": scenario.name, "scenario_hash": scenario.simulation_hash()}
    info |= {"variation": "nominal", "horizon": scenario.assessment.horizon}
    info |= {"step_s": scenario.step_s, "preview_stride": scenario.assessment.preview_stride}
    info |= {name: getattr(loop, name) for name in NAMES}
    with pytest.raises(ValueError, match=message):
        scenario.make_loop(assessment=SimpleNamespace(info_=SimpleNamespace(**info | change)))


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
