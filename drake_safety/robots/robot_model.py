"""The schema of ``robot.yaml`` and its loader."""

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields, is_dataclass, make_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
import yaml
from pydrake.common.yaml import yaml_load_typed

from drake_safety.robots.reading import did_you_mean, parse_yaml, reading, shortened

_Value = TypeVar("_Value")


@dataclass(kw_only=True)
class Foot:
    """A foot: its contact points with the ground, and the joints of its leg."""

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
    """Gains of a joint's position servo."""

    stiffness: float = 0.0
    """Proportional gain [N·m/rad]."""
    damping: float = 0.0
    """Derivative gain [N·m·s/rad]."""


@dataclass(kw_only=True)
class TaskGains:
    """Weight and feedback gains of a task of the whole-body controller."""

    weight: float = 1.0
    """Weight of the squared error of the task's acceleration."""
    stiffness: float = 100.0
    """Gain of the position error [1/s²]."""
    damping: float = 20.0
    """Gain of the rate error [1/s]."""


@dataclass(kw_only=True)
class ReachingFrame:
    """A hand: its reaching point, its collision sphere and the joints of its arm."""

    body: str = ""
    """Body of the point."""
    point: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Reaching point and centre of the collision sphere in the body's frame, (3,) [m]."""
    radius_m: float = 0.0
    """Radius of the hand's collision sphere [m]."""
    joints: list[str] = field(default_factory=list)
    """Joints of the arm, from the torso to the hand."""


@dataclass(kw_only=True)
class WholeBody:
    """Weights and gains of the whole-body controller, by the name of the task."""

    center_of_mass: TaskGains = field(default_factory=lambda: TaskGains(weight=10.0))
    orientation: dict[str, TaskGains] = field(default_factory=dict)
    """Orientation tasks by body."""
    reaching: TaskGains = field(default_factory=lambda: TaskGains(weight=50.0))
    posture: TaskGains = field(default_factory=lambda: TaskGains(weight=0.1))
    contact_damping: float = 40.0
    """Gain K_d of the contact constraints, J v̇ = -J̇v - K_d J v [1/s]."""
    regularization: float = 1e-4
    """Weight of squared accelerations, including the base's."""
    force_regularization: float = 1e-2
    """Weight of squared contact forces over the robot's mass, (f/m)² [m²/s⁴]: it distributes the
    load evenly and makes the solution unique; too large a weight lets the robot sag."""
    friction: float = 0.5
    """Friction coefficient of the planned contact forces, below the ground's own."""

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
        """Returns all tasks by name, ``orientation.BODY`` for the bodies."""
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
        """Checks that the fields define exactly one shape."""
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
"""Sources of collision geometry."""


