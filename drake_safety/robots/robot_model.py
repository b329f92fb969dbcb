"""A robot as data: the schema of ``robot.yaml`` and how it is read."""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import numpy as np
import yaml
from pydrake.common.yaml import yaml_load_typed

_Value = TypeVar("_Value")


@dataclass(kw_only=True)
class Foot:
    """One foot: the points that touch the ground, and the joints of its leg."""

    body: str = ""
    """Body that carries the contact points."""
    contact_points: list[list[float]] = field(default_factory=list)
    """Centres of the contact spheres in the body's frame, each (3,) [m]."""
    radius_m: float = 0.0
    """Radius of the contact spheres [m]."""
    joints: list[str] = field(default_factory=list)
    """Joints of the leg, from the base to the foot."""


@dataclass(kw_only=True)
class JointGains:
    """Gains of a joint's position servo, which Drake integrates implicitly."""

    stiffness: float = 0.0
    """Proportional gain [N·m/rad]."""
    damping: float = 0.0
    """Derivative gain [N·m·s/rad]."""


@dataclass(kw_only=True)
class TaskGains:
    """How much a task of the whole-body controller counts, and how it follows its reference."""

    weight: float = 1.0
    """Weight of the squared error of the task's acceleration."""
    stiffness: float = 100.0
    """Gain of the position error [1/s²]."""
    damping: float = 20.0
    """Gain of the rate error [1/s]."""


@dataclass(kw_only=True)
class ReachingFrame:
    """A hand: the point that reaches, the sphere around it, and the joints of its arm."""

    body: str = ""
    """Body that carries the point."""
    point: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """The reaching point, centre of the hand's sphere, in the body's frame, (3,) [m]."""
    radius_m: float = 0.0
    """Radius of the hand's collision sphere [m]."""
    joints: list[str] = field(default_factory=list)
    """Joints of the arm, from the torso to the hand."""


