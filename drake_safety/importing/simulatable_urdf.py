"""Converts a URDF for Drake, as `drake-safety new` does, and records every change."""

from __future__ import annotations

import contextlib
import glob
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote

import numpy as np

from drake_safety.extras import MissingExtraError
from drake_safety.files.reading import is_number
from drake_safety.importing.urdf_copy import UrdfCopy, pose_of
from drake_safety.robots.meshes import (
    SHOWN_FORMATS,
    check_meshes,
    convex_hull,
    mesh_points,
    shown_mesh,
)
from drake_safety.robots.model_files import model_file
from drake_safety.robots.urdf import (
    as_number,
    empty_shapes,
    joint_elements,
    number,
    read_urdf,
    remove,
    remove_fixed_mimics,
    replace_visual_meshes,
    shape_meshes,
)

if TYPE_CHECKING:
    import trimesh

_IGNORED = (  # By Drake, with a warning: places and tags.
    (".", "gazebo"),
    ("joint", "calibration"),
    ("joint", "safety_controller"),
    ("transmission/actuator", "mechanicalReduction"),
)
_PLACED = "origin", "geometry"  # Parts that a collision shape and a visual share.
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_ROWS, _COLUMNS = np.triu_indices(3)
_ROUNDING = 1e-6  # Of the digits of moments of inertia.
_DESCRIPTIONS = ("urdf", "urdfs", "xacro", "robots", "models", "mjcf")  # Folders in a package.
_NOISE = 1e-12  # Of moments of inertia that should be zero [kg·m²].
_WATER_KG_M3 = 1000.0  # Density of the ball in place of a body whose inertia is negative.


def simulatable_copy(path: Path) -> UrdfCopy:
    """Reads a URDF, replaces what Drake rejects, and collects its meshes.

    Of meshes that Drake does not read, visual ones are converted to glTF and collision ones become
    convex hulls, see :mod:`~drake_safety.robots.meshes`; what cannot be read is left out.
    """
    copy = UrdfCopy(source=path, root=read_urdf(path))
    remove_fixed_mimics(copy.root)
    for place, tag in _IGNORED:
        for element in copy.root.findall(place):
            remove(element, tag)
    copy.drop_world()
    for link, shape, words in empty_shapes(copy.root):
        link.remove(shape)
        copy.warn(f"{words}: it is left out")
    _simplify_joints(copy)
    _fix_inertias(copy)
    _tell_materials_apart(copy)
    _gather_meshes(copy)
    return copy


def _simplify_joints(copy: UrdfCopy) -> None:
    """Removes speed limits of zero, dry friction, and transmissions that Drake ignores."""
    fixed, zeros = set(), []
    for joint in joint_elements(copy.root):
        name, limit, dynamics = joint.get("name", ""), joint.find("limit"), joint.find("dynamics")
        if joint.get("type") == "fixed":
            fixed.add(name)
        elif limit is not None and number(limit, "velocity") == 0:
            del limit.attrib["velocity"]  # At which no joint would move.
            zeros.append(name)
        friction = None if dynamics is None else dynamics.attrib.pop("friction", None)
        if as_number(friction) > 0:
            copy.joint_friction[name] = as_number(friction)
    if zeros:
        copy.warn(f'velocity="0" of joints {zeros} is read as no limit')
    for transmission in copy.root.findall("transmission"):
        kind, driven = transmission.findtext("type", "").strip(), transmission.find("joint")
        is_simple = kind.rpartition("/")[2] == "SimpleTransmission"
        if not is_simple or (driven is not None and driven.get("name") in fixed):
            copy.root.remove(transmission)
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
        if not mass > 0:
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
            remark = f"{lowest:g} is replaced by {changed[0, 0]:.3g} kg·m² about all axes, as of a "
            remark += "ball of water of its mass"
        elif values[0] < _ROUNDING * values[2] and np.triu(moments, 1).any():
            changed, remark = np.diag(np.diag(moments)), "its products of inertia are set to zero"
        elif values[1] > 0 and values[2] > (1 + _ROUNDING) * (values[0] + values[1]):
            # The moments of any body satisfy the triangle inequality.
            values[2] = max(0.999 * (values[0] + values[1]), values[1])  # Digits are rounded.
            changed = axes @ np.diag(values) @ axes.T
            remark = "its largest moment is reduced to the sum of the others"
        else:
            continue
        for key, row, column in zip(_MOMENTS, _ROWS, _COLUMNS, strict=True):
            if changed[row, column] != moments[row, column]:
                inertia.set(key, f"{changed[row, column]:.9g}")
        tell(f"link '{link.get('name')}' has an impossible inertia; {remark}")


