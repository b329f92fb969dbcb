"""RobotLog: a robot's motion in Drake's order and SI units, read from a log of any format."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.extras import require_extra
from drake_safety.logs.channel import Wanted
from drake_safety.logs.checks import check
from drake_safety.logs.conversion import Source, common_span, rotations_at, values_at
from drake_safety.logs.log_map import COMMANDS, QUANTITIES, TIME_UNITS, Joints, LogMap, load_log_map
from drake_safety.logs.messages import attached_map, read_messages
from drake_safety.logs.quantities import MIN_ROWS, continued, cut, in_order, quantities
from drake_safety.logs.tables import read_csv, read_parquet
from drake_safety.robots.robot_model import RobotModel

_READERS = {".csv": read_csv, ".tsv": read_csv, ".parquet": read_parquet}
_READERS |= {".mcap": read_messages, ".bag": read_messages}
FORMATS = tuple(_READERS)  # Suffixes of files; a folder is a ROS 2 bag.
_MOST_CUTS = 3  # In a message.


@dataclass(kw_only=True, eq=False)
class RobotLog:
    """Motion of a robot."""

    path: Path
    robot: str
    time_s: np.ndarray  # Since the first row, increasing, (N,) [s].
    q: np.ndarray  # Base quaternion (w, x, y, z), base position, joints, (N, n_q).
    v: np.ndarray  # Base velocity in the world, angular first, then joints, (N, n_v).
    desired_output: np.ndarray | None = None  # z* in the world, (N, n_z) [m].
    foot_positions: np.ndarray | None = None  # Desired, (N, 3 n_c) [m].
    piece: int = 0  # Number of this piece of a cut log, from 0, again where time begins anew.
    begin_s: float = 0.0  # Time of the first row since the log's first row of any topic.

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last [s]."""
        return float(self.time_s[-1])

    def states_at(self, at_s: np.ndarray) -> np.ndarray:
        """States (M, n_q + n_v) at times (M,) [s]: rotations by slerp, others linearly."""
        quaternions = Rotation.from_quat(self.q[:, :4], scalar_first=True)
        rotations = rotations_at(self.time_s, quaternions, at_s)
        rest = values_at(self.time_s, np.hstack([self.q[:, 4:], self.v]), at_s)
        return np.hstack([rotations.as_quat(scalar_first=True), rest])


@dataclass(frozen=True, kw_only=True, eq=False)
class LogPieces:
    """Pieces of a log, cut at missing values and gaps."""

    pieces: list[RobotLog]
    duration_s: float  # Duration of the whole log.
    lost: list[str]  # Each cut or omission, and its place.
    notes: list[str]  # Each resampled or differentiated quantity.

    @property
    def cuts(self) -> list[str]:
        """Each cut, omission and resampling, and its place."""
        return self.lost + self.notes

    @property
    def kept_share(self) -> float:
        """Share of the log's duration that was kept."""
        return sum(piece.duration_s for piece in self.pieces) / self.duration_s

    def summary(self) -> str:
        """How much of the log is kept, and the first cuts; "" if it is read as it is."""
        if not self.cuts:
            return ""
        num_more = len(self.cuts) - _MOST_CUTS
        more = [f"... and {num_more} more"] if num_more > 0 else []
        kept = f"{100 * self.kept_share:.1f} % of {self.duration_s:.1f} s are kept"
        head = f"log '{self.pieces[0].path}': {kept}, in {len(self.pieces)} pieces"
        return "\n".join([head, *self.cuts[:_MOST_CUTS], *more])