@dataclass(kw_only=True)
class RobotModel:
    """The schema of ``robot.yaml``."""

    name: str = ""
    urdf: str = ""
    """``package://…`` (ours, Drake's or a pip package's) or a path relative to the YAML file; any
    format that Drake's Parser reads."""
    requires: str = ""
    """Requirement by which pip installs the package of ``urdf`` without its dependencies, if no
    extra does."""
    base: str = ""
    """Floating base body."""
    posture: dict[str, float] = field(default_factory=dict)
    """Standing joint positions [rad], by regular expression over joint names."""
    feet: dict[str, Foot] = field(default_factory=dict)
    reaching_frames: dict[str, ReachingFrame] = field(default_factory=dict)
    """By hand."""
    mirror: dict[str, str] = field(default_factory=dict)
    """Mirrored joints: regular expression over joint names -> name of the partner."""
    whole_body: WholeBody = field(default_factory=WholeBody)
    joint_gains: dict[str, JointGains] = field(default_factory=dict)
    """Position servo gains, by regular expression over joint names."""
    effort_limits: dict[str, float] = field(default_factory=dict)
    """Effort limits [N·m] of actuators that the model file lacks or leaves unlimited, by regular
    expression."""
    velocity_limits: dict[str, float] = field(default_factory=dict)
    """Joint speed limits [rad/s] that replace the model file's, by regular expression."""
    rotor_inertia: dict[str, float] = field(default_factory=dict)
    """Inertia of the motors' rotors as the joints feel it [kg·m²], by regular expression."""
    collision: str = "model_file"
    """``model_file``: the model file's collision geometry. ``stated``: only the contact points of
    the feet and ``shapes``, for files with meshes or without shapes (URDF only)."""
    shapes: dict[str, list[CollisionShape]] = field(default_factory=dict)
    """Shapes for ``stated`` collisions, by regular expression over body names."""
    without_collision: list[str] = field(default_factory=list)
    """Links that lost the collision meshes of their source when ``new`` wrote the model file, and
    have no other shape; ``check`` warns of them."""
    foot_friction: float = 0.8
    """Coulomb friction coefficient of the contact points."""
    source_dir: str = ""
    """Folder of the YAML file; set by the loader."""

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
        """Returns all feet and reaching frames."""
        return [*self.feet.values(), *self.reaching_frames.values()]

    def reaching_frame(self, hand: str) -> ReachingFrame:
        """Returns the reaching frame of a hand.

        Raises:
            ValueError: The hand does not exist.
        """
        if hand not in self.reaching_frames:
            raise ValueError(
                f"robot '{self.name}' has no reaching frame '{hand}'; "
                f"it has {list(self.reaching_frames)}"
            )
        return self.reaching_frames[hand]

    def mirror_partners(self, joint_names: Iterable[str]) -> dict[str, str]:
        """Returns each joint's mirrored joint; joints without a pattern map to themselves.

        Patterns hold in both directions, so one side's names suffice.

        Raises:
            ValueError: A pattern matches no joint, or maps a joint to a missing one or to two.
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
    """Reads a YAML mapping into a dataclass of dataclasses and validates each.

    Drake's loader assigns values to a default object, after ``__post_init__``: it is run again
    here, innermost dataclass first.
    """
    for misfit in _misfits(schema, raw, ()):
        raise ValueError(f"{who}: {misfit}")
    try:
        value = yaml_load_typed(schema=schema, data=yaml.safe_dump(raw, sort_keys=False))
        _validate(value)
    except Exception as error:  # Drake's loader raises RuntimeError and bare Exception.
        for misfit in _ill_typed(schema, raw, ()):
            raise ValueError(f"{who}: {misfit}") from error
        raise ValueError(f"{who}: {shortened(str(error))}") from error
    return value


def load_typed_file(schema: type[_Value], path: Path, who: str) -> _Value:
    """Reads a YAML file by :func:`load_typed`."""
    if not path.is_file():
        raise ValueError(f"{who} does not exist")
    with reading(path):
        raw = parse_yaml(path.read_text(encoding="utf-8"), who)
        return load_typed(schema, raw, who)


def _misfits(schema: Any, raw: Any, path: tuple[str, ...]) -> Iterable[str]:
    """Messages about keys that a schema of nested dataclasses does not have."""
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
                name = ".".join((*path, str(key)))
                yield f"unknown key '{name}'{did_you_mean(key, known)}; keys there are {known}"
    elif isinstance(raw, dict | list):
        items = raw.items() if isinstance(raw, dict) else enumerate(raw)
        for inner in get_args(schema):
            if is_dataclass(inner):
                for key, value in items:
                    yield from _misfits(inner, value, (*path, str(key)))


_TYPE_WORDS = {
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "text",
    list: "a list",
    dict: "a mapping",
}


def _ill_typed(schema: Any, raw: Any, path: tuple[str, ...]) -> Iterator[str]:
    """Messages about values that Drake's loader does not convert to their type."""
    if is_dataclass(schema) and isinstance(raw, dict):
        hints = get_type_hints(schema)
        for key, value in raw.items():
            yield from _ill_typed(hints[key], value, (*path, key))
        return
    origin = get_origin(schema)
    if isinstance(raw, dict | list) and origin is type(raw):
        for key, value in raw.items() if isinstance(raw, dict) else enumerate(raw):
            yield from _ill_typed(get_args(schema)[-1], value, (*path, str(key)))
        return
    try:
        one = make_dataclass("One", [("values", dict[str, schema], field(default_factory=dict))])
        yaml_load_typed(schema=one, data=yaml.safe_dump({"values": {"value": raw}}))
    except Exception:  # See `load_typed`.
        words = _TYPE_WORDS.get(origin or schema, getattr(schema, "__name__", str(schema)))
        yield f"'{'.'.join(path)}' must be {words}; got {shortened(repr(raw))}"


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
    """Reads a ``robot.yaml``; its folder is the robot's ``source_dir``.

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
    """Returns the value of the only pattern that fully matches ``name``; None without a match."""
    found = [key for key in patterns if re.fullmatch(key, name)]
    if len(found) > 1:
        raise ValueError(f"robot '{robot_name}': {what} of {kind} '{name}' matches {found}")
    return patterns[found[0]] if found else None
