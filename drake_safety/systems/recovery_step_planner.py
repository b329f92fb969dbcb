"""RecoveryStepPlanner: capture steps, replanned at every update."""

from __future__ import annotations

import math

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem, State

from drake_safety.control.kinematics import RobotKinematics, fit_stance, is_state, yaw_of
from drake_safety.control.observation import quaternion_of
from drake_safety.control.recovery_step import (
    RecoveryStepParameters,
    capture_point,
    come_to_rest,
    first_group,
    foothold,
    gait_groups,
    minimum_jerk,
    swing_position,
)
from drake_safety.control.safe_sets import convex_hull, signed_distance_to_polygon
from drake_safety.systems.periodic_update import declare_update

_IDLE, _STEPPING, _RETURNING, _DONE = 0.0, 1.0, 2.0, 3.0


class RecoveryStepPlanner(LeafSystem):
    """Steps with alternating groups of feet, then returns the base to the nominal set point.

    .. pydrake_system::

        name: RecoveryStepPlanner
        input_ports:
        - plant_state: n_q + n_v
        - recovery_active: 1
        - nominal_desired_output: n_z
        output_ports:
        - desired_output: n_z
        - desired_foot_positions: 3 n_p
        - desired_yaw: 1
        - desired_preview: H n_z
        - desired_outlook: M n_z
        - stance_pose: 3
        - recovery_done: 1

    While idle, the feet keep the positions of the first state that the planner sees when a
    simulation is initialised, put on level ground, or those of :meth:`set_stance`. When
    ``recovery_active`` rises, the group of feet whose partners' line is nearest to the capture
    point swings to Raibert footholds, which follow the base at every update; the base set point
    follows the measured base at the standing height, so that the stance legs carry the weight
    without pulling the base back. The heading of the initial stance is held: the stance legs twist
    the base towards it and damp its yaw rate, and the footholds follow the base. With a
    ``max_twist_rad`` of 0 the base follows the yaw of its feet instead. Groups alternate until the
    capture point is well inside the support polygon and the heading error is small. The base then
    comes to rest like an inverted pendulum over its capture point, and moves to the nominal
    planner's set point in the stance frame of the new footholds; if the capture point comes near
    the polygon's edge meanwhile, the robot steps again. After that ``recovery_done`` is 1 until
    ``recovery_active`` has fallen.

    Preview and outlook are the base set point, held constant, in the stance frame of the present
    set points. No output has direct feedthrough.

    Args:
        horizon: H, samples of the preview.
        num_outlook: M, samples of the outlook.
    """

    def __init__(
        self,
        kinematics: RobotKinematics,
        parameters: RecoveryStepParameters,
        *,
        period_s: float,
        offset_s: float = 0.0,
        horizon: int,
        num_outlook: int,
    ):
        super().__init__()
        self._kinematics = kinematics
        self._parameters = parameters
        self._nominal_feet = np.array(
            [kinematics.nominal_contacts[rows].mean(axis=0) for rows in kinematics.foot_slices]
        )
        self._groups = gait_groups(self._nominal_feet)
        n_p = 3 * kinematics.num_contacts
        self._state_port = self.DeclareVectorInputPort("plant_state", kinematics.num_states)
        self._active_port = self.DeclareVectorInputPort("recovery_active", 1)
        self._nominal_port = self.DeclareVectorInputPort("nominal_desired_output", 3)
        # One discrete state group per quantity.
        self._mode = self.DeclareDiscreteState(1)
        self._swinging_group = self.DeclareDiscreteState(1)
        self._num_steps = self.DeclareDiscreteState(1)
        self._start_s = self.DeclareDiscreteState(1)  # Of the swing, or of the return.
        self._heading = self.DeclareDiscreteState(1)  # Desired.
        self._return_start = self.DeclareDiscreteState(6)  # Position and velocity of the base.
        unset = np.full(n_p, np.nan)
        self._planted = self.DeclareDiscreteState(unset)  # Last contact positions.
        self._set_point = self.DeclareDiscreteState(3)
        self._feet = self.DeclareDiscreteState(unset)  # Set points for the controller.
        self._yaw = self.DeclareDiscreteState(1)
        self._stance = self.DeclareDiscreteState(3)  # x, y, yaw
        # Before the discrete updates, such as that of a controller of these feet.
        self.DeclareInitializationUnrestrictedUpdateEvent(self._initialize)
        declare_update(self, self._update, None, period_s, offset_s)
        self.DeclareStateOutputPort("desired_output", self._set_point)
        self.DeclareStateOutputPort("desired_foot_positions", self._feet)
        self.DeclareStateOutputPort("desired_yaw", self._yaw)
        ticket = {self.all_state_ticket()}
        for name, num_samples in (("desired_preview", horizon), ("desired_outlook", num_outlook)):
            self.DeclareVectorOutputPort(
                name,
                BasicVector(3 * num_samples),
                lambda context, output, n=num_samples: output.SetFromVector(
                    np.tile(self._set_point_in_stance(context), n)
                ),
                ticket,
            )
        self.DeclareStateOutputPort("stance_pose", self._stance)
        self.DeclareVectorOutputPort("recovery_done", BasicVector(1), self._calc_done, ticket)

    def set_stance(self, context: Context, p_WC: np.ndarray, stance_pose: np.ndarray) -> None:
        """Sets the foot positions, and the planner to idle.

        Args:
            p_WC: Centres of the contact spheres, (n_c, 3) [m].
            stance_pose: [x, y, yaw] of the stance frame (3,) [m, rad].
        """
        self._set_stance(context.get_mutable_discrete_state(), p_WC, stance_pose)

    def _set_stance(
        self, discrete_state: DiscreteValues, p_WC: np.ndarray, stance_pose: np.ndarray
    ) -> None:
        discrete_state.set_value(self._mode, [_IDLE])
        discrete_state.set_value(self._stance, stance_pose)
        discrete_state.set_value(self._yaw, stance_pose[2:])
        discrete_state.set_value(self._feet, np.ravel(p_WC))
        discrete_state.set_value(self._planted, np.ravel(p_WC))

    def _initialize(self, context: Context, state: State) -> None:
        discrete_state = state.get_mutable_discrete_state()
        if not np.isnan(discrete_state.get_value(self._planted)).any():
            return
        q = self._state_port.Eval(context)[: self._kinematics.num_positions]
        p_WC = self._kinematics.planted_contacts(q)
        stance = fit_stance(p_WC, self._kinematics.nominal_contacts)
        self._set_stance(discrete_state, p_WC, stance)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        mode = discrete_state.get_value(self._mode)[0]
        is_active = self._active_port.Eval(context)[0] > 0
        if mode in (_IDLE, _DONE) and (mode == _DONE or not is_active):
            discrete_state.set_value(self._mode, [_DONE if is_active else _IDLE])
            discrete_state.set_value(self._set_point, self._nominal_port.Eval(context))
            return
        time, swing_s = context.get_time(), self._parameters.step_duration_s - 1e-9
        q, v = np.split(self._state_port.Eval(context), [self._kinematics.num_positions])
        if not is_state(q, v):  # The set points are held.
            return
        if mode == _RETURNING:
            if self._stays_standing(discrete_state, q, v):
                self._return(discrete_state, self._nominal_port.Eval(context), time)
                return
            self._begin(discrete_state, q, v, time)
        elif mode == _IDLE:
            discrete_state.set_value(self._num_steps, [0])
            discrete_state.set_value(self._heading, discrete_state.get_value(self._stance)[2:])
            self._begin(discrete_state, q, v, time)
        elif time - discrete_state.get_value(self._start_s)[0] >= swing_s:
            self._plant(discrete_state, q, time)
            if self._can_stand(discrete_state, q, v):
                self._stand(discrete_state, q, v)
                return
        self._swing(discrete_state, q, v, time)

    def _contacts(self, discrete_state: DiscreteValues) -> np.ndarray:
        return discrete_state.get_value(self._planted).reshape(-1, 3).copy()

    def _begin(
        self, discrete_state: DiscreteValues, q: np.ndarray, v: np.ndarray, time: float
    ) -> None:
        contacts = self._contacts(discrete_state)
        centres = np.array(
            [contacts[rows, :2].mean(axis=0) for rows in self._kinematics.foot_slices]
        )
        group = first_group(self._groups, centres, capture_point(q[4:7], v[3:6]))
        discrete_state.set_value(self._mode, [_STEPPING])
        discrete_state.set_value(self._swinging_group, [group])
        discrete_state.set_value(self._start_s, [time])

    def _plant(self, discrete_state: DiscreteValues, q: np.ndarray, time: float) -> None:
        """Ends a swing at the measured foot positions, and starts that of the other group."""
        kinematics = self._kinematics
        group = int(discrete_state.get_value(self._swinging_group)[0])
        contacts, measured = self._contacts(discrete_state), kinematics.contact_positions(q)
        for foot in self._groups[group]:
            rows = kinematics.foot_slices[foot]
            contacts[rows, :2] = measured[rows, :2]
            contacts[rows, 2] = kinematics.foot_radii[rows]
        discrete_state.set_value(self._planted, contacts.ravel())
        discrete_state.set_value(self._swinging_group, [1 - group])
        discrete_state.set_value(self._num_steps, discrete_state.get_value(self._num_steps) + 1)
        discrete_state.set_value(self._start_s, [time])

    def _margin(self, discrete_state: DiscreteValues, q: np.ndarray, v: np.ndarray) -> float:
        """Signed distance of the capture point inside the polygon of the planted feet [m]."""
        corners = convex_hull(self._contacts(discrete_state)[:, :2].tolist())
        return signed_distance_to_polygon(capture_point(q[4:7], v[3:6]), corners)

    def _heading_error(self, discrete_state: DiscreteValues, yaw: float) -> float:
        return math.remainder(discrete_state.get_value(self._heading)[0] - yaw, 2 * math.pi)

    def _can_stand(self, discrete_state: DiscreteValues, q: np.ndarray, v: np.ndarray) -> bool:
        parameters = self._parameters
        num_steps = discrete_state.get_value(self._num_steps)[0]
        if num_steps < parameters.min_steps or num_steps >= parameters.max_steps:
            return num_steps >= parameters.max_steps
        if parameters.max_twist_rad > 0:
            yaw = yaw_of(RotationMatrix(quaternion_of(q)))
            if abs(self._heading_error(discrete_state, yaw)) > parameters.settle_heading_rad:
                return False
        return self._margin(discrete_state, q, v) >= parameters.settle_margin_m

    def _stays_standing(self, discrete_state: DiscreteValues, q: np.ndarray, v: np.ndarray) -> bool:
        if discrete_state.get_value(self._num_steps)[0] >= self._parameters.max_steps:
            return True
        return self._margin(discrete_state, q, v) >= self._parameters.resume_margin_m

    def _stand(self, discrete_state: DiscreteValues, q: np.ndarray, v: np.ndarray) -> None:
        contacts = self._contacts(discrete_state)
        stance = fit_stance(contacts, self._kinematics.nominal_contacts)
        base = np.array([q[4], q[5], self._kinematics.standing_height])
        discrete_state.set_value(self._mode, [_RETURNING])
        discrete_state.set_value(self._return_start, np.concatenate([base, v[3:5], [0.0]]))
        discrete_state.set_value(self._set_point, base)
        discrete_state.set_value(self._feet, contacts.ravel())
        discrete_state.set_value(self._stance, stance)
        discrete_state.set_value(self._yaw, stance[2:])

    def _return(self, discrete_state: DiscreteValues, goal: np.ndarray, time: float) -> None:
        elapsed_s = time - discrete_state.get_value(self._start_s)[0]
        p_WB, v_WB = np.split(discrete_state.get_value(self._return_start), 2)
        resting = come_to_rest(p_WB, v_WB, elapsed_s)
        s = min(elapsed_s / self._parameters.return_duration_s, 1.0)
        discrete_state.set_value(self._set_point, resting + minimum_jerk(s) * (goal - resting))
        if s >= 1.0:
            discrete_state.set_value(self._mode, [_DONE])

    def _swing(
        self, discrete_state: DiscreteValues, q: np.ndarray, v: np.ndarray, time: float
    ) -> None:
        kinematics, parameters = self._kinematics, self._parameters
        R_WB = RotationMatrix(quaternion_of(q))
        yaw, p_WB, v_WB = yaw_of(R_WB), q[4:7], v[3:6]
        base = np.array([p_WB[0], p_WB[1], kinematics.standing_height])
        elapsed_s = time - discrete_state.get_value(self._start_s)[0]
        phase = elapsed_s / parameters.step_duration_s
        remaining_s = parameters.step_duration_s - elapsed_s
        R_WF = RotationMatrix.MakeZRotation(yaw).matrix()[:2, :2]
        feet = self._contacts(discrete_state)
        group = int(discrete_state.get_value(self._swinging_group)[0])
        num_steps = int(discrete_state.get_value(self._num_steps)[0])
        swinging = []
        for foot in self._groups[group]:
            rows = kinematics.foot_slices[foot]
            hip = self._nominal_feet[foot] - kinematics.nominal_base_offset
            centre = foothold(p_WB, v_WB, yaw, hip, remaining_s, parameters, num_steps)
            shape = kinematics.nominal_contacts[rows] - self._nominal_feet[foot]
            for i, offset in zip(range(rows.start, rows.stop), shape, strict=True):
                target = np.append(centre + R_WF @ offset, kinematics.foot_radii[i])
                feet[i] = swing_position(feet[i], target, phase, parameters.lift_m)
                swinging.append(i)
        stance = fit_stance(feet, kinematics.nominal_contacts)
        # At its feet's yaw the base resists a turn by the stiffness of the stance legs alone.
        desired_yaw = stance[2]
        if parameters.max_twist_rad > 0:
            twist = self._heading_error(discrete_state, yaw) - parameters.yaw_damping_s * v[2]
            desired_yaw = yaw + min(max(twist, -parameters.max_twist_rad), parameters.max_twist_rad)
        # The controller solves for a level base at the set point; a swinging foot is given relative
        # to the measured base.
        X_adjust = (
            RigidTransform(RotationMatrix.MakeZRotation(desired_yaw), base)
            @ RigidTransform(R_WB, p_WB).inverse()
        )
        set_points = feet.copy()
        for i in swinging:
            set_points[i] = X_adjust @ feet[i]
        discrete_state.set_value(self._set_point, base)
        discrete_state.set_value(self._feet, set_points.ravel())
        discrete_state.set_value(self._yaw, [desired_yaw])
        discrete_state.set_value(self._stance, stance)

    def _set_point_in_stance(self, context: Context) -> np.ndarray:
        x, y, yaw = context.get_discrete_state(self._stance).get_value()
        p = context.get_discrete_state(self._set_point).get_value()
        c, s = math.cos(yaw), math.sin(yaw)
        dx, dy = p[0] - x, p[1] - y
        return np.array([c * dx + s * dy, -s * dx + c * dy, p[2]])

    def _calc_done(self, context: Context, output: BasicVector) -> None:
        mode = context.get_discrete_state(self._mode).GetAtIndex(0)
        output.SetAtIndex(0, float(mode == _DONE))
