"""A URDF as Drake can simulate it: what Drake cannot read is taken out, and written down."""

from __future__ import annotations

import math
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

_READABLE = (".obj", ".gltf", ".glb", ".vtk")  # Meshes that Drake reads.
_DRAKE = "http://drake.mit.edu"
ET.register_namespace("drake", _DRAKE)


@dataclass(frozen=True, kw_only=True)
class JointLimits:
    """What a URDF says of a joint; NaN where it says nothing.

    Attributes:
        effort: [N·m].
        velocity: [rad/s].
    """

    effort: float
    velocity: float


@dataclass(kw_only=True)
class UrdfCopy:
    """A URDF that is being made fit for simulation.

    Attributes:
        source: The file that it was read from.
        root: Its outermost element, which is changed.
        notes: What was changed, one sentence each.
        lost_shapes: Boxes around collision meshes that were taken out, by link: lowest and highest
            corner in the link's frame, (2, 3) [m] each.
        joint_friction: Dry friction that was taken out, by joint [N·m].
        meshes: Meshes that stay: file name in the copy, and the file.
    """

    source: Path
    root: ET.Element
    notes: list[str] = field(default_factory=list)
    lost_shapes: dict[str, list[np.ndarray]] = field(default_factory=dict)
    joint_friction: dict[str, float] = field(default_factory=dict)
    meshes: dict[str, Path] = field(default_factory=dict)

    def link(self, name: str) -> ET.Element:
        """A link's element."""
        return next(link for link in self.root.iter("link") if link.get("name") == name)

    def joint_limits(self) -> dict[str, JointLimits]:
        """Limits of every joint that moves, by name."""
        found = {}
        for joint in self.root.findall("joint"):
            if joint.get("type") in ("revolute", "continuous", "prismatic"):
                limit = joint.find("limit")
                found[joint.get("name", "")] = JointLimits(
                    effort=_number(limit, "effort"), velocity=_number(limit, "velocity")
                )
        return found

    def fix_joints(self, names: Iterable[str]) -> None:
        """Makes joints rigid, at zero.

        Args:
            names: Which.
        """
        fixed = set(names)
        for joint in self.root.findall("joint"):
            if joint.get("name") in fixed:
                joint.set("type", "fixed")
        for transmission in self.root.findall("transmission"):
            driven = transmission.find("joint")
            if driven is not None and driven.get("name") in fixed:
                self.root.remove(transmission)
        if fixed:
            self.notes.append(
                f"{len(fixed)} joints that move neither a foot nor a hand are fixed at zero: "
                + ", ".join(sorted(fixed))
            )

    def replace_collisions(self, link_name: str, points: np.ndarray, radius_m: float) -> None:
        """Gives a link spheres in place of all its collision shapes.

        Args:
            link_name: The link.
            points: Centres in the link's frame, (n, 3) [m].
            radius_m: Radius of each.
        """
        link = self.link(link_name)
        for collision in link.findall("collision"):
            link.remove(collision)
        for index, point in enumerate(points):
            collision = ET.SubElement(link, "collision", name=f"{link_name}_contact_{index}")
            xyz = " ".join(f"{value:.5g}" for value in point)
            ET.SubElement(collision, "origin", xyz=xyz, rpy="0 0 0")
            geometry = ET.SubElement(collision, "geometry")
            ET.SubElement(geometry, "sphere", radius=f"{radius_m:.5g}")
        self.notes.append(
            f"link '{link_name}' touches the ground with {len(points)} spheres in place of its "
            "own collision shapes"
        )

    def ignore_collisions(self, pairs: Iterable[tuple[str, str]]) -> None:
        """Lets pairs of links pass through each other.

        Args:
            pairs: Names of links.
        """
        for index, (one, other) in enumerate(sorted(pairs)):
            group = ET.SubElement(
                self.root, f"{{{_DRAKE}}}collision_filter_group", name=f"overlap_{index}"
            )
            for link in (one, other):
                ET.SubElement(group, f"{{{_DRAKE}}}member", link=link)
            ET.SubElement(
                group, f"{{{_DRAKE}}}ignored_collision_filter_group", name=f"overlap_{index}"
            )
            self.notes.append(f"links '{one}' and '{other}' overlap, so they ignore each other")

    def write(self, path: Path) -> None:
        """Writes the copy, and beside it the meshes that it needs.

        Args:
            path: The URDF to write.
        """
        tree = ET.ElementTree(self.root)
        ET.indent(tree)
        tree.write(path, encoding="utf-8", xml_declaration=True)
        for name, mesh in self.meshes.items():
            target = path.parent / name
            target.parent.mkdir(parents=True, exist_ok=True)
            for file in mesh.parent.glob(f"{mesh.stem}.*"):
                # A material file or a texture of the same stem is part of the mesh.
                if file.suffix in (mesh.suffix, ".mtl", ".png", ".bin"):
                    shutil.copyfile(file, target.with_suffix(file.suffix))