def _tell_materials_apart(copy: UrdfCopy) -> None:
    """Gives visuals the colours of their materials; those of one name and two colours get two."""
    materials = reversed([*copy.root.iter("material")])
    parts = {one.get("name", ""): [*one] for one in materials if len(one)}  # The first of a name.
    colours: dict[str, list[list[str]]] = {}
    for parent in (copy.root, *copy.root.findall("link/visual")):
        for material in parent.findall("material"):
            name = material.get("name", "")
            if not len(material):
                material.extend(parts.get(name, []))
            values = " ".join(value for part in material for value in part.attrib.values()).split()
            if not values:
                parent.remove(material)
                continue
            # 0 and 0.0 are equal.
            colour = [f"{float(value):g}" if is_number(value) else value for value in values]
            others = colours.setdefault(name, [])
            if colour not in others:
                others.append(colour)
            if index := others.index(colour):
                material.set("name", f"{name}_{index}")
    copy.notes += [
        f"the material '{name}' has {len(several)} colours; now each has its own name"
        for name, several in colours.items()
        if len(several) > 1
    ]


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
        """What a mesh becomes; "", with the reason in ``lost``, if it is left out."""
        candidates = _mesh_files(url, copy.source)
        file = next((path for path in candidates if path.is_file()), None)
        name, why = url if file is None else file.name, "are not where the URDF says are left out"
        try:
            if file is not None:
                if not _is_inside(file, url, copy.source):
                    raise ValueError("it lies outside the folders of the URDF and of its package")
                check_meshes(file)
                return convert(file)
            for other in (other for path in candidates for other in _alike(path)):
                name = f"{url} (but '{Path(*other.parts[-len(Path(url).parts) :])}' is there)"
        except MissingExtraError as error:
            why = "Drake does not read are left out, until you "
            why += f"`pip install '{error.needs}'` and write the folder again"
        except ValueError as error:
            why = "cannot be read are left out"
            name = str(error) if name in str(error) else f"{name}: {error}"
        lost.setdefault(f"{kind} meshes that {why}", []).append(name)
        return ""

    def shown(file: Path, rgba: str = "") -> str:
        mesh = shown_mesh(file, rgba)
        if mesh == file:
            return added(file, file.name)
        done.setdefault("visual meshes are converted to glTF", []).append(file.name)
        return added(mesh, f"{file.stem}.gltf")

    replace_visual_meshes(
        copy.root, lambda url, rgba: converted("visual", url, partial(shown, rgba=rgba))
    )
    hulls: dict[str, list[trimesh.Trimesh]] = {}
    for link, shape, mesh in shape_meshes(copy.root, "collision"):
        name, url = link.get("name", ""), mesh.get("filename", "")

        def touched(file: Path, link: str = name, shape: ET.Element = shape) -> str:
            if file.suffix.lower() in SHOWN_FORMATS:
                return added(file, file.name)
            scale = shape.find("geometry/mesh").get("scale", "1 1 1")  # type: ignore[union-attr]
            points = mesh_points(file) * [*map(float, scale.split())]
            hulls.setdefault(link, []).append(convex_hull((pose_of(shape) @ points.T).T))
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
    return [f"{what}: {', '.join(dict.fromkeys(meshes))}" for what, meshes in names.items()]


def _alike(path: Path) -> Iterator[Path]:
    """Paths that differ from one by case, or by - and _, alone."""
    path = path.resolve()
    letters = (f"[{c.lower()}{c.upper()}]" if c.isalpha() else glob.escape(c) for c in str(path))
    pattern = re.sub("[-_]", "[-_]", "".join(letters))
    return Path(path.anchor).glob(pattern.lstrip("/"))


def _is_inside(file: Path, url: str, source: Path) -> bool:
    """Whether a mesh lies in the package of a URDF, in its folder, or in a folder beside that."""
    folder, real = source.resolve().parent, file.resolve()
    around = [folder, *folder.parents]
    homes = [folder, *(path for path in around if (path / "package.xml").is_file())]
    homes += [folder.parent] * (folder.name in _DESCRIPTIONS)
    scheme, _, rest = url.rpartition("://")
    name = unquote(rest).lstrip("/").partition("/")[0]
    if name and scheme in ("package", "model"):
        named = [path / name for path in around]
        near = [*around, *named[:4]]
        homes += [path for path in named if path in near or (path / "package.xml").is_file()]
        with contextlib.suppress(ValueError, MissingExtraError):
            homes.append(model_file(f"package://{name}"))
    is_beside = folder.parent in real.parent.parents
    return is_beside or any(home.resolve() in real.parents for home in homes)


def _mesh_files(url: str, source: Path) -> list[Path]:
    """Where a mesh's URL may be: in a ROS package around the URDF, or in an installed package."""
    scheme, _, rest = url.rpartition("://")
    candidates: list[Path] = []
    for name in (rest, unquote(rest.replace("\\", "/"))):  # As written, or as of Windows.
        if scheme in ("", "file"):
            candidates.append(source.parent / name)
        elif scheme in ("package", "model"):
            folders = source.resolve().parents
            candidates += [folder / name.lstrip("/") for folder in folders]
    if scheme == "package":
        with contextlib.suppress(ValueError):
            candidates.append(model_file(url))
    return candidates
