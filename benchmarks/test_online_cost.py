"""Cost of an evaluation of Γ in a running diagram."""

import copy
import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from costs import alternate
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)
from pydrake.systems.primitives import ConstantVectorSource

from drake_safety import SafetyAssessment, Scenario
from drake_safety.learning.segments import Episodes
from drake_safety.learning.trained_maps import Embedding
from drake_safety.systems.change_monitor import ChangeMonitor
from drake_safety.systems.safety_assessor import SafetyAssessor

INPUT_NAMES = ("state", "desired_preview", "features")
PERIOD_S = 0.01
NUM_UPDATES = 2000  # Evaluations in a round.
ROUNDS = 7
NUM_EPISODES = 96
CASES: dict[str, dict[str, Any]] = {
    "paper": {"mode": "paper"},
    "sharpened": {"mode": "sharpened", "epochs": 1},
    "sharpened 3x(256, 256, 256)": {
        "mode": "sharpened",
        "epochs": 1,
        "ensemble_size": 3,
        "hidden_sizes": [256, 256, 256],
    },
}
TICK_US = 20_000.0  # Of an assessor at 50 Hz.
MAX_US = TICK_US / 50.0


class EmptySystem(LeafSystem):
    """The ports, state and events of a system, without computation."""

    def __init__(self, other: LeafSystem):
        super().__init__()
        for i in range(other.num_input_ports()):
            port = other.get_input_port(i)
            self.DeclareVectorInputPort(port.get_name(), port.size())
        state = self.DeclareDiscreteState(
            sum(other.get_output_port(i).size() for i in range(other.num_output_ports()))
        )
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD_S, 0.0, self._update)
        for i in range(other.num_output_ports()):
            port = other.get_output_port(i)
            self.DeclareVectorOutputPort(
                port.get_name(),
                BasicVector(port.size()),
                lambda context, output: None,
                {self.discrete_state_ticket(state)},
            )

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        pass


class Running:
    """A system with constant inputs in its own diagram, simulated continuously."""

    def __init__(self, system: LeafSystem, inputs: dict[str, np.ndarray]):
        builder = DiagramBuilder()
        self.system = builder.AddSystem(system)
        for name, value in inputs.items():
            source = builder.AddSystem(ConstantVectorSource(value))
            builder.Connect(source.get_output_port(), self.system.GetInputPort(name))
        self._simulator = Simulator(builder.Build())
        self._simulator.Initialize()
        self._num_updates = 0

    def output(self, name: str) -> np.ndarray:
        context = self.system.GetMyContextFromRoot(self._simulator.get_context())
        return self.system.GetOutputPort(name).Eval(context)

    def update(self) -> None:
        """Simulates all updates of a round."""
        # To the middle between two ticks: rounding cannot move a tick out of its round.
        self._num_updates += NUM_UPDATES
        self._simulator.AdvanceTo((self._num_updates - 0.5) * PERIOD_S)


def assessor_of(assessment: SafetyAssessment) -> SafetyAssessor:
    return SafetyAssessor(assessment, period_s=PERIOD_S, checks_margins=False, heeds_alarm=False)


class EagerNetworks:
    """The maps of an assessment as torch modules."""

    def __init__(self, embedding: Embedding):
        def linear(name: str, member: int) -> torch.nn.Linear:
            weight = torch.tensor(embedding.weights[f"{name}.weight"][member])
            layer = torch.nn.Linear(*weight.shape)
            layer.weight.data = weight.T.contiguous()
            layer.bias.data = torch.tensor(embedding.weights[f"{name}.bias"][member])
            return layer

        self._networks = []
        for member in range(embedding.num_members):
            layers: list[torch.nn.Module] = []
            for i in range(embedding.num_layers):
                layers += [linear(f"trunk.{i}", member), torch.nn.ReLU()]
            self._networks.append(torch.nn.Sequential(*layers, linear("output", member)).eval())

    def evaluate(self, x: np.ndarray) -> list[torch.Tensor]:
        with torch.inference_mode():
            z = torch.from_numpy(x)
            return [network(z) for network in self._networks]


