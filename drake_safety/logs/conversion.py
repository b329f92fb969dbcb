"""Conversion of a log's columns to positions and velocities in Drake's order and SI units."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from drake_safety.logs.channel import Channel
from drake_safety.logs.log_map import VELOCITIES, LogMap, si_units


@dataclass(frozen=True, kw_only=True, eq=False)
class Source:
    """The quantities of a piece of a log in SI units, at their own rows and at any time."""

    log_map: LogMap
    joints: list[str]  # In the robot's order.
    channels: Mapping[str, Channel]  # By field of the map.

    @cached_property
    def at_s(self) -> np.ndarray:
        """Times of the base's positions [s] that all quantities cover."""
        begin, end = common_span(self.channels.values())
        base_s = self.channels["base_position"].time_s
        return base_s[(base_s >= begin) & (base_s <= end)]

    @property
    def where(self) -> str:
        """The location of the first converted row."""
        base = self.channels["base_position"]
        return base.where(int(np.searchsorted(base.time_s, self.at_s[0])))

    def table(self, name: str) -> np.ndarray:
        """Returns a quantity's columns in the unit m or rad, per second, (N, n)."""
        part = getattr(self.log_map, name)
        values = self.channels[name].frame[columns := part.names(self.joints)].to_numpy()
        signs, offsets = [part.sign.get(name, 1) for name in columns], part.offset
        return si_units(part) * (signs * values + [offsets.get(name, 0) for name in columns])

    def at(self, name: str, at_s: np.ndarray) -> np.ndarray:
        """Returns a quantity's columns at times (M,) [s], linearly, (M, n)."""
        return values_at(self.channels[name].time_s, self.table(name), at_s)

    @cached_property
    def rotations(self) -> Rotation:
        """Orientations of the base, (N,)."""
        is_first = self.log_map.base_orientation.order == "wxyz"
        return Rotation.from_quat(self.table("base_orientation"), scalar_first=is_first)

    def rotations_at(self, at_s: np.ndarray) -> Rotation:
        """Returns the orientations of the base at times (M,) [s]."""
        return rotations_at(self.channels["base_orientation"].time_s, self.rotations, at_s)

    def positions(self, at_s: np.ndarray) -> np.ndarray:
        """Returns positions in Drake's order at times (M,) [s], (M, n_q)."""
        quaternions = self.rotations_at(at_s).as_quat(scalar_first=True)
        names = ("base_position", "joint_positions")
        return np.hstack([quaternions, *(self.at(name, at_s) for name in names)])

    def velocities(self, at_s: np.ndarray) -> np.ndarray:
        """Returns velocities in Drake's order at times (M,) [s], (M, n_v): logged, or derived."""
        parts = []
        for name in ("base_angular_velocity", "base_linear_velocity", "joint_velocities"):
            source = name if name in self.channels else VELOCITIES[name]
            time_s, table = self.channels[source].time_s, self.table(source)
            if source == "base_orientation":
                table = angular_velocities(time_s, self.rotations)
            elif source != name:
                table = rates(time_s, table)
            elif getattr(getattr(self.log_map, name), "frame", "world") == "body":
                table = self.rotations_at(time_s).apply(table)
            parts.append(values_at(time_s, table, at_s))
        return np.hstack(parts)


def common_span(channels: Iterable[Channel]) -> tuple[float, float]:
    """First and last time that all channels cover [s]."""
    spans = [channel.time_s[[0, -1]] for channel in channels]
    return float(max(span[0] for span in spans)), float(min(span[1] for span in spans))


def rotations_at(time_s: np.ndarray, rotations: Rotation, at_s: np.ndarray) -> Rotation:
    """Rotations at times (M,) [s], clipped to the range of the increasing times (N,), by slerp."""
    return Slerp(time_s, rotations)(np.clip(at_s, time_s[0], time_s[-1]))


def values_at(time_s: np.ndarray, values: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """Columns (N, n) at times (M,) [s], clipped to the range of the times (N,), linearly."""
    return np.stack([np.interp(at_s, time_s, column) for column in values.T], axis=1)


def rates(time_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Differentiates columns (N, n) of at least three rows, exactly for parabolas, [1/s]."""
    return np.gradient(values, time_s, axis=0, edge_order=2)


def angular_velocities(time_s: np.ndarray, rotations: Rotation) -> np.ndarray:
    """Angular velocities (N, 3) in the world [rad/s] of rotations, exact where they are linear."""
    step_s = np.diff(time_s)[:, None]
    between = (rotations[1:] * rotations[:-1].inv()).as_rotvec() / step_s
    slope = np.diff(between, axis=0) / (step_s[:-1] + step_s[1:])
    inner = between[:-1] + slope * step_s[:-1]
    ends = between[0] - slope[0] * step_s[0], between[-1] + slope[-1] * step_s[-1]
    return np.vstack([ends[0], inner, ends[1]])
