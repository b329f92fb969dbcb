"""A URDF as Drake can take it: what it cannot is changed or taken out, and written down."""

from __future__ import annotations

import io
import math
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drake_safety.robots.mesh_cache import has_own_colours, is_shown, shown_mesh
from drake_safety.robots.model_files import model_file

_DRAKE = "http://drake.mit.edu"


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
    """A URDF that is being made fit for simulation; the file that it was read from stays as it is.

    Attributes:
        source: The file that it was read from.
        root: Its outermost element, which is changed.
        notes: What was changed, one sentence each.
        left_out: Those of the notes that tell of shapes which can no longer be seen.
        lost_shapes: Boxes around collision meshes that were taken out, by link: lowest and highest
            corner in the link's frame, (2, 3) [m] each.
        joint_friction: Dry friction that was taken out, by joint [N·m].
        meshes: Meshes that go along: file name in the copy, and the file.
    """

    source: Path
    root: ET.Element
    notes: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    lost_shapes: dict[str, list[np.ndarray]] = field(default_factory=dict)
    joint_friction: dict[str, float] = field(default_factory=dict)
    meshes: dict[str, Path] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._as_read = self.text()

    def text(self) -> str:
        """The URDF as it is now."""
        return ET.tostring(self.root, encoding="unicode")

    @property
    def is_changed(self) -> bool:
        """Whether it differs from the file."""
        return self.text() != self._as_read

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
                    effort=number(limit, "effort"), velocity=number(limit, "velocity")
                )
        return found

    def free_fixed_joints(self) -> None:
        """A fixed joint mimics no other: Drake refuses one that says it does."""
        for joint in self.root.findall("joint[@type='fixed']"):
            _remove(joint, "mimic")

    def drop_collisions(self) -> None:
        """Takes out all collision shapes."""
        for link in self.root.findall("link"):
            _remove(link, "collision")

    def replace_visual_meshes(self, shown: Callable[[str, str], str]) -> None:
        """Puts meshes that Drake shows in the place of those to be seen.

        A mesh whose colours are its own by then needs no material: Drake warns of two.

        Args:
            shown: From a mesh's URL, as the URDF has it, and its colour ("r g b a" or "") to the
                URL of one that Drake shows, or the same; "" takes the visual out.
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

    def take_visuals(self, other: UrdfCopy) -> None:
        """Puts what another URDF's links look like in the place of what those of this one do.

        Links that have no visual shape there keep their own.

        Args:
            other: The other URDF; its frames must be these.

        Raises:
            ValueError: A joint that leads to such a link lies elsewhere there.
        """
        own_joints, their_joints = (
            {
                child.get("link"): origin_of(joint)
                for joint in urdf.root.findall("joint")
                if (child := joint.find("child")) is not None
            }
            for urdf in (self, other)
        )
        for colour in other.root.iter("material"):
            # A colour of the same name may be another one here.
            if colour.get("name"):
                colour.set("name", f"visuals_{colour.get('name')}")
        self.root.extend(other.root.findall("material"))
        links = {link.get("name", ""): link for link in self.root.findall("link")}
        for theirs in other.root.findall("link"):
            name, visuals = theirs.get("name", ""), theirs.findall("visual")
            if name not in links or not visuals:
                continue
            here, there = own_joints.get(name), their_joints.get(name)
            if here is not None and there is not None and not np.allclose(here, there, atol=1e-6):
                raise ValueError(
                    f"'{other.source}' cannot say what link '{name}' of '{self.source}' looks "
                    f"like: its joint's origin is {there} there, and {here} here"
                )
            _remove(links[name], "visual")
            for visual in visuals:
                mesh, material = visual.find("geometry/mesh"), visual.find("material")
                if mesh is not None:
                    path = model_file(mesh.get("filename", ""), str(other.source.parent))
                    mesh.set("filename", str(path.resolve()))
                    # A mesh with colours of its own needs none: Drake warns of two.
                    if material is not None and has_own_colours(path):
                        visual.remove(material)
                links[name].append(visual)

    def convert_visual_meshes(self) -> None:
        """Puts glTF files of the user's cache in the place of visual meshes Drake does not show.

        Raises:
            ValueError: A mesh does not exist, or cannot be converted.
        """
        folder = str(self.source.parent)

        def shown(url: str, rgba: str) -> str:
            path = model_file(url, folder)
            return url if is_shown(path) else shown_mesh(path, rgba).resolve().as_uri()

        self.replace_visual_meshes(shown)

    def anchor_meshes(self) -> None:
        """Makes relative names of meshes absolute: text has no folder that they could start in."""
        for mesh in self.root.iter("mesh"):
            url = mesh.get("filename", "")
            if "://" not in url:
                mesh.set("filename", (self.source.parent / url).resolve().as_uri())

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
        _remove(link, "collision")
        for index, point in enumerate(points):
            name = f"{link_name}_contact_{index}"
            _add_collision(link, name, point, "sphere", radius=f"{radius_m:.5g}")
        self.notes.append(
            f"link '{link_name}' touches the ground with {len(points)} spheres in place of its "
            "own collision shapes"
        )

    def restore_boxes(self, link_name: str) -> bool:
        """Gives a link the boxes around the collision meshes that it has lost.

        Args:
            link_name: The link.

        Returns:
            Whether there are any.
        """
        boxes = self.lost_shapes.get(link_name, [])
        link = self.link(link_name)
        for index, (low, high) in enumerate(boxes):
            name = f"{link_name}_box_{index}"
            _add_collision(link, name, (low + high) / 2, "box", size=_numbers(high - low))
        if boxes:
            self.notes.append(
                f"link '{link_name}' collides as the box around each mesh that it had"
            )
        return bool(boxes)

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
    """Reads a URDF, to be changed.

    Args:
        path: The file.

    Raises:
        ValueError: It does not exist, or is no URDF.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"URDF '{path}' does not exist")
    try:
        root = _parsed(path.read_bytes())
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
    return UrdfCopy(source=path, root=root)


