"""Converts a URDF for Drake, as `drake-safety new` does, and records every change."""

from __future__ import annotations

import contextlib
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from drake_safety.extras import MissingExtraError
from drake_safety.files.reading import is_number
from drake_safety.robots.meshes import SHOWN_FORMATS, convex_hull, mesh_points, shown_mesh
from drake_safety.robots.model_files import model_file
from drake_safety.robots.urdf_copy import UrdfCopy, as_number, number, pose_of, read_urdf, remove

if TYPE_CHECKING:
    import trimesh

_Mesh = TypeVar("_Mesh")
_IGNORED = ("calibration", "safety_controller")  # By Drake, with a warning.
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_ROWS, _COLUMNS = np.triu_indices(3)
_ROUNDING = 1e-6  # Of the digits of moments of inertia.
_NOISE = 1e-12  # Of moments of inertia that should be zero [kg·m²].
_WATER_KG_M3 = 1000.0  # Density of the ball in place of a body whose inertia is negative.


def simulatable_copy(path: Path) -> UrdfCopy:
    """Reads a URDF, replaces what Drake rejects, and collects its meshes.

    Of meshes that Drake does not read, visual ones are converted to glTF and collision ones become
    convex hulls, see :mod:`~drake_safety.robots.meshes`; what cannot be read is left out.

    Raises:
        ValueError: The file does not exist or is not a URDF.
    """
    copy = read_urdf(path)
    remove(copy.root, "gazebo")
    for joint in copy.root.findall("joint"):
        for tag in _IGNORED:
            remove(joint, tag)
    copy.free_fixed_joints()
    copy.drop_world()
    _drop_zeros(copy)
    _drop_transmissions(copy)
    _drop_friction(copy)
    _fix_inertias(copy)
    _tell_materials_apart(copy)
    lost: dict[str, list[str]] = {}  # Names by the reason.
    _gather_visual_meshes(copy, lost)
    hulls = _gather_collision_meshes(copy, lost)
    copy.left_out = [f"{reason}: {_listed(names)}" for reason, names in lost.items()]
    copy.notes += copy.left_out
    for link in copy.root.findall("link"):
        if link.find("visual") is None:
            # Links without visuals show their collision shapes.
            for shape in link.findall("collision"):
                visual = ET.SubElement(link, "visual")
                visual.extend(part for part in shape if part.tag in ("origin", "geometry"))
    for name, of_link in hulls.items():
        copy.set_hulls(name, of_link)
    return copy


def _drop_zeros(copy: UrdfCopy) -> None:
    """Removes shapes without extent, and speed limits of zero, at which no joint would move."""
    for link, shape, words in copy.empty_shapes():
        link.remove(shape)
        copy.warn(f"{words}: it is left out")
    zeros = []
    for joint in copy.root.findall("joint"):
        for limit in joint.findall("limit"):
            if joint.get("type") != "fixed" and number(limit, "velocity") == 0:
                del limit.attrib["velocity"]
                zeros.append(joint.get("name"))
    if zeros:
        copy.warn(f'velocity="0" of joints {zeros} is read as no limit')


def _drop_transmissions(copy: UrdfCopy) -> None:
    """Removes transmissions that Drake ignores with a warning, and their reductions."""
    fixed = {joint.get("name") for joint in copy.root.findall("joint[@type='fixed']")}
    for transmission in copy.root.findall("transmission"):
        kind, joint = transmission.findtext("type", "").strip(), transmission.find("joint")
        is_simple = kind.rpartition("/")[2] == "SimpleTransmission"
        if not is_simple or (joint is not None and joint.get("name") in fixed):
            copy.root.remove(transmission)
        for actuator in transmission.findall("actuator"):
            remove(actuator, "mechanicalReduction")


def _drop_friction(copy: UrdfCopy) -> None:
    """Removes dry friction, which Drake does not simulate from a URDF."""
    for joint in copy.root.iter("joint"):
        for dynamics in joint.findall("dynamics[@friction]"):
            friction = as_number(dynamics.attrib.pop("friction"))
            if friction > 0:
                copy.joint_friction[joint.get("name", "")] = friction
    if copy.joint_friction:
        copy.notes.append(
            f"the dry friction of {len(copy.joint_friction)} joints is left out; the scenario sets "
            "it as joint_friction_nm"
        )


def _fix_inertias(copy: UrdfCopy) -> None:
    """Removes impossible products of inertia, and inertias of bodies without mass."""
    for link in copy.root.iter("link"):
        inertia, mass = link.find("inertial/inertia"), number(link.find("inertial/mass"), "value")
        if inertia is None:
            continue
        if not mass > 0:  # Or not stated.
            remove(link, "inertial")
            continue
        moments = np.zeros((3, 3))
        moments[_ROWS, _COLUMNS] = np.nan_to_num([number(inertia, key) for key in _MOMENTS])
        moments[_COLUMNS, _ROWS] = moments[_ROWS, _COLUMNS]
        values, axes = np.linalg.eigh(moments)
        lowest, tell = moments.diagonal().min(), copy.notes.append
        # Flat and thin bodies are allowed.
        if lowest < -max(_ROUNDING * values[2], _NOISE):
            radius_m = (0.75 * mass / (np.pi * _WATER_KG_M3)) ** (1 / 3)
            changed, tell = 0.4 * mass * radius_m**2 * np.eye(3), copy.warn
            how = f"{lowest:g} is replaced by {changed[0, 0]:.3g} kg·m² about all axes, as of a "
            how += "ball of water of its mass"
        elif values[0] < _ROUNDING * values[2] and np.triu(moments, 1).any():
            changed, how = np.diag(np.diag(moments)), "its products of inertia are set to zero"
        elif values[1] > 0 and values[2] > (1 + _ROUNDING) * (values[0] + values[1]):
            # The moments of any body satisfy the triangle inequality.
            values[2] = max(0.999 * (values[0] + values[1]), values[1])  # Digits are rounded.
            changed = axes @ np.diag(values) @ axes.T
            how = "its largest moment is reduced to the sum of the others"
        else:
            continue
        for key, row, column in zip(_MOMENTS, _ROWS, _COLUMNS, strict=True):
            if changed[row, column] != moments[row, column]:
                inertia.set(key, f"{changed[row, column]:.9g}")
        tell(f"link '{link.get('name')}' has an impossible inertia; {how}")


