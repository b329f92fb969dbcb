"""Conversion of a log's columns to positions and velocities in Drake's order and SI units."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from drake_safety.logs.channel import Channel
from drake_safety.logs.log_map import ANGLE_UNITS, LENGTH_UNITS, LogMap, Position, Velocity


def points(position: Position, channels: Mapping[str, Channel]) -> np.ndarray:
    """Returns points in the world at their topic's times, (N, 3 n) [m]."""
    table = channels[position.topic].table(position.columns)
    return LENGTH_UNITS[position.unit] * table


def base_rotations(log_map: LogMap, channels: Mapping[str, Channel]) -> Rotation:
    """Returns orientations of the base at their topic's times, (N,)."""
    orientation = log_map.base_orientation
    table = channels[orientation.topic].table(orientation.columns)
    return Rotation.from_quat(table, scalar_first=orientation.order == "wxyz")


def joint_table(
    log_map: LogMap, channels: Mapping[str, Channel], joints: list[str], name: str
) -> np.ndarray:
    """Returns joint positions or velocities in the robot's order, (N, n_j) [rad, rad/s]."""
    mapped = getattr(log_map, name)
    table = channels[mapped.topic].table([mapped.column(joint) for joint in joints])
    return ANGLE_UNITS[mapped.unit] * table


def base_velocities(
    velocity: Velocity, channels: Mapping[str, Channel], rotations: Rotation
) -> np.ndarray:
    """Returns a velocity of the base along the world's axes, (N, 3) [m/s or rad/s]."""
    units = LENGTH_UNITS | ANGLE_UNITS
    table = units[velocity.unit] * channels[velocity.topic].table(velocity.columns)
    return table if velocity.frame == "world" else rotations.apply(table)


def rotations_at(time_s: np.ndarray, rotations: Rotation, at_s: np.ndarray) -> Rotation:
    """Rotations at times (M,) [s], clipped to the range of the increasing times (N,), by slerp."""
    if len(time_s) == 1:
        return rotations[np.zeros(len(at_s), dtype=int)]
    return Slerp(time_s, rotations)(np.clip(at_s, time_s[0], time_s[-1]))


def values_at(time_s: np.ndarray, values: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """Columns (N, n) at times (M,) [s], clipped to the range of the times (N,), linearly."""
    return np.stack([np.interp(at_s, time_s, column) for column in values.T], axis=1)


def rates(time_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Differentiates columns (N, n) of at least three rows, exactly for parabolas, [1/s]."""
    return np.gradient(values, time_s, axis=0, edge_order=2)


def angular_velocities(time_s: np.ndarray, rotations: Rotation) -> np.ndarray:
    """Differentiates at least three rotations to angular velocities in the world, (N, 3) [rad/s].

    Each is a weighted mean of the finite differences before and after the row, exact for linearly
    changing angular velocities.
    """
    step_s = np.diff(time_s)[:, None]
    between = (rotations[1:] * rotations[:-1].inv()).as_rotvec() / step_s
    slope = np.diff(between, axis=0) / (step_s[:-1] + step_s[1:])
    inner = between[:-1] + slope * step_s[:-1]
    first = between[0] - slope[0] * step_s[0]
    last = between[-1] + slope[-1] * step_s[-1]
    return np.vstack([first, inner, last])
