"""Cost of reaching compared with its bare plant, and convergence with finer steps."""

import copy
import multiprocessing
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from bare_plant import SEED, BarePlant, costs_beside, log_motion, loop_with_everything
from costs import alternate
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, DiscreteContactApproximation
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from threadpoolctl import threadpool_limits

from drake_safety import Scenario, load_scenario, run_episodes
from drake_safety.models import load_robot
from drake_safety.plants.obstacles import add_obstacles, filter_collisions
from drake_safety.plants.physics import add_ground
from drake_safety.robots.robot import add_robot
from drake_safety.simulation.closed_loop import ClosedLoop

SCENARIO = "atlas_reaching"
NUM_EPISODES, ROUNDS = 6, 6
FINE_TIME_STEP_S, FINE_CONTROL_PERIOD_S = 0.0005, 0.001


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


@pytest.mark.benchmark(timer=time.process_time)
def test_threads_of_blas_cost_nothing_beside_a_busy_core(
    benchmark: Any, report: Callable[..., None], reaching: Scenario
) -> None:
    """An ordinary simulation, with the threads that BLAS has by default and with one."""
    loop = loop_with_everything(reaching)

    def simulate() -> None:
        simulator = Simulator(loop)
        loop.reset(simulator.get_mutable_context(), np.random.default_rng(SEED))
        simulator.AdvanceTo(reaching.episode_duration_s)

    def simulate_with_one_thread() -> None:
        with threadpool_limits(1):
            simulate()

    busy = multiprocessing.get_context("spawn").Process(target=_spin, daemon=True)
    busy.start()
    try:
        cost_s, peers_s = alternate(
            benchmark, simulate, {"one thread": simulate_with_one_thread}, rounds=ROUNDS
        )
    finally:
        busy.kill()
    span_s = reaching.episode_duration_s
    report(
        f"simulated second beside a busy core, {SCENARIO}, everything on",
        cost_s / span_s,
        "CPU-s",
        at_most=1.1 * peers_s["one thread"] / span_s,
        peers={name: seconds / span_s for name, seconds in peers_s.items()},
        note="an ordinary Simulator, BLAS threads as by default",
    )


def _spin() -> None:
    while True:
        pass


def test_labels_beside_those_of_finer_steps(
    benchmark: Any, report: Callable[..., None], reaching: Scenario, pytestconfig: pytest.Config
) -> None:
    """The same starts and targets, under a quicker controller in finer steps of the plant."""
    num_episodes = pytestconfig.getoption("reference_episodes")
    fine = copy.deepcopy(reaching)
    fine.time_step_s, fine.control_period_s = FINE_TIME_STEP_S, FINE_CONTROL_PERIOD_S
    episodes = run_episodes(reaching, num_episodes, seed=SEED)
    reference = benchmark.pedantic(
        run_episodes, args=(fine, num_episodes), kwargs={"seed": SEED}, rounds=1
    )
    is_same = np.array([a.is_safe == b.is_safe for a, b in zip(episodes, reference, strict=True)])
    is_same_cause = [a.cause == b.cause for a, b in zip(episodes, reference, strict=True)]
    report(
        f"labels as in finer steps, {SCENARIO}",
        100 * is_same.mean(),
        "%",
        at_least=98.0,
        peers={"causes %": 100 * float(np.mean(is_same_cause))},
        note=f"{num_episodes} episodes, {episodes.num_unsafe} unsafe, against "
        f"{1 / fine.control_period_s:.0f} Hz control, {1e3 * fine.time_step_s:g} ms plant; "
        f"others: {np.flatnonzero(~is_same).tolist()}",
    )