def _tell_materials_apart(copy: UrdfCopy) -> None:
    """Renames materials that share a name but not a colour."""
    seen: dict[str, list[list[str]]] = {}
    for material in copy.root.iter("material"):
        values = " ".join(value for part in material for value in part.attrib.values())
        if not values:
            continue  # A reference to a material.
        # 0 and 0.0 are equal.
        content = [f"{float(v):g}" if is_number(v) else v for v in values.split()]
        name = material.get("name", "")
        known = seen.setdefault(name, [])
        if content not in known:
            known.append(content)
        if index := known.index(content):
            material.set("name", f"{name}_{index}")
    copy.notes += [
        f"the material '{name}' has {len(contents)} colours; now each has its own name"
        for name, contents in seen.items()
        if len(contents) > 1
    ]


def _gather_visual_meshes(copy: UrdfCopy, lost: dict[str, list[str]]) -> None:
    converted: list[str] = []

    def shown(url: str, rgba: str) -> str:
        file = _mesh_file(url, copy.source)
        mesh = _converted("visual", url, file, lambda file: shown_mesh(file, rgba), lost)
        if file is None or mesh is None:
            return ""
        if mesh == file:
            return _gather(copy, file, file.name)
        converted.append(file.name)
        return _gather(copy, mesh, f"{file.stem}.gltf")

    copy.replace_visual_meshes(shown)
    if converted:
        copy.notes.append(f"visual meshes are converted to glTF: {_listed(converted)}")


def _gather_collision_meshes(
    copy: UrdfCopy, lost: dict[str, list[str]]
) -> dict[str, list[trimesh.Trimesh]]:
    """Convex hulls by link, in its frame, of the meshes that Drake does not read."""
    replaced: list[str] = []
    hulls: dict[str, list[trimesh.Trimesh]] = {}
    for link in copy.root.findall("link"):
        name = link.get("name", "")
        for shape in link.findall("collision"):
            mesh = shape.find("geometry/mesh")
            if mesh is None:
                continue
            url = mesh.get("filename", "")
            file = _mesh_file(url, copy.source)
            if file is not None and file.suffix.lower() in SHOWN_FORMATS:
                mesh.set("filename", _gather(copy, file, file.name))
                continue
            link.remove(shape)
            hull = _converted("collision", url, file, partial(_hull, shape, mesh), lost)
            if file is None or hull is None:
                copy.lost_links.setdefault(name, []).append(url)
            else:
                hulls.setdefault(name, []).append(hull)
                replaced.append(file.name)
    if replaced:
        copy.notes.append(
            "collision meshes that Drake does not read are replaced by convex hulls: "
            f"{_listed(replaced)}"
        )
    return hulls


def _hull(shape: ET.Element, mesh: ET.Element, file: Path) -> trimesh.Trimesh:
    """The convex hull of a collision mesh in the link's frame."""
    scale = [float(word) for word in mesh.get("scale", "1 1 1").split()]
    X_LM = pose_of(shape)
    return convex_hull((X_LM @ (mesh_points(file) * scale).T).T)


def _converted(
    kind: str,
    url: str,
    file: Path | None,
    convert: Callable[[Path], _Mesh],
    lost: dict[str, list[str]],
) -> _Mesh | None:
    """A mesh that Drake reads; None, with the reason in ``lost``, if it is left out."""
    name, why, until = url if file is None else file.name, "are not where the URDF says", ""
    try:
        if file is not None:
            return convert(file)
    except MissingExtraError as error:
        why = "Drake does not read"
        until = f", until you `pip install '{error.needs}'` and write the folder again"
    except ValueError as error:
        why, name = "cannot be read", str(error) if name in str(error) else f"{name}: {error}"
    lost.setdefault(f"{kind} meshes that {why} are left out{until}", []).append(name)
    return None


def _gather(copy: UrdfCopy, file: Path, name: str) -> str:
    """Adds a mesh to the copy and returns its name; equal names get separate folders."""
    folders = chain(["meshes"], (f"meshes/{index}" for index in count(1)))
    targets = (f"{folder}/{name}" for folder in folders)
    return next(target for target in targets if copy.meshes.setdefault(target, file) == file)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(names))


def _mesh_file(url: str, source: Path) -> Path | None:
    """The file of a mesh's URL: in a ROS package around the URDF, or in an installed package."""
    scheme, _, rest = url.rpartition("://")
    if scheme not in ("", "package", "file", "model"):
        return None
    candidates = [source.parent / rest]
    if scheme in ("package", "model"):
        candidates = [folder / rest for folder in source.resolve().parents]
        if scheme == "package":
            with contextlib.suppress(ValueError):
                candidates.append(model_file(url))
    return next((file for file in candidates if file.is_file()), None)
