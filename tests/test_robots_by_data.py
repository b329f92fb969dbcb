"""Robots of the extra `robots`: each stands, by its robot.yaml and its scenario alone."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from command_line import problems
from drake_safety.diagrams.balancing.sampling import throw_start
from drake_safety.diagrams.balancing.throws import Violations
from drake_safety.extras import MissingExtraError
from drake_safety.models import load_robot, robot_names
from drake_safety.simulation.scenario import load_scenario, scenario_names

OF_THE_EXTRA = [
    name
    for name in robot_names()
    if load_robot(name).urdf.startswith("package://example-robot-data/")
]
BALANCING = [name for name in OF_THE_EXTRA if f"{name}_balancing" in scenario_names()]


@pytest.mark.parametrize("name", BALANCING[::3])
def test_it_stands(name, duration_s=2.0):
    loop = load_scenario(f"{name}_balancing").make_loop("actual", recovery=False, ball=False)
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    rng = np.random.default_rng(0)
    start = throw_start(loop.kinematics, rng, half_widths_m=[0, 0], plan_duration_s=[1.0, 1.0])
    loop.reset_calm(context, rng)
    loop.reset_to(context, rng, start)
    simulator.Initialize()
    violations = Violations(loop)
    for row in range(1, round(20 * duration_s) + 1):
        simulator.AdvanceTo(0.05 * row)
        assert not any(violations(context)), violations(context)
        height = loop.GetOutputPort("plant_state").Eval(context)[6]
        assert abs(height - loop.kinematics.standing_height) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", BALANCING)
def test_its_scenario_is_ready(name):
    assert problems(f"{name}_balancing") == {}


def test_without_the_extra_a_scenario_and_their_list_say_what_to_install(monkeypatch, capsys):
    from drake_safety.cli.prepare import scenarios
    from drake_safety.robots import model_files

    monkeypatch.setattr(model_files, "_installed_folder", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"pip install 'drake_safety\[robots\]'"):
        load_scenario(f"{BALANCING[0]}_balancing")
    monkeypatch.setenv("COLUMNS", "200")
    scenarios()
    lines = capsys.readouterr().out.splitlines()
    for name in scenario_names():
        (line,) = [one for one in lines if f" {name} " in one]
        of_extra = name.rpartition("_")[0] in OF_THE_EXTRA
        assert ("drake_safety[robots]" in line) == of_extra
