"""RobotLog: a robot's motion in Drake's order and SI units, read from a log of any format."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.files.schema import load_typed
from drake_safety.logs import checks
from drake_safety.logs.channel import Channel
from drake_safety.logs.conversion import (
    angular_velocities,
    base_rotations,
    base_velocities,
    joint_table,
    points,
    rates,
    rotations_at,
    values_at,
)
from drake_safety.logs.log_map import LogMap, load_log_map
from drake_safety.logs.messages import read_bag, read_mcap
from drake_safety.logs.pieces import cut_channels
from drake_safety.logs.tables import read_csv, read_parquet
from drake_safety.robots.robot_model import RobotModel

FORMATS = (".csv", ".parquet", ".mcap", ".bag")
"""Suffixes of readable files; a folder is a ROS 2 bag."""

_MOST_CUTS = 3  # In a message.
_NUM_LOOKS = 50  # Number of rows at which the slip of the feet is checked.


@dataclass(kw_only=True, eq=False)
class RobotLog:
    """Motion of a robot.

    Attributes:
        time_s: Time since the first row, increasing, (N,) [s].
        q: Positions: base quaternion (w, x, y, z), base position, joints, (N, n_q).
        v: Velocities: of the base in the world, angular first, then of the joints, (N, n_v).
        desired_output: z* in the world, (N, n_z) [m], or None.
        foot_positions: Desired foot positions, (N, 3 n_c) [m], or None.
        piece: Number of this piece of a log that was cut, from 0.
        begin_s: Time of the first row since the log's first row of any topic [s].
    """

    path: Path
    robot: str
    time_s: np.ndarray
    q: np.ndarray
    v: np.ndarray
    desired_output: np.ndarray | None = None
    foot_positions: np.ndarray | None = None
    piece: int = 0
    begin_s: float = 0.0

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last [s]."""
        return float(self.time_s[-1])

    def states_at(self, at_s: np.ndarray) -> np.ndarray:
        """States (M, n_q + n_v) at times (M,) [s]: rotations by slerp, others linearly."""
        rotations = rotations_at(
            self.time_s, Rotation.from_quat(self.q[:, :4], scalar_first=True), at_s
        )
        rest = values_at(self.time_s, np.hstack([self.q[:, 4:], self.v]), at_s)
        return np.hstack([rotations.as_quat(scalar_first=True), rest])


@dataclass(frozen=True, kw_only=True, eq=False)
class LogPieces:
    """What is left of a log that was cut at missing values and gaps.

    Attributes:
        duration_s: Duration of the whole log [s].
    """

    pieces: list[RobotLog]
    duration_s: float
    cuts: list[str]

    @property
    def kept_share(self) -> float:
        """Share of the log's duration that was kept."""
        return sum(piece.duration_s for piece in self.pieces) / self.duration_s


def read_pieces(
    path: str | PathLike[str],
    log_map: LogMap | str | PathLike[str],
    robot: RobotModel,
    *,
    step_s: float | None = None,
) -> LogPieces:
    """Reads a log as :func:`read_log` does, but cuts it where values are missing and at gaps.

    The first piece is checked as a log is, since these checks are about the map: a later one may
    begin in mid-motion, or after a fall.

    Raises:
        ValueError: See :func:`read_log`; or nothing is left.
    """
    path, log_map, kinematics, channels = _opened(path, log_map, robot, step_s)
    found, cuts = cut_channels(channels, log_map.max_gap_s)
    pieces: list[RobotLog] = []
    origin = min(channel.time[0] for channel in channels.values())
    for part in found:
        if len(_times(log_map, part, step_s)) < 2:
            continue
        checks.check_norms(part[log_map.base_orientation.topic], log_map.base_orientation.columns)
        one = _converted(path, log_map, kinematics, part, step_s, is_checked=not pieces)
        before_s = min(channel.seconds_since(origin)[0] for channel in part.values())
        begin_s = float(before_s) + one.begin_s
        pieces.append(replace(one, piece=len(pieces), begin_s=begin_s))
    if not pieces:
        raise ValueError(
            f"log '{path}' has no {checks.MIN_ROWS} rows without a missing value or a gap between "
            f"them: {'; '.join(cuts[:_MOST_CUTS])}"
        )
    begin, end = _common_time(channels)
    return LogPieces(pieces=pieces, duration_s=end - begin, cuts=cuts)


def _times(log_map: LogMap, channels: dict[str, Channel], step_s: float | None) -> np.ndarray:
    """Times of the rows of a converted piece, since the first row of any channel [s]."""
    begin, end = _common_time(channels)
    if step_s is not None:
        return begin + step_s * np.arange(int((end - begin) / step_s + 1e-9) + 1)
    origin = min(channel.time[0] for channel in channels.values())
    base_time = channels[log_map.base_position.topic].seconds_since(origin)
    return base_time[(base_time >= begin) & (base_time <= end)]


