from types import SimpleNamespace

import pytest
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_safety.simulation.closed_loop import (
    ASSESSMENT_PORTS,
    REQUIRED_PORTS,
    ClosedLoop,
    check_ports,
)
from gliding_task import Gliding, gliding

ALL_PORTS = REQUIRED_PORTS + ASSESSMENT_PORTS
LOOP_NAMES = ("state_names", "output_names", "feature_names", "constraint_names")


class Partial(ClosedLoop):
    """Exports only the ports it is told to."""

    def __init__(self, scenario, ports, assessment=None):
        super().__init__(scenario, "nominal", assessment)
        builder = DiagramBuilder()
        source = builder.AddSystem(ConstantVectorSource([0.0]))
        for name in ports:
            builder.ExportOutput(source.get_output_port(), name)
        builder.BuildInto(self)


@pytest.mark.parametrize("name", ALL_PORTS)
def test_a_missing_port_is_named(name):
    ports = REQUIRED_PORTS if name in REQUIRED_PORTS else ALL_PORTS
    assessment = None if name in REQUIRED_PORTS else SimpleNamespace()
    with pytest.raises(ValueError, match="'Partial' does not set"):  # Its ports are complete.
        check_ports(Partial(gliding(), ports, assessment))
    rest = [port for port in ports if port != name]
    with pytest.raises(ValueError, match=rf"'Partial' exports no port \['{name}'\]; it exports"):
        check_ports(Partial(gliding(), rest, assessment))


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
        ({"scenario": "falling"}, "differ in scenario: .* with falling, the diagram has gliding"),
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
    loop = Partial(gliding(), REQUIRED_PORTS)
    members = {*vars(ClosedLoop), *ClosedLoop.__annotations__, *vars(loop)} - set(dir(Diagram))
    assert len([name for name in members if not name.startswith("_")]) <= 14


def test_a_task_without_its_ports_is_refused_when_it_is_made(monkeypatch):
    monkeypatch.setattr(Gliding, "export", lambda *given, **options: None)
    with pytest.raises(ValueError, match="'Gliding' exports no port"):
        gliding().make_loop()
