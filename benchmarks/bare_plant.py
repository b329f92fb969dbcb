"""A loop's plant alone, driven by the logged commands of an episode."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus, InputPort
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from drake_safety import Scenario, load_assessment, run_episode
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.rollouts import episode_rng

SEED = 0


@dataclass(kw_only=True, eq=False)
class Motion:
    """One episode's start, the plant's commands and its end."""

    index: int
    duration_s: float
    start: Context  # The loop's root.
    commands: PiecewisePolynomial
    end_state: np.ndarray


class BarePlant:
    """A plant driven by logged commands.

    Args:
        builder: Of a diagram that holds the plant and its scene graph.
        plant: Finalised, the same as the loop's.
        port: Where its commands come in.
        loop: The loop whose motions it shall follow.
    """

    def __init__(
        self, builder: DiagramBuilder, plant: MultibodyPlant, port: InputPort, loop: ClosedLoop
    ):
        self._source = builder.AddSystem(
            TrajectorySource(PiecewisePolynomial(np.zeros((port.size(), 1))))
        )
        builder.Connect(self._source.get_output_port(), port)
        self._plant, self._loop_plant = plant, loop.plant
        self._diagram: Diagram = builder.Build()

    def follow(self, motion: Motion) -> np.ndarray:
        """Simulates the motion and returns its last state."""
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


def loop_with_everything(scenario: Scenario) -> ClosedLoop:
    """The nominal loop with the shipped assessment: assessor, monitor, seen margins, recovery."""
    return scenario.make_loop(assessment=load_assessment(scenario.name))


def log_motion(loop: ClosedLoop, index: int, port: InputPort) -> Motion:
    """Simulates an episode again and logs each change of an input port of its plant."""
    duration_s = float(run_episode(loop, index, seed=SEED).time_s[-1])
    simulator = Simulator(loop)
    loop.reset(simulator.get_mutable_context(), episode_rng(SEED, index))
    return log_commands(loop, simulator, port, duration_s, index)


def log_commands(
    loop: ClosedLoop, simulator: Simulator, port: InputPort, duration_s: float, index: int = 0
) -> Motion:
    """Simulates from the present state and logs each change of an input port of the plant."""
    plant, context = loop.plant, simulator.get_mutable_context()
    plant_context = plant.GetMyContextFromRoot(context)
    start = context.Clone()
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


def costs_beside(
    benchmark: Any, loop: ClosedLoop, bare: BarePlant, motions: list[Motion], num_rounds: int
) -> tuple[np.ndarray, np.ndarray]:
    """CPU seconds of every episode in the loop, (N,), and of its motion by the plant alone, (N,).

    The two take turns, and the quickest of the rounds counts: what else runs on the machine only
    ever adds.
    """
    for motion in motions:
        np.testing.assert_allclose(bare.follow(motion), motion.end_state, atol=1e-9)
    loop_s = np.full((num_rounds, len(motions)), np.inf)
    plant_s = loop_s.copy()
    pairs = iter([(round_, i) for round_ in range(num_rounds) for i in range(len(motions))])
    now = (0, 0)

    def follow_bare() -> None:
        nonlocal now
        now = next(pairs)
        started = time.process_time()
        bare.follow(motions[now[1]])
        plant_s[now] = time.process_time() - started

    def run_loop() -> None:
        started = time.process_time()
        run_episode(loop, motions[now[1]].index, seed=SEED)
        loop_s[now] = time.process_time() - started

    benchmark.pedantic(run_loop, setup=follow_bare, rounds=loop_s.size)
    return loop_s.min(axis=0), plant_s.min(axis=0)
