"""Tasks of one's own, outside the package: a mass that glides, and one carried to a goal."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydrake.systems.framework import BasicVector, DiagramBuilder, LeafSystem

from drake_safety.cli.training_folder import MODES, assessment_file, episodes_folder
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.segments import DivergenceError
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import load_scenario, parse_scenario

CONTROL_PERIOD_S = 0.01
SIDES = {"left": 1.0, "right": -1.0}
BOX = np.array([[0.6, -0.3, 0.2], [1.4, 1.4, 1.0]])
FAILING_Z_M = 0.9


def declare_outputs(system, ports, read):
    """Declares output ports: of each name its size, and what it says of what is read."""
    for name, (size, calc) in ports.items():
        system.DeclareVectorOutputPort(
            name,
            BasicVector(size),
            lambda context, output, calc=calc: output.SetFromVector(calc(*read(context))),
        )


def evaluated(system, context, name):
    return system.GetOutputPort(name).Eval(context)


@dataclass(kw_only=True)
class GlidingParameters:
    """Parameters of a gliding scenario."""

    speed_m_s: float = 2.0  # Largest at the start.
    failure: str = ""  # Beyond x = 0.5: "raise", "nan", "inf", "1e13", "bug" or none.
    fails_at_start: bool = False
    wall_m: float = 1.0


class Mass(LeafSystem):
    """x, v of a mass without forces between two walls."""

    def __init__(self, parameters, horizon):
        super().__init__()
        self.parameters, wall_m = parameters, parameters.wall_m
        self.DeclareDiscreteState(2)
        self.DeclareInitializationDiscreteUpdateEvent(self._start)
        self.DeclarePeriodicDiscreteUpdateEvent(CONTROL_PERIOD_S, 0.0, self._update)
        ports = {
            "state": (2, lambda *xv: xv),
            "true_state": (2, lambda *xv: xv),
            "output": (3, lambda x, v: [x, 0.0, 0.0]),
            "desired_output": (3, lambda x, v: np.zeros(3)),
            "desired_preview": (3 * horizon, lambda x, v: np.zeros(3 * horizon)),
            "features": (1, lambda x, v: [1.0 - x]),
            "margins": (2, lambda x, v: [wall_m - x, x + wall_m]),
            "safe": (1, lambda x, v: [float(min(wall_m - x, x + wall_m) >= 0)]),
        }
        declare_outputs(self, ports, lambda context: context.get_discrete_state_vector().value())

    def _start(self, context, discrete_state):
        if self.parameters.fails_at_start:
            raise RuntimeError("no start")

    def _update(self, context, discrete_state):
        x, v = context.get_discrete_state_vector().get_value()
        x += CONTROL_PERIOD_S * v
        if x > 0.5:
            if self.parameters.failure == "raise":
                raise DivergenceError("the solver failed")
            if self.parameters.failure == "bug":
                raise RuntimeError("operands could not be broadcast together")
            if self.parameters.failure:
                x = float(self.parameters.failure)
        discrete_state.set_value([x, v])


class Toy(ClosedLoop):
    """A task of a single system, whose ports it exports."""

    def build(self, system):
        builder = DiagramBuilder()
        self.mass = builder.AddSystem(system)
        ports = map(system.get_output_port, range(system.num_output_ports()))
        self.export(builder, {port.get_name(): port for port in ports}, period_s=0.04)
        builder.BuildInto(self)

    def set_state(self, context, *state):
        self.mass.GetMyMutableContextFromRoot(context).SetDiscreteState(np.hstack(state))


class Gliding(Toy):
    """The whole task of the mass that glides."""

    Parameters = GlidingParameters

    def __init__(self, scenario, variation="nominal", *, assessment=None, meshcat=None):
        super().__init__(scenario, variation, assessment)
        self.state_names = ["x", "v"]
        self.output_names = ["x", "y", "z"]
        self.feature_names = ["distance"]
        self.constraint_names = ["right", "left"]
        self.build(Mass(scenario.parameters, scenario.assessment.horizon))

    def reset(self, context, rng):
        x, v = rng.uniform(-0.3, 0.3), rng.uniform(-1, 1) * self.scenario.parameters.speed_m_s
        self.set_state(context, x, v)
        return int(rng.integers(2))


class Drifting(Gliding):
    """One that can glide for as long as one likes."""

    def reset_undisturbed(self, context, rng, duration_s):
        self.set_state(context, rng.uniform(-0.3, 0.3), rng.uniform(-0.6, 0.6) / duration_s)


SCENARIO = """
task: toy_tasks:Gliding
robot: none
episode_duration_s: 0.8
step_s: 0.04
variations: {nominal: {}, actual: {mass_scale: 1.2}}
"""


def gliding(task="Gliding", **parameters):
    text = SCENARIO.replace("Gliding", task) + f"parameters: {parameters}\n"
    return parse_scenario(text, name="gliding", folder=Path())


@dataclass(kw_only=True)
class ShuttleParameters:
    """Parameters of a shuttle scenario: none."""


class Shuttle(LeafSystem):
    """A mass that is carried at a constant speed, past walls at x = 1 and at y = 1 on its side."""

    def __init__(self, scenario, sign):
        super().__init__()
        self.reflect = np.array([1.0, sign, 1.0])
        self.DeclareDiscreteState(6)
        self.DeclarePeriodicDiscreteUpdateEvent(CONTROL_PERIOD_S, 0.0, self._update)
        self.duration_s = scenario.episode_duration_s
        offsets = scenario.step_s * np.arange(scenario.assessment.horizon)

        def state(p, v, left_s):
            return np.append(self.reflect * p, self.reflect * v)

        def preview(p, v, left_s):
            return (self.reflect * (p + np.minimum(offsets, left_s)[:, None] * v)).ravel()

        ports = {
            "state": (6, state),
            "true_state": (6, state),
            "output": (3, lambda p, v, left_s: p),
            "desired_output": (3, lambda p, v, left_s: p),
            "desired_preview": (3 * len(offsets), preview),
            "features": (2, lambda p, v, left_s: self.margins(p + left_s * v)),
            "margins": (2, lambda p, v, left_s: self.margins(p)),
            "safe": (1, lambda p, v, left_s: [float(min(self.margins(p)) >= 0)]),
            "plant_state": (6, lambda p, v, left_s: np.append(p, v)),
            "num_controller_failures": (1, lambda p, v, _: [v[2] * self.duration_s > FAILING_Z_M]),
        }
        declare_outputs(self, ports, self.read)

    def read(self, context):
        value = context.get_discrete_state_vector().get_value()
        return value[:3], value[3:], max(self.duration_s - context.get_time(), 0.0)

    def margins(self, p):
        return np.array([1.0 - p[0], 1.0 - (self.reflect * p)[1]])

    def _update(self, context, discrete_state):
        p, v, _ = self.read(context)
        discrete_state.set_value(np.append(p + CONTROL_PERIOD_S * v, v))


class Shuttling(Toy):
    """The whole task of the mass that is carried to a goal."""

    Parameters = ShuttleParameters
    hand = None
    named_targets: ClassVar[dict] = {}

    def __init__(
        self, scenario, variation="nominal", *, assessment=None, meshcat=None, side="left"
    ):
        super().__init__(scenario, variation, assessment)
        self.state_names = ["x", "y", "z", "vx", "vy", "vz"]
        self.output_names = ["x", "y", "z"]
        self.feature_names = ["to_the_front", "to_the_flank"]
        self.constraint_names = ["front", "flank"]
        self.fall_name = "flank"
        self.watched_features = {"front_margin": "to_the_front"}
        self.build(Shuttle(scenario, SIDES[side]))

    @property
    def target_box(self):
        return np.sort(self.mass.reflect * BOX, axis=0)

    def reset(self, context, rng, goal=None):
        start = self.mass.reflect * rng.uniform(-0.1, 0.1, 3)
        drawn = self.mass.reflect * rng.uniform(*BOX)
        self._carry(context, start, drawn if goal is None else goal)
        return 0

    def reset_standing(self, context, goal, rng=None):
        self._carry(context, np.zeros(3), goal)

    def _carry(self, context, start, goal):
        context.SetTime(0.0)
        self.set_state(context, start, (goal - start) / self.scenario.episode_duration_s)


SHUTTLING = """
task: toy_tasks:Shuttling
robot: none
episode_duration_s: 0.8
step_s: 0.04
variations: {nominal: {}, actual: {mass_scale: 1.1}}
assessment:
  {epochs: 6, ensemble_size: 1, hidden_sizes: [16], perplexity: 5, shortest_segment: 5}
"""


def shuttling():
    return parse_scenario(SHUTTLING, name="shuttling", folder=Path())


def train_shuttle(folder):
    """Learns both modes into a folder; returns the scenario's file."""
    file = folder / "shuttling.yaml"
    file.write_text(SHUTTLING)
    scenario = load_scenario(file)
    extra = {"command": "drake-safety train shuttling --out /somebodys/own"}
    episodes = run_episodes(scenario, 60, num_workers=1, path=episodes_folder(folder), extra=extra)
    for mode in MODES:
        scenario.assessment.mode = mode
        SafetyAssessment(scenario.assessment).fit(episodes).save(assessment_file(folder, mode))
    return file
