"""Converts a URDF for Drake, as `drake-safety new` does, and records every change."""

from __future__ import annotations

import contextlib
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from drake_safety.extras import MissingExtraError
from drake_safety.robots.mesh_cache import SHOWN_FORMATS, mesh_points, shown_mesh
from drake_safety.robots.model_files import model_file
from drake_safety.robots.urdf_copy import UrdfCopy, number, origin_of, read_urdf

_IGNORED = ("calibration", "safety_controller")
"""Elements of a joint that Drake ignores with a warning."""
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def simulatable_copy(path: Path) -> UrdfCopy:
    """Reads a URDF, replaces what Drake rejects, and collects its meshes.

    Visual meshes that Drake does not render are converted, see
    :func:`~drake_safety.robots.mesh_cache.shown_mesh`, or left out if that fails. Collision meshes
    that Drake does not read are left out.

    Raises:
        ValueError: The file does not exist or is not a URDF.
    """
    copy = read_urdf(path)
    for element in copy.root.findall("gazebo"):
        copy.root.remove(element)
    for joint in copy.root.findall("joint"):
        for element in [part for part in joint if part.tag in _IGNORED]:
            joint.remove(element)
    copy.free_fixed_joints()
    _drop_transmissions(copy)
    _drop_friction(copy)
    _fix_inertias(copy)
    _tell_materials_apart(copy)
    _gather_visual_meshes(copy)
    _gather_collision_meshes(copy)
    for link in copy.root.findall("link"):
        if link.find("visual") is None:
            # Links without visuals show their collision shapes.
            for shape in link.findall("collision"):
                visual = ET.SubElement(link, "visual")
                visual.extend(part for part in shape if part.tag in ("origin", "geometry"))
    return copy


def _drop_transmissions(copy: UrdfCopy) -> None:
    """Removes transmissions that Drake ignores with a warning, and their reductions."""
    fixed = {joint.get("name") for joint in copy.root.findall("joint[@type='fixed']")}
    for transmission in copy.root.findall("transmission"):
        kind, joint = transmission.find("type"), transmission.find("joint")
        name = "" if kind is None or kind.text is None else kind.text.strip()
        is_simple = name.rpartition("/")[2] == "SimpleTransmission"
        if not is_simple or (joint is not None and joint.get("name") in fixed):
            copy.root.remove(transmission)
            continue
        for actuator in transmission.findall("actuator"):
            for reduction in actuator.findall("mechanicalReduction"):
                actuator.remove(reduction)


