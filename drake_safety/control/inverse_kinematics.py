"""From a base pose and foot positions to joint positions, for legs of any shape."""

from __future__ import annotations

import numpy as np
from pydrake.math import RigidTransform

from drake_safety.control.kinematics import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    RobotKinematics,
)

_TOLERANCE_M = 1e-4
_DAMPING = 1e-8  # [m²/rad²]: keeps a stretched leg's step finite.
_MAX_STEP_RAD = 0.5  # in one iteration.


def solve_inverse_kinematics(
    kinematics: RobotKinematics,
    X_WB: RigidTransform,
    p_WC: np.ndarray,
    guess: np.ndarray,
    *,
    max_iterations: int = 20,
    tolerance_m: float = _TOLERANCE_M,
) -> np.ndarray:
    """Joint positions that put every contact point where it is wanted, base pose given.

    Damped Gauss-Newton, started from ``guess``: from the last tick's
    answer one step suffices. A target out of reach ends at the nearest reachable point. Joints
    that belong to no leg keep the guess, and every joint stays inside its limits.

    Args:
        kinematics: The robot.
        X_WB: Base pose.
        p_WC: Wanted positions of the contact spheres' centres, (n_c, 3) [m].
        guess: Joint positions to start from, (n_j,) [rad].
        max_iterations: Bound on the Newton steps.
        tolerance_m: Largest error of a contact point's coordinate at which the search ends [m].

    Returns:
        Joint positions (n_j,) [rad].
    """
    lowest, highest = kinematics.position_limits.T
    q = kinematics.positions_at(X_WB, guess)
    joints = np.minimum(np.maximum(guess, lowest), highest)
    for _ in range(max_iterations):
        q[NUM_BASE_POSITIONS:] = joints
        error = (p_WC - kinematics.contact_positions(q)).ravel()
        if max(error.max(), -error.min()) < tolerance_m:
            break
        # Columns of joints that move no foot are zero: the damping leaves those joints alone.
        J = kinematics.contact_jacobian(q)[:, NUM_BASE_VELOCITIES:]
        step = _damped_step(J, error)
        moved = np.minimum(np.maximum(joints + step, lowest), highest)
        is_blocked = (moved == joints) & (step != 0)
        if is_blocked.any():
            # Joints pushed against a limit give no help: the others must do without them.
            J[:, is_blocked] = 0.0
            moved = np.minimum(np.maximum(joints + _damped_step(J, error), lowest), highest)
        joints = moved
    return joints


def _damped_step(J: np.ndarray, error: np.ndarray) -> np.ndarray:
    gram = J.T @ J
    gram.flat[:: len(gram) + 1] += _DAMPING
    step = np.linalg.solve(gram, J.T @ error)
    largest = max(step.max(), -step.min())
    return step * (_MAX_STEP_RAD / largest) if largest > _MAX_STEP_RAD else step
