"""A task of one's own, outside the package: a mass that glides, with failures to order."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.systems.framework import BasicVector, DiagramBuilder, LeafSystem

from drake_safety.learning.segments import DivergenceError
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.scenario import parse_scenario

CONTROL_PERIOD_S = 0.01


@dataclass(kw_only=True)
class GlidingParameters:
    """What a gliding scenario may say."""

    speed_m_s: float = 2.0
    """Largest speed at the start."""
    failure: str = ""
    """How it fails beyond x = 0.5: "raise", "nan", "inf", "1e13", "bug" or not at all."""
    fails_at_start: bool = False
    """Whether it fails before the first row already."""

    def __post_init__(self) -> None:
        if self.failure not in ("", "raise", "nan", "inf", "1e13", "bug"):
            raise ValueError(f"gliding: unknown failure '{self.failure}'")


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


class Mass(LeafSystem):
    """x, v of a mass without forces."""

    def __init__(self, parameters, horizon):
        super().__init__()
        self.parameters = parameters
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
            "margins": (2, lambda x, v: [1.0 - x, x + 1.0]),
            "safe": (1, lambda x, v: [float(min(1.0 - x, x + 1.0) >= 0)]),
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


class Gliding(ClosedLoop):
    """The whole task."""

    Parameters = GlidingParameters

    def __init__(self, scenario, variation="nominal", *, assessment=None, meshcat=None):
        super().__init__(scenario, variation, assessment)
        self.state_names = ["x", "v"]
        self.output_names = ["x", "y", "z"]
        self.feature_names = ["distance"]
        self.constraint_names = ["right", "left"]
        builder = DiagramBuilder()
        self.mass = builder.AddSystem(Mass(scenario.parameters, scenario.assessment.horizon))
        ports = map(self.mass.get_output_port, range(self.mass.num_output_ports()))
        self.export(builder, {port.get_name(): port for port in ports}, period_s=0.04)
        builder.BuildInto(self)

    def reset(self, context, rng):
        x, v = rng.uniform(-0.3, 0.3), rng.uniform(-1, 1) * self.scenario.parameters.speed_m_s
        mass_context = self.mass.GetMyMutableContextFromRoot(context)
        mass_context.SetDiscreteState([x, v])
        return int(rng.integers(2))


class Drifting(Gliding):
    """One that can glide for as long as one likes."""

    def reset_undisturbed(self, context, rng, duration_s):
        self.mass.GetMyMutableContextFromRoot(context).SetDiscreteState(
            [rng.uniform(-0.3, 0.3), rng.uniform(-0.6, 0.6) / duration_s]
        )


SCENARIO = """
task: gliding_task:Gliding
robot: none
episode_duration_s: 0.8
step_s: 0.04
variations: {nominal: {}, actual: {mass_scale: 1.2}}
"""


def gliding(task="Gliding", **parameters):
    text = SCENARIO.replace("Gliding", task) + f"parameters: {parameters}\n"
    return parse_scenario(text, name="gliding", folder=Path())