def _common_time(channels: dict[str, Channel]) -> tuple[float, float]:
    """First and last time that all channels cover, since the first row of any [s]."""
    origin = min(channel.time[0] for channel in channels.values())
    spans = [channel.seconds_since(origin)[[0, -1]] for channel in channels.values()]
    return float(max(span[0] for span in spans)), float(min(span[1] for span in spans))


def read_log(
    path: str | PathLike[str],
    log_map: LogMap | str | PathLike[str],
    robot: RobotModel,
    *,
    step_s: float | None = None,
) -> RobotLog:
    """Reads, checks and converts a log.

    Args:
        path: A ``.csv``, ``.parquet``, ``.mcap`` or ``.bag`` file, or the folder of a ROS 2 bag.
        log_map: The map of its columns, or the path of a ``columns.yaml``.
        step_s: Time between two rows of the result [s]; by default the times are those of the
            base's positions.

    Raises:
        ValueError: A value is missing or implausible; the message names file, row and column.
    """
    path, log_map, kinematics, channels = _opened(path, log_map, robot, step_s)
    for channel in channels.values():
        checks.check_time(channel, log_map.max_gap_s)
        checks.check_finite(channel)
    orientation = log_map.base_orientation
    checks.check_norms(channels[orientation.topic], orientation.columns)
    return _converted(path, log_map, kinematics, channels, step_s)


def _opened(
    path: str | PathLike[str],
    log_map: LogMap | str | PathLike[str],
    robot: RobotModel,
    step_s: float | None,
) -> tuple[Path, LogMap, RobotKinematics, dict[str, Channel]]:
    path = Path(path)
    if isinstance(log_map, LogMap):  # Its values may have been set since the construction.
        log_map = load_typed(LogMap, asdict(log_map), "map")
    else:
        log_map = load_log_map(Path(log_map))
    if step_s is not None and not step_s > 0:
        raise ValueError(f"read_log: step_s must be positive; got {step_s}")
    kinematics = RobotKinematics(robot)
    return path, log_map, kinematics, _read_channels(path, _wanted(log_map, kinematics), log_map)


def _wanted(log_map: LogMap, kinematics: RobotKinematics) -> dict[str, list[str]]:
    """Names of the mapped columns by topic."""
    wanted: dict[str, list[str]] = {}
    for name in (
        "base_position",
        "base_orientation",
        "base_linear_velocity",
        "base_angular_velocity",
        "desired_output",
        "foot_positions",
    ):
        part = getattr(log_map, name)
        if part.columns:
            wanted.setdefault(part.topic, []).extend(part.columns)
    for name in ("joint_positions", "joint_velocities"):
        part = getattr(log_map, name)
        if not (part.template or part.columns):
            continue
        unknown = [joint for joint in part.columns if joint not in kinematics.joint_names]
        missing = [joint for joint in kinematics.joint_names if not part.column(joint)]
        if unknown or missing:
            raise ValueError(
                f"map: '{name}' must give a column to every joint of robot "
                f"'{kinematics.robot.name}', {kinematics.joint_names}; it has none for {missing}, "
                f"and the robot has no joints {unknown}"
            )
        columns = [part.column(joint) for joint in kinematics.joint_names]
        wanted.setdefault(part.topic, []).extend(columns)
    num_feet = len(log_map.foot_positions.columns)
    if num_feet not in (0, 3 * kinematics.num_contacts):
        raise ValueError(
            f"map: 'foot_positions.columns' must be x, y, z of {kinematics.num_contacts} contact "
            f"points of robot '{kinematics.robot.name}'; got {num_feet} columns"
        )
    return {topic: list(dict.fromkeys(names)) for topic, names in wanted.items()}


def _read_channels(path: Path, wanted: dict[str, list[str]], log_map: LogMap) -> dict[str, Channel]:
    if path.is_dir() and (path / "metadata.yaml").is_file():
        return read_bag(path, wanted, log_map.time)
    if not path.is_file():
        what = "is a folder without the metadata.yaml of a ROS 2 bag"
        raise ValueError(f"log '{path}' {what if path.is_dir() else 'does not exist'}")
    suffix = path.suffix.lower()
    if suffix == ".bag":
        return read_bag(path, wanted, log_map.time)
    if suffix == ".mcap":
        return read_mcap(path, wanted, log_map.time)
    if suffix not in FORMATS:
        raise ValueError(
            f"log '{path}' has the suffix '{suffix}'; known are {list(FORMATS)} and the folder of "
            "a ROS 2 bag"
        )
    topics = [topic for topic in wanted if topic]
    if topics:
        raise ValueError(f"log '{path}' is a table and has no topics; the map names {topics}")
    read = read_csv if suffix == ".csv" else read_parquet
    return {"": read(path, wanted[""], log_map.time)}


