"""RecoveryStepPlanner: capture steps, replanned at every update."""

import math
from types import SimpleNamespace

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem, State

from drake_safety.control.kinematics import RobotKinematics, fit_stance, is_state
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
        input_ports: [plant_state: n_q + n_v, recovery_active: 1, nominal_desired_output: n_z]
        output_ports: [desired_output: n_z, desired_foot_positions: 3 n_p, desired_yaw: 1,
          desired_preview: H n_z, desired_outlook: M n_z, stance_pose: 3, recovery_done: 1]

    While idle, the feet stay as in the planner's first state, put on level ground, or where
    :meth:`set_stance` puts them. When ``recovery_active`` rises, groups of feet swing by turns to
    Raibert footholds. The base set point follows the measured base at the standing height:
    otherwise the stance legs would pull it back. The legs twist it towards the first heading.

    Groups alternate until the capture point is well inside the support polygon and the heading
    error is small. The base then comes to rest like an inverted pendulum over its capture point,
    and moves to the nominal set point in the new stance frame. If the capture point comes near the
    polygon's edge meanwhile, the robot steps again. After that ``recovery_done`` is 1 until
    ``recovery_active`` has fallen. Preview and outlook repeat the set point, in the stance frame.

    Args:
        offset_s: Time of the first update, after the trigger's [s].
        horizon, num_outlook: H and M, samples of preview and outlook.
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
        self._nominal_feet = self._foot_centres(kinematics.nominal_contacts)
        self._swing_groups = gait_groups(self._nominal_feet)
        self._state_port = self.DeclareVectorInputPort("plant_state", kinematics.num_states)
        self._active_port = self.DeclareVectorInputPort("recovery_active", 1)
        self._nominal_port = self.DeclareVectorInputPort("nominal_desired_output", 3)
        unset = np.full(3 * kinematics.num_contacts, np.nan)
        initial = {
            "mode": np.zeros(1),
            "group": np.zeros(1),  # The swinging group.
            "num_steps": np.zeros(1),
            "start_s": np.zeros(1),  # Start of the swing, or of the return.
            "heading": np.zeros(1),  # Desired.
            "return_start": np.zeros(6),  # Position and velocity of the base.
            "planted": unset,  # Last contact positions.
            "desired_output": np.zeros(3),
            "desired_foot_positions": unset,
            "desired_yaw": np.zeros(1),
            "stance_pose": np.zeros(3),  # x, y, yaw
        }
        self._groups = {name: self.DeclareDiscreteState(value) for name, value in initial.items()}
        # Before the discrete updates, such as that of a controller of these feet.
        self.DeclareInitializationUnrestrictedUpdateEvent(self._initialize)
        declare_update(self, self._update, None, period_s, offset_s)
        for name in ("desired_output", "desired_foot_positions", "desired_yaw", "stance_pose"):
            self.DeclareStateOutputPort(name, self._groups[name])
        ticket = {self.all_state_ticket()}
        for name, num_samples in (("desired_preview", horizon), ("desired_outlook", num_outlook)):
            self.DeclareVectorOutputPort(name, 3 * num_samples, self._calc_samples, ticket)
        self.DeclareVectorOutputPort("recovery_done", 1, self._calc_done, ticket)

    def set_stance(
        self, discrete_state: DiscreteValues, p_WC: np.ndarray, stance_pose: np.ndarray
    ) -> None:
        """Sets contact positions (n_c, 3) [m] and stance pose (3,) [m, rad]; the planner idles."""
        now = self._values(discrete_state)
        now.mode, now.stance_pose, now.desired_yaw = [_IDLE], stance_pose, stance_pose[2:]
        now.desired_foot_positions = now.planted = np.ravel(p_WC)
        self._set_values(discrete_state, now)

    def _values(self, discrete_state: DiscreteValues) -> SimpleNamespace:
        """Copies of all discrete states, by name."""
        groups = self._groups.items()
        return SimpleNamespace(**{name: discrete_state.get_value(i).copy() for name, i in groups})

    def _set_values(self, discrete_state: DiscreteValues, values: SimpleNamespace) -> None:
        for name, index in self._groups.items():
            discrete_state.set_value(index, getattr(values, name))

    def _initialize(self, context: Context, state: State) -> None:
        discrete_state = state.get_mutable_discrete_state()
        if np.isnan(discrete_state.get_value(self._groups["planted"])).any():
            q = self._state_port.Eval(context)[: self._kinematics.num_positions]
            p_WC = self._kinematics.planted_contacts(q)
            stance = fit_stance(p_WC, self._kinematics.nominal_contacts)
            self.set_stance(discrete_state, p_WC, stance)

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        mode = discrete_state.get_value(self._groups["mode"])[0]
        nominal = self._nominal_port.Eval(context)
        is_active = self._active_port.Eval(context)[0] > 0
        if mode == _DONE or (mode == _IDLE and not is_active):
            # The usual case, without copies of all states.
            discrete_state.set_value(self._groups["mode"], [_DONE if is_active else _IDLE])
            discrete_state.set_value(self._groups["desired_output"], nominal)
            return
        q, v = np.split(self._state_port.Eval(context), [self._kinematics.num_positions])
        if is_state(q, v):  # Otherwise the set points are held.
            now = self._values(discrete_state)
            self._recover(now, q, v, context.get_time(), nominal)
            self._set_values(discrete_state, now)

    def _recover(
        self, now: SimpleNamespace, q: np.ndarray, v: np.ndarray, time_s: float, nominal: np.ndarray
    ) -> None:
        parameters = self._parameters
        if now.mode == _RETURNING:
            is_last = now.num_steps >= parameters.max_steps
            if is_last or self._margin(now, q, v) >= parameters.resume_margin_m:
                self._return(now, nominal, time_s)
                return
        elif now.mode == _IDLE:
            now.num_steps, now.heading = np.zeros(1), now.stance_pose[2:]
        elif time_s - now.start_s >= parameters.step_duration_s - 1e-9:
            self._plant(now, q, time_s)
            if self._can_stand(now, q, v):
                self._stand(now, q, v)
                return
        if now.mode != _STEPPING:
            centres = self._foot_centres(now.planted.reshape(-1, 3))
            group = first_group(self._swing_groups, centres, capture_point(q[4:7], v[3:6]))
            now.mode, now.group, now.start_s = [_STEPPING], [group], [time_s]
        self._swing(now, q, v, time_s)

    def _foot_centres(self, contacts: np.ndarray) -> np.ndarray:
        """Centres (n_feet, 2) of the feet's contact points (n_c, ...)."""
        slices = self._kinematics.foot_slices
        return np.array([contacts[rows, :2].mean(axis=0) for rows in slices])

    def _plant(self, now: SimpleNamespace, q: np.ndarray, time_s: float) -> None:
        """Ends a swing at the measured foot positions, and starts that of the other group."""
        kinematics, group = self._kinematics, int(now.group[0])
        contacts, measured = now.planted.reshape(-1, 3), kinematics.contact_positions(q)
        for foot in self._swing_groups[group]:
            rows = kinematics.foot_slices[foot]
            contacts[rows, :2] = measured[rows, :2]
            contacts[rows, 2] = kinematics.foot_radii[rows]
        now.group, now.start_s = [1 - group], [time_s]
        now.num_steps += 1

    def _margin(self, now: SimpleNamespace, q: np.ndarray, v: np.ndarray) -> float:
        """Signed distance of the capture point inside the polygon of the planted feet [m]."""
        corners = convex_hull(now.planted.reshape(-1, 3)[:, :2].tolist())
        return signed_distance_to_polygon(capture_point(q[4:7], v[3:6]), corners)

    def _can_stand(self, now: SimpleNamespace, q: np.ndarray, v: np.ndarray) -> bool:
        parameters = self._parameters
        if now.num_steps >= parameters.max_steps:
            return True
        yaw = RollPitchYaw(RotationMatrix(quaternion_of(q))).yaw_angle()
        is_turned = abs(_heading_error(now, yaw)) > parameters.settle_heading_rad
        if now.num_steps < parameters.min_steps or (is_turned and parameters.max_twist_rad > 0):
            return False
        return self._margin(now, q, v) >= parameters.settle_margin_m

    def _stand(self, now: SimpleNamespace, q: np.ndarray, v: np.ndarray) -> None:
        stance = fit_stance(now.planted.reshape(-1, 3), self._kinematics.nominal_contacts)
        base = np.array([q[4], q[5], self._kinematics.standing_height])
        now.mode, now.desired_output, now.desired_foot_positions = [_RETURNING], base, now.planted
        now.return_start = np.concatenate([base, v[3:5], [0.0]])
        now.stance_pose, now.desired_yaw = stance, stance[2:]

    def _return(self, now: SimpleNamespace, goal: np.ndarray, time_s: float) -> None:
        elapsed_s = time_s - now.start_s[0]
        p_WB, v_WB = np.split(now.return_start, 2)
        resting = come_to_rest(p_WB, v_WB, elapsed_s)
        s = min(elapsed_s / self._parameters.return_duration_s, 1.0)
        now.desired_output = resting + minimum_jerk(s) * (goal - resting)
        if s >= 1.0:
            now.mode = [_DONE]

    def _swing(self, now: SimpleNamespace, q: np.ndarray, v: np.ndarray, time_s: float) -> None:
        kinematics, parameters = self._kinematics, self._parameters
        R_WB = RotationMatrix(quaternion_of(q))
        yaw, p_WB, v_WB = RollPitchYaw(R_WB).yaw_angle(), q[4:7], v[3:6]
        base = np.array([p_WB[0], p_WB[1], kinematics.standing_height])
        elapsed_s = time_s - now.start_s[0]
        phase = elapsed_s / parameters.step_duration_s
        remaining_s = parameters.step_duration_s - elapsed_s
        R_WF = RotationMatrix.MakeZRotation(yaw).matrix()[:2, :2]
        feet = now.planted.reshape(-1, 3).copy()
        swinging = []
        for foot in self._swing_groups[int(now.group[0])]:
            rows = kinematics.foot_slices[foot]
            hip = self._nominal_feet[foot] - kinematics.nominal_base_offset
            centre = foothold(p_WB, v_WB, yaw, hip, remaining_s, parameters, int(now.num_steps[0]))
            shape = kinematics.nominal_contacts[rows] - self._nominal_feet[foot]
            for i, offset in zip(range(rows.start, rows.stop), shape, strict=True):
                goal = np.append(centre + R_WF @ offset, kinematics.foot_radii[i])
                feet[i] = swing_position(feet[i], goal, phase, parameters.lift_m)
                swinging.append(i)
        stance = fit_stance(feet, kinematics.nominal_contacts)
        # At its feet's yaw the base resists a turn by the stiffness of the stance legs alone.
        desired_yaw = stance[2]
        if parameters.max_twist_rad > 0:
            twist = _heading_error(now, yaw) - parameters.yaw_damping_s * v[2]
            desired_yaw = yaw + min(max(twist, -parameters.max_twist_rad), parameters.max_twist_rad)
        # The controller solves for a level base at the set point; a swinging foot is given relative
        # to the measured base.
        X_level = RigidTransform(RotationMatrix.MakeZRotation(desired_yaw), base)
        X_adjust = X_level @ RigidTransform(R_WB, p_WB).inverse()
        for i in swinging:
            feet[i] = X_adjust @ feet[i]
        now.desired_output, now.desired_foot_positions = base, feet.ravel()
        now.desired_yaw, now.stance_pose = [desired_yaw], stance

    def _calc_samples(self, context: Context, output: BasicVector) -> None:
        """Repeats the set point, in the stance frame."""
        x, y, yaw = context.get_discrete_state(self._groups["stance_pose"]).get_value()
        p = context.get_discrete_state(self._groups["desired_output"]).get_value()
        c, s = math.cos(yaw), math.sin(yaw)
        dx, dy = p[0] - x, p[1] - y
        set_point = [c * dx + s * dy, -s * dx + c * dy, p[2]]
        output.SetFromVector(np.tile(set_point, output.size() // 3))

    def _calc_done(self, context: Context, output: BasicVector) -> None:
        mode = context.get_discrete_state(self._groups["mode"]).GetAtIndex(0)
        output.SetAtIndex(0, float(mode == _DONE))


def _heading_error(now: SimpleNamespace, yaw: float) -> float:
    return math.remainder(now.heading[0] - yaw, 2 * math.pi)
