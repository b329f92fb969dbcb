"""Costs of walking: the loop beside its bare plant, and the policy beside its network alone."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from bare_plant import BarePlant, log_commands
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, DiscreteContactApproximation
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_safety import load_assessment, load_scenario
from drake_safety.plants.physics import add_ground
from drake_safety.robots.robot import add_robot
from drake_safety.simulation.closed_loop import ClosedLoop

SCENARIOS = ("go2_walking", "g1_walking")
COMMAND, SPAN_S, ROUNDS = np.array([0.5, 0.0, 0.3]), 3.0, 6
pytest.importorskip("onnxruntime")


def bare_plant(loop: ClosedLoop) -> BarePlant:
    """The scenario's robot with the policy's servos, on the ground."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, loop.scenario.time_step_s)
    plant.set_discrete_contact_approximation(DiscreteContactApproximation.kLagged)
    variation = loop.scenario.variation("nominal")
    instance = add_robot(plant, loop.robot, variation, scene_graph=scene_graph, servos=True)
    add_ground(plant, variation.foot_friction or loop.robot.foot_friction)
    plant.SetUseSampledOutputPorts(False)
    plant.Finalize()
    return BarePlant(builder, plant, plant.get_desired_state_input_port(instance), loop)


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize("name", SCENARIOS)
@pytest.mark.parametrize("everything", [False, True])
def test_walking_beside_its_bare_plant(
    benchmark: Any, report: Callable[..., None], name: str, everything: bool
) -> None:
    scenario = load_scenario(name)
    options: dict[str, Any] = {}
    if everything:
        options = {"assessment": load_assessment(name), "guard": True, "recovery": True}
    loop = scenario.make_loop(**options)
    simulator = Simulator(loop)

    def begin() -> Simulator:
        loop.reset_standing(simulator.get_mutable_context(), COMMAND)
        simulator.Initialize()
        return simulator

    port = loop.plant.get_desired_state_input_port(loop.robot_instance)
    motion = log_commands(loop, begin(), port, SPAN_S)
    bare = bare_plant(loop)
    np.testing.assert_allclose(bare.follow(motion), motion.end_state, atol=1e-6)
    loop_s, plant_s = [], []

    def alternate() -> None:
        started = time.process_time()
        bare.follow(motion)
        plant_s.append(time.process_time() - started)
        begin()
        started = time.process_time()
        simulator.AdvanceTo(SPAN_S)
        loop_s.append(time.process_time() - started)

    benchmark.pedantic(alternate, rounds=ROUNDS)
    report(
        f"simulated second, {name}" + (", everything on" if everything else ""),
        min(loop_s) / SPAN_S,
        "CPU-s",
        at_most=0.5,
        peers={"bare plant": min(plant_s) / SPAN_S, "ratio": min(loop_s) / min(plant_s)},
        note="assessor, guard and recovery" if everything else "policy, monitor and features",
    )


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize("name", SCENARIOS)
def test_a_tick_of_the_policy_beside_its_network(
    benchmark: Any, report: Callable[..., None], name: str
) -> None:
    loop = load_scenario(name).make_loop()
    policy = loop.policy
    q, v = loop.kinematics.standing_positions(), np.zeros(loop.kinematics.num_velocities)
    action, history = np.zeros(len(policy.joints)), np.full(sum(policy.sizes), np.nan)
    memory = policy.network.initial_memory

    def tick() -> np.ndarray:
        seen = policy.see(q, v, COMMAND, action, policy.initial_phases)
        return policy.targets(policy.act(policy.observe(seen, history), memory)[0])

    observation = policy.observe(policy.see(q, v, COMMAND, action, policy.initial_phases), history)
    count = 200
    started = time.process_time()
    for _ in range(count):
        policy.network(observation, memory)
    network_s = (time.process_time() - started) / count
    benchmark.pedantic(tick, rounds=50, iterations=20)
    report(
        f"policy's tick, {name}",
        1e6 * benchmark.stats.stats.min,
        "µs",
        at_most=1000.0,
        peers={"network alone": 1e6 * network_s},
        note=f"{len(observation)} inputs, {len(action)} actions",
    )
