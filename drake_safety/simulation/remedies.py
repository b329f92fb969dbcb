"""Remedies with values to try, for what `check` finds in a scenario or robot.yaml."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from drake_safety.control.kinematics import RobotKinematics

_SPREADS = ("velocity_std_m_s", "angular_velocity_std_rad_s", "base_offset_m", "target_offset_m")
"""Parameters under ``start`` that widen or narrow the initial states and plans of a task."""
_ROOM_RAD = 0.05  # Distance from a joint stop.
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
    entries = []
    for name in names:
        index = kinematics.joint_names.index(name)
        low, high = kinematics.position_limits[index]
        room = min(_ROOM_RAD, 0.1 * (high - low))
        value = float(np.clip(kinematics.posture[index], low + room, high - room))
        entries.append(f"{name}: {value:.3g}")
    return f"under 'posture' in robot.yaml write {', '.join(entries)} [rad]"


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


def _text(values: np.ndarray) -> str:
    if values.ndim == 0:
        return f"{values:.3g}"
    return "[" + ", ".join(f"{value:.3g}" for value in values.tolist()) + "]"