def read_urdf(path: Path) -> UrdfCopy:
    """Reads a URDF and takes out what Drake cannot read.

    Args:
        path: The file.

    Raises:
        ValueError: It does not exist, or is no URDF.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"URDF '{path}' does not exist")
    try:
        root = ET.parse(path).getroot()
    except ET.ParseError as error:
        raise ValueError(f"'{path}' is not XML: {error}") from error
    if root.tag != "robot":
        raise ValueError(
            f"'{path}' is no URDF: its outermost element is <{root.tag}>, not <robot>. Convert it "
            "first, or write robot.yaml by hand: Drake itself reads SDFormat and MJCF, too"
        )
    if any("xacro" in element.tag for element in root.iter()):
        raise ValueError(f"'{path}' is not expanded yet: run `xacro {path.name} > robot.urdf`")
    if not root.findall("link"):
        raise ValueError(f"'{path}' has no links")
    copy = UrdfCopy(source=path, root=root)
    for element in root.findall("gazebo"):
        root.remove(element)
    _drop_friction(copy)
    _mend_inertias(copy)
    dropped: dict[str, int] = {"visual": 0, "collision": 0}
    for link in root.findall("link"):
        for kind in dropped:
            for shape in link.findall(kind):
                dropped[kind] += _drop_unreadable(copy, link, shape)
        if link.find("visual") is None:
            # Something to look at: the shapes that touch.
            for shape in link.findall("collision"):
                visual = ET.SubElement(link, "visual")
                visual.extend(part for part in shape if part.tag in ("origin", "geometry"))
    for kind, count in dropped.items():
        if count:
            copy.notes.append(
                f"{count} {kind} meshes that Drake cannot read, or that do not exist, are left out"
            )
    return copy


def _drop_friction(copy: UrdfCopy) -> None:
    """Takes out dry friction, which Drake does not simulate from a URDF."""
    for joint in copy.root.iter("joint"):
        dynamics = joint.find("dynamics")
        if dynamics is not None:
            friction = _number(dynamics, "friction")
            dynamics.attrib.pop("friction", None)
            if friction > 0:
                copy.joint_friction[joint.get("name", "")] = friction
    if copy.joint_friction:
        copy.notes.append(
            f"the dry friction of {len(copy.joint_friction)} joints is left out; a scenario states "
            "it, as joint_friction_nm"
        )


def _mend_inertias(copy: UrdfCopy) -> None:
    """Takes out products of inertia that no body can have."""
    for link in copy.root.iter("link"):
        inertia = link.find("inertial/inertia")
        if inertia is None:
            continue
        xx, yy, zz, xy, xz, yz = (
            _number(inertia, key) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        )
        moments = np.nan_to_num([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        principal = np.linalg.eigvalsh(moments)
        # A flat or a thin body is allowed, one without extent in some direction is not.
        if principal[0] < 1e-6 * principal[2] and np.any([xy, xz, yz]):
            for key in ("ixy", "ixz", "iyz"):
                inertia.set(key, "0")
            copy.notes.append(
                f"link '{link.get('name')}' has an inertia that no body can have; its products of "
                "inertia are taken to be zero"
            )


def _drop_unreadable(copy: UrdfCopy, link: ET.Element, shape: ET.Element) -> bool:
    mesh = shape.find("geometry/mesh")
    if mesh is None:
        return False
    file = _mesh_file(mesh.get("filename", ""), copy.source)
    if file is not None and file.suffix.lower() in _READABLE:
        name = f"meshes/{file.name}"
        # Two files of one name would be one in the copy.
        if copy.meshes.setdefault(name, file) == file:
            mesh.set("filename", name)
            return False
    link.remove(shape)
    box = None if file is None else _stl_box(file)
    if shape.tag == "collision" and box is not None:
        scale = [float(value) for value in mesh.get("scale", "1 1 1").split()]
        origin = shape.find("origin")
        xyz, rpy = (
            [
                float(v)
                for v in (origin.get(key, "0 0 0") if origin is not None else "0 0 0").split()
            ]
            for key in ("xyz", "rpy")
        )
        corners = np.array(np.meshgrid(*(box * scale).T)).reshape(3, -1).T
        corners = corners @ _rotation(*rpy).T + xyz
        copy.lost_shapes.setdefault(link.get("name", ""), []).append(
            np.array([corners.min(axis=0), corners.max(axis=0)])
        )
    return True


def _mesh_file(url: str, source: Path) -> Path | None:
    """The file behind a mesh's URL, looked for around the URDF as ROS lays packages out."""
    scheme, _, rest = url.rpartition("://")
    if scheme not in ("", "package", "file", "model"):
        return None
    if scheme in ("", "file"):
        candidates = [source.parent / rest]
    else:
        package, _, inside = rest.partition("/")
        candidates = []
        for folder in source.resolve().parents:
            if folder.name == package:
                candidates.append(folder / inside)
            candidates.append(folder / package / inside)
    return next((file for file in candidates if file.is_file()), None)


def _stl_box(file: Path) -> np.ndarray | None:
    """Lowest and highest corner of a binary STL, (2, 3)."""
    if file.suffix.lower() != ".stl":
        return None
    content = file.read_bytes()
    count = int.from_bytes(content[80:84], "little")
    if count == 0 or len(content) < 84 + 50 * count:
        return None
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    corners = np.frombuffer(content, kind, count, 84)["corners"].reshape(-1, 3)
    return np.array([corners.min(axis=0), corners.max(axis=0)], dtype=float)


def _rotation(roll: float, pitch: float, yaw: float) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()


def _number(element: ET.Element | None, key: str) -> float:
    try:
        return math.nan if element is None else float(element.get(key, "nan"))
    except ValueError:
        return math.nan
