"""CrouchController: joint set points that lower a robot with damping."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_safety.control.kinematics import NUM_BASE_POSITIONS, RobotKinematics


class CrouchController(LeafSystem):
    """Moves the joints' set points towards a posture, never far from the measured joints.

    .. pydrake_system::

        name: CrouchController
        input_ports:
        - plant_state
        output_ports:
        - desired_joint_state

    With position servos the torque is then at most stiffness times ``step_rad`` beside the damping,
    so the robot yields to the ground.

    Args:
        kinematics: The robot.
        posture: Joint positions, (n_j,) [rad].
        step_rad: Largest distance of a set point from the measured joint [rad].
        period_s: Update period [s].
        offset_s: Time of the first update [s].
    """

    def __init__(
        self,
        kinematics: RobotKinematics,
        posture: np.ndarray,
        *,
        step_rad: float,
        period_s: float,
        offset_s: float = 0.0,
    ):
        super().__init__()
        self._posture, self._step_rad = posture, step_rad
        self._joints = slice(NUM_BASE_POSITIONS, kinematics.num_positions)
        self._state_port = self.DeclareVectorInputPort(
            "plant_state", kinematics.num_positions + kinematics.num_velocities
        )
        state = self.DeclareDiscreteState(np.concatenate([posture, np.zeros(len(posture))]))
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, offset_s, self._update)
        self.DeclareStateOutputPort("desired_joint_state", state)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        joints = self._state_port.Eval(context)[self._joints]
        if np.isfinite(joints).all():
            step = np.clip(self._posture - joints, -self._step_rad, self._step_rad)
            discrete_state.set_value(np.concatenate([joints + step, np.zeros(len(joints))]))