def read_pieces(path: str | Path, map_file: str | Path | None, robot: RobotModel) -> LogPieces:
    """Reads, checks and converts a log, cut where values are missing and at gaps.

    Args:
        path: A ``.csv``, ``.tsv``, ``.parquet``, ``.mcap`` or ``.bag`` file, or the folder of a
            ROS 2 bag.
        map_file: The ``columns.yaml`` that names its columns; None for that in an MCAP file, by
            which nothing is checked.
    """
    path = Path(path)
    kinematics = RobotKinematics(robot)
    joints = kinematics.joint_names
    require_extra("logs", f"log '{path}'", "pandas")
    if not path.exists():
        raise ValueError(f"log '{path}' does not exist")
    suffix = ".bag" if path.is_dir() else path.suffix.lower()
    if suffix not in _READERS:
        known = f"{list(FORMATS)} and the folder of a ROS 2 bag"
        raise ValueError(f"log '{path}' has the suffix '{suffix}'; known are {known}")
    log_map = attached_map(path) if map_file is None else load_log_map(map_file)
    topics = _READERS[suffix](path, _wanted(log_map, kinematics), log_map.time)
    lost, restarts = list[str](), dict[str, float]()
    for topic, channel in topics.items():
        if len(topics) == 1:  # Else all topics would have to begin anew together.
            channel, restarts = continued(channel, log_map.max_gap_s)
        topics[topic], joined = in_order(channel, log_map.max_gap_s)
        lost += joined
    origin = min((channel.time[0] for channel in topics.values() if len(channel.time)), default=0)
    topics = {topic: replace(channel, origin=origin) for topic, channel in topics.items()}
    channels, log_map, notes = quantities(topics, log_map, joints)
    parts, reasons = cut(channels, log_map.max_gap_s)
    lost += [f"{where}: time begins anew, with another log" for where in restarts]
    lost += [reason for reason in reasons if not reason.startswith(tuple(restarts))]
    sources = [Source(log_map=log_map, joints=joints, channels=part) for part in parts]
    sources = [source for source in sources if len(source.at_s) > 1]
    measured = {getattr(log_map, name).topic for name in channels if name not in COMMANDS}
    begin, end = common_span(topics[topic] for topic in measured)
    if not sources:
        why = "; ".join(lost[:_MOST_CUTS])
        if end <= begin:
            spans = {topic: topics[topic].time_s[[0, -1]].tolist() for topic in sorted(measured)}
            why = f"its topics do not overlap: {spans}"
        what = f"has no {MIN_ROWS} rows without a missing value or a gap between them"
        raise ValueError(f"log '{path}' {what}: {why}")
    if map_file is not None:  # A file's own map was written with it.
        notes += check(sources, kinematics)
    unit = TIME_UNITS[next(iter(topics.values())).time_unit]
    begins = (np.array([*restarts.values()]) - origin) / unit
    logs = np.searchsorted(begins, [source.at_s[0] for source in sources], "right")
    pieces = [
        RobotLog(
            path=path,
            robot=robot.name,
            time_s=source.at_s - source.at_s[0],
            q=source.positions(source.at_s),
            v=source.velocities(source.at_s),
            piece=i - int(np.searchsorted(logs, logs[i])),
            begin_s=float(source.at_s[0]),
            **{name: source.at(name, source.at_s) for name in COMMANDS if name in source.channels},
        )
        for i, source in enumerate(sources)
    ]
    duration_s = end - begin - 2 * log_map.max_gap_s * len(restarts)
    return LogPieces(pieces=pieces, duration_s=duration_s, lost=lost, notes=notes)


def read_log(path: str | Path, map_file: str | Path | None, robot: RobotModel) -> RobotLog:
    """Reads a log as :func:`read_pieces` does, but refuses one of which something is lost."""
    pieces = read_pieces(path, map_file, robot)
    if pieces.lost:
        raise ValueError(f"{pieces.lost[0]}, expected a log of which nothing is lost")
    return pieces.pieces[0]


def _wanted(log_map: LogMap, kinematics: RobotKinematics) -> Wanted:
    """Names of the mapped columns by topic."""
    wanted: dict[str, list[str]] = {}
    joints = kinematics.joint_names
    for name in QUANTITIES:
        part = getattr(log_map, name)
        columns = part.names(joints)
        if columns and isinstance(part, Joints):
            unknown = [joint for joint in part.columns if joint not in joints]
            missing = [joint for joint, column in zip(joints, columns, strict=True) if not column]
            if unknown or missing:
                what = f"it has none for {missing}, and the robot has no joints {unknown}"
                raise ValueError(f"map: '{name}' must give a column to every joint; {what}")
        count = 3 * kinematics.num_contacts
        if name == "foot_positions" and len(columns) not in (0, count):
            raise ValueError(f"map: '{name}.columns' must be {count}, x, y, z of every contact")
        if others := [other for other in (*part.sign, *part.offset) if other not in columns]:
            what = f"are by column, of {columns}; got {others}"
            raise ValueError(f"map: 'sign' and 'offset' of '{name}' {what}")
        if columns:
            wanted.setdefault(part.topic, []).extend(columns)
    return {topic: list(dict.fromkeys(names)) for topic, names in wanted.items()}
