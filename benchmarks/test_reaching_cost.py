"""Cost of reaching compared with its bare plant."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from bare_plant import BarePlant, costs_beside, log_motion, loop_with_everything
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, DiscreteContactApproximation
from pydrake.systems.framework import DiagramBuilder

from drake_safety import Scenario, load_scenario
from drake_safety.models import load_robot
from drake_safety.plants.obstacles import add_obstacles, filter_collisions
from drake_safety.plants.physics import add_ground
from drake_safety.robots.robot import add_robot
from drake_safety.simulation.closed_loop import ClosedLoop

SCENARIO = "atlas_reaching"
NUM_EPISODES, ROUNDS = 6, 6


@pytest.fixture(scope="module")
def reaching() -> Scenario:
    return load_scenario(SCENARIO)


def bare_plant(loop: ClosedLoop) -> BarePlant:
    """The scenario's plant and scene under torques."""
    scenario = loop.scenario
    robot = load_robot(scenario.robot)
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, scenario.time_step_s)
    plant.set_discrete_contact_approximation(DiscreteContactApproximation.kLagged)
    variation = scenario.variation("nominal")
    instance = add_robot(plant, robot, variation, scene_graph=scene_graph, servos=False)
    add_ground(plant, variation.foot_friction or robot.foot_friction)
    obstacles = add_obstacles(plant, scenario.parameters.obstacles)
    add_obstacles(plant, scenario.parameters.decorations)
    plant.SetUseSampledOutputPorts(False)
    plant.Finalize()
    filter_collisions(plant, scene_graph, robot, obstacles)
    return BarePlant(builder, plant, plant.get_actuation_input_port(instance), loop)


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize("everything", [False, True])
def test_reaching_beside_its_bare_plant(
    benchmark: Any, report: Callable[..., None], reaching: Scenario, everything: bool
) -> None:
    loop = loop_with_everything(reaching) if everything else reaching.make_loop()
    port = loop.plant.get_actuation_input_port(loop.robot_instance)
    motions = [log_motion(loop, index, port) for index in range(NUM_EPISODES)]
    loop_s, plant_s = costs_beside(benchmark, loop, bare_plant(loop), motions, ROUNDS)
    spans = np.array([motion.duration_s for motion in motions])
    report(
        f"simulated second, {SCENARIO}" + (", everything on" if everything else ""),
        loop_s.sum() / spans.sum(),
        "CPU-s",
        at_most=0.28 if everything else 0.25,
        peers={"bare plant": plant_s.sum() / spans.sum(), "ratio": loop_s.sum() / plant_s.sum()},
        note=f"{1 / reaching.control_period_s:.0f} Hz control, "
        f"{1e3 * reaching.time_step_s:g} ms plant, {len(motions)} episodes",
    )
