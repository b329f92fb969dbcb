"""A copied Context, continued by another simulator, moves on as its original does."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import PortDataType

from drake_safety import load_assessment, load_scenario

BEFORE_THE_FIRST_UPDATE_S = 0.0001


def outputs(loop, context):
    ports = map(loop.get_output_port, range(loop.num_output_ports()))
    vectors = [port for port in ports if port.get_data_type() == PortDataType.kVectorValued]
    return {port.get_name(): port.Eval(context).copy() for port in vectors}


@pytest.mark.parametrize(
    ("name", "variation", "options", "copied_s", "follows_s"),
    [
        ("laikago_balancing", "actual", {"recovery": True}, (0.05, 0.1237), 0.5),
        ("laikago_balancing", "nominal", {}, (BEFORE_THE_FIRST_UPDATE_S,), 0.05),
        ("go2_walking", "nominal", {"guard": True, "recovery": True}, (0.0137, 0.1), 0.05),
        ("atlas_reaching", "actual", {}, (BEFORE_THE_FIRST_UPDATE_S, 0.05), 0.02),
    ],
)
def test_a_copied_context_goes_on_as_its_original(name, variation, options, copied_s, follows_s):
    is_triggered = options.keys() == {"recovery"}
    assessment = None if is_triggered else load_assessment(name)
    loop = load_scenario(name).make_loop(variation=variation, assessment=assessment, **options)
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    loop.reset(context, np.random.default_rng(3))
    if is_triggered:
        loop.GetInputPort("safety_probability").FixValue(context, [0.0])
    simulator.Initialize()
    copies = []
    for time_s in copied_s:
        simulator.AdvanceTo(time_s)
        copies.append(Simulator(loop, context.Clone()))
        copies[-1].Initialize()
        np.testing.assert_equal(outputs(loop, copies[-1].get_context()), outputs(loop, context))
    simulator.AdvanceTo(copied_s[-1] + follows_s)
    expected = outputs(loop, context)
    assert expected.get("recovery_active", [1.0]) == [1.0] or not is_triggered
    for copy in copies:
        copy.AdvanceTo(context.get_time())
        np.testing.assert_equal(outputs(loop, copy.get_context()), expected)
