"""What the assessor sees of a robot: its state in the stance frame, free of world position."""

from __future__ import annotations

import math

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.robots.robot import ObservationNoise


def quaternion_of(q: np.ndarray) -> Quaternion:
    """The base's orientation in a position vector, normalised."""
    return Quaternion(q[:4] / math.sqrt(q[:4] @ q[:4]))


def rotation_vector(R: RotationMatrix) -> np.ndarray:
    """Rotation vector (3,) of a rotation, angle in [0, π] [rad]: one hemisphere only."""
    angle_axis = R.ToAngleAxis()
    angle, axis = angle_axis.angle(), angle_axis.axis()
    if angle > math.pi:
        angle, axis = 2 * math.pi - angle, -axis
    return angle * axis


def state_names(kinematics: RobotKinematics) -> list[str]:
    """Names of the entries of :func:`stance_state`."""
    names = [f"base_{axis}" for axis in "xyz"] + [f"rotation_{axis}" for axis in "xyz"]
    names += [f"angular_velocity_{axis}" for axis in "xyz"]
    names += [f"velocity_{axis}" for axis in "xyz"]
    names += list(kinematics.joint_names)
    return names + [f"{name}_rate" for name in kinematics.joint_names]


def is_rate(name: str) -> bool:
    """Whether an entry of :func:`stance_state` is a velocity, by its name."""
    return name.endswith("_rate") or "velocity" in name


def stance_state(kinematics: RobotKinematics, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The state s_k: base pose and velocity in the stance frame S, joints and their rates.

    S lies on the ground at the centroid of the contact points, turned as the planar fit of the
    standing posture's points to the measured ones, so that s_k is the same wherever the robot
    stands. Departure: the paper's s_k holds configurations only; without velocities the recall
    of unsafe states collapses, since a pushed robot is told from a still one by nothing else.

    Args:
        kinematics: The robot.
        q: Positions (n_q,).
        v: Velocities (n_v,).

    Returns:
        (12 + 2 n_j,) [m, rad, m/s, rad/s], in the order of :func:`state_names`; NaN throughout
        when a position or velocity is not finite.
    """
    if not q.dot(q) + v.dot(v) < math.inf:
        return np.full(12 + 2 * kinematics.num_joints, np.nan)
    x, y, yaw = kinematics.stance_pose(q)
    R_SW = RotationMatrix.MakeZRotation(-yaw)
    R = R_SW.matrix()
    R_SB = R_SW @ RotationMatrix(quaternion_of(q))
    return np.concatenate(
        [
            R @ (q[4:7] - (x, y, 0.0)),
            rotation_vector(R_SB),
            R @ v[:3],
            R @ v[3:6],
            q[7:],
            v[6:],
        ]
    )


def add_noise(
    q: np.ndarray, v: np.ndarray, unit_noise: np.ndarray, noise: ObservationNoise
) -> tuple[np.ndarray, np.ndarray]:
    """A measured state: orientation noise is a small rotation, the rest is added.

    Args:
        q: Positions (n_q,).
        v: Velocities (n_v,).
        unit_noise: Standard normal draws (2 n_v,): for positions, then for velocities.
        noise: Standard deviations.

    Returns:
        Noisy positions (n_q,) and velocities (n_v,).
    """
    n_v = len(v)
    dq = noise.position * unit_noise[:n_v]
    w, x, y, z = q[:4]
    a, b, c = 0.5 * dq[:3]
    quaternion = np.array(
        [
            w - a * x - b * y - c * z,
            x + a * w + b * z - c * y,
            y + b * w + c * x - a * z,
            z + c * w + a * y - b * x,
        ]
    )
    quaternion /= math.sqrt(quaternion @ quaternion)
    return (
        np.concatenate([quaternion, q[4:] + dq[3:]]),
        v + noise.velocity * unit_noise[n_v:],
    )
