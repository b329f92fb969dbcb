"""Plausibility checks of a log; errors name file, row and column."""

from __future__ import annotations

import math

import numpy as np

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.observation import quaternion_of
from drake_safety.logs.channel import Channel
from drake_safety.logs.conversion import Source
from drake_safety.logs.log_map import TIME_UNITS

MIN_ROWS = 3
"""Least number of rows, for derivatives."""
_INTERVALS_S = (1e-4, 0.5)  # Range of the median time between two rows.
_NORM_TOLERANCE = 0.01
_MAX_TILT_RAD = math.radians(60.0)
_FOOT_SHARE = 0.2  # Largest height of the lowest foot, relative to the standing height.
_FAR_RAD = 0.3  # Largest excess over a joint stop by servo errors and encoder offsets.
_REACH_SHARE = 3.0  # Largest distance of z* from the base, relative to the standing height.


def check_clock(channel: Channel) -> None:
    """Checks that time is finite, increasing and in plausible units."""
    time = channel.time
    if len(time) < MIN_ROWS:
        of = f" of topic '{channel.topic}'" if channel.topic else ""
        raise ValueError(
            f"log '{channel.path}'{of} has {len(time)} rows with a value and a time of their own, "
            f"expected at least {MIN_ROWS}"
        )
    if not np.isfinite(time).all():
        row = int(np.argmin(np.isfinite(time)))
        raise ValueError(f"{channel.where(row, channel.time_name)}: the time is {time[row]}")
    step = np.diff(time)
    if not (step > 0).all():
        row = int(np.argmax(step <= 0)) + 1
        how = "runs backwards" if step[row - 1] < 0 else "stands still"
        raise ValueError(
            f"{channel.where(row, channel.time_name)}: time {how}, from {time[row - 1]} to "
            f"{time[row]} {channel.time_unit}"
        )
    usual = float(np.median(step))
    low, high = _INTERVALS_S
    if not low <= usual / TIME_UNITS[channel.time_unit] <= high:
        likely = [unit for unit, n in TIME_UNITS.items() if low <= usual / n <= high]
        raise ValueError(
            f"{channel.where(0, channel.time_name)}: rows are {usual:g} apart, which as "
            f"{channel.time_unit} is implausible; 'time.unit' may rather be one of {likely}"
        )


def check_norms(source: Source) -> None:
    """Checks that quaternions have a norm of 1."""
    names = source.log_map.base_orientation.columns
    norms = np.linalg.norm(source.table("base_orientation"), axis=1)
    is_bad = np.abs(norms - 1.0) > _NORM_TOLERANCE
    if is_bad.any():
        row = int(np.argmax(is_bad))
        raise ValueError(
            f"{source.channels['base_orientation'].where(row)}, columns {names}: the quaternion "
            f"has a norm of {norms[row]:g}, expected 1"
        )


def implausible(kinematics: RobotKinematics, q: np.ndarray) -> str:
    """Returns why a robot at positions (n_q,) does not stand on the ground z = 0, or ""."""
    if beyond := _beyond_stops(kinematics, q[None, 7:]):
        return beyond[2]
    up = quaternion_of(q).rotation()[2, 2]
    tilt = math.acos(min(max(up, -1.0), 1.0))
    if tilt > _MAX_TILT_RAD:
        return f"its base is tilted by {math.degrees(tilt):.0f}° from upright"
    height = float((kinematics.contact_positions(q)[:, 2] - kinematics.foot_radii).min())
    if abs(height) > _FOOT_SHARE * kinematics.standing_height:
        side = "above" if height > 0 else "below"
        return f"its lowest foot is {abs(height):.3g} m {side} the ground"
    return ""


def _beyond_stops(kinematics: RobotKinematics, joints: np.ndarray) -> tuple[int, int, str] | None:
    """The first row of joints (N, n_j) [rad] with one far beyond its stops, and which and where."""
    low, high = kinematics.position_limits.T
    excess = np.maximum(low - joints, joints - high)
    if not (excess > _FAR_RAD).any():
        return None
    row = int(np.argmax((excess > _FAR_RAD).any(axis=1)))
    joint = int(np.argmax(excess[row]))
    text = (
        f"joint '{kinematics.joint_names[joint]}' is at {joints[row, joint]:.3g} rad, far beyond "
        f"its stops {low[joint]:.3g} and {high[joint]:.3g}"
    )
    return row, joint, text


def check_limits(source: Source, kinematics: RobotKinematics) -> None:
    """Checks that joints are not far beyond their stops."""
    if beyond := _beyond_stops(kinematics, source.table("joint_positions")):
        row, joint, text = beyond
        column = source.log_map.joint_positions.column(source.joints[joint])
        raise ValueError(f"{source.channels['joint_positions'].where(row, column)}: {text}")


def check_desired_output(source: Source, kinematics: RobotKinematics) -> None:
    """Checks that the desired output, if there is one, begins near the base."""
    if "desired_output" not in source.channels:
        return
    desired, base = (source.at(n, source.at_s[:1]) for n in ("desired_output", "base_position"))
    distance = float(np.linalg.norm(desired - base))
    if distance > _REACH_SHARE * kinematics.standing_height:
        raise ValueError(
            f"{source.where}: the desired output is {distance:.3g} m from the base of robot "
            f"'{kinematics.robot.name}': check its frame and its unit, "
            f"{source.log_map.desired_output.unit}"
        )