def _converted(
    path: Path,
    log_map: LogMap,
    kinematics: RobotKinematics,
    channels: dict[str, Channel],
    step_s: float | None,
    *,
    is_checked: bool = True,
) -> RobotLog:
    origin = min(channel.time[0] for channel in channels.values())
    times = {topic: channel.seconds_since(origin) for topic, channel in channels.items()}
    start, end = _common_time(channels)
    if not end > start:
        spans = {topic: (float(t[0]), float(t[-1])) for topic, t in times.items()}
        raise ValueError(f"log '{path}': its topics do not overlap in time: {spans} [s]")
    base_time = times[log_map.base_position.topic]
    at_s = _times(log_map, channels, step_s)
    if len(at_s) < 2:
        raise ValueError(f"log '{path}': its topics overlap for {end - start:g} s only")
    first_row = int(np.searchsorted(base_time, at_s[0]))
    where = channels[log_map.base_position.topic].where(min(first_row, len(base_time) - 1))

    def positions(read_by: LogMap, at: np.ndarray) -> np.ndarray:
        rotations = base_rotations(read_by, channels)
        rotations = rotations_at(times[read_by.base_orientation.topic], rotations, at)
        base = values_at(base_time, points(read_by.base_position, channels), at)
        table = joint_table(read_by, channels, kinematics.joint_names, "joint_positions")
        joints = values_at(times[read_by.joint_positions.topic], table, at)
        return np.hstack([rotations.as_quat(scalar_first=True), base, joints])

    if is_checked:
        checks.check_first_row(
            kinematics, log_map, lambda read_by: positions(read_by, at_s[:1])[0], where
        )
        some = at_s[:: max(len(at_s) // _NUM_LOOKS, 1)]
        checks.check_stillness(
            kinematics, log_map, lambda read_by: positions(read_by, some), f"{where} and after it"
        )
    q = positions(log_map, at_s)
    v = _velocities(log_map, kinematics, channels, times, at_s, is_checked)
    extra: dict[str, Any] = {}
    for name in ("desired_output", "foot_positions"):
        part = getattr(log_map, name)
        if part.columns:
            extra[name] = values_at(times[part.topic], points(part, channels), at_s)
    if is_checked and "desired_output" in extra:
        unit = log_map.desired_output.unit
        checks.check_desired_output(kinematics, extra["desired_output"][0], q[0, 4:7], where, unit)
    extra |= {"time_s": at_s - at_s[0], "begin_s": float(at_s[0])}
    return RobotLog(path=path, robot=kinematics.robot.name, q=q, v=v, **extra)


def _velocities(
    log_map: LogMap,
    kinematics: RobotKinematics,
    channels: dict[str, Channel],
    times: dict[str, np.ndarray],
    at_s: np.ndarray,
    is_checked: bool,
) -> np.ndarray:
    rotation_time = times[log_map.base_orientation.topic]
    rotations = base_rotations(log_map, channels)
    base_time = times[log_map.base_position.topic]
    joint_map = log_map.joint_positions
    joint_time = times[joint_map.topic]
    joints = joint_table(log_map, channels, kinematics.joint_names, "joint_positions")
    joint_columns = [joint_map.column(joint) for joint in kinematics.joint_names]
    checks.check_limits(kinematics, joints, channels[joint_map.topic], joint_columns)
    parts = []
    for velocity, time, derived in (
        (
            log_map.base_angular_velocity,
            rotation_time,
            angular_velocities(rotation_time, rotations),
        ),
        (
            log_map.base_linear_velocity,
            base_time,
            rates(base_time, points(log_map.base_position, channels)),
        ),
    ):
        if velocity.columns:
            own_time = times[velocity.topic]
            table = base_velocities(
                velocity, channels, rotations_at(rotation_time, rotations, own_time)
            )
            channel = channels[velocity.topic]
            if is_checked:
                checks.check_rates(table, derived, channel, velocity.columns, velocity.unit)
            parts.append(values_at(own_time, table, at_s))
        else:
            parts.append(values_at(time, derived, at_s))
    rate_map = log_map.joint_velocities
    derived = rates(joint_time, joints)
    if rate_map.template or rate_map.columns:
        table = joint_table(log_map, channels, kinematics.joint_names, "joint_velocities")
        columns = [rate_map.column(joint) for joint in kinematics.joint_names]
        if is_checked:
            checks.check_rates(table, derived, channels[rate_map.topic], columns, rate_map.unit)
        parts.append(values_at(times[rate_map.topic], table, at_s))
    else:
        parts.append(values_at(joint_time, derived, at_s))
    return np.hstack(parts)