def _parsed(content: bytes) -> ET.Element:
    """The outermost element; elements that Drake knows by their prefix keep it."""
    root = None
    prefixes = {"drake": _DRAKE}
    parser = ET.iterparse(io.BytesIO(content), events=("start-ns", "start"))
    for event, value in parser:
        if event == "start-ns":
            prefixes[value[0]] = value[1]
        elif root is None:
            root = value
    assert root is not None  # There is no XML without an element.
    # Drake looks at the prefix alone, whatever address a file gives it.
    own = f"{{{prefixes.pop('drake')}}}"
    for element in root.iter():
        if element.tag.startswith(own):
            element.tag = f"{{{_DRAKE}}}{element.tag.removeprefix(own)}"
    for prefix, address in prefixes.items():
        ET.register_namespace(prefix, address)
    ET.register_namespace("drake", _DRAKE)
    return root


def _remove(element: ET.Element, tag: str) -> None:
    """Takes the parts of a kind out of an element."""
    for part in element.findall(tag):
        element.remove(part)


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.5g}" for value in values)


def _add_collision(
    link: ET.Element, name: str, center: np.ndarray, shape: str, **sizes: str
) -> None:
    collision = ET.SubElement(link, "collision", name=name)
    ET.SubElement(collision, "origin", xyz=_numbers(center), rpy="0 0 0")
    ET.SubElement(ET.SubElement(collision, "geometry"), shape, sizes)


def origin_of(element: ET.Element) -> list[float]:
    """Where an element lies in its parent: xyz [m] and rpy [rad], (6,)."""
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
    """An attribute of an element; NaN where there is none, or no number."""
    try:
        return math.nan if element is None else float(element.get(key, "nan"))
    except ValueError:
        return math.nan
