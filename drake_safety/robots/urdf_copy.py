"""An editable copy of a URDF, with a record of its changes."""

from __future__ import annotations

import io
import math
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from drake_safety.robots.fitted_shapes import FittedShape
from drake_safety.robots.mesh_cache import is_shown, shown_mesh
from drake_safety.robots.model_files import model_file

_DRAKE = "http://drake.mit.edu"


@dataclass(kw_only=True)
class UrdfCopy:
    """An editable copy of a URDF file.

    Attributes:
        notes: Descriptions of the changes, one sentence each.
        left_out: Notes about visuals that were removed.
        lost_meshes: Vertices of removed collision meshes by link, in its frame, (n, 3) [m] each;
            none of those that cannot be read.
        fitted: Shapes in place of these meshes, by link.
        joint_friction: Removed dry friction by joint [N·m].
        meshes: Meshes of the copy: name relative to the copy -> original file.
        hulls: Convex hulls of the copy: name relative to the copy -> OBJ.
    """

    source: Path
    root: ET.Element
    notes: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    lost_meshes: dict[str, list[np.ndarray]] = field(default_factory=dict)
    fitted: dict[str, list[FittedShape]] = field(default_factory=dict)
    joint_friction: dict[str, float] = field(default_factory=dict)
    meshes: dict[str, Path] = field(default_factory=dict)
    hulls: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._as_read = self.text()

    def text(self) -> str:
        """Returns the edited URDF."""
        return ET.tostring(self.root, encoding="unicode")

    @property
    def is_changed(self) -> bool:
        """Whether it differs from the file."""
        return self.text() != self._as_read

    def link(self, name: str) -> ET.Element:
        """Returns a link's element."""
        return next(link for link in self.root.iter("link") if link.get("name") == name)

    def bare_links(self) -> list[str]:
        """Returns the links whose collision meshes were removed and that have no other shape."""
        return [
            link.get("name", "")
            for link in self.root.findall("link")
            if link.get("name") in self.lost_meshes and link.find("collision") is None
        ]

    def effort_limits(self) -> dict[str, float]:
        """Returns the effort limits of all movable joints by name [N·m]; NaN without a limit."""
        return {
            joint.get("name", ""): number(joint.find("limit"), "effort")
            for joint in self.root.findall("joint")
            if joint.get("type") in ("revolute", "continuous", "prismatic")
        }

    def free_fixed_joints(self) -> None:
        """Removes <mimic> from fixed joints, where Drake rejects it."""
        for joint in self.root.findall("joint[@type='fixed']"):
            _remove(joint, "mimic")

    def drop_collisions(self) -> None:
        """Removes all collision shapes."""
        for link in self.root.findall("link"):
            _remove(link, "collision")

    def replace_visual_meshes(self, shown: Callable[[str, str], str]) -> None:
        """Replaces visual meshes by ``shown(url, rgba)``, or removes them where that is "".

        The material of a converted mesh is removed: the mesh has its own, and Drake warns of two.
        """
        colours = {one.get("name", ""): one for one in self.root.findall("material")}
        for link in self.root.findall("link"):
            for visual in link.findall("visual"):
                mesh = visual.find("geometry/mesh")
                if mesh is None:
                    continue
                material = visual.find("material")
                url = mesh.get("filename", "")
                replacement = shown(url, _colour(material, colours))
                if not replacement:
                    link.remove(visual)
                    continue
                mesh.set("filename", replacement)
                is_converted = Path(replacement).suffix != Path(url).suffix
                if material is not None and is_converted:
                    visual.remove(material)

    def convert_visual_meshes(self) -> None:
        """Replaces visual meshes that Drake does not render by glTF files in the user's cache."""
        folder = str(self.source.parent)

        def shown(url: str, rgba: str) -> str:
            path = model_file(url, folder)
            return url if is_shown(path) else shown_mesh(path, rgba).resolve().as_uri()

        self.replace_visual_meshes(shown)

    def anchor_meshes(self) -> None:
        """Makes relative mesh paths absolute, as URDF text has no folder."""
        for mesh in self.root.iter("mesh"):
            url = mesh.get("filename", "")
            if "://" not in url:
                mesh.set("filename", (self.source.parent / url).resolve().as_uri())

    def fix_joints(self, names: Iterable[str]) -> None:
        """Fixes joints at zero."""
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
        """Replaces all collision shapes of a link by spheres at points (n, 3) [m] in its frame."""
        link = self.link(link_name)
        _remove(link, "collision")
        for index, point in enumerate(points):
            name = f"{link_name}_contact_{index}"
            _add_collision(link, name, point, "sphere", radius=f"{radius_m:.5g}")
        self.notes.append(
            f"the collision shapes of link '{link_name}' are replaced by {len(points)} spheres on "
            "the ground"
        )

    def set_fitted(self, link_name: str, shapes: list[FittedShape]) -> None:
        """Sets the shapes in place of a link's removed collision meshes; earlier ones go."""
        self.fitted[link_name] = shapes
        link = self.link(link_name)
        for collision in link.findall("collision"):
            if collision.get("name", "").startswith(f"{link_name}_fitted_"):
                link.remove(collision)
        for index, shape in enumerate(shapes):
            name = f"{link_name}_fitted_{index}"
            geometry = _add_geometry(link, name, shape.X_LS)
            if shape.kind == "hull":
                file = f"meshes/{name}.obj"
                self.hulls[file] = shape.obj
                mesh = ET.SubElement(geometry, "mesh", filename=file)
                ET.SubElement(mesh, f"{{{_DRAKE}}}declare_convex")
                continue
            sizes = {key: _numbers(np.atleast_1d(value)) for key, value in shape.sizes.items()}
            tag = f"{{{_DRAKE}}}capsule" if shape.kind == "capsule" else shape.kind
            ET.SubElement(geometry, tag, sizes)

    def ignore_collisions(self, pairs: Iterable[tuple[str, str]]) -> None:
        """Filters collisions between pairs of links."""
        for index, (one, other) in enumerate(sorted(pairs)):
            group = ET.SubElement(
                self.root, f"{{{_DRAKE}}}collision_filter_group", name=f"overlap_{index}"
            )
            for link in (one, other):
                ET.SubElement(group, f"{{{_DRAKE}}}member", link=link)
            ET.SubElement(
                group, f"{{{_DRAKE}}}ignored_collision_filter_group", name=f"overlap_{index}"
            )
            self.notes.append(f"collisions of the overlapping links '{one}' and '{other}' are off")

    def write(self, path: Path) -> None:
        """Writes the copy and its meshes."""
        tree = ET.ElementTree(self.root)
        ET.indent(tree)
        tree.write(path, encoding="utf-8", xml_declaration=True)
        for name, text in self.hulls.items():
            target = path.parent / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text, encoding="utf-8")
        for name, mesh in self.meshes.items():
            target = path.parent / name
            target.parent.mkdir(parents=True, exist_ok=True)
            for file in mesh.parent.glob(f"{mesh.stem}.*"):
                # Material files and textures have the mesh's stem.
                if file.suffix in (mesh.suffix, ".mtl", ".png", ".bin"):
                    shutil.copyfile(file, target.with_suffix(file.suffix))


