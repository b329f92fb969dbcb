"""An editable copy of a URDF, with what it says of drives and a record of its changes."""

from __future__ import annotations

import glob
import re
import shutil
import xml.etree.ElementTree as ET
import zlib
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from drake_safety.robots.urdf import DRAKE, joint_elements, number, remove

if TYPE_CHECKING:
    import trimesh

_MOVABLE = ("revolute", "continuous", "prismatic", "screw")


@dataclass(frozen=True, kw_only=True)
class JointDrives:
    """Drives of the joints of a URDF."""

    mimics: dict[str, str] = field(default_factory=dict)  # The joint that a coupled one follows.
    # Joints with a transmission (ROS 1) or a command interface (``<ros2_control>``).
    listed: set[str] = field(default_factory=set)
    efforts: dict[str, float] = field(default_factory=dict)  # Limits [N·m]; NaN without one.

    def passive(self, names: Collection[str]) -> dict[str, str]:
        """Returns the joints of some that have no motor, and the evidence."""
        listed = self.listed.intersection(names)
        if listed:
            lacking = [name for name in names if name not in listed]
            return dict.fromkeys(lacking, "no transmission, as others have")
        has_efforts = any(self.efforts[name] > 0 for name in names)
        weak = [name for name in names if has_efforts and self.efforts[name] == 0]
        return dict.fromkeys(weak, 'effort="0"')


