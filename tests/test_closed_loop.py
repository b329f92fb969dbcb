from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_safety import check_contract
from drake_safety.simulation.closed_loop import (
    ASSESSMENT_PORTS,
    REQUIRED_PORTS,
    ClosedLoop,
    check_ports,
)
from gliding_task import Gliding, gliding
from shuttle_task import shuttling

ALL_PORTS = REQUIRED_PORTS + ASSESSMENT_PORTS
LOOP_NAMES = ("state_names", "output_names", "feature_names", "constraint_names")


class Constant(ClosedLoop):
    """Ports of given sizes, by default one, that say the same for ever."""

    def __init__(self, sizes=None, value=1.0, *, names=True, ports=REQUIRED_PORTS, assessment=None):
        super().__init__(gliding(), "nominal", assessment)
        builder = DiagramBuilder()
        for name in ports:
            numbers = np.full((sizes or {}).get(name, 1), value)
            source = builder.AddSystem(ConstantVectorSource(numbers))
            builder.ExportOutput(source.get_output_port(), name)
        if names:
            self.state_names = self.output_names = ["x"]
            self.feature_names = self.constraint_names = ["x"]
        builder.BuildInto(self)

    def reset(self, context, rng):
        return 0


@pytest.mark.parametrize("name", ALL_PORTS)
def test_a_missing_port_is_named(name):
    ports = REQUIRED_PORTS if name in REQUIRED_PORTS else ALL_PORTS
    assessment = None if name in REQUIRED_PORTS else SimpleNamespace()
    with pytest.raises(ValueError, match="'Constant' does not set"):  # Its ports are complete.
        check_ports(Constant(names=False, ports=ports, assessment=assessment))
    rest = [port for port in ports if port != name]
    with pytest.raises(ValueError, match=rf"'Constant' exports no port \['{name}'\]; it exports"):
        check_ports(Constant(names=False, ports=rest, assessment=assessment))


def assessment_for(loop, **changes):
    scenario = loop.scenario
    info = {
        "scenario": scenario.name,
        "scenario_hash": scenario.simulation_hash(),
        "variation": "nominal",
        "horizon": scenario.assessment.horizon,
        "step_s": scenario.step_s,
        "preview_stride": scenario.assessment.preview_stride,
    }
    info |= {name: getattr(loop, name) for name in LOOP_NAMES}
    return SimpleNamespace(info_=SimpleNamespace(**info | changes))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"horizon": 7}, "differ in horizon: .* with 7, the diagram has 10"),
        ({"preview_stride": 3}, "differ in preview_stride: .* with 3, the diagram has 1"),
        ({"step_s": 0.05}, "differ in step_s: .* with 0.05, the diagram has 0.04"),
        ({"state_names": ["x"]}, r"differ in state: .* with \['x'\], the diagram has \['x', 'v'\]"),
        ({"output_names": ["x"]}, r"differ in output: .* with \['x'\]"),
        ({"feature_names": []}, r"differ in features: .* with \[\], .* \['distance'\]"),
        ({"constraint_names": ["left", "right"]}, r"differ in constraints: .* \['right', 'left'\]"),
        ({"scenario_hash": "0" * 64}, "differ in scenario hash: .* with 0000"),
    ],
)
def test_an_assessment_of_another_diagram_is_refused_with_both_sides_named(change, message):
    foreign = assessment_for(Gliding(gliding()), **change)
    with pytest.raises(ValueError, match=message):
        gliding().make_loop(assessment=foreign)


def test_a_task_must_say_no_more_than_its_parameters_and_names():
    names = {f"{kind}_names" for kind in ("state", "output", "feature", "constraint")}
    assert set(ClosedLoop.__annotations__) - set(vars(ClosedLoop)) == {"Parameters", *names}


def test_a_closed_loop_has_few_members_of_its_own():
    loop = Constant(names=False)
    members = {*vars(ClosedLoop), *ClosedLoop.__annotations__, *vars(loop)} - set(dir(Diagram))
    assert len([name for name in members if not name.startswith("_")]) <= 14


def test_a_task_without_its_ports_is_refused_when_it_is_made(monkeypatch):
    monkeypatch.setattr(Gliding, "export", lambda *given, **options: None)
    with pytest.raises(ValueError, match="'Gliding' exports no port"):
        gliding().make_loop()


WHOLE = {"desired_preview": 10}


def problems(diagram):
    return {finding.item: finding for finding in check_contract(diagram) if not finding.is_ok}


@pytest.mark.parametrize("make", [gliding, shuttling])
def test_a_task_that_keeps_the_contract_has_no_problem(make):
    assert problems(make().make_loop()) == {}


def test_a_port_of_another_size_than_its_names_is_refused():
    with pytest.raises(ValueError, match="'state' has size 2, expected 1"):
        check_ports(Constant(WHOLE | {"state": 2}))
    with pytest.raises(ValueError, match="'desired_preview' has size 9, expected 10"):
        check_ports(Constant({"desired_preview": 9}))


def test_names_that_are_not_set_are_a_problem_with_a_remedy():
    found = problems(Constant(WHOLE, names=False))
    assert "does not set ['state_names', 'output_names'" in found["ports"].message
    assert found["ports"].remedy


def test_values_that_are_not_finite_are_named_by_port():
    found = problems(Constant(WHOLE, value=np.nan))
    assert "'features'" in found["values at the start"].message


def test_a_reset_that_raises_or_returns_nothing_is_a_problem_and_no_exception():
    class Raising(Constant):
        def reset(self, context, rng):
            raise ValueError("no start today")

    class Silent(Constant):
        def reset(self, context, rng):
            return None

    assert problems(Raising(WHOLE))["reset"].message == "no start today"
    assert problems(Silent(WHOLE))["reset"].message == "returns None"
