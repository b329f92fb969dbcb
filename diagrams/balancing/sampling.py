"""Random starts, plans and balls of the balancing task."""

import math
from dataclasses import field

import numpy as np
from pydantic import FiniteFloat
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.inverse_kinematics import solve_inverse_kinematics
from drake_safety.control.kinematics import (
    NUM_BASE_VELOCITIES,
    RobotKinematics,
    fit_stance,
    planar_pose,
)
from drake_safety.files.schema import Bounds, Pair, Positive, Share, Triple, schema
from drake_safety.plants.balls import Throw
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.systems.trajectory_planner import interpolate

_RESTS_S = (0.2, 1.0)  # Shortest and longest rest between two undisturbed motions.
_USUAL_SHARE = 0.5  # Ends of undisturbed plans, as a share of the range in training.


@schema(kw_only=True)
class StartSampling:
    """Random initial states and plans. Offsets are half-widths about the standing posture."""

    foot_offset_m: float = 0.02  # Half-width for every contact point, along x and y.
    base_offset_m: Pair[FiniteFloat] = field(default_factory=lambda: [0.08, 0.05])
    base_height_m: Bounds[FiniteFloat] = field(default_factory=lambda: [0.36, 0.45])
    tilt_rad: float = 0.1  # Half-width of roll, pitch and yaw, each.
    velocity_std_m_s: Triple = field(default_factory=lambda: [0.5, 0.35, 0.1])
    angular_velocity_std_rad_s: float = 0.4
    joint_std_rad: float = 0.02
    tracking_offset_m: Triple = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Initial tracking error of the base, along x, y and z. "We also add a random offset to the
    initial state to simulate the disturbances" (paper)."""
    target_offset_m: Pair[FiniteFloat] = field(default_factory=lambda: [0.20, 0.11])
    target_height_m: Bounds[FiniteFloat] = field(default_factory=lambda: [0.34, 0.46])
    plan_duration_s: Bounds[Positive] = field(default_factory=lambda: [0.8, 1.6])

    def sample(self, kinematics: RobotKinematics, rng: np.random.Generator) -> EpisodeStart:
        """Samples a start with a moving base within the ranges and the feet at rest."""
        p_WC = _contacts(kinematics, rng, self.foot_offset_m)
        X_WS = planar_pose(fit_stance(p_WC, kinematics.nominal_contacts))
        start = np.append(
            kinematics.nominal_base_offset + rng.uniform(-1, 1, 2) * self.base_offset_m,
            rng.uniform(*self.base_height_m),
        )
        rotation = RollPitchYaw(rng.uniform(-1, 1, 3) * self.tilt_rad)
        error = np.asarray(self.tracking_offset_m)
        if error.any():
            error = error * rng.uniform(-1, 1, 3)
        X_WB = X_WS @ RigidTransform(RotationMatrix(rotation), start + error)
        w_WB = rng.normal(size=3) * self.angular_velocity_std_rad_s
        v_WB = rng.normal(size=3) * self.velocity_std_m_s
        offsets = rng.normal(size=kinematics.num_joints) * self.joint_std_rad
        goal = np.append(
            kinematics.nominal_base_offset + rng.uniform(-1, 1, 2) * self.target_offset_m,
            rng.uniform(*self.target_height_m),
        )
        plan = interpolate(start, goal, rng.uniform(*self.plan_duration_s))
        return _start(kinematics, X_WB, p_WC, plan, np.concatenate([w_WB, v_WB]), offsets)


@schema(kw_only=True)
class PushSampling:
    """Random balls, and the undisturbed motion during which they are thrown."""

    share: Share = 0.25  # Share of nominal episodes that begin with the impact of a ball.
    mass_kg: Bounds[Positive] = field(default_factory=lambda: [2.0, 4.0])
    speed_m_s: Bounds[Positive] = field(default_factory=lambda: [2.0, 11.0])
    offset_m: float = 0.0
    height_m: float = 0.03
    target_offset_m: Pair[FiniteFloat] = field(default_factory=lambda: [0.05, 0.03])

    def sample(self, rng: np.random.Generator, time_s: float) -> Throw:
        """Samples a ball from any horizontal direction."""
        return Throw(
            time_s=time_s,
            mass_kg=rng.uniform(*self.mass_kg),
            speed_m_s=rng.uniform(*self.speed_m_s),
            direction_rad=rng.uniform(-math.pi, math.pi),
            offset_m=rng.uniform(-self.offset_m, self.offset_m),
            height_m=rng.uniform(-self.height_m, self.height_m),
        )


