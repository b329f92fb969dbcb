"""StateObserver: the measured plant state, and the assessor's state derived from it."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_safety.control.kinematics import RobotKinematics, is_state
from drake_safety.control.mirror import Mirror
from drake_safety.control.observation import (
    add_noise,
    heading_velocity,
    stance_state,
    state_names,
    walking_state,
    walking_state_names,
)
from drake_safety.robots.robot import ObservationNoise


class StateObserver(LeafSystem):
    """Measures a robot: plant state plus noise, the stance-frame state s_k, the output z_k.

    .. pydrake_system::

        name: StateObserver
        input_ports: [plant_state: n_q + n_v, noise: 2 n_v (optional)]
        output_ports: [measured_plant_state: n_q + n_v, state: n_s, output: n_z]

    State and output of a measurement that is not finite, or without an orientation, are NaN; the
    base's position is as measured.

    Args:
        noise: Standard deviations that scale the standard normal ``noise`` input.
        hand: Name of the reaching frame whose position is the output z_k; the base by default.
        mirror: If given, the state s_k is that of the robot's mirror image.
        is_walking: Whether s_k is :func:`~drake_safety.control.observation.walking_state`, and z_k
            the velocity (v_x, v_y, ω_z) in the heading frame [m/s, rad/s].
    """

    def __init__(
        self,
        kinematics: RobotKinematics,
        noise: ObservationNoise | None = None,
        *,
        hand: str | None = None,
        mirror: Mirror | None = None,
        is_walking: bool = False,
    ):
        super().__init__()
        self._mirror, self._is_walking = mirror, is_walking
        self._hand = None if hand is None else kinematics.robot.reaching_frame(hand)
        self._kinematics = kinematics
        self._noise = noise or ObservationNoise()
        n_x, self._n_q = kinematics.num_states, kinematics.num_positions
        self.state_names = (walking_state_names if is_walking else state_names)(kinematics)
        self.output_names = [f"{'base' if hand is None else 'hand'}_{axis}" for axis in "xyz"]
        if is_walking:
            self.output_names = ["forward_velocity", "left_velocity", "yaw_rate"]
        self._state_port = self.DeclareVectorInputPort("plant_state", n_x)
        self._noise_port = self.DeclareVectorInputPort("noise", 2 * kinematics.num_velocities)
        self._measured_port = self.DeclareVectorOutputPort(
            "measured_plant_state", n_x, self._calc_measured
        )
        self.DeclareVectorOutputPort("state", len(self.state_names), self._calc_state)
        self.DeclareVectorOutputPort("output", 3, self._calc_output)

    def _calc_measured(self, context: Context, output: BasicVector) -> None:
        state, noise = self._state_port.Eval(context), self._noise
        q, v = np.split(state, [self._n_q])
        is_noisy = (noise.position or noise.velocity) and self._noise_port.HasValue(context)
        if is_noisy and is_state(q, v):
            state = np.concatenate(add_noise(q, v, self._noise_port.Eval(context), noise))
        output.SetFromVector(state)

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        q, v = np.split(self._measured_port.Eval(context), [self._n_q])
        state = (walking_state if self._is_walking else stance_state)(self._kinematics, q, v)
        output.SetFromVector(state if self._mirror is None else self._mirror.stance_state(state))

    def _calc_output(self, context: Context, output: BasicVector) -> None:
        q, v = np.split(self._measured_port.Eval(context), [self._n_q])
        if self._is_walking:
            output.SetFromVector(heading_velocity(q, v))
        elif self._hand is None:
            output.SetFromVector(q[4:7])
        elif is_state(q, v):
            output.SetFromVector(self._kinematics.reaching_position(q, self._hand))
        else:
            output.SetFromVector(np.full(3, np.nan))
