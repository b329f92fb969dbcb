"""Remedies with values to try, for what `check` finds in a scenario or robot.yaml."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from drake_safety.control.inverse_kinematics import solve_inverse_kinematics
from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.safe_sets import convex_hull, signed_distance_to_polygon

LEVEL_M = 2e-3
"""Largest difference of the feet's heights [m]."""

_SPREADS = ("velocity_std_m_s", "angular_velocity_std_rad_s", "base_offset_m", "target_offset_m")
"""Parameters under ``start`` that widen or narrow the initial states and plans of a task."""
_ROOM_RAD = 0.05  # Distance from a joint stop.
_MISSED_M = 0.01  # Largest distance of a foot from where it shall be.
_SAME_RAD = 1e-3  # Smaller changes are none.
_RAISED = (0.05, 0.1, 0.2)  # Higher grounds to try, in standing heights.
_NUDGES_RAD = (0.0, 0.2, -0.2)  # Guesses beside the posture: straight legs stay straight.
_NUM_SHIFTS = 3  # Of the feet under the centre of mass, which moves with the legs.
_EFFORT = 4.0  # Largest torque over mass times height [m/s²], as `new` estimates it.


def scaled_start(parameters: Any, factor: float) -> str:
    """Entries under ``start`` of a task's parameters, scaled; "" if it has none of them.

    Args:
        parameters: The task's parameters.
        factor: Above 1 for more unsafe episodes.
    """
    start = getattr(parameters, "start", None)
    entries = []
    for name in _SPREADS:
        value = getattr(start, name, None)
        if value is not None and np.any(value):
            scaled = np.array(value, dtype=float) * factor
            entries.append(f"{name}: {_text(scaled)}")
    return f"; try under 'start': {', '.join(entries)}" if entries else ""


def within_stops(kinematics: RobotKinematics, names: Iterable[str]) -> str:
    """Entries of ``posture`` for joints that are beyond their stops, just within them [rad]."""
    joints = kinematics.posture.copy()
    for name in names:
        index = kinematics.joint_names.index(name)
        low, high = kinematics.position_limits[index]
        room = min(_ROOM_RAD, 0.1 * (high - low))
        joints[index] = np.clip(joints[index], low + room, high - room)
    return _posture_entries(kinematics, np.round(joints, 4))


def level_feet(kinematics: RobotKinematics) -> str:
    """Entries of ``posture`` that put all feet on one ground [rad], for as few joints as possible.

    Returns:
        The remedy; without values if inverse kinematics finds no such posture within the stops.
    """
    joints = _solved(kinematics, np.zeros(2))
    if joints is None:
        return (
            "no posture was found within the joint stops with all feet on one ground: correct "
            "their 'contact_points' and 'radius_m' under 'feet' in robot.yaml [m]"
        )
    return f"{_posture_entries(kinematics, joints)}, or correct the feet's 'contact_points' [m]"


def feet_below(kinematics: RobotKinematics, p_W: np.ndarray) -> str:
    """Entries of ``posture`` that move the feet under centre of mass and base [rad].

    Args:
        kinematics: The robot.
        p_W: The point that the feet do not surround, (2,) or (3,) [m].

    Returns:
        The remedy; without values if inverse kinematics finds no such posture within the stops.
    """
    q = kinematics.standing_positions()
    centre = np.mean(_polygon(kinematics, q), axis=0)

    def surrounds(q: np.ndarray) -> bool:
        corners, inner = _polygon(kinematics, q), (kinematics.center_of_mass(q)[:2], q[4:6])
        return all(signed_distance_to_polygon(point, corners) > 0 for point in inner)

    present = q
    for _ in range(_NUM_SHIFTS):
        shift = 0.5 * (kinematics.center_of_mass(present)[:2] + q[4:6]) - centre
        joints = _solved(kinematics, shift)
        if joints is None:
            break
        present = kinematics.positions_at(RigidTransform(q[4:7]), joints)
        if surrounds(present):
            return (
                f"{_posture_entries(kinematics, joints)}, which moves the feet by {_metres(shift)}"
                " in x and y, or correct their 'contact_points' [m]"
            )
    return (
        f"it is at {_metres(p_W[:2] - centre)} in x and y from the centre of the feet, and no "
        "posture was found within the joint stops whose feet surround it: correct their "
        "'contact_points' under 'feet' in robot.yaml [m], or the masses in the URDF [kg]"
    )