@dataclass(kw_only=True)
class WholeBody:
    """Weights and gains of the whole-body controller, by the name of the task."""

    center_of_mass: TaskGains = field(default_factory=lambda: TaskGains(weight=10.0))
    orientation: dict[str, TaskGains] = field(default_factory=dict)
    """By body; each keeps the orientation of its reference."""
    reaching: TaskGains = field(default_factory=lambda: TaskGains(weight=50.0))
    posture: TaskGains = field(default_factory=lambda: TaskGains(weight=0.1))
    contact_damping: float = 40.0
    """Gain K_d of the rows that keep a contact point still, J v̇ = -J̇v - K_d J v [1/s]."""
    regularization: float = 1e-4
    """Weight of squared accelerations, of the base too."""
    force_regularization: float = 1e-2
    """Weight of squared contact forces over the robot's mass, (f/m)² [m²/s⁴]: it shares the load
    out evenly and makes the solution unique; far heavier, and the robot sags."""
    friction: float = 0.5
    """Friction coefficient that the planned contact forces respect; below the ground's own."""

    def __post_init__(self) -> None:
        for task, gains in self.tasks().items():
            for name in ("weight", "stiffness", "damping"):
                _check_not_negative(f"whole_body.{task}.{name}", getattr(gains, name))
        _check_not_negative("whole_body.contact_damping", self.contact_damping)
        for name in ("regularization", "force_regularization", "friction"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise ValueError(f"whole_body.{name} must be finite and positive; got {value}")

    def tasks(self) -> dict[str, TaskGains]:
        """Every task by its name, ``orientation.BODY`` for the bodies."""
        bodies = {f"orientation.{body}": gains for body, gains in self.orientation.items()}
        return {
            "center_of_mass": self.center_of_mass,
            **bodies,
            "reaching": self.reaching,
            "posture": self.posture,
        }


def _check_not_negative(what: str, value: float) -> None:
    if not 0 <= value < math.inf:
        raise ValueError(f"{what} must be finite and not negative; got {value}")


@dataclass(kw_only=True)
class CollisionShape:
    """A shape fixed to a body: a box, a sphere, or with ``to_m`` a capsule."""

    position_m: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Centre of a box or sphere, centre of a capsule's first end, in the body's frame, (3,)."""
    box_m: list[float] = field(default_factory=list)
    """Edges of a box along the body's axes, (3,)."""
    radius_m: float = 0.0
    """Of a sphere or capsule."""
    to_m: list[float] = field(default_factory=list)
    """Centre of a capsule's other end, (3,)."""

    def check(self, who: str) -> None:
        """Refuses what is no shape, or more than one.

        Raises:
            ValueError: Numbers are missing, or say two things.
        """
        for name in ("position_m", "box_m", "to_m"):
            values = getattr(self, name)
            if len(values) != 3 and (values or name == "position_m"):
                raise ValueError(f"{who}: {name} must be three numbers [m]; got {values}")
        if bool(self.box_m) == (self.radius_m > 0):
            raise ValueError(
                f"{who}: either box_m or a positive radius_m; got box_m {self.box_m}, radius_m "
                f"{self.radius_m}"
            )
        if self.to_m and (self.box_m or self.to_m == self.position_m):
            raise ValueError(
                f"{who}: to_m must be a capsule's other end, away from position_m; got to_m "
                f"{self.to_m} with position_m {self.position_m}, box_m {self.box_m}"
            )


COLLISIONS = ("model_file", "stated")
"""Whose collision geometry a robot has."""


@dataclass(kw_only=True)
class RobotModel:
    """The schema of ``robot.yaml``: all that controllers and safe sets need to know of a robot."""

    name: str = ""
    urdf: str = ""
    """``package://…`` (ours, Drake's or a pip package's) or a path beside the YAML file; any
    format that Drake's Parser reads."""
    visuals: str = ""
    """A URDF that says what the links look like, those of the same names, when its package is
    installed: ``package://…``. Their frames must be those of ``urdf``, itself a URDF. Nothing that
    is simulated depends on it."""
    base: str = ""
    """Floating base body."""
    posture: dict[str, float] = field(default_factory=dict)
    """Standing joint positions [rad], by regular expression over joint names."""
    feet: dict[str, Foot] = field(default_factory=dict)
    reaching_frames: dict[str, ReachingFrame] = field(default_factory=dict)
    """By name of the hand."""
    mirror: dict[str, str] = field(default_factory=dict)
    """Joints on the other side: regular expression over joint names -> its partner's name."""
    whole_body: WholeBody = field(default_factory=WholeBody)
    joint_gains: dict[str, JointGains] = field(default_factory=dict)
    """Position servo gains, by regular expression over joint names."""
    effort_limits: dict[str, float] = field(default_factory=dict)
    """Effort limits [N·m] of actuators that the model file lacks, or that have none there, by
    regular expression."""
    velocity_limits: dict[str, float] = field(default_factory=dict)
    """Joint speed limits [rad/s] in place of the model file's, by regular expression."""
    collision: str = "model_file"
    """``model_file``: the model file's collision geometry. ``stated``: the contact points of the
    feet and ``shapes`` alone, where the file has meshes or none (URDF only)."""
    shapes: dict[str, list[CollisionShape]] = field(default_factory=dict)
    """With ``stated`` collisions, by regular expression over body names."""
    foot_friction: float = 0.8
    """Coulomb friction coefficient of the contact points."""
    source_dir: str = ""
    """Folder of the YAML file; filled in by the loader."""

    def __post_init__(self) -> None:
        for name, foot in self.feet.items():
            points = np.asarray(foot.contact_points, dtype=float)
            if points.ndim != 2 or points.shape[1] != 3:
                raise ValueError(
                    f"robot '{self.name}', foot '{name}': contact_points must be a list of "
                    f"[x, y, z]; got {foot.contact_points}"
                )
        for name, frame in self.reaching_frames.items():
            if np.asarray(frame.point, dtype=float).shape != (3,):
                raise ValueError(
                    f"robot '{self.name}', reaching frame '{name}': point must be [x, y, z]; "
                    f"got {frame.point}"
                )
            _check_not_negative(
                f"robot '{self.name}', reaching frame '{name}': radius_m", frame.radius_m
            )
        for pattern in self.mirror:
            try:
                re.compile(pattern)
            except re.error as error:
                raise ValueError(
                    f"robot '{self.name}': mirror pattern '{pattern}' is not a regular "
                    f"expression: {error}"
                ) from error
        if self.collision not in COLLISIONS:
            raise ValueError(
                f"robot '{self.name}': collision must be one of {list(COLLISIONS)}; got "
                f"'{self.collision}'"
            )
        for pattern, shapes in self.shapes.items():
            for shape in shapes:
                shape.check(f"robot '{self.name}', shapes '{pattern}'")
        if self.collision == "model_file" and self.shapes:
            raise ValueError(
                f"robot '{self.name}': shapes {list(self.shapes)} need collision: stated"
            )
        if not self.foot_friction > 0:
            raise ValueError(
                f"robot '{self.name}': foot_friction must be positive; got {self.foot_friction}"
            )

    def limbs(self) -> list[Foot | ReachingFrame]:
        """Legs and arms, by what is at their ends."""
        return [*self.feet.values(), *self.reaching_frames.values()]

    def reaching_frame(self, hand: str) -> ReachingFrame:
        """The reaching frame of a hand.

        Raises:
            ValueError: There is none of that name.
        """
        if hand not in self.reaching_frames:
            raise ValueError(
                f"robot '{self.name}' has no reaching frame '{hand}'; "
                f"it has {list(self.reaching_frames)}"
            )
        return self.reaching_frames[hand]

    def mirror_partners(self, joint_names: Iterable[str]) -> dict[str, str]:
        """Each joint's partner on the other side; joints that no pattern names are their own.

        A pattern pairs both ways, so that one side's names are enough.

        Raises:
            ValueError: A pattern matches no joint, or pairs a joint with one that does not
                exist or with two.
        """
        names = list(joint_names)
        partners: dict[str, str] = {}
        for pattern, template in self.mirror.items():
            matches = [match for name in names if (match := re.fullmatch(pattern, name))]
            if not matches:
                raise ValueError(
                    f"robot '{self.name}' has no joint for mirror pattern '{pattern}'; "
                    f"it has {names}"
                )
            for match in matches:
                name = match.string
                try:
                    partner = match.expand(template)
                except (re.error, IndexError) as error:
                    raise ValueError(
                        f"robot '{self.name}': mirror pattern '{pattern}' cannot be replaced by "
                        f"'{template}': {error}"
                    ) from error
                if partner not in names:
                    raise ValueError(
                        f"robot '{self.name}' has no joint '{partner}', the mirror of '{name}'; "
                        f"it has {names}"
                    )
                for one, other in ((name, partner), (partner, name)):
                    if partners.setdefault(one, other) != other:
                        raise ValueError(
                            f"robot '{self.name}': mirror pairs joint '{one}' with "
                            f"'{partners[one]}' and with '{other}'"
                        )
        return {name: partners.get(name, name) for name in names}


def load_typed(schema: type[_Value], raw: Any, who: str) -> _Value:
    """Reads a YAML mapping into a dataclass of dataclasses, every one of them validated.

    Drake's loader assigns a file's values to an object made of defaults, so that
    ``__post_init__`` never sees them: it runs again here, innermost dataclass first.

    Args:
        schema: The dataclass.
        raw: What the YAML holds.
        who: Whose data it is, for messages.

    Raises:
        ValueError: An unknown key, a value of another type, or one that validation refuses.
    """
    for misfit in _misfits(schema, raw, ()):
        raise ValueError(f"{who}: {misfit}")
    try:
        value = yaml_load_typed(schema=schema, data=yaml.safe_dump(raw, sort_keys=False))
        _validate(value)
    except Exception as error:  # Drake's loader raises RuntimeError and bare Exceptions alike.
        raise ValueError(f"{who}: {error}") from error
    return value


def load_typed_file(schema: type[_Value], path: Path, who: str) -> _Value:
    """:func:`load_typed` of a YAML file.

    Raises:
        ValueError: The file does not exist, is not YAML, or does not fit the schema.
    """
    if not path.is_file():
        raise ValueError(f"{who} does not exist")
    try:
        raw = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ValueError(f"{who} is not YAML: {error}") from error
    return load_typed(schema, raw, who)


def _misfits(schema: Any, raw: Any, path: tuple[str, ...]) -> Iterable[str]:
    """What a schema of nested dataclasses does not know, with what it knows there."""
    optional = get_args(schema)
    if len(optional) == 2 and optional[1] is type(None):
        if raw is None:
            return
        schema = optional[0]
    if is_dataclass(schema):
        hints = get_type_hints(schema)
        known = [entry.name for entry in fields(schema)]
        if not isinstance(raw, dict):
            where = f"'{'.'.join(path)}'" if path else "this"
            yield f"{where} must be a mapping with keys of {known}; got {raw}"
            return
        for key, value in raw.items():
            if key in known:
                yield from _misfits(hints[key], value, (*path, key))
            else:
                yield f"unknown key '{'.'.join((*path, str(key)))}'; keys there are {known}"
    elif isinstance(raw, dict | list):
        items = raw.items() if isinstance(raw, dict) else enumerate(raw)
        for inner in get_args(schema):
            if is_dataclass(inner):
                for key, value in items:
                    yield from _misfits(inner, value, (*path, str(key)))


def _validate(value: Any) -> None:
    if isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            _validate(item)
    elif is_dataclass(value):
        for entry in fields(value):
            _validate(getattr(value, entry.name))
        if hasattr(value, "__post_init__"):
            value.__post_init__()


def load_robot_file(path: str | Path) -> RobotModel:
    """Reads a ``robot.yaml``.

    Args:
        path: The YAML file.

    Returns:
        The robot, its ``source_dir`` set to the file's folder.

    Raises:
        ValueError: The file does not exist or does not fit the schema.
    """
    path = Path(path)
    robot = load_typed_file(RobotModel, path, f"robot file '{path}'")
    robot.source_dir = str(path.resolve().parent)
    return robot


def by_pattern(
    patterns: dict[str, _Value], name: str, what: str, robot_name: str, kind: str = "joint"
) -> _Value | None:
    """The value of the only pattern that matches ``name`` in full; None when none does.

    Raises:
        ValueError: Two patterns match.
    """
    found = [key for key in patterns if re.fullmatch(key, name)]
    if len(found) > 1:
        raise ValueError(f"robot '{robot_name}': {what} of {kind} '{name}' matches {found}")
    return patterns[found[0]] if found else None
