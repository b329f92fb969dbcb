"""WholeBodyController: set points of the hand and the body become joint torques."""

from __future__ import annotations

import copy

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.whole_body_model import (
    PointReference,
    WholeBodyModel,
    WholeBodyReference,
)
from drake_safety.control.whole_body_qp import SOLVED, NotFiniteError, build_qp, solve_qp
from drake_safety.systems.float_system import FloatSystem

NOT_FINITE = 1
"""Solver status of a tick whose state or set point no controller could use."""


class WholeBodyController(FloatSystem, LeafSystem):
    """Torques that follow weighted tasks while the feet stand still, by one QP a tick.

    .. pydrake_system::

        name: WholeBodyController
        input_ports:
        - plant_state
        - desired_output (optional)
        - desired_output_rate (optional)
        output_ports:
        - actuation
        - solver_status

    ``desired_output`` is where the hand goes, or the centre of mass for a controller without a
    hand, in the world [m], and ``desired_output_rate`` its rate [m/s]; while they are not
    connected, the point is the one of :meth:`set_reference`, at rest. The command is a discrete
    state, so the outputs have no direct feedthrough. ``solver_status`` is 0 after a tick whose
    program was solved, negative when it was not (daqp's exit flag: -1 infeasible) and
    ``NOT_FINITE`` when there was none to solve; the last good command then stays, zero torque
    if there was none since the initialisation.

    Args:
        kinematics: The robot as the controller believes it to be.
        hand: Name of the reaching frame that follows ``desired_output``; None when none does.
        actuation_matrix: Maps joint torques (n_j,) onto the plant's actuators, (n_u, n_j), see
            :func:`~drake_safety.robots.robot.actuation_matrix`; the joints' own order by
            default.
        period_s: Control period [s].
        offset_s: Time of the first tick; commands of what drives it are then fresh [s].

    Raises:
        ValueError: The robot has no such hand, or the matrix is of another size.
    """

    def __init__(
        self,
        kinematics: RobotKinematics,
        *,
        hand: str | None = None,
        actuation_matrix: np.ndarray | None = None,
        period_s: float,
        offset_s: float = 0.0,
    ):
        super().__init__()
        n_j = kinematics.num_joints
        matrix = np.eye(n_j) if actuation_matrix is None else np.array(actuation_matrix, float)
        if matrix.ndim != 2 or matrix.shape[1] != n_j:
            raise ValueError(
                f"whole-body controller: actuation_matrix must have {n_j} columns, in the order "
                f"of {kinematics.joint_names}; got shape {matrix.shape}"
            )
        self.model = WholeBodyModel(kinematics, hand)
        self._kinematics = kinematics
        self._matrix = matrix
        self._n_q = kinematics.num_positions
        # Looked up by name in every tick, ports would cost more than what they carry.
        self._state_port = self.DeclareVectorInputPort(
            "plant_state", kinematics.num_positions + kinematics.num_velocities
        )
        self._desired_port = self.DeclareVectorInputPort("desired_output", 3)
        self._rate_port = self.DeclareVectorInputPort("desired_output_rate", 3)
        standing = self.model.reference(kinematics.standing_positions())
        self._reference_index = self.DeclareAbstractParameter(Value(standing))
        self._actuation = self.DeclareDiscreteState(len(matrix))  # Torques of the actuators.
        self._status = self.DeclareDiscreteState(1)
        self._num_failures = self.DeclareDiscreteState(1)  # Since the initialisation.
        self.DeclareInitializationDiscreteUpdateEvent(self._initialize)
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, offset_s, self._tick)
        self.DeclareStateOutputPort("actuation", self._actuation)
        self.DeclareStateOutputPort("solver_status", self._status)

    def set_reference(self, context: Context, reference: WholeBodyReference) -> None:
        """Sets where the robot stands and how: stance, centre of mass, orientations, posture.

        Args:
            context: This system's Context, which keeps a copy.
            reference: For instance ``model.reference(q)`` of the positions an episode starts in.

        Raises:
            ValueError: A part of the reference does not fit the robot.
        """
        self.model.check_reference(reference)
        parameter = context.get_mutable_abstract_parameter(self._reference_index)
        parameter.set_value(copy.deepcopy(reference))

    def num_failures(self, context: Context) -> int:
        """Ticks since the initialisation whose ``solver_status`` was not 0."""
        return int(context.get_discrete_state(self._num_failures).GetAtIndex(0))

    def _reference(self, context: Context) -> WholeBodyReference:
        reference = context.get_abstract_parameter(self._reference_index).get_value()
        if not self._desired_port.HasValue(context):
            return reference
        point = PointReference(position=self._desired_port.Eval(context))
        if self._rate_port.HasValue(context):
            point.rate = self._rate_port.Eval(context)
        reference = copy.copy(reference)
        if self.model.hand is None:
            reference.center_of_mass = point
        else:
            reference.reaching = point
        return reference

    def _tick(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = self._state_port.Eval(context)
        try:
            qp = build_qp(
                self.model, state[: self._n_q], state[self._n_q :], self._reference(context)
            )
        except NotFiniteError:
            status = NOT_FINITE
        else:
            solution = solve_qp(qp)
            status = solution.status
            if status == SOLVED:
                discrete_state.set_value(self._actuation, self._matrix @ solution.torques)
        discrete_state.set_value(self._status, [status])
        if status != SOLVED:
            num_failures = discrete_state.get_value(self._num_failures)
            discrete_state.set_value(self._num_failures, num_failures + 1)

    def _initialize(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._actuation, np.zeros(len(self._matrix)))
        discrete_state.set_value(self._num_failures, [0])
        self._tick(context, discrete_state)