def per_update_us(seconds: float) -> float:
    return 1e6 * seconds / NUM_UPDATES


def repeat(function: Callable[[], Any]) -> Callable[[], None]:
    """As often as a round has updates."""

    def run() -> None:
        for _ in range(NUM_UPDATES):
            function()

    return run


@pytest.fixture(scope="module")
def some(episodes: Episodes) -> Episodes:
    return episodes[:NUM_EPISODES]


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize("case", list(CASES))
def test_one_evaluation_inside_a_diagram(
    benchmark: Any, report: Callable[..., None], scenario: Scenario, some: Episodes, case: str
) -> None:
    parameters = copy.deepcopy(scenario.assessment)
    for name, value in CASES[case].items():
        setattr(parameters, name, value)
    assessment = SafetyAssessment(parameters).fit(some)
    starts = [np.stack([getattr(e, name)[0] for e in some]) for name in INPUT_NAMES]
    safest = int(np.argmax(assessment.predict(*starts).belief[:, 0]))
    inputs = {name: rows[safest] for name, rows in zip(INPUT_NAMES, starts, strict=True)}
    names = list(inputs) if assessment.uses_features else ["state", "desired_preview"]
    x = np.concatenate([inputs[name] for name in names]).astype(np.float32)

    previous_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        running = Running(assessor_of(assessment), inputs)
        empty = Running(EmptySystem(running.system), inputs)
        eager = EagerNetworks(assessment.embedding_)
        # Γ is really evaluated, and torch does the same.
        assert running.output("safety_probability")[0] > 0.0
        ours = assessment.embedding_.evaluate(x[None])
        theirs = np.stack([z.numpy() for z in eager.evaluate(x)])
        np.testing.assert_allclose(ours.embedding[:, 0], theirs[:, :2], rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(ours.margins[:, 0], theirs[:, 2:], rtol=1e-3, atol=1e-3)
        cost_s, peers_s = alternate(
            benchmark,
            running.update,
            {
                "empty LeafSystem": empty.update,
                "torch, forward pass": repeat(lambda: eager.evaluate(x)),
            },
            rounds=ROUNDS,
        )
    finally:
        torch.set_num_threads(previous_threads)
    weights = assessment.embedding_.weights
    widths = [weights[f"trunk.{i}.bias"].shape[1] for i in range(assessment.embedding_.num_layers)]
    report(
        f"Γ in a diagram, {case}",
        per_update_us(cost_s),
        "us CPU",
        at_most=MAX_US,
        peers={name: per_update_us(seconds) for name, seconds in peers_s.items()},
        note=f"{assessment.embedding_.num_members} maps, {len(x)} inputs, layers {widths}",
    )


@pytest.mark.benchmark(timer=time.process_time)
def test_novelty_and_monitor_beside_an_evaluation(
    benchmark: Any, report: Callable[..., None], scenario: Scenario, some: Episodes
) -> None:
    assessment = SafetyAssessment(copy.deepcopy(scenario.assessment)).fit(some)
    detector = dataclasses.replace(assessment.detector_, step_s=PERIOD_S)
    assessment.detector_ = detector
    inputs = {name: getattr(some[0], name)[0] for name in INPUT_NAMES}
    gamma = Running(assessor_of(assessment), inputs)
    monitor = Running(ChangeMonitor(assessment), inputs)
    # Constant inputs are frozen ones, which the monitor notices: it is really evaluated.
    monitor.update()
    assert monitor.output("levels").min() > 1.0
    cost_s, peers_s = alternate(
        benchmark, monitor.update, {"Γ in a diagram": gamma.update}, rounds=ROUNDS
    )
    peers = {name: per_update_us(seconds) for name, seconds in peers_s.items()}
    report(
        "novelty and monitor in a diagram",
        per_update_us(cost_s),
        "us CPU",
        at_most=0.75 * peers["Γ in a diagram"],
        peers=peers,
        note=f"{len(detector.columns)} inputs, {len(detector.watched)} states",
    )