def throw_start(
    kinematics: RobotKinematics,
    rng: np.random.Generator,
    *,
    half_widths_m: list[float],
    plan_duration_s: list[float],
    elapsed_s: float = 0.0,
) -> EpisodeStart:
    """Samples a start on a plan about the stance that began ``elapsed_s`` ago, without error."""
    half = np.array([*half_widths_m, 0.0])
    nominal = np.array([*kinematics.nominal_base_offset, kinematics.standing_height])
    start = nominal + rng.uniform(-half, half)
    goal = nominal + rng.uniform(-half, half)
    duration_s = rng.uniform(*plan_duration_s)
    plan = interpolate(start, goal, duration_s, start_time_s=-elapsed_s)
    V_WB = np.zeros(NUM_BASE_VELOCITIES)
    if elapsed_s < duration_s:
        V_WB[3:] = plan.MakeDerivative().value(0.0).ravel()
    p_WC = np.column_stack([kinematics.nominal_contacts, kinematics.foot_radii])
    return _start(kinematics, RigidTransform(plan.value(0.0).ravel()), p_WC, plan, V_WB)


def undisturbed_start(
    kinematics: RobotKinematics,
    rng: np.random.Generator,
    sampling: StartSampling,
    duration_s: float,
) -> EpisodeStart:
    """Samples a start at rest with base motions one after another, for a duration [s]."""
    p_WC = _contacts(kinematics, rng, sampling.foot_offset_m)
    low, high = sampling.target_height_m
    middle = np.array([*kinematics.nominal_base_offset, 0.5 * (low + high)])
    half = _USUAL_SHARE * np.array([*sampling.target_offset_m, 0.5 * (high - low)])
    point = np.array([*kinematics.nominal_base_offset, kinematics.standing_height])
    X_WB = planar_pose(fit_stance(p_WC, kinematics.nominal_contacts)) @ RigidTransform(point)
    plan = _rest(point, 0.0, rng.uniform(*_RESTS_S))
    while (time_s := plan.end_time()) < duration_s:
        goal = middle + rng.uniform(-half, half)
        motion = interpolate(point, goal, rng.uniform(*sampling.plan_duration_s), time_s)
        plan.ConcatenateInTime(motion)
        plan.ConcatenateInTime(_rest(goal, motion.end_time(), rng.uniform(*_RESTS_S)))
        point = goal
    return _start(kinematics, X_WB, p_WC, plan, np.zeros(NUM_BASE_VELOCITIES))


def _rest(point: np.ndarray, start_s: float, duration_s: float) -> PiecewisePolynomial:
    times = [start_s, start_s + duration_s]
    return PiecewisePolynomial.ZeroOrderHold(times, np.stack([point, point], axis=1))


def _contacts(kinematics: RobotKinematics, rng: np.random.Generator, offset_m: float) -> np.ndarray:
    xy = rng.uniform(-1, 1, (kinematics.num_contacts, 2)) * offset_m
    return np.column_stack([kinematics.nominal_contacts + xy, kinematics.foot_radii])


def _start(
    kinematics: RobotKinematics,
    X_WB: RigidTransform,
    p_WC: np.ndarray,
    plan: PiecewisePolynomial,
    V_WB: np.ndarray,
    joint_offsets: np.ndarray | float = 0.0,
) -> EpisodeStart:
    joints = solve_inverse_kinematics(kinematics, X_WB, p_WC, kinematics.posture)
    # The base moves over feet at rest: 0 = J_b V_WB + J_j dq.
    J = kinematics.contact_jacobian(kinematics.positions_at(X_WB, joints))
    J_base, J_joints = np.split(J, [NUM_BASE_VELOCITIES], axis=1)
    rates, *_ = np.linalg.lstsq(J_joints, -J_base @ V_WB, rcond=1e-6)
    joints = np.clip(joints + joint_offsets, *kinematics.position_limits.T)
    q = kinematics.positions_at(X_WB, joints)
    v = np.concatenate([V_WB, rates])
    return EpisodeStart(q=q, v=v, plan=plan, foot_positions=p_WC)
