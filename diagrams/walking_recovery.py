"""Recovery of a walking robot: the trigger, and the branches that a scenario can name."""

from pathlib import Path

import numpy as np
from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import MatrixGain, PortSwitch

from drake_safety.control.kinematics import NUM_BASE_POSITIONS, RobotKinematics
from drake_safety.control.policy import Policy
from drake_safety.control.policy_files import load_policy
from drake_safety.diagrams.walking_parameters import WalkingRecovery
from drake_safety.robots.robot_model import by_pattern
from drake_safety.systems.crouch_controller import CrouchController
from drake_safety.systems.policy_controller import PolicyController
from drake_safety.systems.recovery_trigger import RecoveryTrigger


class RecoveryBranches:
    """Adds a trigger to a diagram, and switches to the branch that the scenario names.

    Args:
        builder: The diagram's builder.
        recovery: The scenario's recovery.
        initial_uncertainty: μ_ini of the assessment.
        period_s: Update period [s].
        offset_s: Time of the trigger's first update; the branches' is twice that [s].

    Attributes:
        trigger: The trigger, whose inputs are the caller's to connect.
    """

    def __init__(
        self,
        builder: DiagramBuilder,
        recovery: WalkingRecovery,
        *,
        initial_uncertainty: float,
        period_s: float,
        offset_s: float,
    ):
        self._builder, self._recovery = builder, recovery
        self._period_s, self._offset_s = period_s, 2 * offset_s
        self.trigger: RecoveryTrigger = builder.AddNamedSystem(
            "recovery_trigger",
            RecoveryTrigger(
                threshold=recovery.threshold,
                persistence_s=recovery.persistence_s,
                initial_uncertainty=initial_uncertainty,
                period_s=period_s,
                offset_s=offset_s,
            ),
        )
        builder.ExportOutput(self.trigger.GetOutputPort("recovery_active"), "recovery_active")

    def command(self, nominal: OutputPort) -> OutputPort:
        """The command, or that of the branches "stop" and "slower" during recovery."""
        recovery, builder = self._recovery, self._builder
        if recovery.branch not in ("stop", "slower"):
            return nominal
        share = recovery.slower_share if recovery.branch == "slower" else 0.0
        slower = builder.AddNamedSystem("slower_command", MatrixGain(share * np.eye(3)))
        builder.Connect(nominal, slower.get_input_port())
        return self._switched("command_switch", nominal, slower.get_output_port())

    def joints(
        self,
        kinematics: RobotKinematics,
        policy: Policy,
        file: Path,
        *,
        nominal: OutputPort,
        measured: OutputPort,
        command: OutputPort,
    ) -> OutputPort:
        """The joints' set points, or those of "crouch" and "policy" during recovery.

        Args:
            kinematics: The robot.
            policy: The policy that walks.
            file: File of the other policy.
            nominal: Set points of the policy that walks.
            measured: The measured plant state.
            command: The command that the other policy follows.

        Raises:
            ValueError: The other policy has other gains.
        """
        recovery, builder = self._recovery, self._builder
        if recovery.branch == "crouch":
            other = builder.AddNamedSystem(
                "crouch_controller",
                CrouchController(
                    kinematics,
                    _posture(recovery, kinematics),
                    step_rad=recovery.crouch_step_rad,
                    period_s=self._period_s,
                    offset_s=self._offset_s,
                ),
            )
        elif recovery.branch == "policy":
            second = load_policy(file, kinematics)
            if second.gains != policy.gains:
                raise ValueError(
                    f"recovery: policy '{recovery.policy}' has other joint gains than the policy "
                    "that walks, and the servos have one set"
                )
            other = builder.AddNamedSystem(
                "recovery_policy_controller",
                PolicyController(kinematics, second, offset_s=self._offset_s),
            )
            builder.Connect(command, other.GetInputPort("command"))
        else:
            return nominal
        builder.Connect(measured, other.GetInputPort("plant_state"))
        return self._switched("joint_switch", nominal, other.GetOutputPort("desired_joint_state"))

    def _switched(self, name: str, nominal: OutputPort, recovering: OutputPort) -> OutputPort:
        switch = self._builder.AddNamedSystem(name, PortSwitch(nominal.size()))
        self._builder.Connect(
            self.trigger.GetOutputPort("port_selector"), switch.get_port_selector_input_port()
        )
        self._builder.Connect(nominal, switch.DeclareInputPort("nominal"))
        self._builder.Connect(recovering, switch.DeclareInputPort("recovery"))
        return switch.GetOutputPort("value")


def _posture(recovery: WalkingRecovery, kinematics: RobotKinematics) -> np.ndarray:
    standing = kinematics.standing_positions()[NUM_BASE_POSITIONS:]
    names = kinematics.joint_names
    stated = [by_pattern(recovery.crouch, name, "crouch", kinematics.robot.name) for name in names]
    pairs = zip(stated, standing.tolist(), strict=True)
    return np.array([rest if value is None else value for value, rest in pairs])
