"""The schema of ``robot.yaml`` and its loader."""

import re
from collections.abc import Iterable
from dataclasses import field
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import Field, FiniteFloat

from drake_safety.files.schema import (
    NotNegative,
    Pattern,
    Positive,
    Requirement,
    Triple,
    load_typed_file,
    schema,
)

_Value = TypeVar("_Value")


@schema(kw_only=True)
class Foot:
    """A foot: its contact points with the ground, and the joints of its leg."""

    body: str = ""
    # Centres of the contact spheres in the body's frame, each (3,) [m].
    contact_points: Annotated[list[Triple], Field(min_length=1)]
    radius_m: float = 0.0
    joints: list[str] = field(default_factory=list)  # Joints of the leg, from base to foot.


@schema(kw_only=True)
class JointGains:
    """Gains of a joint's position servo."""

    stiffness: NotNegative = 0.0  # [N·m/rad]
    damping: NotNegative = 0.0  # [N·m·s/rad]


@schema(kw_only=True)
class TaskGains:
    """Weight and feedback gains of a task of the whole-body controller."""

    weight: NotNegative = 1.0  # Weight of the squared error of the task's acceleration.
    stiffness: NotNegative = 100.0  # Gain of the position error [1/s²].
    damping: NotNegative = 20.0  # Gain of the rate error [1/s].


@schema(kw_only=True)
class ReachingFrame:
    """A hand: its reaching point, its collision sphere and the joints of its arm."""

    body: str = ""
    # Reaching point and centre of the collision sphere in the body's frame, (3,) [m].
    point: Triple = field(default_factory=lambda: [0.0, 0.0, 0.0])
    radius_m: NotNegative = 0.0
    joints: list[str] = field(default_factory=list)  # Joints of the arm, from torso to hand.


@schema(kw_only=True)
class WholeBody:
    """Weights and gains of the whole-body controller, by the name of the task."""

    center_of_mass: TaskGains = field(default_factory=lambda: TaskGains(weight=10.0))
    orientation: dict[str, TaskGains] = field(default_factory=dict)  # Orientation tasks by body.
    reaching: TaskGains = field(default_factory=lambda: TaskGains(weight=50.0))
    posture: TaskGains = field(default_factory=lambda: TaskGains(weight=0.1))
    contact_damping: NotNegative = 40.0  # K_d in the contacts' J v̇ = -J̇v - K_d J v [1/s].
    regularization: Positive = 1e-4  # Weight of squared accelerations, including the base's.
    force_regularization: Positive = 1e-2  # Weight of squared forces over mass, (f/m)² [m²/s⁴].
    friction: Positive = 0.5  # Coefficient of planned contact forces, below the ground's own.


@schema(kw_only=True)
class CollisionShape:
    """A shape fixed to a body: a box, a sphere, or with ``to_m`` a capsule."""

    # Centre of a box or sphere, centre of a capsule's first end, in the body's frame, (3,).
    position_m: Triple = field(default_factory=lambda: [0.0, 0.0, 0.0])
    box_m: Triple | None = None  # Edges of a box along the body's axes, (3,).
    radius_m: NotNegative = 0.0  # Radius of a sphere or capsule.
    to_m: Triple | None = None  # Centre of a capsule's other end, (3,).

    def __post_init__(self) -> None:
        is_box, is_end = self.box_m is not None, self.to_m == self.position_m
        if is_box != (self.radius_m == 0) or (self.to_m and (is_box or is_end)):
            raise ValueError(f"expected box_m, or radius_m (with to_m); got {vars(self)}")


