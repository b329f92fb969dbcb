"""LogMap: the schema of a columns.yaml, which says where a log keeps what, and in which units."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from drake_safety.robots.robot_model import load_typed_file

TIME_UNITS = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": 1_000_000_000}
"""How many of each are a second."""
LENGTH_UNITS = {"m": 1.0, "mm": 1e-3}
"""Metres of each; for a velocity, per second."""
ANGLE_UNITS = {"rad": 1.0, "deg": 0.017453292519943295}
"""Radians of each; for a rate, per second."""
ORDERS = ("wxyz", "xyzw")
"""Orders of a quaternion's four columns."""
FRAMES = ("world", "body")
"""Frames that a velocity of the base may be given in."""


@dataclass(kw_only=True)
class LogTime:
    """When a row, or a message, was."""

    column: str = ""
    """The column, or the field of every message (``header.stamp``); empty for the time at which
    the messages were recorded."""
    unit: str = "s"
    """Of a number; a ROS stamp, a recording time and a column of dates need none."""

    def __post_init__(self) -> None:
        _check_one_of("time.unit", self.unit, TIME_UNITS)


@dataclass(kw_only=True)
class _Columns:
    """Where numbers are that belong together."""

    topic: str = ""
    """Of the messages; empty for a table."""
    columns: list[str] = field(default_factory=list)
    """Columns, or fields of the messages such as ``pose.pose.position.x``."""

    def _check(self, multiple: int, **chosen: tuple[str, Iterable[str]]) -> None:
        """Refuses a number of columns, or a choice, given with what there is to choose from."""
        for name, (value, known) in chosen.items():
            _check_one_of(name, value, known)
        if len(self.columns) % multiple:
            raise ValueError(f"'columns' must be {multiple} names; got {self.columns}")
        if len(set(self.columns)) != len(self.columns):
            raise ValueError(f"'columns' names a column twice: {self.columns}")


@dataclass(kw_only=True)
class Position(_Columns):
    """A point, or several one after the other, in the world: x, y, z."""

    unit: str = "m"

    def __post_init__(self) -> None:
        self._check(3, unit=(self.unit, LENGTH_UNITS))


@dataclass(kw_only=True)
class Orientation(_Columns):
    """The base's orientation in the world, a quaternion."""

    order: str = "wxyz"
    """Of the columns."""

    def __post_init__(self) -> None:
        self._check(4, order=(self.order, ORDERS))


@dataclass(kw_only=True)
class Velocity(_Columns):
    """A linear or angular velocity of the base relative to the world: x, y, z."""

    unit: str = ""
    """m or mm, rad or deg, per second; m and rad by default."""
    frame: str = "world"
    """Whose axes x, y, z are: ``world`` or ``body``, the base's own (as in ROS odometry)."""

    def __post_init__(self) -> None:
        units = ("", *LENGTH_UNITS, *ANGLE_UNITS)
        self._check(3, unit=(self.unit, units), frame=(self.frame, FRAMES))


@dataclass(kw_only=True)
class Joints:
    """Positions or velocities of all joints."""

    topic: str = ""
    template: str = ""
    """Column of every joint, its name in the place of ``{joint}``: ``q_{joint}``, or of messages
    with names (sensor_msgs/JointState) ``position[{joint}]``."""
    columns: dict[str, str] = field(default_factory=dict)
    """By joint, where the template does not hold: ``motor[3].q``, ``position[FR_HFE]``."""
    unit: str = "rad"
    """rad or deg; for velocities per second."""

    def __post_init__(self) -> None:
        _check_one_of("unit", self.unit, ANGLE_UNITS)
        if self.template and "{joint}" not in self.template:
            raise ValueError(f"template must hold '{{joint}}'; got '{self.template}'")

    def column(self, joint: str) -> str:
        """The column of a joint; empty when the map has none."""
        return self.columns.get(joint, self.template.replace("{joint}", joint))


@dataclass(kw_only=True)
class LogMap:
    """What a ``columns.yaml`` holds."""

    time: LogTime = field(default_factory=LogTime)
    base_position: Position = field(default_factory=Position)
    base_orientation: Orientation = field(default_factory=Orientation)
    base_linear_velocity: Velocity = field(default_factory=Velocity)
    """Of the base's origin; the derivative of its position if left out."""
    base_angular_velocity: Velocity = field(default_factory=Velocity)
    """The derivative of the orientation if left out."""
    joint_positions: Joints = field(default_factory=Joints)
    joint_velocities: Joints = field(default_factory=Joints)
    """The derivatives of the positions if left out."""
    desired_output: Position = field(default_factory=Position)
    """z*: where the base, or the hand, is to be. An episode needs it."""
    foot_positions: Position = field(default_factory=Position)
    """Where the controller wants the feet: centres of the contact spheres, in the order of the
    ``robot.yaml``. Where the joints have them if left out."""
    max_gap_s: float = 0.1
    """Longest time between two rows that is bridged [s]."""

    def check(self) -> None:
        """Refuses a map that is not complete, or contradicts itself.

        Raises:
            ValueError: Names the part.
        """
        for name in ("base_position", "base_orientation"):
            if not getattr(self, name).columns:
                raise ValueError(f"'{name}.columns' is missing: a log without it says nothing")
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

    Args:
        path: The file.

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
