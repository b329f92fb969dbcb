"""Converts a URDF for Drake, as `drake-safety new` does, and records every change."""

from __future__ import annotations

import contextlib
import xml.etree.ElementTree as ET
from collections.abc import Callable
from copy import deepcopy
from functools import partial
from itertools import chain, count, product
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote

import numpy as np

from drake_safety.extras import MissingExtraError
from drake_safety.importing.urdf_copy import UrdfCopy, pose_of
from drake_safety.robots import meshes, urdf
from drake_safety.robots.model_files import model_file

if TYPE_CHECKING:
    import trimesh

# Places and tags of what Drake ignores with a warning.
_IGNORED = {".": ["gazebo"], "joint": ["calibration", "safety_controller"]}
_IGNORED |= {"transmission/actuator": ["mechanicalReduction"]}
_PLACED = "origin", "geometry"  # Parts that a collision shape and a visual share.
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_ROWS, _COLUMNS = np.triu_indices(3)
_ROUNDING = 1e-6  # Rounding of the digits of moments of inertia.
_NOISE = 1e-12  # Noise of moments of inertia that should be zero [kg·m²].


def simulatable_copy(path: Path, source: Path | None = None) -> UrdfCopy:
    """Reads a URDF, replaces what Drake rejects, and collects and converts its meshes.

    They are searched around ``source``, by default the URDF.
    """
    copy = UrdfCopy(source=source or path, root=urdf.read_urdf(path))
    urdf.remove_fixed_mimics(copy.root)
    for place, tags in _IGNORED.items():
        for element, tag in product(copy.root.findall(place), tags):
            urdf.remove(element, tag)
    copy.drop_world()
    for link, shape, words in urdf.empty_shapes(copy.root):
        link.remove(shape)
        copy.warn(f"{words}: it is left out")
    _simplify_joints(copy)
    _fix_inertias(copy)
    _name_materials(copy)
    _gather_meshes(copy)
    return copy


def _simplify_joints(copy: UrdfCopy) -> None:
    """Removes speed limits of zero, dry friction, and transmissions that Drake ignores."""
    fixed = set()
    for joint in urdf.joint_elements(copy.root):
        name, limit, dynamics = joint.get("name", ""), joint.find("limit"), joint.find("dynamics")
        if joint.get("type") == "fixed":
            fixed.add(name)
        elif limit is not None and urdf.number(limit, "velocity") == 0:
            del limit.attrib["velocity"]  # At which no joint would move.
            copy.warn(f"velocity=\"0\" of joint '{name}' is read as no limit")
        friction = None if dynamics is None else dynamics.attrib.pop("friction", None)
        if urdf.as_number(friction) > 0:
            copy.joint_friction[name] = urdf.as_number(friction)
    for transmission in copy.root.findall("transmission"):
        kind, driven = transmission.findtext("type", "").strip(), transmission.find("joint")
        is_simple = kind.rpartition("/")[2] == "SimpleTransmission"
        if not is_simple or (driven is not None and driven.get("name") in fixed):
            copy.root.remove(transmission)
    if copy.joint_friction:
        copy.notes.append("the joints' dry friction is joint_friction_nm of the scenario")


def _fix_inertias(copy: UrdfCopy) -> None:
    """Corrects impossible inertias, and removes inertias of bodies without mass."""
    for link in copy.root.iter("link"):
        inertia = link.find("inertial/inertia")
        mass = urdf.number(link.find("inertial/mass"), "value")
        if inertia is None:
            continue
        if not mass > 0:
            urdf.remove(link, "inertial")
            continue
        name, moments = link.get("name"), np.zeros((3, 3))
        moments[_ROWS, _COLUMNS] = np.nan_to_num([urdf.number(inertia, key) for key in _MOMENTS])
        moments[_COLUMNS, _ROWS] = moments[_ROWS, _COLUMNS]
        values, diagonal = np.linalg.eigvalsh(moments), moments.diagonal().copy()
        if (lowest := diagonal.min()) < -max(_ROUNDING * values[2], _NOISE):
            what = f"link '{name}' has a negative moment of inertia, {lowest:g}"
            raise ValueError(f"new: '{copy.source}': {what}")
        is_singular = values[0] < _ROUNDING * values[2] and np.triu(moments, 1).any()
        # Flat and thin bodies are allowed.
        if not is_singular and values[2] <= (1 + _ROUNDING) * (values[0] + values[1]):
            continue
        largest = int(np.argmax(diagonal))
        _, second, _ = np.sort(diagonal)
        most = max(0.999 * (diagonal.sum() - diagonal[largest]), second)  # Digits are rounded.
        diagonal[largest] = min(diagonal[largest], most)
        for key, value in zip(_MOMENTS, np.diag(diagonal)[_ROWS, _COLUMNS], strict=True):
            inertia.set(key, f"{value:.9g}")
        what = "products are set to zero, its largest moment is at most the sum of the others"
        copy.notes.append(f"link '{name}' has an impossible inertia; its {what}")


