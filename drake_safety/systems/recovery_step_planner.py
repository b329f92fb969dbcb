"""RecoveryStepPlanner: steps that catch a robot, planned again at every tick."""

from __future__ import annotations

import math

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drake_safety.control.kinematics import RobotKinematics, fit_stance, yaw_of
from drake_safety.control.observation import quaternion_of
from drake_safety.control.recovery_step import (
    RecoveryStepParameters,
    capture_point,
    first_group,
    foothold,
    gait_groups,
    swing_position,
)
from drake_safety.control.safe_sets import convex_hull, signed_distance_to_polygon

_IDLE, _STEPPING, _RETURNING, _DONE = 0.0, 1.0, 2.0, 3.0


class RecoveryStepPlanner(LeafSystem):
    """Catches the robot by swinging groups of feet in turn, then returns the base over them.

    .. pydrake_system::

        name: RecoveryStepPlanner
        input_ports:
        - plant_state
        - recovery_active
        - nominal_desired_output
        output_ports:
        - desired_output
        - desired_foot_positions
        - desired_preview
        - stance_pose
        - recovery_done

    While idle, the feet stay where they were set (:meth:`set_stance`). When
    ``recovery_active`` rises, the group of feet whose partners' line is nearest the capture
    point swings to Raibert footholds that follow the base at every tick; the base set point
    follows the measured base at the standing height, so the stance legs carry the weight without
    pulling it back. Groups alternate until the base is slow and its capture point well inside the
    support polygon. The stance pose then becomes that of the new footholds, and the base is led
    to the nominal planner's set point, which stands in that stance pose. After that
    ``recovery_done`` is 1 until ``recovery_active`` has fallen.

    Every output is a discrete state; the preview is the base set point, held, in the stance
    frame.

    Args:
        kinematics: The robot as the controller believes it to be.
        parameters: Numbers of the step.
        period_s: Planning period [s].
        offset_s: Time of the first tick [s].
        horizon: H of the preview.
    """

    def __init__(
        self,
        kinematics: RobotKinematics,
        parameters: RecoveryStepParameters,
        *,
        period_s: float,
        offset_s: float = 0.0,
        horizon: int,
    ):
        super().__init__()
        self._kinematics = kinematics
        self._parameters = parameters
        self._horizon = horizon
        self._nominal_feet = np.array(
            [kinematics.nominal_contacts[rows].mean(axis=0) for rows in kinematics.foot_slices]
        )
        self._groups = gait_groups(self._nominal_feet)
        n_p = 3 * kinematics.num_contacts
        self.DeclareVectorInputPort(
            "plant_state", kinematics.num_positions + kinematics.num_velocities
        )
        self.DeclareVectorInputPort("recovery_active", 1)
        self.DeclareVectorInputPort("nominal_desired_output", 3)
        # Discrete state groups, each read and written by name.
        self._mode = self.DeclareDiscreteState(4)  # mode, group, steps done, time of its start
        self._stance = self.DeclareDiscreteState(3)  # x, y, yaw
        self._base = self.DeclareDiscreteState(6)  # set point; where the return began
        self._feet = self.DeclareDiscreteState(n_p)  # commanded to the controller
        self._planted = self.DeclareDiscreteState(n_p)  # where feet stand, or left the ground
        self.DeclarePeriodicDiscreteUpdateEvent(period_s, offset_s, self._update)
        ticket = {self.all_state_ticket()}
        self.DeclareVectorOutputPort(
            "desired_output", BasicVector(3), self._calc_desired_output, ticket
        )
        self.DeclareVectorOutputPort(
            "desired_foot_positions", BasicVector(n_p), self._calc_feet, ticket
        )
        self.DeclareVectorOutputPort(
            "desired_preview", BasicVector(3 * horizon), self._calc_preview, ticket
        )
        self.DeclareVectorOutputPort("stance_pose", BasicVector(3), self._calc_stance, ticket)
        self.DeclareVectorOutputPort("recovery_done", BasicVector(1), self._calc_done, ticket)

    def set_stance(self, context: Context, p_WC: np.ndarray, stance_pose: np.ndarray) -> None:
        """Sets where the feet stand, and puts the planner to rest.

        Args:
            context: This system's Context.
            p_WC: Centres of the contact spheres, (n_c, 3) [m].
            stance_pose: [x, y, yaw] of the stance frame (3,) [m, rad].
        """
        context.SetDiscreteState(self._mode, np.zeros(4))
        context.SetDiscreteState(self._stance, stance_pose)
        context.SetDiscreteState(self._feet, np.ravel(p_WC))
        context.SetDiscreteState(self._planted, np.ravel(p_WC))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        mode, group, steps, start = discrete_state.get_vector(self._mode).get_value().tolist()
        is_active = self.GetInputPort("recovery_active").Eval(context)[0] > 0
        if mode == _IDLE and not is_active:
            self._set_base(
                discrete_state, self.GetInputPort("nominal_desired_output").Eval(context)
            )
            return
        if mode == _DONE:
            if not is_active:
                discrete_state.set_value(self._mode, np.zeros(4))
            else:
                nominal = self.GetInputPort("nominal_desired_output").Eval(context)
                self._set_base(discrete_state, nominal)
            return
        time = context.get_time()
        plant_state = self.GetInputPort("plant_state").Eval(context)
        q = plant_state[: self._kinematics.num_positions]
        v = plant_state[self._kinematics.num_positions :]
        if mode == _IDLE:
            feet = discrete_state.get_vector(self._planted).get_value().reshape(-1, 3)
            centres = self._foot_centres(feet)
            point = capture_point(q[4:7], v[3:6])
            group = first_group(self._groups, centres, point)
            mode, steps, start = _STEPPING, 0, time
        if mode == _STEPPING:
            group, steps, start, is_settled = self._step(
                discrete_state, q, v, int(group), int(steps), start, time
            )
            if is_settled:
                mode, start = _RETURNING, time
        elif mode == _RETURNING:
            s = min((time - start) / self._parameters.return_duration_s, 1.0)
            began = discrete_state.get_vector(self._base).get_value()[3:]
            goal = self.GetInputPort("nominal_desired_output").Eval(context)
            blend = s**3 * (10 - 15 * s + 6 * s**2)
            self._set_base(discrete_state, began + blend * (goal - began))
            if s >= 1.0:
                mode = _DONE
        discrete_state.set_value(self._mode, np.array([mode, group, steps, start]))

    def _set_base(self, discrete_state: DiscreteValues, p_WB: np.ndarray) -> None:
        base = discrete_state.get_vector(self._base).get_value().copy()
        base[:3] = p_WB
        discrete_state.set_value(self._base, base)

    def _foot_centres(self, contacts: np.ndarray) -> np.ndarray:
        return np.array([contacts[rows, :2].mean(axis=0) for rows in self._kinematics.foot_slices])

    def _step(
        self,
        discrete_state: DiscreteValues,
        q: np.ndarray,
        v: np.ndarray,
        group: int,
        steps: int,
        start: float,
        time: float,
    ) -> tuple[int, int, float, bool]:
        kinematics, parameters = self._kinematics, self._parameters
        R_WB = RotationMatrix(quaternion_of(q))
        yaw = yaw_of(R_WB)
        p_WB, v_WB = q[4:7], v[3:6]
        planted = discrete_state.get_vector(self._planted).get_value().reshape(-1, 3).copy()
        is_settled = False
        if time - start >= parameters.step_duration_s - 1e-9:
            measured = kinematics.contact_positions(q)
            for foot in self._groups[group]:
                rows = kinematics.foot_slices[foot]
                planted[rows] = measured[rows]
                planted[rows, 2] = kinematics.foot_radii[rows]
            steps += 1
            is_settled = self._is_settled(planted, p_WB, v_WB, steps)
            group, start = 1 - group, time
        feet = planted.copy()
        X_WS = RigidTransform(
            RotationMatrix.MakeZRotation(yaw),
            [p_WB[0], p_WB[1], kinematics.standing_height],
        )
        base = np.array([p_WB[0], p_WB[1], kinematics.standing_height])
        if is_settled:
            stance = fit_stance(planted, kinematics.nominal_contacts)
            discrete_state.set_value(self._stance, stance)
            discrete_state.set_value(self._base, np.concatenate([base, base]))
        else:
            phase = (time - start) / parameters.step_duration_s
            remaining_s = parameters.step_duration_s - (time - start)
            # The controller solves for a level base at the standing height; a swinging foot must
            # reach its place from the base as it is.
            X_adjust = X_WS @ RigidTransform(R_WB, p_WB).inverse()
            for foot in self._groups[group]:
                rows = kinematics.foot_slices[foot]
                hip = self._nominal_feet[foot] - kinematics.nominal_base_offset
                centre = foothold(p_WB, v_WB, yaw, hip, remaining_s, parameters)
                c, s = math.cos(yaw), math.sin(yaw)
                R = np.array([[c, -s], [s, c]])
                shape = kinematics.nominal_contacts[rows] - self._nominal_feet[foot]
                for i, offset in zip(range(rows.start, rows.stop), shape, strict=True):
                    target = np.append(centre + R @ offset, kinematics.foot_radii[i])
                    feet[i] = X_adjust @ swing_position(
                        planted[i], target, phase, parameters.lift_m
                    )
            self._set_base(discrete_state, base)
        discrete_state.set_value(self._feet, feet.ravel())
        discrete_state.set_value(self._planted, planted.ravel())
        return group, steps, start, is_settled

    def _is_settled(
        self, planted: np.ndarray, p_WB: np.ndarray, v_WB: np.ndarray, steps: int
    ) -> bool:
        parameters = self._parameters
        if steps >= parameters.max_steps:
            return True
        if steps < parameters.min_steps or np.hypot(*v_WB[:2]) > parameters.settle_speed_m_s:
            return False
        corners = convex_hull(planted[:, :2])
        margin = signed_distance_to_polygon(capture_point(p_WB, v_WB), corners)
        return margin >= parameters.settle_margin_m

    def _calc_desired_output(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._base).get_value()[:3])

    def _calc_feet(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._feet).get_value())

    def _calc_preview(self, context: Context, output: BasicVector) -> None:
        x, y, yaw = context.get_discrete_state(self._stance).get_value()
        p = context.get_discrete_state(self._base).get_value()[:3]
        c, s = math.cos(yaw), math.sin(yaw)
        dx, dy = p[0] - x, p[1] - y
        p_S = np.array([c * dx + s * dy, -s * dx + c * dy, p[2]])
        output.SetFromVector(np.tile(p_S, self._horizon))

    def _calc_stance(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._stance).get_value())

    def _calc_done(self, context: Context, output: BasicVector) -> None:
        mode = context.get_discrete_state(self._mode).GetAtIndex(0)
        output.SetAtIndex(0, float(mode == _DONE))
