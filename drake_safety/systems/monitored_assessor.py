"""MonitoredSafetyAssessor: a fitted assessment with its monitor, as a diagram."""

import logging
import math
from collections.abc import Iterable, Iterator
from typing import Literal

from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort, System

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.systems.change_monitor import ChangeMonitor
from drake_safety.systems.safety_assessor import SafetyAssessor

OnAlarm = Literal["unknown", "report"]
"""Effect of an alarm: every belief is unknown, or only the port ``alarm`` reports it."""
_LOGGER = logging.getLogger("drake_safety")


class MonitoredSafetyAssessor(Diagram):
    """Γ in a diagram: a :class:`SafetyAssessor` and a :class:`ChangeMonitor`, connected.

    .. pydrake_system::

        name: MonitoredSafetyAssessor
        input_ports: [state: n_s, desired_preview: H n_z,
          features: n_f (read in the sharpened mode only), margins: n_c, hold: 1 (optional)]
        output_ports: [safety_probability: 1, belief: 3, cause_probability: n_c, embedding: 2,
          predicted_margins: n_c, novelty: 1, probability_without_alarm: 1, belief_without_alarm: 3,
          fall_probability: 1, learned: abstract, alarm: 1, levels: n_w, alarm_cause: abstract,
          judged_share: 1, watched_inputs: n_u]

    Args:
        period_s: Time between two evaluations [s]; the step of the training episodes by default.
        checks_margins: Whether a state outside the safe set is always unsafe.
        on_alarm: Effect of the monitor's alarm, an `OnAlarm`; None for no monitor.

    Example: ``assessor = builder.AddSystem(MonitoredSafetyAssessor(assessment))``
    """

    def __init__(
        self,
        assessment: SafetyAssessment,
        *,
        period_s: float | None = None,
        checks_margins: bool = True,
        on_alarm: str | None = "unknown",
    ):
        super().__init__()
        if on_alarm not in ("unknown", "report", None):
            raise ValueError(f"on_alarm must be 'unknown', 'report' or None; got {on_alarm!r}")
        builder = DiagramBuilder()
        period_s = assessment.info_.step_s if period_s is None else period_s
        heeds_alarm = on_alarm == "unknown"
        assessor = SafetyAssessor(
            assessment, period_s=period_s, checks_margins=checks_margins, heeds_alarm=heeds_alarm
        )
        self.assessor = builder.AddNamedSystem("safety_assessor", assessor)
        self.monitor: ChangeMonitor | None = None
        inputs = ["state", "desired_preview", "features"]
        for name in [*inputs, "margins"] if checks_margins else inputs:
            builder.ExportInput(self.assessor.GetInputPort(name), name)
        if on_alarm is not None:
            self.monitor = builder.AddNamedSystem("change_monitor", ChangeMonitor(assessment))
            for name in inputs:
                builder.ConnectInput(name, self.monitor.GetInputPort(name))
            builder.ExportInput(self.monitor.GetInputPort("hold"), "hold")
            if heeds_alarm:
                alarm = self.monitor.GetOutputPort("alarm")
                builder.Connect(alarm, self.assessor.GetInputPort("alarm"))
        for system in filter(None, (self.assessor, self.monitor)):
            for i in range(system.num_output_ports()):
                port = system.get_output_port(i)
                builder.ExportOutput(port, port.get_name())
        builder.BuildInto(self)

    def connect_recovery(self, builder: DiagramBuilder, recovery: System) -> None:
        """Connects a recovery trigger or switch, which follows Γ also during an alarm."""
        for name, port in (("safety_probability", "probability"), ("belief", "belief")):
            output = self.GetOutputPort(f"{port}_without_alarm")
            builder.Connect(output, recovery.GetInputPort(name))

    def adopt(self, context: Context, adapted: SafetyAssessment) -> None:
        """Takes over what an adapted assessment has learned; the monitor begins anew."""
        self.assessor.adopt(self.GetMutableSubsystemContext(self.assessor, context), adapted)
        if self.monitor is not None:
            own_context = self.GetMutableSubsystemContext(self.monitor, context)
            self.monitor.adopt(own_context, adapted)


def AddSafetyAssessor(
    builder: DiagramBuilder,
    assessment: SafetyAssessment,
    *,
    state: OutputPort,
    desired_preview: OutputPort,
    margins: OutputPort | None,
    features: OutputPort | None = None,
    hold: OutputPort | None = None,
    period_s: float | None = None,
    on_alarm: str | None = "unknown",
    name: str = "safety_assessor",
) -> MonitoredSafetyAssessor:
    """Adds a :class:`MonitoredSafetyAssessor`, and connects it.

    It warns of plants with sampled output ports, and of a monitor that never alarms.

    Args:
        state, desired_preview, features: Γ's inputs, (n_s,), (H n_z,) and (n_f,).
        margins: Margins of the measured state, (n_c,) [m, rad]; None: it may lie outside unnoticed.
        hold: 1 while a known disturbance acts, for which the monitor waits.
        period_s, on_alarm: As of `MonitoredSafetyAssessor`.
        name: Name of the subsystem, another one for a second Γ.

    Example: ``assessor = AddSafetyAssessor(builder, assessment, margins=None, **ports)``
    """
    if builder.HasSubsystemNamed(name):
        raise ValueError(f"AddSafetyAssessor: the builder has a '{name}'; pass another name")
    assessor = MonitoredSafetyAssessor(
        assessment, period_s=period_s, checks_margins=margins is not None, on_alarm=on_alarm
    )
    warn_of_sampled_ports("AddSafetyAssessor", builder.GetSystems())
    if on_alarm is not None and math.isinf(assessment.detector_.alarm_level):
        _LOGGER.warning("AddSafetyAssessor: %s", assessment.detector_.describe())
    builder.AddNamedSystem(name, assessor)
    ports: dict[str, OutputPort | None] = {"state": state, "desired_preview": desired_preview}
    ports |= {"features": features, "margins": margins, "hold": hold}
    for input_port, port in ports.items():
        if port is not None:
            builder.Connect(port, assessor.GetInputPort(input_port))
    return assessor


def leaf_systems(systems: Iterable[System]) -> Iterator[System]:
    """The systems, with each diagram replaced by its leaves."""
    for system in systems:
        yield from leaf_systems(system.GetSystems()) if isinstance(system, Diagram) else [system]


def warn_of_sampled_ports(who: str, systems: Iterable[System]) -> None:
    """Logs which plants show the next state to what updates at the same time."""
    for system in leaf_systems(systems):
        if isinstance(system, MultibodyPlant) and system.has_sampled_output_ports():
            text = "%s: plant '%s' shows a later state than in episodes; make it with %s"
            config = "MultibodyPlantConfig(use_sampled_output_ports=False)"
            _LOGGER.warning(text, who, system.get_name(), config)
