"""WholeBodyController: joint torques from set points of the hand and the body."""

import copy
from dataclasses import replace

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.whole_body_model import PointReference, WholeBodyModel, WholeBodyReference
from drake_safety.control.whole_body_qp import SOLVED, NotFiniteError, build_qp, solve_qp
from drake_safety.systems.periodic_update import declare_update

NOT_FINITE = 1
"""Solver status of an update with a non-finite state or set point."""


class WholeBodyController(LeafSystem):
    """Torques that track weighted tasks with the feet at rest, from one QP per update.

    .. pydrake_system::

        name: WholeBodyController
        input_ports: [plant_state: n_q + n_v, desired_output: n_z,
          desired_output_rate: n_z]
        output_ports: [actuation: n_j, solver_status: 1, num_failures: 1]

    ``desired_output`` is the set point of the hand in the world [m]; :meth:`set_reference` sets the
    other references. ``solver_status`` is 0 if the last program was solved, negative if it
    was not (daqp's exit flag), and ``NOT_FINITE`` if its inputs were not finite. The last command
    is then held, initially zero torque. ``num_failures`` counts these updates.

    Args:
        hand: Name of the reaching frame that follows ``desired_output``.
        actuation_matrix: See :func:`~drake_safety.robots.robot.actuation_matrix`, (n_u, n_j); the
            identity by default.
        offset_s: Time of the first update, after the inputs' updates [s].
    """

    def __init__(
        self,
        kinematics: RobotKinematics,
        *,
        hand: str,
        actuation_matrix: np.ndarray | None = None,
        period_s: float,
        offset_s: float = 0.0,
    ):
        super().__init__()
        self.model = WholeBodyModel(kinematics, hand)
        identity = np.eye(kinematics.num_joints)
        self._matrix = identity if actuation_matrix is None else np.array(actuation_matrix, float)
        self._n_q = kinematics.num_positions
        self._state_port = self.DeclareVectorInputPort("plant_state", kinematics.num_states)
        self._desired_port = self.DeclareVectorInputPort("desired_output", 3)
        self._rate_port = self.DeclareVectorInputPort("desired_output_rate", 3)
        standing = self.model.reference(kinematics.standing_positions())
        self._reference_index = self.DeclareAbstractParameter(Value(standing))
        self._actuation = self.DeclareDiscreteState(len(self._matrix))  # Torques of the actuators.
        self._status = self.DeclareDiscreteState(1)
        self._num_failures = self.DeclareDiscreteState(1)
        declare_update(self, self._update, self._initialize, period_s, offset_s)
        self.DeclareStateOutputPort("actuation", self._actuation)
        self.DeclareStateOutputPort("solver_status", self._status)
        self.DeclareStateOutputPort("num_failures", self._num_failures)

    def set_reference(self, context: Context, reference: WholeBodyReference) -> None:
        """Sets stance, centre of mass, orientations and posture, such as ``model.reference(q)``."""
        self.model.check_reference(reference)
        parameter = context.get_mutable_abstract_parameter(self._reference_index)
        parameter.set_value(copy.deepcopy(reference))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        q, v = np.split(self._state_port.Eval(context), [self._n_q])
        position, rate = self._desired_port.Eval(context), self._rate_port.Eval(context)
        hand = PointReference(position=position, rate=rate)
        reference = context.get_abstract_parameter(self._reference_index).get_value()
        try:
            qp = build_qp(self.model, q, v, replace(reference, reaching=hand))
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
        self._update(context, discrete_state)
