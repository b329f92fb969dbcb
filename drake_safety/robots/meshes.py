"""Meshes in formats that Drake does not read: glTF files to be seen, convex hulls to collide."""

from __future__ import annotations

import hashlib
import json
import os
import re
import warnings
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.extras import MissingExtraError, require_extra
from drake_safety.files.atomic import write_file
from drake_safety.robots.model_files import model_file

if TYPE_CHECKING:
    import trimesh

SHOWN_FORMATS = (".gltf", ".obj", ".vtk")  # That Drake renders.
CACHE_VARIABLE = "DRAKE_SAFETY_CACHE"
_TRANSPARENCY = re.compile(r"^\s*Tr\s+(\d+\.?\d*)\s*$", re.MULTILINE)  # In an MTL file.
_BARE_FACE = re.compile(r"^\s*f\s(?:.*\s)?-?\d+(?:/-?\d*)?(?=\s|$)", re.MULTILINE)
"""A corner without a normal in an OBJ file, which Drake's renderer refuses."""
_MESH = re.compile(r"""(?:file(?:name)?\s*=\s*["']|<uri>\s*)([^"'<>]+\.\w+)""")
_GREY = [0.6, 0.6, 0.6, 1.0]
_UP_AXIS = re.compile(r"<up_axis>\s*(\w+)")  # In a COLLADA file.
_X_ZY = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])  # From y up to z up.
_VERSION = b"4"  # Version of the conversion, part of the cache's keys.
_THINNEST_M = 1e-3  # Edge of the box around a flat mesh.
_FLAT_M = 1e-6  # Extent below which points lie in a plane.


def cache_folder() -> Path:
    """Returns ``$DRAKE_SAFETY_CACHE``, else ``drake_safety`` in ``$XDG_CACHE_HOME`` or ~/.cache."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get(CACHE_VARIABLE) or Path(base, "drake_safety"))


def check_meshes(model: Path) -> None:
    """Checks the meshes of a model file, or the mesh that it is: damaged meshes crash Drake."""
    text = "" if model.suffix in SHOWN_FORMATS else model.read_text("utf-8", "replace")
    for url in {str(model), *_MESH.findall(text)}:
        try:
            path = model_file(url, str(model.parent))
        except (ValueError, MissingExtraError):
            continue  # Others say what they cannot find.
        if path.suffix.lower() in _FAULTS and path.is_file():
            if fault := _fault(path, path.stat().st_mtime_ns):
                raise ValueError(f"mesh '{path}' {fault}: export it again")


@lru_cache(maxsize=4096)
def _fault(path: Path, changed_ns: int) -> str:
    del changed_ns  # Part of the cache key only.
    try:
        return _FAULTS[path.suffix.lower()](path.read_bytes())
    except (KeyError, IndexError, TypeError, ValueError) as error:
        return f"is damaged: {error}"


def _obj_fault(content: bytes) -> str:
    lines = [line.split() for line in content.replace(b"\\\n", b" ").splitlines()]
    points = [line[1:4] for line in lines if line[:1] == [b"v"]]
    faces = (line[1:] for line in lines if line[:1] == [b"f"])
    corners = [corner.split(b"/")[0] for face in faces for corner in face]
    if not np.isfinite(np.array(points, dtype=float)).all():
        return "has a vertex that is not three finite numbers"
    index = np.array(corners, dtype=float)
    wrong = index[(index == 0) | (np.abs(index) > len(points))]
    if len(wrong):
        return f"has {len(points)} vertices and a face of vertex {wrong[0]:.0f}"
    return "" if corners else "has no faces"


def _gltf_fault(content: bytes) -> str:
    mesh = json.loads(content)
    views, buffers = mesh.get("bufferViews", []), mesh.get("buffers", [])
    for accessor in mesh.get("accessors", []):
        view = views[accessor.get("bufferView", 0)]
        if view.get("byteOffset", 0) + view["byteLength"] > buffers[view["buffer"]]["byteLength"]:
            return "has a view beyond its buffer"
    return ""


def _vtk_fault(content: bytes) -> str:
    points = re.search(rb"^POINTS\s+(\d+)", content, re.M)
    cells = re.search(rb"^CELLS\s+\d+\s+\d+\s+([\d\s]+)", content, re.M)
    if points is None or cells is None:
        return ""  # It is binary.
    corners = np.array(cells[1].split(), dtype=int).reshape(-1, 5)[:, 1:]  # Tetrahedra.
    is_beyond = corners.max(initial=0) >= int(points[1])
    return f"has {int(points[1])} points and a cell of point {corners.max()}" if is_beyond else ""


_FAULTS = {".obj": _obj_fault, ".gltf": _gltf_fault, ".vtk": _vtk_fault}


@lru_cache(maxsize=1024)
def is_shown(path: Path) -> bool:
    """Whether Drake renders a mesh as it is; MeshLab may declare opaque OBJ files transparent."""
    materials = path.with_suffix(".mtl")
    if path.suffix.lower() != ".obj" or not materials.is_file():
        return path.suffix.lower() in SHOWN_FORMATS
    transparency = _TRANSPARENCY.findall(materials.read_text("utf-8", "replace"))
    return not transparency or min(map(float, transparency)) < 1.0


def shown_mesh(path: Path, rgba: str = "") -> Path:
    """The file itself if Drake renders it, else a glTF file in the cache, coloured "r g b a"."""
    is_bare = path.suffix.lower() == ".obj" and find_spec("trimesh") is not None
    if is_shown(path) and not (is_bare and _BARE_FACE.search(path.read_text("utf-8", "replace"))):
        return path
    if not path.is_file():
        raise ValueError(f"mesh '{path}' does not exist")
    digest = hashlib.sha256(_VERSION + rgba.encode() + path.read_bytes()).hexdigest()
    target = cache_folder() / "meshes" / f"{path.stem}-{digest[:16]}.gltf"
    if not target.is_file():
        write_file(target, _to_gltf(path, rgba))  # Other processes may read the cache.
    return target


def mesh_points(path: Path) -> np.ndarray:
    """Returns the vertices of a mesh, (n, 3), in the mesh's units."""
    return np.array(_scene(path).to_mesh().vertices, dtype=float)