def _name_materials(copy: UrdfCopy) -> None:
    """Gives every visual a material of its own, as Drake refuses two colours of one name."""
    stated = reversed([*copy.root.iter("material")])
    parts = {material.get("name"): [*material] for material in stated if len(material)}
    for material in copy.root.findall("material"):
        copy.root.remove(material)
    for index, visual in enumerate(copy.root.findall("link/visual")):
        for material in visual.findall("material"):
            name = material.get("name", "")
            if not len(material):
                material.extend(parts.get(name, []))
            material.set("name", f"{name}_{index}")
            if not any(part.attrib for part in material):
                visual.remove(material)


def _gather_meshes(copy: UrdfCopy) -> None:
    """Adds the meshes to the copy: as they are, as glTF, or as convex hulls."""
    done: dict[str, list[str]] = {}  # Names of meshes by what became of them.
    lost: dict[str, list[str]] = {}

    def added(file: Path, name: str) -> str:
        """The name of a mesh in the copy; equal names get separate folders."""
        folders = chain(["meshes"], (f"meshes/{index}" for index in count(1)))
        targets = (f"{folder}/{name}" for folder in folders)
        return next(target for target in targets if copy.meshes.setdefault(target, file) == file)

    def converted(kind: str, url: str, convert: Callable[[Path], str]) -> str:
        """Converts a mesh; "", with the reason in ``lost``, if it is left out."""
        name, why = url, "are not where the URDF says are left out"
        try:
            if (file := _mesh_file(url, copy.source)) is not None:
                name = file.name
                meshes.check_meshes(file)
                return convert(file)
        except MissingExtraError as error:
            why = f"Drake does not read are left out, until you `pip install '{error.needs}'`"
        except ValueError as error:
            why = "cannot be read are left out"
            name = str(error) if name in str(error) else f"{name}: {error}"
        lost.setdefault(f"{kind} meshes that {why}", []).append(name)
        return ""

    def shown(file: Path, rgba: str = "") -> str:
        mesh = meshes.shown_mesh(file, rgba)
        if mesh == file:
            return added(file, file.name)
        done.setdefault("visual meshes are converted to glTF", []).append(file.name)
        return added(mesh, f"{file.stem}.gltf")

    urdf.replace_visual_meshes(
        copy.root, lambda url, rgba: converted("visual", url, partial(shown, rgba=rgba))
    )
    hulls: dict[str, list[trimesh.Trimesh]] = {}
    for link, shape, mesh in urdf.shape_meshes(copy.root, "collision"):
        name, url = link.get("name", ""), mesh.get("filename", "")

        def touched(file: Path, link: str = name, shape: ET.Element = shape) -> str:
            if file.suffix.lower() in meshes.SHOWN_FORMATS:
                return added(file, file.name)
            scale = shape.find("geometry/mesh").get("scale", "1 1 1")  # type: ignore[union-attr]
            points = meshes.mesh_points(file) * [*map(float, scale.split())]
            hulls.setdefault(link, []).append(meshes.convex_hull((pose_of(shape) @ points.T).T))
            what = "collision meshes that Drake does not read are replaced by convex hulls"
            done.setdefault(what, []).append(file.name)
            return "hull"

        copy.mesh_urls.setdefault(name, []).append(url)
        target = converted("collision", url, touched)
        mesh.set("filename", target)
        if target in ("", "hull"):
            link.remove(shape)
        if not target:
            copy.lost_links.add(name)
    copy.left_out = _counted(lost)
    copy.notes += [*_counted(done), *copy.left_out]
    for link in copy.root.findall("link"):
        # Links without visuals show their collision shapes.
        for shape in link.findall("collision") if link.find("visual") is None else ():
            visual = ET.SubElement(link, "visual")
            visual.extend(deepcopy([part for part in shape if part.tag in _PLACED]))
            for mesh in visual.iter("mesh"):
                mesh.set("filename", shown(copy.meshes[mesh.get("filename", "")]))
    for name, of_link in hulls.items():
        copy.set_hulls(name, of_link)


def _counted(names: dict[str, list[str]]) -> list[str]:
    return [f"{what}: {', '.join(dict.fromkeys(files))}" for what, files in names.items()]


def _mesh_file(url: str, source: Path) -> Path | None:
    """The file of a mesh beside a URDF, in a ROS package around it, or in an installed one."""
    scheme, _, rest = url.rpartition("://")
    rest = unquote(rest.replace("\\", "/"))
    folder = source.resolve().parent
    around = [folder, *folder.parents]
    if scheme in ("", "file"):
        homes = [path for path in around if (path / "package.xml").is_file()] + [folder.parent]
        places = [(folder / rest, home) for home in homes]
    else:
        name, _, path = rest.lstrip("/").partition("/")
        packages = [parent / name for parent in around]
        near = {*around, *packages[:4]}
        homes = [home for home in packages if home in near or (home / "package.xml").is_file()]
        if scheme == "package":
            with contextlib.suppress(ValueError, MissingExtraError):
                homes.append(model_file(f"package://{name}"))
        places = [(home / path, home) for home in homes]
    files = [(file, home) for file, home in places if file.is_file()]
    for file, home in files:
        if file.resolve().is_relative_to(home.resolve()):
            return file
    if files:
        raise ValueError("it lies outside the folders of the URDF and of its package")
    return None