@dataclass(kw_only=True)
class UrdfCopy:
    """An editable copy of a URDF file."""

    source: Path
    root: ET.Element
    drives: JointDrives = field(init=False)
    notes: list[str] = field(default_factory=list)  # The changes, one sentence each.
    warnings: list[str] = field(default_factory=list)  # Notes that the user should see at once.
    left_out: list[str] = field(default_factory=list)  # Notes about meshes that were removed.
    mesh_urls: dict[str, list[str]] = field(default_factory=dict)  # Collision meshes by link.
    lost_links: set[str] = field(default_factory=set)  # Links whose collision meshes were removed.
    joint_friction: dict[str, float] = field(default_factory=dict)  # Removed, by joint [N·m].
    meshes: dict[str, Path] = field(default_factory=dict)  # Files by name relative to the copy.
    # Convex hulls in place of collision meshes, by link, in its frame [m].
    hulls: dict[str, list[trimesh.Trimesh]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.drives = read_drives(self.root)

    def warn(self, note: str) -> None:
        """Adds a note that the user should see at once."""
        self.notes.append(note)
        self.warnings.append(note)

    def link(self, name: str) -> ET.Element:
        """Returns a link's element."""
        return next(link for link in self.root.findall("link") if link.get("name") == name)

    @property
    def bare_links(self) -> list[str]:
        """Links whose collision meshes were removed and that have no other shape."""
        links = (link for link in self.root.findall("link") if link.find("collision") is None)
        return [name for link in links if (name := link.get("name", "")) in self.lost_links]

    def drop_world(self) -> None:
        """Removes a root link 'world', and root links under which the robot floats."""
        joints = {
            joint: [part.get("link") for tag in ("parent", "child") for part in joint.findall(tag)]
            for joint in joint_elements(self.root)
        }
        carried = {name for ends in joints.values() for name in ends[1:]}
        for link in self.root.findall("link"):
            name = link.get("name")
            below = [joint for joint, ends in joints.items() if name in ends[:1]]
            kinds = {joint.get("type") for joint in below}
            is_world = name == "world" and kinds == {"fixed"}
            if name not in carried and (is_world or kinds & {"floating", "planar"}):
                for element in (link, *below):
                    self.root.remove(element)
                self.warn(f"the root link '{name}' is left out, as the base floats")

    def add_root(self, name: str, below: str, pose: RigidTransform) -> str:
        """Adds a massless root link at a pose in the present one; returns its name, not taken."""
        while any(element.get("name") in (name, f"{name}_fixed") for element in self.root):
            name += "_"
        ET.SubElement(self.root, "link", name=name)
        joint = ET.SubElement(self.root, "joint", name=f"{name}_fixed", type="fixed")
        ET.SubElement(joint, "parent", link=name)
        ET.SubElement(joint, "child", link=below)
        X_NB = pose.inverse()
        rpy = as_text(X_NB.rotation().ToRollPitchYaw().vector())
        ET.SubElement(joint, "origin", xyz=as_text(X_NB.translation()), rpy=rpy)
        return name

    def fix_joints(self, names: Collection[str]) -> None:
        """Fixes joints at zero."""
        for joint in joint_elements(self.root):
            if joint.get("name") in names:
                joint.tag = "joint"
                joint.set("type", "fixed")
                remove(joint, "mimic")
        for transmission in self.root.findall("transmission[joint]"):
            if any(joint.get("name") in names for joint in transmission.findall("joint")):
                self.root.remove(transmission)
        if names:
            text = ", ".join(sorted(names))
            self.notes.append(f"{len(names)} joints that move no foot or hand are fixed: {text}")

    def replace_collisions(self, link_name: str, points: np.ndarray, radius_m: float) -> None:
        """Replaces all collision shapes of a link by spheres at points (n, 3) [m] in its frame."""
        link = self.link(link_name)
        remove(link, "collision")
        self.hulls.pop(link_name, None)
        for index, point in enumerate(points):
            collision = ET.SubElement(link, "collision", name=f"{link_name}_contact_{index}")
            ET.SubElement(collision, "origin", xyz=" ".join(f"{value:.5g}" for value in point))
            geometry = ET.SubElement(collision, "geometry")
            ET.SubElement(geometry, "sphere", radius=f"{radius_m:.5g}")
        self.notes.append(f"link '{link_name}' collides as {len(points)} spheres on the ground")

    def set_hulls(self, link_name: str, hulls: list[trimesh.Trimesh]) -> None:
        """Sets the convex hulls in place of a link's collision meshes and earlier hulls."""
        link = self.link(link_name)
        for shape in link.findall("collision"):
            if shape.get("name", "").startswith(f"{link_name}_hull_"):
                link.remove(shape)
        self.hulls[link_name] = hulls
        if not hulls:
            self.lost_links.add(link_name)
        for index in range(len(hulls)):
            shape = ET.SubElement(link, "collision", name=f"{link_name}_hull_{index}")
            geometry = ET.SubElement(shape, "geometry")
            mesh = ET.SubElement(geometry, "mesh", filename=_hull_file(link_name, index))
            ET.SubElement(mesh, f"{{{DRAKE}}}declare_convex")

    def ignore_collisions(self, pairs: Iterable[tuple[str, str]]) -> None:
        """Filters collisions between pairs of links."""
        for index, (one, other) in enumerate(sorted(pairs)):
            drake, name = f"{{{DRAKE}}}", f"overlap_{index}"
            group = ET.SubElement(self.root, f"{drake}collision_filter_group", name=name)
            for link in (one, other):
                ET.SubElement(group, f"{drake}member", link=link)
            ET.SubElement(group, f"{drake}ignored_collision_filter_group", name=name)
            self.notes.append(
                f"'{one}' and '{other}', which overlap or are excluded, never collide"
            )

    def write(self, path: Path) -> None:
        """Writes the copy and its meshes."""
        tree = ET.ElementTree(self.root)
        ET.indent(tree)
        tree.write(path, encoding="utf-8", xml_declaration=True)
        for name in (*self.meshes, *(_hull_file(link, 0) for link in self.hulls)):
            (path.parent / name).parent.mkdir(parents=True, exist_ok=True)
        for link, hulls in self.hulls.items():
            for index, hull in enumerate(hulls):
                target = path.parent / _hull_file(link, index)
                hull.export(target, include_normals=False, header=None)
        for name, mesh in self.meshes.items():
            for file in mesh.parent.glob(f"{glob.escape(mesh.stem)}.*"):
                # Material files and textures have the mesh's stem.
                is_beside = file.resolve().parent == mesh.resolve().parent
                if is_beside and file.suffix in (mesh.suffix, ".mtl", ".png", ".bin"):
                    shutil.copyfile(file, (path.parent / name).with_suffix(file.suffix))


def pose_of(element: ET.Element) -> RigidTransform:
    """Returns the pose of an element's <origin>."""
    origin = element.find("origin")
    stated = {} if origin is None else origin.attrib
    xyz, rpy = ([*map(float, (stated.get(key) or "0 0 0").split())] for key in ("xyz", "rpy"))
    return RigidTransform(RollPitchYaw(rpy), xyz)


def as_text(values: Iterable[float]) -> str:
    """Returns numbers with nine digits, as attributes have them."""
    return " ".join(f"{value:.9g}" for value in values)


def _hull_file(link: str, index: int) -> str:
    """A link's hull file; a hash keeps names apart whose characters were replaced."""
    plain = re.sub(r"[^\w.-]", "_", link)
    mark = "" if plain == link else f"_{zlib.crc32(link.encode()):08x}"
    return f"meshes/{plain}{mark}_hull_{index}.obj"


def read_drives(root: ET.Element) -> JointDrives:
    """Reads the drives of a URDF's joints."""
    movable = [joint for joint in joint_elements(root) if joint.get("type") in _MOVABLE]
    joints = {joint.get("name", ""): joint for joint in movable}
    motors = "transmission//joint", "ros2_control/joint[command_interface]"
    mimics = {name: joint.find("mimic") for name, joint in joints.items()}
    followed = ((name, mimic) for name, mimic in mimics.items() if mimic is not None)
    return JointDrives(
        mimics={name: mimic.get("joint", "") for name, mimic in followed},
        listed={joint.get("name", "") for place in motors for joint in root.findall(place)},
        efforts={name: number(joint.find("limit"), "effort") for name, joint in joints.items()},
    )
