"""InverseKinematicsController: joint position commands from a desired base position."""

import math

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_safety.control.inverse_kinematics import solve_from
from drake_safety.control.kinematics import NUM_BASE_POSITIONS, RobotKinematics, fit_stance
from drake_safety.systems.periodic_update import declare_update

_RATE_SHARE = 0.7  # Share of a joint's speed limit; the rest is for the servo's overshoot.
_LIFTED_M = 0.005  # Height of a foot's set point above which the foot carries no weight.


class InverseKinematicsController(LeafSystem):
    """Joint positions of a level base over given feet, with a gravity offset.

    .. pydrake_system::

        name: InverseKinematicsController
        input_ports: [plant_state: n_q + n_v, desired_output: n_z,
          desired_foot_positions: 3 n_p (optional), desired_yaw: 1 (optional)]
        output_ports: [desired_joint_state: 2 n_j]

    The command, set points and their rates, is a discrete state for the plant's implicit joint
    servos. A static offset τ/k_p removes the sag of the servos; τ is from the weight, distributed
    over the feet on the ground. Set points respect the joint limits and 0.7 of the speed limits.

    Without ``desired_foot_positions`` the feet stay as in a simulation's first state, put on level
    ground. Without ``desired_yaw`` the planar fit of the feet gives the base's yaw.

    Args:
        stiffness: k_p of the servos, (n_j,) [N·m/rad]; by default the robot's.
        offset_s: Time of the first update, after the inputs' updates [s].
    """

    def __init__(
        self,
        kinematics: RobotKinematics,
        stiffness: np.ndarray | None = None,
        *,
        period_s: float,
        offset_s: float = 0.0,
    ):
        super().__init__()
        n_j, names = kinematics.num_joints, kinematics.joint_names
        if stiffness is None:
            gains = map(kinematics.robot.gains_of, names)
            stiffness = np.array([0.0 if gain is None else gain.stiffness for gain in gains])
        if not np.all(stiffness > 0):
            raise ValueError(f"inverse kinematics: stiffness of {names} must be positive")
        self._kinematics, self._stiffness, self._period_s = kinematics, stiffness, period_s
        self._rate_limit = _RATE_SHARE * kinematics.velocity_limits
        n_p = 3 * kinematics.num_contacts
        self._state_port = self.DeclareVectorInputPort("plant_state", kinematics.num_states)
        self._desired_port = self.DeclareVectorInputPort("desired_output", 3)
        self._feet_port = self.DeclareVectorInputPort("desired_foot_positions", n_p)
        self._yaw_port = self.DeclareVectorInputPort("desired_yaw", 1)
        self._feet = self.DeclareDiscreteState(np.full(n_p, np.nan))
        self._set_point = self.DeclareDiscreteState(n_j)  # Joint positions without the offset.
        self._command = self.DeclareDiscreteState(2 * n_j)  # Positions with it, and rates.
        declare_update(self, self._update, self._initialize, period_s, offset_s)
        self.DeclareStateOutputPort("desired_joint_state", self._command)

    def set_foot_positions(self, context: Context, p_WC: np.ndarray) -> None:
        """Sets the feet, (n_c, 3) [m], in place of the first state's feet."""
        context.SetDiscreteState(self._feet, np.ravel(p_WC))

    def foot_positions(self, context: Context) -> np.ndarray:
        """The present set points of the feet: centres of the contact spheres, (n_c, 3) [m]."""
        if self._feet_port.HasValue(context):
            return self._feet_port.Eval(context).reshape(-1, 3)
        return context.get_discrete_state(self._feet).value().reshape(-1, 3)

    def start(self, context: Context) -> None:
        """Sets the command for the present inputs, as the start of a simulation does."""
        self._initialize(context, context.get_mutable_discrete_state())

    def update(self, context: Context) -> None:
        """Updates the command for the present inputs, as a simulation does every period."""
        self._update(context, context.get_mutable_discrete_state())

    def _solve(
        self, context: Context, p_WC: np.ndarray, guess: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns joint positions and the torques of the weight, (n_j,) each."""
        kinematics = self._kinematics
        if self._yaw_port.HasValue(context):
            yaw = self._yaw_port.Eval(context)[0]
        else:
            yaw = fit_stance(p_WC, kinematics.nominal_contacts)[2]
        q = np.zeros(kinematics.num_positions)
        q[0], q[3] = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
        q[4:NUM_BASE_POSITIONS] = self._desired_port.Eval(context)
        q[NUM_BASE_POSITIONS:] = guess
        joints, J = solve_from(kinematics, q, p_WC)
        q[NUM_BASE_POSITIONS:] = joints
        is_stance = p_WC[:, 2] - kinematics.foot_radii <= _LIFTED_M
        return joints, kinematics.gravity_torques(q, is_stance, J)

    def _initialize(self, context: Context, discrete_state: DiscreteValues) -> None:
        q = self._state_port.Eval(context)[: self._kinematics.num_positions]
        p_WC = self.foot_positions(context)
        if math.isnan(p_WC[0, 0]):
            p_WC = self._kinematics.planted_contacts(q)
            discrete_state.set_value(self._feet, p_WC.ravel())
        joints, torques = self._solve(context, p_WC, q[NUM_BASE_POSITIONS:])
        self._command_joints(discrete_state, joints, torques, np.zeros_like(joints))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        previous = context.get_discrete_state(self._set_point).get_value()
        last_rate = context.get_discrete_state(self._command).get_value()[len(previous) :]
        # Extrapolation of smooth set points: most updates then need no Newton step.
        guess = previous + self._period_s * last_rate
        desired, torques = self._solve(context, self.foot_positions(context), guess)
        rate = (desired - previous) / self._period_s
        rate = np.minimum(np.maximum(rate, -self._rate_limit), self._rate_limit)
        self._command_joints(discrete_state, previous + self._period_s * rate, torques, rate)

    def _command_joints(
        self, state: DiscreteValues, joints: np.ndarray, torques: np.ndarray, rate: np.ndarray
    ) -> None:
        lowest, highest = self._kinematics.position_limits.T
        positions = np.minimum(np.maximum(joints + torques / self._stiffness, lowest), highest)
        state.set_value(self._set_point, joints)
        state.set_value(self._command, np.concatenate([positions, rate]))
