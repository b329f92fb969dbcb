"""LogMap: the schema of a columns.yaml, which maps a log's columns and their units."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from drake_safety.robots.robot_model import load_typed_file

TIME_UNITS = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": 1_000_000_000}
"""Units per second."""
LENGTH_UNITS = {"m": 1.0, "mm": 1e-3}
"""Metres per unit; for velocities, per second."""
ANGLE_UNITS = {"rad": 1.0, "deg": 0.017453292519943295}
"""Radians per unit; for rates, per second."""
ORDERS = ("wxyz", "xyzw")
"""Orders of a quaternion's columns."""
FRAMES = ("world", "body")
"""Frames of a velocity of the base."""
_NO_POSITION = (
    ": a log of joints and an inertial measurement unit has none; a state estimator for legged "
    "robots adds it, such as MUSE, Pronto or invariant-ekf (docs/logs.md, 'Logs without a base "
    "position')"
)


@dataclass(kw_only=True)
class LogTime:
    """Time of a row or a message."""

    column: str = ""
    """The column, or the field of every message (``header.stamp``); empty for the recording time
    of messages."""
    unit: str = "s"
    """Unit of a number; ignored for ROS stamps, recording times and dates."""

    def __post_init__(self) -> None:
        _check_one_of("time.unit", self.unit, TIME_UNITS)


@dataclass(kw_only=True)
class _Columns:
    """Columns of one quantity."""

    topic: str = ""
    """Topic of the messages; empty for a table."""
    columns: list[str] = field(default_factory=list)
    """Columns, or fields of the messages such as ``pose.pose.position.x``."""

    def _check(self, multiple: int, **chosen: tuple[str, Iterable[str]]) -> None:
        """Checks the number of columns, and the values of options against known ones."""
        for name, (value, known) in chosen.items():
            _check_one_of(name, value, known)
        if len(self.columns) % multiple:
            raise ValueError(f"'columns' must be {multiple} names; got {self.columns}")
        if len(set(self.columns)) != len(self.columns):
            raise ValueError(f"'columns' names a column twice: {self.columns}")


@dataclass(kw_only=True)
class Position(_Columns):
    """One or several points in the world: x, y, z."""

    unit: str = "m"

    def __post_init__(self) -> None:
        self._check(3, unit=(self.unit, LENGTH_UNITS))


@dataclass(kw_only=True)
class Orientation(_Columns):
    """The base's orientation in the world, a quaternion."""

    order: str = "wxyz"
    """Order of the columns."""

    def __post_init__(self) -> None:
        self._check(4, order=(self.order, ORDERS))


@dataclass(kw_only=True)
class Velocity(_Columns):
    """A linear or angular velocity of the base relative to the world: x, y, z."""

    unit: str = ""
    """m or mm, rad or deg, per second; m and rad by default."""
    frame: str = "world"
    """Frame of x, y, z: ``world`` or ``body``, the base's own (as in ROS odometry)."""

    def __post_init__(self) -> None:
        units = ("", *LENGTH_UNITS, *ANGLE_UNITS)
        self._check(3, unit=(self.unit, units), frame=(self.frame, FRAMES))


@dataclass(kw_only=True)
class Joints:
    """Positions or velocities of all joints."""

    topic: str = ""
    template: str = ""
    """Column of a joint, with ``{joint}`` in place of its name: ``q_{joint}``, or for messages with
    names (sensor_msgs/JointState) ``position[{joint}]``."""
    columns: dict[str, str] = field(default_factory=dict)
    """Columns by joint that differ from the template: ``motor[3].q``, ``position[FR_HFE]``."""
    unit: str = "rad"
    """rad or deg; for velocities per second."""

    def __post_init__(self) -> None:
        _check_one_of("unit", self.unit, ANGLE_UNITS)
        if self.template and "{joint}" not in self.template:
            raise ValueError(f"template must contain '{{joint}}'; got '{self.template}'")

    def column(self, joint: str) -> str:
        """Returns the column of a joint; empty if the map has none."""
        return self.columns.get(joint, self.template.replace("{joint}", joint))


@dataclass(kw_only=True)
class LogMap:
    """The schema of a ``columns.yaml``."""

    time: LogTime = field(default_factory=LogTime)
    base_position: Position = field(default_factory=Position)
    base_orientation: Orientation = field(default_factory=Orientation)
    base_linear_velocity: Velocity = field(default_factory=Velocity)
    """Velocity of the base's origin; by default the derivative of its position."""
    base_angular_velocity: Velocity = field(default_factory=Velocity)
    """By default the derivative of the orientation."""
    joint_positions: Joints = field(default_factory=Joints)
    joint_velocities: Joints = field(default_factory=Joints)
    """By default the derivatives of the positions."""
    desired_output: Position = field(default_factory=Position)
    """z*, the desired position of the base or the hand. Required for episodes."""
    foot_positions: Position = field(default_factory=Position)
    """Desired centres of the contact spheres, in the order of the ``robot.yaml``; by default those
    of the joint positions."""
    max_gap_s: float = 0.1
    """Largest time between two rows [s]."""

    def check(self) -> None:
        """Checks that the map is complete and consistent."""
        for name in ("base_position", "base_orientation"):
            if not getattr(self, name).columns:
                hint = _NO_POSITION if name == "base_position" else ""
                raise ValueError(f"'{name}.columns' is missing{hint}")
        for name in ("base_position", "desired_output"):
            if len(getattr(self, name).columns) not in (0, 3):
                raise ValueError(
                    f"'{name}.columns' must be [x, y, z]; got {getattr(self, name).columns}"
                )
        for name, units in (
            ("base_linear_velocity", LENGTH_UNITS),
            ("base_angular_velocity", ANGLE_UNITS),
        ):
            unit = getattr(self, name).unit
            if unit and unit not in units:
                raise ValueError(f"'{name}.unit' must be one of {list(units)}; got '{unit}'")
        if not (self.joint_positions.template or self.joint_positions.columns):
            raise ValueError("'joint_positions' needs a 'template', or 'columns' by joint")
        if not self.max_gap_s > 0:
            raise ValueError(f"'max_gap_s' must be positive; got {self.max_gap_s}")


def load_log_map(path: str | Path) -> LogMap:
    """Reads a ``columns.yaml``.

    Raises:
        ValueError: The file does not exist or does not fit the schema.
    """
    who = f"map '{path}'"
    log_map = load_typed_file(LogMap, Path(path), who)
    try:
        log_map.check()
    except ValueError as error:
        raise ValueError(f"{who}: {error}") from error
    return log_map


def _check_one_of(name: str, value: str, known: Iterable[str]) -> None:
    known = list(known)
    if value not in known:
        raise ValueError(f"'{name}' must be one of {known}; got '{value}'")
