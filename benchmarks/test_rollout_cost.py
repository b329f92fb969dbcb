"""Cost of a rollout compared with its bare plant, and speed-up by a second worker."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from bare_plant import SEED, BarePlant, costs_beside, log_motion, loop_with_everything
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, DiscreteContactApproximation
from pydrake.systems.framework import DiagramBuilder

from drake_safety import Scenario, run_episodes
from drake_safety.models import load_robot
from drake_safety.plants.balls import add_ball
from drake_safety.plants.physics import add_ground
from drake_safety.robots.robot import add_robot
from drake_safety.simulation.closed_loop import ClosedLoop

NUM_EPISODES = 24  # Candidates for the comparison with the bare plant.
ROUNDS = 3
THROUGHPUT_EPISODES = 128
WARM_UP_EPISODES = 16


def bare_plant(loop: ClosedLoop) -> BarePlant:
    """The scenario's plant with its implicit PD."""
    scenario = loop.scenario
    robot = load_robot(scenario.robot)
    variation = scenario.variation("nominal")
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, scenario.time_step_s)
    plant.set_discrete_contact_approximation(DiscreteContactApproximation.kLagged)
    instance = add_robot(plant, robot, variation, scene_graph=scene_graph)
    add_ground(plant, variation.foot_friction or robot.foot_friction)
    add_ball(plant)
    plant.SetUseSampledOutputPorts(False)
    plant.Finalize()
    return BarePlant(builder, plant, plant.get_desired_state_input_port(instance), loop)


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize("everything", [False, True])
def test_the_closed_loop_beside_its_bare_plant(
    benchmark: Any, report: Callable[..., None], scenario: Scenario, everything: bool
) -> None:
    loop = loop_with_everything(scenario) if everything else scenario.make_loop()
    port = loop.plant.get_desired_state_input_port(loop.robot_instance)
    motions = [log_motion(loop, index, port) for index in range(NUM_EPISODES)]
    loop_s, plant_s = costs_beside(benchmark, loop, bare_plant(loop), motions, ROUNDS)
    spans = np.array([motion.duration_s for motion in motions])
    is_whole = spans > scenario.episode_duration_s - 1e-9
    what = "rollout with everything on" if everything else "rollout"
    for name, chosen, limit in (
        (f"{what} / bare plant, whole episodes", is_whole, None if everything else 1.4),
        (f"{what} / bare plant, all episodes", np.full(len(spans), True), None),
    ):
        per_episode = loop_s[chosen] / plant_s[chosen]
        per_second = 1e3 / spans[chosen].sum()
        report(
            name,
            loop_s[chosen].sum() / plant_s[chosen].sum(),
            "x",
            at_most=limit,
            peers={
                "loop ms/s": per_second * loop_s[chosen].sum(),
                "plant ms/s": per_second * plant_s[chosen].sum(),
            },
            note=f"{chosen.sum()} episodes, each {per_episode.min():.2f} to "
            f"{per_episode.max():.2f}",
        )


def test_two_workers_beside_one(
    benchmark: Any, report: Callable[..., None], scenario: Scenario
) -> None:
    run_episodes(scenario, WARM_UP_EPISODES, seed=SEED, num_workers=2)
    run_episodes(scenario, WARM_UP_EPISODES, seed=SEED, num_workers=1)
    wall_s: dict[int, list[float]] = {1: [], 2: []}

    def run(num_workers: int) -> None:
        started = time.perf_counter()
        run_episodes(scenario, THROUGHPUT_EPISODES, seed=SEED, num_workers=num_workers)
        wall_s[num_workers].append(time.perf_counter() - started)

    benchmark.pedantic(run, args=(2,), setup=lambda: run(1), rounds=ROUNDS)
    one, two = min(wall_s[1]), min(wall_s[2])
    ratios = [a / b for a, b in zip(wall_s[1], wall_s[2], strict=True)]
    report(
        "two workers / one, throughput",
        one / two,
        "x",
        at_least=1.8,
        peers={"one, episodes/s": THROUGHPUT_EPISODES / one},
        note=f"two {THROUGHPUT_EPISODES / two:.4g}, median of pairs "
        f"{statistics.median(ratios):.2f}",
    )
