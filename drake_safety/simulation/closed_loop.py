"""ClosedLoop: the contract of a task's diagram."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.segments import RECORDED, EpisodesInfo
from drake_safety.systems.monitored_assessor import AddSafetyAssessor, MonitoredSafetyAssessor

REQUIRED_PORTS = (*RECORDED, "safe")
ASSESSMENT_PORTS = ("safety_probability", "belief")

Purpose = Literal["evaluation", "paper", "pairs"]
_NAMES = ("state_names", "output_names", "feature_names", "constraint_names")


class ClosedLoop(Diagram):
    """A task's diagram: plant, controller, planner, monitor, and optionally an assessor.

    A subclass sets the names of the ports' entries and connects its systems in ``__init__``, calls
    :meth:`export`, and finally ``builder.BuildInto(self)``. Optional features are protocols.

    .. pydrake_system::

        name: ClosedLoop
        output_ports: [state: n_s, true_state: n_s, output: n_z, desired_output: n_z,
          desired_preview: H n_z, features: n_f, margins: n_c, safe: 1,
          safety_probability: 1 (with an assessment), belief: 3 (with an assessment),
          alarm: 1 (with an assessment), recovery_active: 1 (with recovery),
          num_controller_failures: 1 (optional), controller_memory: n_m (optional)]

    ``Parameters`` is the dataclass of the task's part of the scenario file. It may also have
    ``online``, names of parameters on which no episode depends, and a class method
    ``completed(stated, robot)``, which adds defaults that depend on the robot.

    Example: ``margins = loop.GetOutputPort("margins")``
    """

    Parameters: type
    angular_constraints: tuple[str, ...] = ()  # Their margins are angles; others are lengths.
    fall_name: str = ""  # The constraint whose violation is a fall, which ends a motion.
    # The "states" that the change monitor predicts, and the "features" by which it does; or all.
    monitored: Mapping[str, list[str]] = {}
    state_names: list[str]
    output_names: list[str]
    feature_names: list[str]
    constraint_names: list[str]

    # `scenario` is a Scenario, whose module imports this one.
    def __init__(self, scenario: Any, variation: str, assessment: SafetyAssessment | None):
        super().__init__()
        self.scenario, self.variation, self.assessment = scenario, variation, assessment
        self._plant_variation = scenario.variation(variation)

    @classmethod
    def options_for(cls, purpose: Purpose, scenario: Any, variation: str) -> dict[str, Any]:
        """Options of the diagram that differ from training's.

        Args:
            purpose: Such as "evaluation", or "pairs", whose twins start alike.
            scenario: The scenario of the task.
            variation: Name of the plant.
        """
        del purpose, scenario, variation
        return {}

    @classmethod
    def model_files(cls, scenario: Any) -> list[Path]:
        """Files besides the scenario that determine the plant; part of the hash."""
        del scenario
        return []

    # A root Context that pydrake returns as its own part keeps itself alive for ever.

    def GetMyContextFromRoot(self, root_context: Context) -> Context:
        """Finds this diagram's Context in that of the outermost diagram."""
        is_outermost = str(self.GetSystemPathname()).count("::") == 1
        return root_context if is_outermost else super().GetMyContextFromRoot(root_context)

    def GetMyMutableContextFromRoot(self, root_context: Context) -> Context:
        """See :meth:`GetMyContextFromRoot`."""
        is_outermost = str(self.GetSystemPathname()).count("::") == 1
        return root_context if is_outermost else super().GetMyMutableContextFromRoot(root_context)

    def prepare(self, context: Context) -> None:
        """Removes from the root Context what only pictures need, before a simulation."""

    def disturbances(self, context: Context) -> dict[str, np.ndarray]:
        """Returns what will act on the robot beside its start and plan, in SI units, (n,) each."""
        del context
        return {}

    def reset(self, context: Context, rng: np.random.Generator) -> int:
        """Samples a state and a plan; returns the first step whose future is undisturbed."""
        raise TypeError(f"task '{type(self).__name__}' must override reset")

    def export(
        self,
        builder: DiagramBuilder,
        ports: Mapping[str, OutputPort],
        *,
        period_s: float,
        margins: OutputPort | None = None,
        hold: OutputPort | None = None,
    ) -> MonitoredSafetyAssessor | None:
        """Exports output ports by name; adds an assessor and its ports, if there is an assessment.

        Args:
            period_s, margins, hold: As of `AddSafetyAssessor`; the exported margins by default.
        """
        for name, port in ports.items():
            builder.ExportOutput(port, name)
        if self.assessment is None:
            return None
        self._check_assessment(self.assessment.info_)
        assessor = AddSafetyAssessor(
            builder,
            self.assessment,
            **{name: ports[name] for name in ("state", "desired_preview", "features")},
            margins=margins or ports["margins"],
            hold=hold,
            period_s=period_s,
            on_alarm=self.scenario.on_alarm,
        )
        for port in map(assessor.get_output_port, range(assessor.num_output_ports())):
            builder.ExportOutput(port, port.get_name())
        return assessor

    def _check_assessment(self, info: EpisodesInfo) -> None:
        scenario = self.scenario
        here: dict[str, Any] = {
            "horizon": scenario.assessment.horizon,
            "preview_stride": scenario.assessment.preview_stride,
            "step_s": scenario.step_s,
            **{name: list(getattr(self, name)) for name in _NAMES},
            "scenario_hash": scenario.simulation_hash(info.variation, name=info.scenario),
        }
        for name, own in here.items():
            learned = getattr(info, name)
            if (learned := list(learned) if name in _NAMES else learned) != own:
                text = f"it was learned with {learned}, the diagram has {own}"
                raise ValueError(f"assessment and diagram differ in {name}: {text}")


def port_sizes(diagram: Diagram) -> dict[str, int]:
    """Sizes of a diagram's output ports by name."""
    ports = map(diagram.get_output_port, range(diagram.num_output_ports()))
    return {port.get_name(): port.size() for port in ports}


def require_ports(diagram: Diagram, names: Iterable[str]) -> None:
    """Checks that a task's diagram, or another one, has output ports."""
    if missing := [name for name in names if not diagram.HasOutputPort(name)]:
        task, ports = type(diagram).__name__, list(port_sizes(diagram))
        raise ValueError(f"task '{task}' exports no port {missing}; it exports {ports}")


def check_ports(loop: ClosedLoop) -> None:
    """Checks that the required ports exist, and have as many entries as names."""
    task = f"task '{type(loop).__name__}'"
    require_ports(loop, REQUIRED_PORTS + (ASSESSMENT_PORTS if loop.assessment else ()))
    if missing := [name for name in _NAMES if not hasattr(loop, name)]:
        raise ValueError(f"{task} does not set {missing}, names of the ports' entries")
    ports = port_sizes(loop)
    states, outputs, features, constraints = (len(getattr(loop, name)) for name in _NAMES)
    sizes = {"state": states, "true_state": states, "output": outputs, "desired_output": outputs}
    sizes["desired_preview"] = outputs * loop.scenario.assessment.horizon
    sizes |= {"features": features, "margins": constraints, "safe": 1}
    if wrong := {name: ports[name] for name, size in sizes.items() if ports[name] != size}:
        expected = {name: sizes[name] for name in wrong}
        raise ValueError(f"{task} has ports of sizes {wrong}; by their names expected {expected}")
