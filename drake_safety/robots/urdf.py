"""URDFs as Drake reads them: faults that it does not name, and what it rejects or cannot show."""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from pathlib import Path

from drake_safety.files.reading import is_number
from drake_safety.robots.meshes import is_shown, shown_mesh
from drake_safety.robots.model_files import model_file

DRAKE = "http://drake.mit.edu"  # Namespace of Drake's elements.
ET.register_namespace("drake", DRAKE)
_PREFIX = re.compile(rb"""(xmlns:drake\s*=\s*)["'][^"']*["']""")
_VECTORS = {"xyz", "rpy", "size", "scale", "radius", "length"}
_SIZES = ("size", "radius", "length", "scale")  # Attributes of shapes.


def read_urdf(path: Path) -> ET.Element:
    """Reads the <robot> of a URDF, and refuses what Drake would misread or not name."""
    if not path.is_file():
        raise ValueError(f"URDF '{path}' does not exist")
    content = path.read_bytes()
    try:
        # Drake knows its elements by their prefix, for any address in the file.
        root = ET.fromstring(_PREFIX.sub(rf'\1"{DRAKE}"'.encode(), content))
    except ET.ParseError as error:
        raise ValueError(f"'{path}' is not XML: {error}") from error
    if root.tag != "robot":
        what = f"its root element is <{root.tag}>, expected <robot>"
        raise ValueError(f"'{path}' is not a URDF: {what}. Convert it first")
    # It may be in a comment, too.
    if b"<xacro:" in content and any("xacro" in element.tag for element in root.iter()):
        raise ValueError(f"'{path}' is not expanded yet: run `xacro {path.name} > robot.urdf`")
    if not root.findall("link"):
        raise ValueError(f"'{path}' has no links")
    for fault in _faults(root):
        raise ValueError(f"'{path}': {fault}")
    return root


def _faults(root: ET.Element) -> Iterator[str]:
    """Faults that Drake misreads, or refuses without the name of the link or joint."""
    links, joints = root.findall("link"), joint_elements(root)
    for link in links:
        mass = number(element := link.find("inertial/mass"), "value")
        if element is not None and not 0.0 <= mass < math.inf:
            yield f"link '{link.get('name')}' has a mass of {mass:g} kg"
    parents: dict[str | None, list[str | None]] = {}
    for joint in joints:
        for child in joint.findall("child"):
            parents.setdefault(child.get("link"), []).append(joint.get("name"))
    for name, several in parents.items():
        if len(several) > 1:
            yield f"link '{name}' is the child of joints {several}; expected one, as in a tree"
    for owner in (*links, *joints):
        for part in owner.iter():
            for key, text in part.attrib.items():
                if key in _VECTORS and not all(map(is_number, text.split())):
                    what = f"{owner.tag} '{owner.get('name')}' has {key}=\"{text}\""
                    yield f"{what} in <{part.tag}>; expected numbers"
    for joint in joints:
        kind, limit = joint.get("type"), joint.find("limit")
        wrong = [key for key in ("effort", "velocity") if number(limit, key) < 0]
        if number(limit, "lower") > number(limit, "upper") and kind in ("revolute", "prismatic"):
            wrong = ["lower", "upper"]
        if limit is not None and wrong and kind != "fixed":
            stated = " ".join(f'{key}="{limit.get(key)}"' for key in wrong)
            yield f"joint '{joint.get('name')}' has {stated}; expected lower < upper, and positive"


def drake_urdf(path: Path, *, with_collisions: bool, with_visuals: bool) -> str | None:
    """Returns a URDF's text as Drake can build and render it; None if that is the file itself."""
    root = read_urdf(path)
    as_read = ET.tostring(root, encoding="unicode")
    remove_fixed_mimics(root)
    if not with_collisions:
        for link in root.findall("link"):
            remove(link, "collision")

    def shown(url: str, rgba: str) -> str:
        mesh = model_file(url, str(path.parent))
        return url if is_shown(mesh) else shown_mesh(mesh, rgba).resolve().as_uri()

    if with_visuals:
        replace_visual_meshes(root, shown)
    if ET.tostring(root, encoding="unicode") == as_read:
        return None
    # A text has no folder.
    for mesh in root.iter("mesh"):
        url = mesh.get("filename", "")
        if "://" not in url:
            mesh.set("filename", (path.parent / url).resolve().as_uri())
    return ET.tostring(root, encoding="unicode")


def remove_fixed_mimics(root: ET.Element) -> None:
    """Removes couplings of fixed joints, which Drake rejects."""
    for joint in root.findall("joint[@type='fixed']"):
        remove(joint, "mimic")


def replace_visual_meshes(root: ET.Element, shown: Callable[[str, str], str]) -> None:
    """Replaces visual meshes by ``shown(url, rgba)``, or removes them where that is ""."""
    shared = {material.get("name"): _colour(material) for material in root.findall("material")}
    for link, visual, mesh in shape_meshes(root, "visual"):
        material, url = visual.find("material"), mesh.get("filename", "")
        name = None if material is None else material.get("name")
        mesh.set("filename", shown(url, _colour(material) or shared.get(name, "")))
        if not mesh.get("filename"):
            link.remove(visual)
        elif Path(mesh.get("filename", "")).suffix != Path(url).suffix:  # It has its own material.
            remove(visual, "material")


def shape_meshes(root: ET.Element, kind: str) -> list[tuple[ET.Element, ET.Element, ET.Element]]:
    """Returns the meshes of ``visual`` or ``collision`` shapes: link, shape, mesh."""
    return [
        (link, shape, mesh)
        for link in root.findall("link")
        for shape in link.findall(kind)
        for mesh in shape.findall("geometry/mesh")
    ]


def empty_shapes(root: ET.Element) -> list[tuple[ET.Element, ET.Element, str]]:
    """Returns shapes without extent: link, shape, and both in words."""
    empty = []
    for link in root.findall("link"):
        for shape in (*link.findall("visual"), *link.findall("collision")):
            for part in shape.findall("geometry/*"):
                stated = {key: part.get(key, "") for key in _SIZES if key in part.attrib}
                sizes = [*map(as_number, " ".join(stated.values()).split())]
                # Meshes may be mirrored by a negative scale.
                if 0.0 in sizes or ("scale" not in stated and any(x < 0 for x in sizes)):
                    what = f"the {shape.tag} of link '{link.get('name')}'"
                    size = ", ".join(f"{key} {text}" for key, text in stated.items())
                    words = f"{what} is a {part.tag.rpartition('}')[2]} of {size}"
                    empty.append((link, shape, words))
    return empty


def joint_elements(root: ET.Element) -> list[ET.Element]:
    """Returns the joints of a URDF, including joints that only Drake knows."""
    return [element for element in root if element.tag in ("joint", f"{{{DRAKE}}}joint")]


def remove(element: ET.Element, tag: str) -> None:
    """Removes all children of an element with a tag."""
    for part in element.findall(tag):
        element.remove(part)


def number(element: ET.Element | None, key: str) -> float:
    """Returns an attribute as a number; NaN if it is missing or not a number."""
    return as_number(None if element is None else element.get(key))


def as_number(text: str | None, default: float = math.nan) -> float:
    """Returns a text as a number; the default if it is missing or not a number."""
    try:
        return float(text or default)
    except ValueError:
        return default


def _colour(material: ET.Element | None) -> str:
    colour = None if material is None else material.find("color")
    return "" if colour is None else colour.get("rgba", "")
