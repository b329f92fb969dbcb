"""FloatSystem: cloned by building anew; refuses other scalar types with the reason."""

import copy

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Diagram, DiagramBuilder, LeafSystem

from drake_safety import load_scenario
from drake_safety.systems.float_system import FloatSystem


class Gain(FloatSystem, LeafSystem):
    def __init__(self, gain, *, size=1):
        super().__init__()
        port = self.DeclareVectorInputPort("u", size)
        self.DeclareVectorOutputPort(
            "y",
            BasicVector(size),
            lambda context, output: output.SetFromVector(gain * port.Eval(context)),
        )


class Wrapped(FloatSystem, Diagram):
    def __init__(self, gain):
        super().__init__()
        builder = DiagramBuilder()
        gain = builder.AddNamedSystem("gain", Gain(gain, size=2))
        builder.ExportInput(gain.GetInputPort("u"), "u")
        builder.ExportOutput(gain.GetOutputPort("y"), "y")
        builder.BuildInto(self)


def value_of(system):
    context = system.CreateDefaultContext()
    system.GetInputPort("u").FixValue(context, np.ones(2))
    return system.GetOutputPort("y").Eval(context)


@pytest.mark.parametrize("make", [lambda: Gain(3.0, size=2), lambda: Wrapped(3.0)])
@pytest.mark.parametrize("clone_of", [lambda system: system.Clone(), copy.deepcopy])
def test_a_clone_is_another_system_that_does_the_same(make, clone_of):
    system = make()
    system.set_name("three")
    clone = clone_of(system)
    assert clone is not system
    assert type(clone) is type(system)
    assert clone.get_name() == "three"
    np.testing.assert_array_equal(value_of(clone), [3.0, 3.0])


def test_other_scalar_types_are_refused_with_the_reason():
    with pytest.raises(TypeError, match=r"Gain cannot be converted to AutoDiffXd: .* floats only"):
        Gain(1.0).ToAutoDiffXd()
    with pytest.raises(TypeError, match="Wrapped cannot be converted to symbolic Expression"):
        Wrapped(1.0).ToSymbolic()


def test_a_closed_loop_and_each_of_its_own_systems_can_be_cloned():
    loop = load_scenario("laikago_balancing").make_loop("actual", recovery=True, ball=True)
    own = [system for system in loop.GetSystems() if isinstance(system, FloatSystem)]
    assert len(own) >= 7
    for system in own:
        clone = system.Clone()
        assert [clone.get_output_port(i).get_name() for i in range(clone.num_output_ports())] == [
            system.get_output_port(i).get_name() for i in range(system.num_output_ports())
        ]
    ends = []
    for each in (loop, loop.Clone()):
        simulator = Simulator(each)
        context = simulator.get_mutable_context()
        each.reset(context, np.random.default_rng(3))
        each.GetInputPort("safety_probability").FixValue(context, [1.0])
        simulator.AdvanceTo(0.1)
        ends.append(each.GetOutputPort("plant_state").Eval(context))
    np.testing.assert_array_equal(*ends)
