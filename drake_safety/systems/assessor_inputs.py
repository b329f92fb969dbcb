"""AssessorInputs: what an assessor reads of a legged robot besides its plan, as a diagram."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import ConstantVectorSource, MatrixGain, Multiplexer

from drake_safety.control.kinematics import NUM_BASE_POSITIONS, RobotKinematics
from drake_safety.control.mirror import Mirror
from drake_safety.systems.gravity_features import GravityFeatures
from drake_safety.systems.plan_features import PlanFeatures
from drake_safety.systems.safety_monitor import FeaturedSafeSet, SafetyMonitor
from drake_safety.systems.state_observer import StateObserver


class AssessorInputs(Diagram):
    """State, features and margins of a measured plant state, in the order of their names.

    .. pydrake_system::

        name: AssessorInputs
        input_ports:
        - plant_state: n_q + n_v
        - desired_outlook: M n_z
        - desired_joint_state: 2 n_j (only with servo loads)
        - controller_memory: n_m (only with its names)
        output_ports:
        - state: n_s
        - features: n_f
        - margins: n_c

    The features are those of the safe set, and behind them, where they are asked for, two of
    gravity (:class:`~drake_safety.systems.gravity_features.GravityFeatures`), the loads of the
    servos and the controller's memory. The shipped assessments read: of balancing, gravity and
    loads; of reaching, gravity; of walking, the memory of the policy.

    Args:
        num_outlook: M, samples of the outlook.
        gravity: In the world of ``plant_state``, (3,) [m/s²]; None for no features of gravity.
        servo_loads: Whether features are commanded minus measured joint positions, (n_j,) [rad].
        memory: Names of the entries of ``controller_memory``.
        mirror: If given, state and gravity are those of the robot's mirror image.
        is_walking: See :class:`~drake_safety.systems.state_observer.StateObserver`.

    Attributes:
        state_names, feature_names, constraint_names: Names of the ports' entries.
    """

    def __init__(
        self,
        kinematics: RobotKinematics,
        safe_set: FeaturedSafeSet,
        *,
        num_outlook: int = 5,
        gravity: Sequence[float] | None = None,
        servo_loads: bool = False,
        memory: Sequence[str] = (),
        mirror: Mirror | None = None,
        is_walking: bool = False,
    ):
        super().__init__()
        sizes = kinematics.num_positions, kinematics.num_velocities
        builder = DiagramBuilder()
        observer = builder.AddNamedSystem(
            "observer", StateObserver(kinematics, mirror=mirror, is_walking=is_walking)
        )
        monitor = builder.AddNamedSystem("safety_monitor", SafetyMonitor(safe_set, *sizes))
        plan = builder.AddNamedSystem(
            "plan_features", PlanFeatures(safe_set, *sizes, horizon=num_outlook)
        )
        builder.ExportInput(observer.GetInputPort("plant_state"), "plant_state")
        for system in (monitor, plan):
            builder.ConnectInput("plant_state", system.GetInputPort("plant_state"))
        builder.ExportInput(plan.GetInputPort("desired_preview"), "desired_outlook")
        parts: list[tuple[OutputPort | None, list[str]]] = [
            (plan.GetOutputPort("features"), plan.feature_names)
        ]
        if gravity is not None:
            against = builder.AddNamedSystem(
                "gravity_features", GravityFeatures(kinematics, mirror=mirror)
            )
            constant = builder.AddNamedSystem("gravity", ConstantVectorSource(np.array(gravity)))
            builder.Connect(constant.get_output_port(), against.GetInputPort("gravity"))
            builder.ConnectInput("plant_state", against.GetInputPort("plant_state"))
            parts.append((against.GetOutputPort("features"), against.feature_names))
        if servo_loads:
            names = kinematics.joint_names
            parts.append((_add_loads(builder, kinematics), [f"servo_load_{n}" for n in names]))
        if memory:
            parts.append((None, list(memory)))
        joined = builder.AddNamedSystem("features", Multiplexer([len(names) for _, names in parts]))
        for i, (port, _) in enumerate(parts):
            if port is None:
                builder.ExportInput(joined.get_input_port(i), "controller_memory")
            else:
                builder.Connect(port, joined.get_input_port(i))
        builder.ExportOutput(observer.GetOutputPort("state"), "state")
        builder.ExportOutput(joined.get_output_port(0), "features")
        builder.ExportOutput(monitor.GetOutputPort("margins"), "margins")
        self.state_names = observer.state_names
        self.feature_names = [name for _, names in parts for name in names]
        self.constraint_names = monitor.constraint_names
        builder.BuildInto(self)


def _add_loads(builder: DiagramBuilder, kinematics: RobotKinematics) -> OutputPort:
    """Adds commanded minus measured joint positions, to which loads are proportional."""
    n_j, n_x = kinematics.num_joints, kinematics.num_positions + kinematics.num_velocities
    gain = np.zeros((n_j, 2 * n_j + n_x))
    gain[:, :n_j] = np.eye(n_j)
    gain[:, 2 * n_j + NUM_BASE_POSITIONS :][:, :n_j] = -np.eye(n_j)
    both = builder.AddNamedSystem("command_and_state", Multiplexer([2 * n_j, n_x]))
    loads = builder.AddNamedSystem("servo_loads", MatrixGain(gain))
    builder.ExportInput(both.get_input_port(0), "desired_joint_state")
    builder.ConnectInput("plant_state", both.get_input_port(1))
    builder.Connect(both.get_output_port(0), loads.get_input_port())
    return loads.get_output_port()