def _drop_friction(copy: UrdfCopy) -> None:
    """Removes dry friction, which Drake does not simulate from a URDF."""
    for joint in copy.root.iter("joint"):
        dynamics = joint.find("dynamics")
        if dynamics is not None:
            friction = number(dynamics, "friction")
            dynamics.attrib.pop("friction", None)
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
        inertial, inertia = link.find("inertial"), link.find("inertial/inertia")
        if inertial is None or inertia is None:
            continue
        if number(inertial.find("mass"), "value") == 0:
            link.remove(inertial)
            continue
        xx, yy, zz, xy, xz, yz = (
            number(inertia, key) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        )
        moments = np.nan_to_num([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        principal = np.linalg.eigvalsh(moments)
        # Flat and thin bodies are allowed.
        if principal[0] < 1e-6 * principal[2] and np.any([xy, xz, yz]):
            for key in ("ixy", "ixz", "iyz"):
                inertia.set(key, "0")
            copy.notes.append(
                f"link '{link.get('name')}' has an impossible inertia; its products of inertia are "
                "set to zero"
            )
        elif 0 < principal[0] and principal[2] > (1 + 1e-6) * (principal[0] + principal[1]):
            # The moments of any body satisfy the triangle inequality.
            values, axes = np.linalg.eigh(moments)
            values[2] = 0.999 * (values[0] + values[1])  # Digits are rounded.
            changed = axes @ np.diag(values) @ axes.T
            rows, columns = np.triu_indices(3)
            for key, value in zip(_MOMENTS, changed[rows, columns], strict=True):
                inertia.set(key, f"{value:.9g}")
            copy.notes.append(
                f"link '{link.get('name')}' has an impossible inertia; its largest moment is "
                "reduced to the sum of the others"
            )


def _tell_materials_apart(copy: UrdfCopy) -> None:
    """Renames materials that share a name but not a colour."""
    seen: dict[str, list[tuple[str, ...]]] = {}
    for material in copy.root.iter("material"):
        content = tuple(
            _plain(value) for part in material for value in " ".join(part.attrib.values()).split()
        )
        if not content:
            continue  # A reference to a material.
        name = material.get("name", "")
        known = seen.setdefault(name, [])
        if content not in known:
            known.append(content)
        index = known.index(content)
        if index:
            material.set("name", f"{name}_{index}")
    for name, contents in seen.items():
        if len(contents) > 1:
            copy.notes.append(
                f"the material '{name}' has {len(contents)} colours; now each has its own name"
            )


def _plain(value: str) -> str:
    """Canonical form of a number, so that 0 and 0.0 are equal."""
    try:
        return f"{float(value):g}"
    except ValueError:
        return value


def _gather_visual_meshes(copy: UrdfCopy) -> None:
    converted: list[str] = []
    lost: dict[str, list[str]] = {}  # By the reason.

    def shown(url: str, rgba: str) -> str:
        file = _mesh_file(url, copy.source)
        if file is None:
            lost.setdefault(
                "visual meshes that are not where the URDF says are left out: {}", []
            ).append(url)
            return ""
        try:
            mesh = shown_mesh(file, rgba)
        except MissingExtraError:
            lost.setdefault(
                "visual meshes that Drake does not render are left out: {}; install their "
                "converter by `pip install 'drake_safety[robots]'` and write the folder again",
                [],
            ).append(file.name)
            return ""
        except ValueError as error:
            lost.setdefault("a visual is left out: {}", []).append(str(error))
            return ""
        if mesh != file:
            converted.append(file.name)
        return _gather(copy, mesh, file.name if mesh == file else f"{file.stem}.gltf")

    copy.replace_visual_meshes(shown)
    if converted:
        copy.notes.append(f"visual meshes are converted to glTF: {_listed(converted)}")
    copy.left_out += [reason.format(_listed(names)) for reason, names in lost.items()]
    copy.notes += copy.left_out


def _gather_collision_meshes(copy: UrdfCopy) -> None:
    lost: list[str] = []
    for link in copy.root.findall("link"):
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
            lost.append(url if file is None else file.name)
            points = copy.lost_meshes.setdefault(link.get("name", ""), [])
            if file is not None:
                points += _points(copy, file, shape, mesh)
    if lost:
        copy.notes.append(
            f"collision meshes that Drake cannot read, or that do not exist, are left out: "
            f"{_listed(lost)}"
        )


def _gather(copy: UrdfCopy, file: Path, name: str) -> str:
    """Adds a mesh to the copy and returns its name; equal names get separate folders."""
    index = 0
    while True:
        target = f"meshes/{index}/{name}" if index else f"meshes/{name}"
        if copy.meshes.setdefault(target, file) == file:
            return target
        index += 1


def _listed(names: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(names))


def _points(copy: UrdfCopy, file: Path, shape: ET.Element, mesh: ET.Element) -> list[np.ndarray]:
    """Vertices in the link's frame; none, with a note, if the mesh cannot be read."""
    try:
        points = mesh_points(file)
    except MissingExtraError as error:
        note = (
            "no shapes are fitted to collision meshes that Drake does not read; install what does "
            f"it by `pip install '{error.needs}'` and write the folder again"
        )
    except ValueError as error:
        note = f"no shape is fitted to a collision mesh: {error}"
    else:
        scale = [float(value) for value in mesh.get("scale", "1 1 1").split()]
        origin = origin_of(shape)
        X_LM = RigidTransform(RollPitchYaw(origin[3:]), origin[:3])
        return [(X_LM @ (points * scale).T).T]
    if note not in copy.left_out:
        copy.left_out.append(note)
        copy.notes.append(note)
    return []


def _mesh_file(url: str, source: Path) -> Path | None:
    """The file of a mesh's URL: in a ROS package around the URDF, or in an installed package."""
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
        if scheme == "package":
            with contextlib.suppress(ValueError):
                candidates.append(model_file(url))
    return next((file for file in candidates if file.is_file()), None)