def read_urdf(path: Path) -> UrdfCopy:
    """Reads a URDF as an editable copy."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"URDF '{path}' does not exist")
    try:
        root = _parsed(path.read_bytes())
    except ET.ParseError as error:
        raise ValueError(f"'{path}' is not XML: {error}") from error
    if root.tag != "robot":
        raise ValueError(
            f"'{path}' is not a URDF: its root element is <{root.tag}>, expected <robot>. Convert "
            "it first, or write robot.yaml by hand: Drake also reads SDFormat and MJCF"
        )
    if any("xacro" in element.tag for element in root.iter()):
        raise ValueError(f"'{path}' is not expanded yet: run `xacro {path.name} > robot.urdf`")
    if not root.findall("link"):
        raise ValueError(f"'{path}' has no links")
    for link in root.iter("link"):
        element = link.find("inertial/mass")
        mass = number(element, "value")
        # Drake warns, and simulates a body of another mass.
        if element is not None and not 0.0 <= mass < math.inf:
            raise ValueError(
                f"'{path}': link '{link.get('name')}' has a mass of {mass:g} kg, expected a finite "
                "number that is not negative"
            )
    return UrdfCopy(source=path, root=root)


def _parsed(content: bytes) -> ET.Element:
    """The root element; Drake's own elements keep their prefix."""
    root = None
    prefixes = {"drake": _DRAKE}
    parser = ET.iterparse(io.BytesIO(content), events=("start-ns", "start"))
    for event, value in parser:
        if event == "start-ns":
            prefixes[value[0]] = value[1]
        elif root is None:
            root = value
    assert root is not None  # There is no XML without an element.
    # Drake identifies its elements by prefix, whatever the namespace's address.
    own = f"{{{prefixes.pop('drake')}}}"
    for element in root.iter():
        if element.tag.startswith(own):
            element.tag = f"{{{_DRAKE}}}{element.tag.removeprefix(own)}"
    for prefix, address in prefixes.items():
        ET.register_namespace(prefix, address)
    ET.register_namespace("drake", _DRAKE)
    return root


def _remove(element: ET.Element, tag: str) -> None:
    """Removes all children with a tag."""
    for part in element.findall(tag):
        element.remove(part)


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.5g}" for value in values)


def _add_collision(
    link: ET.Element, name: str, center: np.ndarray, shape: str, **sizes: str
) -> None:
    ET.SubElement(_add_geometry(link, name, RigidTransform(center)), shape, sizes)


def _add_geometry(link: ET.Element, name: str, X_LS: RigidTransform) -> ET.Element:
    collision = ET.SubElement(link, "collision", name=name)
    turn = RollPitchYaw(X_LS.rotation()).vector()
    ET.SubElement(collision, "origin", xyz=_numbers(X_LS.translation()), rpy=_numbers(turn))
    return ET.SubElement(collision, "geometry")


def origin_of(element: ET.Element) -> list[float]:
    """Returns an element's origin in its parent: xyz [m] and rpy [rad], (6,)."""
    origin = element.find("origin")
    texts = [("" if origin is None else origin.get(key)) or "0 0 0" for key in ("xyz", "rpy")]
    return [float(word) for word in " ".join(texts).split()]


def _colour(material: ET.Element | None, colours: dict[str, ET.Element]) -> str:
    if material is None:
        return ""
    for one in (material, colours.get(material.get("name", ""))):
        colour = None if one is None else one.find("color")
        if colour is not None:
            return colour.get("rgba", "")
    return ""


def number(element: ET.Element | None, key: str) -> float:
    """Returns an attribute as a number; NaN if it is missing or not a number."""
    try:
        return math.nan if element is None else float(element.get(key, "nan"))
    except ValueError:
        return math.nan
