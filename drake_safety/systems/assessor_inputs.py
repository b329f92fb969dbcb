"""AssessorInputs: what an assessor reads of a legged robot besides its plan."""

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_safety.control.kinematics import NUM_BASE_POSITIONS, RobotKinematics
from drake_safety.control.mirror import Mirror
from drake_safety.control.observation import (
    gravity_in_foot_plane,
    stance_state,
    state_names,
    walking_state,
    walking_state_names,
)
from drake_safety.learning.inputs import kept_features
from drake_safety.learning.segments import floats
from drake_safety.systems.safety_monitor import SafeSet, finite_margins


class AssessorInputs(LeafSystem):
    """State, features and margins of a measured plant state, in the order of their names.

    .. pydrake_system::

        name: AssessorInputs
        input_ports: [plant_state: n_q + n_v, desired_outlook: M n_z,
          desired_joint_state: 2 n_j (with ``servo_loads``),
          controller_memory: n_m (with ``memory``)]
        output_ports: [state: n_s, features: n_f, margins: n_c]

    Features of the safe set come first. On request three others follow: gravity in the plane of
    the feet, which shows the slope of the ground; with ``servo_loads``, commanded minus measured
    joint positions, (n_j,) [rad]; and the controller's memory.

    Args:
        num_outlook: M, samples of the outlook.
        gravity: Gravity in the world of ``plant_state``, (3,) [m/s²].
        memory: Names of the entries of ``controller_memory``.
        mirror: If given, state and gravity are mirrored.
        without: Patterns such as ``foot_height_*`` of features that are left out.
        is_walking: See :class:`~drake_safety.systems.state_observer.StateObserver`.
    """

    def __init__(
        self,
        kinematics: RobotKinematics,
        safe_set: SafeSet,
        *,
        num_outlook: int = 5,
        gravity: Sequence[float] | None = None,
        servo_loads: bool = False,
        memory: Sequence[str] = (),
        mirror: Mirror | None = None,
        is_walking: bool = False,
        without: Sequence[str] = (),
    ):
        super().__init__()
        self._kinematics, self._safe_set, self._mirror = kinematics, safe_set, mirror
        self._state_of = walking_state if is_walking else stance_state
        self._gravity = None if gravity is None else np.array(gravity)
        self.state_names = (walking_state_names if is_walking else state_names)(kinematics)
        self.constraint_names = list(safe_set.names)
        gravity_names = [] if gravity is None else ["gravity_x", "gravity_y"]
        self.feature_names = [*safe_set.feature_names, *gravity_names]
        self._state_port = self.DeclareVectorInputPort("plant_state", kinematics.num_states)
        self._outlook_port = self.DeclareVectorInputPort("desired_outlook", 3 * num_outlook)
        self._command_port = self._memory_port = None
        if servo_loads:
            self.feature_names += [f"servo_load_{name}" for name in kinematics.joint_names]
            size = 2 * kinematics.num_joints
            self._command_port = self.DeclareVectorInputPort("desired_joint_state", size)
        if memory:
            self.feature_names += memory
            self._memory_port = self.DeclareVectorInputPort("controller_memory", len(memory))
        self._kept = kept_features(self.feature_names, without)
        self.feature_names = [self.feature_names[i] for i in self._kept]
        ticket = {self.input_port_ticket(self._state_port.get_index())}
        n_s, n_f, n_c = map(len, (self.state_names, self.feature_names, self.constraint_names))
        self.DeclareVectorOutputPort("state", BasicVector(n_s), self._calc_state, ticket)
        self.DeclareVectorOutputPort("features", BasicVector(n_f), self._calc_features)
        self.DeclareVectorOutputPort("margins", BasicVector(n_c), self._calc_margins, ticket)

    def _measured(self, context: Context) -> tuple[np.ndarray, np.ndarray]:
        q, v = np.split(self._state_port.Eval(context), [self._kinematics.num_positions])
        return q, v

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        state = self._state_of(self._kinematics, *self._measured(context))
        output.SetFromVector(state if self._mirror is None else self._mirror.stance_state(state))

    def _calc_features(self, context: Context, output: BasicVector) -> None:
        q, v = self._measured(context)
        outlook = self._outlook_port.Eval(context).reshape(-1, 3)
        parts = [floats(self._safe_set.features(q, v, outlook))]
        if self._gravity is not None:
            gravity = gravity_in_foot_plane(self._kinematics, q, self._gravity)
            parts.append(gravity if self._mirror is None else gravity * (1.0, -1.0))
        if self._command_port is not None:
            joints = q[NUM_BASE_POSITIONS:]
            parts.append(self._command_port.Eval(context)[: len(joints)] - joints)
        if self._memory_port is not None:
            parts.append(self._memory_port.Eval(context))
        output.SetFromVector(np.concatenate(parts)[self._kept])

    def _calc_margins(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(finite_margins(self._safe_set, *self._measured(context)))
