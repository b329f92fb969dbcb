"""A task whose plans have a goal: a mass that is carried there at a constant speed, past walls."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from drake_safety.cli.training_folder import MODES, assessment_file, episodes_folder
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import load_scenario, parse_scenario
from gliding_task import declare_outputs

SIDES = {"left": 1.0, "right": -1.0}
BOX = np.array([[0.6, -0.3, 0.2], [1.4, 1.4, 1.0]])
FAILING_Z_M = 0.9
PERIOD_S = 0.01


@dataclass(kw_only=True)
class ShuttleParameters:
    """What a shuttle scenario may say: nothing."""


class Shuttle(LeafSystem):
    """Position and velocity of the mass; the walls are at x = 1 and at y = 1 on its side."""

    def __init__(self, scenario, sign):
        super().__init__()
        self.reflect = np.array([1.0, sign, 1.0])
        self.DeclareDiscreteState(6)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD_S, 0.0, self._update)
        self.duration_s = scenario.episode_duration_s
        offsets = scenario.step_s * np.arange(scenario.assessment.horizon)
        ports = {
            "state": (6, lambda p, v, left_s: np.append(self.reflect * p, self.reflect * v)),
            "true_state": (6, lambda p, v, left_s: np.append(self.reflect * p, self.reflect * v)),
            "output": (3, lambda p, v, left_s: p),
            "desired_output": (3, lambda p, v, left_s: p),
            "desired_preview": (
                3 * len(offsets),
                lambda p, v, left_s: (
                    self.reflect * (p + np.minimum(offsets, left_s)[:, None] * v)
                ).ravel(),
            ),
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
        discrete_state.set_value(np.append(p + PERIOD_S * v, v))


class Shuttling(ClosedLoop):
    """The whole task."""

    Parameters = ShuttleParameters
    hand = None
    named_targets: ClassVar[dict] = {}

    def __init__(
        self, scenario, variation="nominal", *, assessment=None, meshcat=None, side="left"
    ):
        super().__init__(scenario, variation, assessment)
        self.side = side
        self.state_names = ["x", "y", "z", "vx", "vy", "vz"]
        self.output_names = ["x", "y", "z"]
        self.feature_names = ["to_the_front", "to_the_flank"]
        self.constraint_names = ["front", "flank"]
        self.fall_name = "flank"
        self.watched_features = {"front_margin": "to_the_front"}
        builder = DiagramBuilder()
        self.shuttle = builder.AddSystem(Shuttle(scenario, SIDES[side]))
        ports = map(self.shuttle.get_output_port, range(self.shuttle.num_output_ports()))
        self.export(builder, {port.get_name(): port for port in ports}, period_s=0.04)
        builder.BuildInto(self)

    @property
    def target_box(self):
        return np.sort(self.shuttle.reflect * BOX, axis=0)

    def reset(self, context, rng, goal=None):
        start = self.shuttle.reflect * rng.uniform(-0.1, 0.1, 3)
        drawn = self.shuttle.reflect * rng.uniform(*BOX)
        self._set(context, start, drawn if goal is None else np.asarray(goal))
        return 0

    def reset_standing(self, context, goal, rng=None):
        self._set(context, np.zeros(3), np.asarray(goal))

    def _set(self, context, start, goal):
        context.SetTime(0.0)
        velocity = (goal - start) / self.scenario.episode_duration_s
        shuttle_context = self.shuttle.GetMyMutableContextFromRoot(context)
        shuttle_context.SetDiscreteState(np.append(start, velocity))

    def goal_of(self, episode):
        position, velocity = np.split(episode.state[0], 2)
        goal = position + self.scenario.episode_duration_s * velocity
        return self.shuttle.reflect * goal


SCENARIO = """
task: shuttle_task:Shuttling
robot: none
episode_duration_s: 0.8
step_s: 0.04
variations: {nominal: {}, actual: {mass_scale: 1.1}}
assessment:
  {epochs: 6, ensemble_size: 1, hidden_sizes: [16], perplexity: 5, shortest_segment: 5}
"""


def shuttling():
    return parse_scenario(SCENARIO, name="shuttling", folder=Path())


def train_shuttle(folder):
    """Learns both modes into a folder; returns the scenario's file."""
    file = folder / "shuttling.yaml"
    file.write_text(SCENARIO)
    scenario = load_scenario(file)
    extra = {"command": "drake-safety train shuttling --out /somebodys/own"}
    episodes = run_episodes(scenario, 60, num_workers=1, path=episodes_folder(folder), extra=extra)
    for mode in MODES:
        scenario.assessment.mode = mode
        SafetyAssessment(scenario.assessment).fit(episodes).save(assessment_file(folder, mode))
    return file
