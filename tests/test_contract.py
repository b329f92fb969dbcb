import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_safety import check_contract
from drake_safety.simulation.closed_loop import REQUIRED_PORTS, ClosedLoop, check_ports
from gliding_task import gliding
from shuttle_task import shuttling


class Constant(ClosedLoop):
    """Ports of given sizes that say the same for ever."""

    def __init__(self, sizes, value=1.0, names=True):
        super().__init__(gliding(), "nominal", None)
        builder = DiagramBuilder()
        for name in REQUIRED_PORTS:
            source = builder.AddSystem(ConstantVectorSource(np.full(sizes.get(name, 1), value)))
            builder.ExportOutput(source.get_output_port(), name)
        if names:
            self.state_names = self.output_names = ["x"]
            self.feature_names = self.constraint_names = ["x"]
        builder.BuildInto(self)

    def reset(self, context, rng):
        return 0


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
