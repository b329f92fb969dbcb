"""Inverse kinematics: from a base pose and foot positions to joint positions."""

import numpy as np
from pydrake.math import RigidTransform

from drake_safety.control.kinematics import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    RobotKinematics,
    dposv,
)

_TOLERANCE_M = 1e-4  # Tolerance of a contact point's coordinates.
_DAMPING = 1e-8  # [m²/rad²]: limits the step of a stretched leg.
_MAX_ITERATIONS = 20
_MAX_STEP_RAD = 0.5  # Per iteration.
# The error after a Newton step is of second order: about 1e-5 m for a leg of 1 m.
_LAST_STEP_RAD = 0.004


def solve_inverse_kinematics(
    kinematics: RobotKinematics, X_WB: RigidTransform, p_WC: np.ndarray, guess: np.ndarray
) -> np.ndarray:
    """Returns joint positions (n_j,) [rad] with desired contact points at a given base pose.

    Damped Gauss-Newton from ``guess`` (n_j,) [rad] to the contact spheres' centres ``p_WC``,
    (n_c, 3) [m], or the nearest reachable points. Joints outside the legs keep the guess, and every
    joint stays inside its limits.
    """
    return solve_from(kinematics, kinematics.positions_at(X_WB, guess), p_WC)[0]


def solve_from(
    kinematics: RobotKinematics, q: np.ndarray, p_WC: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """As :func:`solve_inverse_kinematics` from ``q`` (n_q,), whose joints are overwritten.

    Also returns the contact Jacobian (3 n_c, n_v) at the last iterate, at most one small step away.
    """
    lowest, highest = kinematics.position_limits.T
    joints = np.minimum(np.maximum(q[NUM_BASE_POSITIONS:], lowest), highest)
    J = np.empty((3 * kinematics.num_contacts, kinematics.num_velocities))
    for _ in range(_MAX_ITERATIONS):
        q[NUM_BASE_POSITIONS:] = joints
        kinematics.set_positions(q)
        reached, J = kinematics.present_contacts()
        error = (p_WC - reached).ravel()
        if max(error.max(), -error.min()) < _TOLERANCE_M:
            break
        # Joints that move no foot have zero columns, so the damping gives them zero steps.
        J_joints = J[:, NUM_BASE_VELOCITIES:]
        step = _damped_step(J_joints, error)
        wanted = joints + step
        moved = np.minimum(np.maximum(wanted, lowest), highest)
        if (moved != wanted).any():
            # Solves again without the joints at their limits.
            J_joints = J_joints.copy()
            J_joints[:, (moved == joints) & (step != 0)] = 0.0
            step = _damped_step(J_joints, error)
            moved = np.minimum(np.maximum(joints + step, lowest), highest)
        joints = moved
        if max(step.max(), -step.min()) < _LAST_STEP_RAD:
            break
    return joints, J


def _damped_step(J: np.ndarray, error: np.ndarray) -> np.ndarray:
    gram = J.T @ J
    gram.flat[:: len(gram) + 1] += _DAMPING
    _, step, _ = dposv(gram, J.T @ error)
    largest = max(step.max(), -step.min())
    return step * (_MAX_STEP_RAD / largest) if largest > _MAX_STEP_RAD else step