def convex_hull(points: np.ndarray) -> trimesh.Trimesh:
    """Returns a hull of the points (n, 3) [m] that are extreme in 42 directions; a box if flat."""
    from trimesh import convex, creation

    if np.linalg.matrix_rank(points - points.mean(axis=0), tol=_FLAT_M) < 3:
        low, high = points.min(axis=0), points.max(axis=0)
        half, middle = 0.5 * np.maximum(high - low, _THINNEST_M), 0.5 * (low + high)
        return creation.box(bounds=[middle - half, middle + half])
    directions = creation.icosphere(subdivisions=1).vertices
    corners = convex.convex_hull(points).vertices
    return convex.convex_hull(corners[np.unique(np.argmax(corners @ directions.T, axis=0))])


def above(hull: trimesh.Trimesh, up: np.ndarray, height_m: float) -> trimesh.Trimesh | None:
    """Returns the part of a hull above a height along the unit vector ``up`` (3,); None if none."""
    from trimesh.intersections import slice_faces_plane

    if (hull.vertices @ up).max() <= height_m:
        return None
    return convex_hull(slice_faces_plane(hull.vertices, hull.faces, up, height_m * up)[0])


def _scene(path: Path) -> trimesh.Scene:
    # trimesh reads COLLADA files through the other.
    modules = ("trimesh", "collada") if path.suffix.lower() == ".dae" else ("trimesh",)
    require_extra("robots", f"mesh '{path}', as Drake does not read {path.suffix} files", *modules)
    import trimesh

    check_meshes(path)
    try:
        with warnings.catch_warnings():
            # The reader of COLLADA sets shapes of arrays, which NumPy deprecates from 2.5 on.
            warnings.simplefilter("ignore", DeprecationWarning)
            scene = trimesh.load_scene(path)
    except Exception as error:  # trimesh's readers raise many kinds of exceptions.
        raise ValueError(f"mesh '{path}' cannot be read: {error}") from error
    if scene.bounds is None:
        raise ValueError(f"mesh '{path}' is empty, or has no surface that trimesh can read")
    if path.suffix.lower() == ".dae":
        # COLLADA states its unit and its vertical axis; trimesh applies neither.
        if scene.units not in (None, "meters"):
            scene = scene.convert_units("meters")
        up = _UP_AXIS.search(path.read_text("utf-8", "replace"))
        if up is None or up[1] == "Y_UP":  # COLLADA's default.
            scene.apply_transform(_X_ZY)
    return scene


def _to_gltf(path: Path, rgba: str) -> bytes:
    scene = _scene(path)
    import trimesh

    is_coloured = is_shown(path) and path.with_suffix(".mtl").is_file()
    if path.suffix.lower() in (".stl", ".obj") and not is_coloured:
        colour = [float(value) for value in rgba.split()] or _GREY
        for mesh in scene.geometry.values():
            material = trimesh.visual.material.PBRMaterial(
                baseColorFactor=colour, metallicFactor=0.0, roughnessFactor=0.8
            )
            mesh.visual = trimesh.visual.TextureVisuals(material=material)
    # In glTF the y axis points up; Drake rotates it back to z.
    scene.apply_transform(_X_ZY.T)
    export = trimesh.exchange.gltf.export_gltf
    (content,) = export(scene, merge_buffers=True, embed_buffers=True).values()
    return bytes(content)
