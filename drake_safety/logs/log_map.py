"""LogMap: the schema of a columns.yaml, which maps a log's columns and their units."""

from collections.abc import Sequence
from dataclasses import field
from pathlib import Path
from typing import Any, ClassVar, Literal

from drake_safety.files.schema import Positive, load_typed_file, schema

TimeUnit = Literal["s", "ms", "us", "ns"]
LengthUnit = Literal["m", "mm"]
AngleUnit = Literal["rad", "deg"]
Order = Literal["wxyz", "xyzw"]
Frame = Literal["world", "body"]
TIME_UNITS: dict[TimeUnit, int] = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": 1_000_000_000}
"""Units per second."""
LENGTH_UNITS: dict[LengthUnit, float] = {"m": 1.0, "mm": 1e-3}
ANGLE_UNITS: dict[AngleUnit, float] = {"rad": 1.0, "deg": 0.017453292519943295}
"""Metres and radians per unit; for velocities, per second."""
VELOCITIES = {
    "base_linear_velocity": "base_position",
    "base_angular_velocity": "base_orientation",
    "joint_velocities": "joint_positions",
}
"""Velocities that a log may have, and the positions whose derivatives they are."""
COMMANDS = ("desired_output", "foot_positions")  # Valid until the next value.
ATTACHED_MAP = "columns.yaml"
"""Name of the attachment by which an MCAP file has its own map."""
QUANTITIES = (*VELOCITIES.values(), *VELOCITIES, *COMMANDS)  # Fields of a LogMap with columns.


@schema(kw_only=True)
class LogTime:
    """Time of a row or a message."""

    column: str = ""
    """The column, or the field of every message (``header.stamp``); empty for the recording time
    of messages."""
    unit: TimeUnit = "s"  # Of a number; ignored for ROS stamps, recording times and Parquet dates.


@schema(kw_only=True)
class _Quantity:
    topic: str = ""  # Topic of the messages; empty for a table.
    sign: dict[str, Literal[1, -1]] = field(default_factory=dict)  # Factor by column; 1 by default.
    offset: dict[str, float] = field(default_factory=dict)
    """Added then, by column, in its unit; 0 by default."""


@schema(kw_only=True)
class _Columns(_Quantity):
    """Columns of one quantity."""

    columns: list[str] = field(default_factory=list)
    """Columns, or fields of the messages such as ``pose.pose.position.x``."""
    multiple: ClassVar[int] = 3  # Number of a value's columns.

    def names(self, joints: Sequence[str]) -> list[str]:
        """Returns the columns; a quantity of joints has them in the order of the joints."""
        return self.columns

    def __post_init__(self) -> None:
        if len(self.columns) % self.multiple:
            what = f"got {len(self.columns)}: {self.columns}"
            raise ValueError(f"columns must be {self.multiple} names; {what}")
        if len(set(self.columns)) != len(self.columns):
            raise ValueError(f"columns names a column twice: {self.columns}")


@schema(kw_only=True)
class Position(_Columns):
    """One or several points in the world: x, y, z."""

    unit: LengthUnit = "m"


@schema(kw_only=True)
class Orientation(_Columns):
    """The base's orientation in the world, a quaternion."""

    multiple: ClassVar[int] = 4
    order: Order = "wxyz"  # Order of the columns.


@schema(kw_only=True)
class LinearVelocity(Position):
    """Velocity of the base's origin relative to the world: x, y, z per second."""

    frame: Frame = "world"  # Frame of x, y, z; ``body``: the base's own (as in ROS odometry).


@schema(kw_only=True)
class AngularVelocity(_Columns):
    """Angular velocity of the base relative to the world: x, y, z per second."""

    unit: AngleUnit = "rad"
    frame: Frame = "world"


@schema(kw_only=True)
class Joints(_Quantity):
    """Positions or velocities of all joints."""

    template: str = ""
    """Column of a joint, with ``{joint}`` in place of its name: ``q_{joint}``, or for messages with
    names (sensor_msgs/JointState) ``position[{joint}]``."""
    columns: dict[str, str] = field(default_factory=dict)
    """Columns by joint that differ from the template: ``motor[3].q``, ``position[FR_HFE]``."""
    unit: AngleUnit = "rad"  # rad or deg; for velocities per second.

    def __post_init__(self) -> None:
        if self.template and "{joint}" not in self.template:
            raise ValueError(f"template must contain '{{joint}}'; got '{self.template}'")

    def column(self, joint: str) -> str:
        """Returns the column of a joint; empty if the map has none."""
        return self.columns.get(joint, self.template.replace("{joint}", joint))

    def names(self, joints: Sequence[str]) -> list[str]:
        """Returns the columns of all joints; none if the map has none."""
        is_mapped = self.template or self.columns
        return [self.column(joint) for joint in joints] if is_mapped else []


@schema(kw_only=True)
class LogMap:
    """The schema of a ``columns.yaml``."""

    time: LogTime = field(default_factory=LogTime)
    base_position: Position = field(default_factory=Position)
    base_orientation: Orientation = field(default_factory=Orientation)
    base_linear_velocity: LinearVelocity = field(default_factory=LinearVelocity)
    """Velocity of the base's origin; by default the derivative of its position."""
    base_angular_velocity: AngularVelocity = field(default_factory=AngularVelocity)
    """By default the derivative of the orientation."""
    joint_positions: Joints = field(default_factory=Joints)
    joint_velocities: Joints = field(default_factory=Joints)  # By default derivatives of positions.
    desired_output: Position = field(default_factory=Position)
    """z*, the desired position of the base or the hand. Required for episodes."""
    foot_positions: Position = field(default_factory=Position)
    """Desired centres of the contact spheres, in the order of the ``robot.yaml``; by default from
    the joint positions."""
    max_gap_s: Positive = 0.1  # Largest time between two rows [s].

    def __post_init__(self) -> None:
        for name in ("base_position", "base_orientation"):
            if not getattr(self, name).columns:
                where = "(docs/logs.md, 'Logs without a base position')"
                raise ValueError(f"'{name}.columns' is missing; a state estimator adds it {where}")
        for name in QUANTITIES:
            part, is_one = getattr(self, name), name != "foot_positions"
            if is_one and isinstance(part, _Columns) and len(part.columns) > part.multiple:
                what = f"must be {part.multiple} names; got {len(part.columns)}: {part.columns}"
                raise ValueError(f"'{name}.columns' {what}")
        if not (self.joint_positions.template or self.joint_positions.columns):
            raise ValueError("'joint_positions' needs a 'template', or 'columns' by joint")


def si_units(part: object) -> float:
    """Returns m or rad per unit of a quantity's columns; 1 if it has no unit."""
    units: dict[Any, float] = {**LENGTH_UNITS, **ANGLE_UNITS}
    return units.get(getattr(part, "unit", ""), 1.0)


def load_log_map(path: str | Path) -> LogMap:
    """Reads a ``columns.yaml``."""
    return load_typed_file(LogMap, Path(path), f"map '{path}'")