@schema(kw_only=True)
class RobotModel:
    """The schema of ``robot.yaml``."""

    name: str = ""
    urdf: str = ""  # ``package://…`` (ours, Drake's, pip's) or a path from the YAML file.
    requires: Requirement = ""  # Package of ``urdf`` for pip, without dependencies, if no extra.
    base: str = ""  # Floating base body.
    # Standing joint positions [rad], by regular expression over joint names.
    posture: dict[Pattern, FiniteFloat] = field(default_factory=dict)
    feet: dict[str, Foot] = field(default_factory=dict)
    reaching_frames: dict[str, ReachingFrame] = field(default_factory=dict)  # By hand.
    # Mirrored joints: regular expression over joint names -> name of the partner.
    mirror: dict[Pattern, str] = field(default_factory=dict)
    whole_body: WholeBody = field(default_factory=WholeBody)
    # Position servo gains, by regular expression over joint names.
    joint_gains: dict[Pattern, JointGains] = field(default_factory=dict)
    # Effort limits [N·m] that the model file lacks, by regular expression.
    effort_limits: dict[Pattern, Positive] = field(default_factory=dict)
    # Joint speed limits [rad/s] that replace the model file's, by regular expression.
    velocity_limits: dict[Pattern, Positive] = field(default_factory=dict)
    # Inertia of the motors' rotors as the joints feel it [kg·m²], by regular expression.
    rotor_inertia: dict[Pattern, NotNegative] = field(default_factory=dict)
    # ``stated``: only the feet's contact points and ``shapes`` (URDF only).
    collision: Literal["model_file", "stated"] = "model_file"
    # Shapes for ``stated`` collisions, by regular expression over body names.
    shapes: dict[Pattern, list[CollisionShape]] = field(default_factory=dict)
    # Links that lost their collision meshes to ``new`` and have no shape; ``check`` warns.
    without_collision: list[str] = field(default_factory=list)
    foot_friction: Positive = 0.8  # Coulomb friction coefficient of the contact points.
    source_dir: str = ""  # Folder of the YAML file; set by the loader.

    def __post_init__(self) -> None:
        if self.collision == "model_file" and self.shapes:
            raise ValueError(f"shapes {list(self.shapes)} need collision: stated")

    def gains_of(self, joint_name: str) -> JointGains | None:
        """Returns a joint's servo gains, by the pattern that it matches; None without one."""
        return by_pattern(self.joint_gains, joint_name, "gains", self.name)

    def limbs(self) -> list[Foot | ReachingFrame]:
        """Returns all feet and reaching frames."""
        return [*self.feet.values(), *self.reaching_frames.values()]

    def reaching_frame(self, hand: str) -> ReachingFrame:
        """Returns the reaching frame of a hand."""
        if hand not in self.reaching_frames:
            names = list(self.reaching_frames)
            raise ValueError(f"robot '{self.name}' has no reaching frame '{hand}'; it has {names}")
        return self.reaching_frames[hand]

    def mirror_partners(self, joint_names: Iterable[str]) -> dict[str, str]:
        """Returns each joint's mirrored joint; joints without a pattern map to themselves."""
        names, partners = list(joint_names), dict[str, str]()
        for pattern, template in self.mirror.items():
            matches = [match for name in names if (match := re.fullmatch(pattern, name))]
            try:
                pairs = {match.string: match.expand(template) for match in matches}
            except (re.error, IndexError):
                pairs = {}
            if not pairs or not {*pairs.values()} <= {*names}:
                what = f"mirror pattern '{pattern}: {template}' pairs joints {pairs}"
                raise ValueError(f"robot '{self.name}': {what}; it has {names}")
            for joint, other in (*pairs.items(), *((other, one) for one, other in pairs.items())):
                if partners.setdefault(joint, other) != other:
                    both = f"'{partners[joint]}' and with '{other}'"
                    raise ValueError(f"robot '{self.name}': mirror pairs '{joint}' with {both}")
        return {name: partners.get(name, name) for name in names}


def load_robot_file(path: str | Path) -> RobotModel:
    """Reads a ``robot.yaml``; its folder is the robot's ``source_dir``."""
    path = Path(path)
    robot = load_typed_file(RobotModel, path, f"robot file '{path}'")
    robot.source_dir = str(path.resolve().parent)
    return robot


def as_pattern(name: str) -> str:
    """Returns a regular expression that matches a name alone, and is the name where it can be."""
    return re.sub(r"[.^$*+?{}\[\]\\|()]", r"\\\g<0>", name)


def require_known(robot_name: str, what: str, names: Iterable[str], known: list[str]) -> None:
    """Checks that names, or patterns, are of what a robot has."""
    for name in names:
        if name not in known and not any(re.fullmatch(name, other) for other in known):
            raise ValueError(f"robot '{robot_name}' has no {what} '{name}'; it has {known}")


def by_pattern(
    patterns: dict[str, _Value], name: str, what: str, robot_name: str, kind: str = "joint"
) -> _Value | None:
    """Returns the value of the only pattern that fully matches ``name``; None without a match."""
    keys = [key for key in patterns if re.fullmatch(key, name)]
    if len(keys) > 1:
        raise ValueError(f"robot '{robot_name}': {what} of {kind} '{name}' matches {keys}")
    return patterns[keys[0]] if keys else None
