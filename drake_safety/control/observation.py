"""The assessor's state of a robot, in the stance frame and independent of world position."""

import math

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix

from drake_safety.control.kinematics import RobotKinematics, is_state
from drake_safety.robots.robot import ObservationNoise

_LEAST_FOOT_SPREAD_M = 0.005  # Root mean square extent of the feet that defines a plane.


def quaternion_of(q: np.ndarray) -> Quaternion:
    """Returns the normalised quaternion of the base in a position vector."""
    return Quaternion(q[:4] / math.sqrt(q[:4] @ q[:4]))


def rotation_vector(R: RotationMatrix) -> np.ndarray:
    """Returns the rotation vector (3,) with an angle in [0, π] [rad]."""
    angle_axis = R.ToAngleAxis()
    angle, axis = angle_axis.angle(), angle_axis.axis()
    return angle * axis if angle <= math.pi else (2 * math.pi - angle) * -axis


def state_names(kinematics: RobotKinematics) -> list[str]:
    """Returns the names of the entries of :func:`stance_state`."""
    base = [f"{quantity}_{axis}" for quantity in ("base", "rotation") for axis in "xyz"]
    return base + _rate_and_joint_names(kinematics)


def _rate_and_joint_names(kinematics: RobotKinematics) -> list[str]:
    names = [f"{rate}_{axis}" for rate in ("angular_velocity", "velocity") for axis in "xyz"]
    return names + kinematics.joint_names + [f"{name}_rate" for name in kinematics.joint_names]


def stance_state(kinematics: RobotKinematics, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Returns the state s_k: base pose and velocity in the stance frame S, joints and their rates.

    S lies on the ground at the centroid of the contact points, with the yaw of their planar fit.
    Departure: the paper's s_k has configurations only; without velocities a pushed robot cannot be
    distinguished from one at rest. The (12 + 2 n_j,) entries [m, rad, m/s, rad/s], named by
    :func:`state_names`, are NaN without a finite state with an orientation.
    """
    if not is_state(q, v):
        return np.full(12 + 2 * kinematics.num_joints, np.nan)
    x, y, yaw = kinematics.stance_pose(q)
    R_SW = RotationMatrix.MakeZRotation(-yaw)
    R = R_SW.matrix()
    # R_SW R_WB; Drake's product of rotations is wrapped in Python.
    R_SB = R_SW.inverse().InvertAndCompose(RotationMatrix(quaternion_of(q)))
    pose = R @ (q[4:7] - (x, y, 0.0)), rotation_vector(R_SB)
    return np.concatenate([*pose, R @ v[:3], R @ v[3:6], q[7:], v[6:]])


def walking_state_names(kinematics: RobotKinematics) -> list[str]:
    """Returns the names of the entries of :func:`walking_state`."""
    base = ["base_height", "gravity_x", "gravity_y", "gravity_z"]
    return base + _rate_and_joint_names(kinematics)


def walking_state(kinematics: RobotKinematics, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Returns the state s_k of a walking robot, which does not depend on its place and heading.

    Departure: feet that swing define no stance frame. Height is over the ground z = 0, and the
    direction of gravity and the velocities are in the base's frame. The (10 + 2 n_j,) entries,
    named by :func:`walking_state_names`, are NaN as in :func:`stance_state`.
    """
    if not is_state(q, v):
        return np.full(10 + 2 * kinematics.num_joints, np.nan)
    R_BW = RotationMatrix(quaternion_of(q)).matrix().T
    return np.concatenate([q[6:7], -R_BW[:, 2], R_BW @ v[:3], R_BW @ v[3:6], q[7:], v[6:]])


def heading_velocity(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(v_x, v_y, ω_z) [m/s, rad/s] of the base in its heading frame; NaN without a state."""
    if not is_state(q, v):
        return np.full(3, np.nan)
    x_axis = RotationMatrix(quaternion_of(q)).matrix()[:2, 0]
    length = math.hypot(*x_axis)
    c, s = x_axis / length if length > 0 else (1.0, 0.0)
    return np.array([c * v[3] + s * v[4], c * v[4] - s * v[3], v[2]])


def gravity_in_foot_plane(
    kinematics: RobotKinematics, q: np.ndarray, gravity: np.ndarray
) -> np.ndarray:
    """Components (2,) of gravity's direction along the x and y axes of the stance frame.

    On a slope, they are the sine of its inclination downhill. The plane is fitted to the contact
    points; along a direction in which these do not extend it is level. NaN without a state.
    """
    if not is_state(q, gravity):
        return np.full(2, np.nan)
    p_WC = kinematics.contact_positions(q) - kinematics.foot_radii[:, None] * (0.0, 0.0, 1.0)
    p = p_WC - p_WC.sum(axis=0) / len(p_WC)
    spread = p[:, :2].T @ p[:, :2]
    spread.flat[::3] += len(p) * _LEAST_FOOT_SPREAD_M**2
    slope = np.linalg.solve(spread, p[:, :2].T @ p[:, 2])
    yaw = kinematics.stance_pose(q)[2]
    c, s = math.cos(yaw), math.sin(yaw)
    tangents = np.array([[c, s, 0.0], [-s, c, 0.0]])
    tangents[:, 2] = tangents[:, :2] @ slope
    along = tangents @ gravity / math.sqrt(gravity @ gravity)
    return along / np.sqrt((tangents * tangents).sum(axis=1))


def add_noise(
    q: np.ndarray, v: np.ndarray, unit_noise: np.ndarray, noise: ObservationNoise
) -> tuple[np.ndarray, np.ndarray]:
    """Adds noise to a state, from standard normal samples (2 n_v,); the base rotates a little."""
    n_v = len(v)
    dq = noise.position * unit_noise[:n_v]
    w, x, y, z = q[:4]
    a, b, c = 0.5 * dq[:3]
    turned_w, turned_x = w - a * x - b * y - c * z, x + a * w + b * z - c * y
    turned_y, turned_z = y + b * w + c * x - a * z, z + c * w + a * y - b * x
    quaternion = np.array([turned_w, turned_x, turned_y, turned_z])
    quaternion /= math.sqrt(quaternion @ quaternion)
    return np.concatenate([quaternion, q[4:] + dq[3:]]), v + noise.velocity * unit_noise[n_v:]
