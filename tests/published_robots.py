"""A robot as its makers published it, link by link, and its mechanics in plain numpy.

Nothing here knows Drake or the project's own model files: it is what these are compared with.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

Pose = tuple[np.ndarray, np.ndarray]  # Rotation (3, 3) and origin (3,) in the world.


class Link(NamedTuple):
    """A rigid body: mass [kg], centre of mass [m] and inertia about it [kg·m²], in its axes."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray


class Joint(NamedTuple):
    """A joint, its frame in the parent's; one without axis is fixed."""

    parent: str
    child: str
    rotation: np.ndarray
    origin: np.ndarray
    axis: np.ndarray | None = None
    limits: tuple[float, float] = (0.0, 0.0)
    effort: float = 0.0
    speed: float = 0.0
    damping: float = 0.0


@dataclass(frozen=True)
class PublishedRobot:
    """Figures of a robot; ``joints`` holds parents before their children."""

    base: str
    links: Mapping[str, Link]
    joints: Mapping[str, Joint]
    total_mass: float
    posture: Mapping[str, float]
    """Standing positions [rad]; joints that are not named stand at zero."""
    standing_height: float
    standing_height_tolerance: float
    contact_centres: Mapping[str, list[list[float]]]
    """By body, the centres of the spheres that touch the ground, in the body's frame [m]."""
    contact_radius: float
    foot_friction: float
    other_friction: float
    partner: tuple[str, str]
    """Regular expression over the left side's names and the right side's name."""

    @property
    def movable(self) -> list[str]:
        """Names of the joints that move."""
        return [name for name, joint in self.joints.items() if joint.axis is not None]

    @property
    def bodies(self) -> list[str]:
        """Names of the links that move by themselves: the base and the children of joints."""
        return [self.base, *(self.joints[name].child for name in self.movable)]

    def poses(self, X_WB: Pose, positions: Mapping[str, float]) -> dict[str, Pose]:
        """Pose in the world of every link, fixed ones included."""
        poses = {self.base: X_WB}
        for name, joint in self.joints.items():
            R_WP, p_WP = poses[joint.parent]
            R_WJ = R_WP @ joint.rotation
            if joint.axis is not None:
                R_WJ = R_WJ @ rotation_about(joint.axis, positions[name])
            poses[joint.child] = (R_WJ, p_WP + R_WP @ joint.origin)
        return poses

    def carrier(self, link: str) -> str:
        """The body that a link is part of."""
        for joint in self.joints.values():
            if joint.child == link and joint.axis is None:
                return self.carrier(joint.parent)
        return link

    def body_inertia(self, body: str) -> tuple[float, np.ndarray, np.ndarray]:
        """Mass, first moment (3,) and inertia (3, 3) about the body's origin, in its axes."""
        zero = dict.fromkeys(self.movable, 0.0)
        poses = self.poses((np.eye(3), np.zeros(3)), zero)
        R_WB, p_WB = poses[body]
        mass, moment, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
        for name, link in self.links.items():
            if self.carrier(name) == body:
                R_BL = R_WB.T @ poses[name][0]
                c = R_WB.T @ (poses[name][1] - p_WB) + R_BL @ link.com
                mass += link.mass
                moment += link.mass * c
                inertia += R_BL @ link.inertia @ R_BL.T - link.mass * cross(c) @ cross(c)
        return mass, moment, inertia


def cross(p: np.ndarray) -> np.ndarray:
    """The matrix of the cross product with p."""
    return np.array([[0.0, -p[2], p[1]], [p[2], 0.0, -p[0]], [-p[1], p[0], 0.0]])


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation about a unit axis, by Rodrigues' formula."""
    K = cross(axis)
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


def rotation_rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """URDF's fixed-axis roll, pitch and yaw."""
    x, y, z = np.eye(3)
    return rotation_about(z, yaw) @ rotation_about(y, pitch) @ rotation_about(x, roll)


def _rows(table: str) -> list[list[str]]:
    return [line.split() for line in table.split("\n") if line]


def read_links(table: str) -> dict[str, Link]:
    """Reads lines of: name, mass, x y z, ixx iyy izz ixy ixz iyz."""
    links = {}
    for name, *figures in _rows(table):
        mass, x, y, z, xx, yy, zz, xy, xz, yz = map(float, figures)
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        links[name] = Link(mass, np.array([x, y, z]), inertia)
    return links


def read_joints(table: str) -> dict[str, Joint]:
    """Reads lines of: name, parent, child, x y z, r p y, axis, lower upper effort speed damping."""
    joints = {}
    for name, parent, child, *figures in _rows(table):
        f = [float(figure) for figure in figures]
        lower, upper, effort, speed, damping = f[9:]
        R_PJ, p_PJ, axis = rotation_rpy(*f[3:6]), np.array(f[:3]), np.array(f[6:9])
        joints[name] = Joint(
            parent, child, R_PJ, p_PJ, axis, (lower, upper), effort, speed, damping
        )
    return joints


def read_fixed(table: str) -> dict[str, Joint]:
    """Reads lines of: child, parent, x y z, r p y."""
    joints = {}
    for child, parent, *figures in _rows(table):
        f = [float(figure) for figure in figures]
        joints[f"{child}_fixed"] = Joint(parent, child, rotation_rpy(*f[3:]), np.array(f[:3]))
    return joints
