"""What a rollout costs beside its bare plant, and what a second worker gains."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from pydrake.geometry import HalfSpace
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    DiscreteContactApproximation,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from threadpoolctl import threadpool_limits

from drake_safety import Scenario, run_episode, run_episodes
from drake_safety.control.robot import add_robot, add_to_package_map
from drake_safety.models import load_robot
from drake_safety.simulation.balls import add_ball
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.rollouts import episode_rng

SEED = 0
NUM_EPISODES = 24  # Candidates for the comparison with the bare plant.
ROUNDS = 3
THROUGHPUT_EPISODES = 128
WARM_UP_EPISODES = 16


@dataclass(kw_only=True, eq=False)
class Motion:
    """One episode's start, its joint commands and its end."""

    index: int
    duration_s: float
    start: Context  # The loop's root.
    commands: PiecewisePolynomial
    end_state: np.ndarray


class BarePlant:
    """The scenario's plant with its implicit PD, driven by logged commands from C++ alone."""

    def __init__(self, loop: ClosedLoop):
        scenario = loop.scenario
        robot = load_robot(scenario.robot)
        variation = scenario.variation("nominal")
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, scenario.time_step_s)
        plant.set_discrete_contact_approximation(DiscreteContactApproximation.kLagged)
        instance = add_robot(plant, robot, variation, scene_graph=scene_graph)
        parser = Parser(plant)
        add_to_package_map(parser.package_map())
        parser.AddModels(url="package://drake_safety_models/scenes/ground.urdf")
        mu = variation.foot_friction or robot.foot_friction
        plant.RegisterCollisionGeometry(
            plant.world_body(), RigidTransform(), HalfSpace(), "ground", CoulombFriction(mu, mu)
        )
        add_ball(plant)
        plant.SetUseSampledOutputPorts(False)
        plant.Finalize()
        port = plant.get_desired_state_input_port(instance)
        self._source = builder.AddSystem(
            TrajectorySource(PiecewisePolynomial(np.zeros((port.size(), 1))))
        )
        builder.Connect(self._source.get_output_port(), port)
        self._plant, self._loop_plant = plant, loop.plant
        self._diagram: Diagram = builder.Build()

    def follow(self, motion: Motion) -> np.ndarray:
        """Simulates the motion; its last state."""
        self._source.UpdateTrajectory(motion.commands)
        simulator = Simulator(self._diagram)
        context = simulator.get_mutable_context()
        plant_context = self._plant.GetMyMutableContextFromRoot(context)
        start = self._loop_plant.GetMyContextFromRoot(motion.start)
        plant_context.get_mutable_discrete_state().SetFrom(start.get_discrete_state())
        plant_context.get_mutable_parameters().SetFrom(start.get_parameters())
        simulator.Initialize()
        simulator.AdvanceTo(motion.duration_s)
        return self._plant.GetPositionsAndVelocities(plant_context)


def log_motion(loop: ClosedLoop, index: int) -> Motion:
    """Runs an episode again and logs what the plant's servos are told, whenever it changes."""
    duration_s = float(run_episode(loop, index, seed=SEED).time_s[-1])
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    loop.reset(context, episode_rng(SEED, index))
    plant = loop.plant
    plant_context = plant.GetMyContextFromRoot(context)
    start = context.Clone()
    port = plant.get_desired_state_input_port(loop.robot_instance)
    breaks: list[float] = []
    samples: list[np.ndarray] = []

    def log(root: Context) -> EventStatus:
        command = port.Eval(plant_context)
        if not samples or np.any(command != samples[-1]):
            # In the middle of a step: no rounding of times can move it across a plant step.
            breaks.append(root.get_time() - 0.5 * loop.scenario.time_step_s)
            samples.append(command.copy())
        return EventStatus.DidNothing()

    simulator.set_monitor(log)
    simulator.Initialize()
    simulator.AdvanceTo(duration_s)
    breaks.append(duration_s + 1.0)
    samples.append(samples[-1])
    return Motion(
        index=index,
        duration_s=duration_s,
        start=start,
        commands=PiecewisePolynomial.ZeroOrderHold(breaks, np.transpose(samples)),
        end_state=plant.GetPositionsAndVelocities(plant_context),
    )


@pytest.mark.benchmark(timer=time.process_time)
def test_the_closed_loop_beside_its_bare_plant(
    benchmark: Any, report: Callable[..., None], scenario: Scenario
) -> None:
    with threadpool_limits(1):
        loop = scenario.make_loop()
        bare = BarePlant(loop)
        motions = [log_motion(loop, index) for index in range(NUM_EPISODES)]
        for motion in motions:
            np.testing.assert_allclose(bare.follow(motion), motion.end_state, atol=1e-9)
        cost = {"loop": np.full((ROUNDS, len(motions)), np.inf)}
        cost["plant"] = cost["loop"].copy()
        pairs = iter([(round_, i) for round_ in range(ROUNDS) for i in range(len(motions))])
        now = (0, 0)

        def follow_bare() -> None:
            nonlocal now
            now = next(pairs)
            started = time.process_time()
            bare.follow(motions[now[1]])
            cost["plant"][now] = time.process_time() - started

        def run_loop() -> None:
            started = time.process_time()
            run_episode(loop, motions[now[1]].index, seed=SEED)
            cost["loop"][now] = time.process_time() - started

        benchmark.pedantic(run_loop, setup=follow_bare, rounds=cost["loop"].size)
    spans = np.array([motion.duration_s for motion in motions])
    # The quickest of the rounds, of either: what else runs on the machine only ever adds.
    loop_s, plant_s = (cost[name].min(axis=0) for name in ("loop", "plant"))
    is_whole = spans > scenario.episode_duration_s - 1e-9
    for name, chosen, limit in (
        ("rollout / bare plant, whole episodes", is_whole, 1.6),
        ("rollout / bare plant, all episodes", np.full(len(spans), True), None),
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
