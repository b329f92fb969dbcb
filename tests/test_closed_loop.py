"""ClosedLoop: the contract is checked when a task is built, not when someone trips over it."""

from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_safety.plants.balls import Throw
from drake_safety.simulation.closed_loop import (
    ASSESSMENT_PORTS,
    REQUIRED_PORTS,
    ClosedLoop,
)
from drake_safety.simulation.rollouts import run_episode
from gliding_task import Gliding, gliding
from shuttle_task import Shuttling, shuttling

LOOP_NAMES = ("state_names", "output_names", "feature_names", "constraint_names")


class Partial(ClosedLoop):
    """Exports only the ports it is told to."""

    def __init__(self, scenario, ports, assessment=None):
        super().__init__(scenario, "nominal", assessment)
        builder = DiagramBuilder()
        source = builder.AddSystem(ConstantVectorSource([0.0]))
        for name in ports:
            builder.ExportOutput(source.get_output_port(), name)
        self.finish(builder)


def test_a_task_with_every_port_is_accepted():
    assert Partial(gliding(), REQUIRED_PORTS).num_output_ports() == len(REQUIRED_PORTS)


@pytest.mark.parametrize("name", REQUIRED_PORTS)
def test_a_missing_port_is_named(name):
    rest = [port for port in REQUIRED_PORTS if port != name]
    with pytest.raises(ValueError, match=rf"'Partial' exports no port \['{name}'\]; it exports"):
        Partial(gliding(), rest)


@pytest.mark.parametrize("name", ASSESSMENT_PORTS)
def test_with_an_assessment_its_ports_are_promised_too(name):
    rest = [port for port in REQUIRED_PORTS + ASSESSMENT_PORTS if port != name]
    with pytest.raises(ValueError, match=rf"exports no port \['{name}'\]"):
        Partial(gliding(), rest, assessment=SimpleNamespace())


def test_an_unknown_variation_is_answered_with_those_that_exist():
    with pytest.raises(ValueError, match=r"'gliding' has no variation 'x'; it has \['nominal', 'a"):
        Gliding(gliding(), "x")


def test_a_task_without_a_ball_says_so():
    loop = Gliding(gliding())
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="task 'Gliding' has no ball to throw"):
        loop.throw_ball(loop.CreateDefaultContext(), Throw(), 0.1)
    with pytest.raises(ValueError, match="task 'Gliding' has no ball to throw"):
        loop.sample_throw(rng, 0.1)
    with pytest.raises(ValueError, match="task 'Gliding' has no calm motion"):
        loop.reset_calm(loop.CreateDefaultContext(), rng)


def names_of(loop):
    return {name: getattr(loop, name) for name in LOOP_NAMES}


def assessment_for(loop, **changes):
    scenario = loop.scenario
    info = {
        "scenario": scenario.name,
        "scenario_hash": scenario.simulation_hash(),
        "variation": "nominal",
        "horizon": scenario.assessment.horizon,
        "step_s": scenario.step_s,
    }
    return SimpleNamespace(info_=SimpleNamespace(**info | names_of(loop) | changes))


def test_an_assessment_of_the_same_diagram_is_accepted():
    loop = Gliding(gliding())
    loop.check_assessment()
    loop.assessment = assessment_for(loop)
    loop.check_assessment()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scenario": "falling"}, "differ in scenario: .* with falling, the diagram has gliding"),
        ({"horizon": 7}, "differ in horizon: .* with 7, the diagram has 10"),
        ({"step_s": 0.05}, "differ in step_s: .* with 0.05, the diagram has 0.04"),
        ({"state_names": ["x"]}, r"differ in state: .* with \['x'\], the diagram has \['x', 'v'\]"),
        ({"output_names": ["x"]}, r"differ in output: .* with \['x'\]"),
        ({"feature_names": []}, r"differ in features: .* with \[\], .* \['distance'\]"),
        ({"constraint_names": ["left", "right"]}, r"differ in constraints: .* \['right', 'left'\]"),
        ({"scenario_hash": "0" * 64}, "differ in scenario hash: .* with 0000"),
    ],
)
def test_an_assessment_of_another_diagram_is_refused_with_both_sides_named(change, message):
    loop = Gliding(gliding())
    loop.assessment = assessment_for(loop, **change)
    with pytest.raises(ValueError, match=message):
        loop.check_assessment()


def test_a_task_refuses_a_foreign_assessment_when_it_is_built():
    loop = Gliding(gliding())
    with pytest.raises(ValueError, match="differ in horizon"):
        gliding().make_loop(assessment=assessment_for(loop, horizon=3))


def test_a_task_whose_plans_have_no_goal_says_so():
    loop = Gliding(gliding())
    context = loop.CreateDefaultContext()
    assert loop.target_box is None
    assert loop.fair_box is None
    assert loop.mirror_options == {}
    assert loop.num_controller_failures(context) == 0
    for ask in (loop.goal_of, lambda _: loop.reset_standing(context, np.zeros(3))):
        with pytest.raises(ValueError, match="task 'Gliding' has plans without a goal"):
            ask(None)


def test_without_a_word_of_its_own_all_of_a_tasks_targets_are_fair():
    class Plain(Shuttling):
        fair_box = ClosedLoop.fair_box

    loop = Plain(shuttling())
    np.testing.assert_array_equal(loop.fair_box, loop.target_box)
    assert all(loop.is_fair(run_episode(loop, index)) for index in range(3))


def test_a_goal_outside_the_fair_box_is_not_fair():
    loop = Shuttling(shuttling())
    for index in range(12):
        episode = run_episode(loop, index)
        low, high = loop.fair_box
        goal = loop.goal_of(episode)
        assert loop.is_fair(episode) == bool(np.all((low <= goal) & (goal <= high)))