def effort_limits(kinematics: RobotKinematics, names: Iterable[str]) -> str:
    """Entries of ``effort_limits``, estimated from mass and height as `new` does [N·m]."""
    effort = _EFFORT * kinematics.total_mass * kinematics.standing_height
    entries = ", ".join(f"{name}: {effort:.3g}" for name in names)
    return f"under 'effort_limits' in robot.yaml write {entries} [N·m], or the maker's"


def scaled_gains(gains: Mapping[str, Any], factor: float) -> str:
    """Entries of ``joint_gains`` with scaled stiffness, and damping by its root."""
    entries = ", ".join(
        f"{pattern}: {{stiffness: {factor * one.stiffness:.3g}, "
        f"damping: {factor**0.5 * one.damping:.3g}}}"
        for pattern, one in list(gains.items())[:2]
    )
    return f"'joint_gains', such as {entries}" if entries else "'joint_gains'"


def _polygon(kinematics: RobotKinematics, q: np.ndarray) -> list[tuple[float, float]]:
    return convex_hull(kinematics.contact_positions(q)[:, :2].tolist())


def _solved(kinematics: RobotKinematics, shift_m: np.ndarray) -> np.ndarray | None:
    """Joint positions (n_j,) [rad] with all feet on one ground, shifted by (2,) [m] below the base.

    Of several grounds, the one for which the fewest joints move; None if the feet reach none.
    """
    q = kinematics.standing_positions()
    X_WB = RigidTransform(q[4:7])
    present = kinematics.contact_positions(q)
    heights = present[:, 2] - kinematics.foot_radii
    grounds = [heights[points].min() for points in kinematics.foot_slices]
    grounds += [max(grounds) + share * kinematics.standing_height for share in _RAISED]
    # Rounded as they are printed, inwards at the stops.
    low, high = kinematics.position_limits.T
    low, high = np.ceil(1e4 * low) / 1e4, np.floor(1e4 * high) / 1e4
    found: list[np.ndarray] = []
    for ground in grounds:
        p_WC = present.copy()
        p_WC[:, :2] += shift_m
        p_WC[:, 2] = ground + kinematics.foot_radii
        for nudge in _NUDGES_RAD:
            guess = kinematics.posture + nudge
            joints = solve_inverse_kinematics(kinematics, X_WB, p_WC, guess, max_iterations=60)
            joints = np.clip(np.round(joints, 4), low, high)
            reached = kinematics.contact_positions(kinematics.positions_at(X_WB, joints))
            is_level = np.ptp(reached[:, 2] - kinematics.foot_radii) < 0.5 * LEVEL_M
            # The points of a tilted foot come apart in x and y as it is levelled, not its centre.
            missed = [(reached - p_WC)[points].mean(axis=0) for points in kinematics.foot_slices]
            if is_level and np.abs(missed).max() < _MISSED_M:
                found.append(joints)
                break

    def change(joints: np.ndarray) -> tuple[int, float]:
        return len(_moved(kinematics, joints)), float(np.abs(joints - kinematics.posture).sum())

    return min(found, key=change, default=None)


def _moved(kinematics: RobotKinematics, joints: np.ndarray) -> list[str]:
    is_moved = np.abs(joints - kinematics.posture) > _SAME_RAD
    return [name for name, moved in zip(kinematics.joint_names, is_moved, strict=True) if moved]


def _posture_entries(kinematics: RobotKinematics, joints: np.ndarray) -> str:
    """What to write for joint positions (n_j,) [rad] that differ from the posture."""
    moved, names = _moved(kinematics, joints), kinematics.joint_names

    def covered(pattern: str) -> set[str]:
        return {name for name in names if re.fullmatch(pattern, name)}

    # A joint may not match two patterns: one that covers others too is replaced for all of them.
    patterns = [key for key in kinematics.robot.posture if covered(key) & set(moved) - {key}]
    written = set(moved).union(*map(covered, patterns))
    entries = ", ".join(
        f"{name}: {value:g}"
        for name, value in zip(names, joints.tolist(), strict=True)
        if name in written
    )
    instead = f" in place of {patterns}" if patterns else ""
    return f"under 'posture' in robot.yaml write {entries} [rad]{instead}"


def _metres(offset: np.ndarray) -> str:
    return f"({offset[0]:+.3f}, {offset[1]:+.3f}) m"


def _text(values: np.ndarray) -> str:
    if values.ndim == 0:
        return f"{values:.3g}"
    return "[" + ", ".join(f"{value:.3g}" for value in values.tolist()) + "]"
