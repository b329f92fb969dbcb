"""Meshes that Drake does not read: converted once, upright and in colour; hulls of few vertices."""

import json

import numpy as np
import pytest

from drake_safety.robots.meshes import convex_hull, is_shown, mesh_points, shown_mesh

trimesh = pytest.importorskip("trimesh")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DRAKE_SAFETY_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def tower(tmp_path):
    """A box 1 by 2 by 4 m, upright."""
    path = tmp_path / "tower.stl"
    trimesh.creation.box(extents=[1.0, 2.0, 4.0]).export(path)
    return path


def assert_colour(path, rgba):
    (material,) = json.loads(path.read_text())["materials"]
    # trimesh keeps colours as bytes.
    found = material["pbrMetallicRoughness"]["baseColorFactor"]
    np.testing.assert_allclose(found, rgba, atol=1 / 255)


@pytest.mark.parametrize(
    ("asset", "extents"),
    [
        ("", [1.0, 4.0, 2.0]),  # COLLADA's default is y.
        ('<unit meter="0.01"/><up_axis>Z_UP</up_axis>', [0.01, 0.02, 0.04]),
    ],
)
# The writer of COLLADA sets shapes of arrays, which NumPy deprecates from 2.5 on.
@pytest.mark.filterwarnings("ignore:Setting the shape on a NumPy array:DeprecationWarning")
def test_a_collada_mesh_is_upright_and_in_metres(tmp_path, asset, extents):
    path = tmp_path / "tower.dae"
    trimesh.creation.box(extents=[1.0, 2.0, 4.0]).export(path)
    text = path.read_text()
    own = "<up_axis>Y_UP</up_axis>"
    assert own in text
    path.write_text(text.replace(own, asset))
    assert np.ptp(mesh_points(path), axis=0) == pytest.approx(extents)


@pytest.mark.parametrize(
    ("materials", "shown"),
    [("newmtl a\nTr 1.0\nnewmtl b\nTr 0.5\n", True), ("newmtl a\nKd 1 0 0\nTr 1.000000\n", False)],
)
def test_an_obj_whose_materials_are_all_transparent_is_converted(cache, tmp_path, materials, shown):
    path = tmp_path / "hip.obj"
    trimesh.creation.box(extents=[1.0, 2.0, 4.0]).export(path, include_normals=True)
    path.with_suffix(".mtl").write_text(materials)
    assert is_shown(path) == shown
    found = shown_mesh(path, "0.2 0.4 0.6 1")
    assert (found == path) == shown == (not cache.exists())
    if not shown:
        assert_colour(found, [0.2, 0.4, 0.6, 1.0])


POINTS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
NORMAL = "vn 0 0 1\n"


@pytest.mark.parametrize(
    ("faces", "shown"),
    [
        (NORMAL + "f 1//1 2//1 3//1\nf 1//1 2//1 4//1\n", True),
        ("f 1 2 3\nf 1 2 4\n", False),
        ("  f\t1 2 3 4 \r\n", False),
    ],
)
def test_an_obj_without_normals_is_converted_if_it_can_be(
    cache, tmp_path, monkeypatch, faces, shown
):
    path = tmp_path / "hull.obj"
    path.write_text(POINTS + faces)
    path.with_suffix(".mtl").write_text("newmtl a\nKd 1 0 0\n")
    found = shown_mesh(path)
    assert (found == path) == shown
    monkeypatch.setattr("drake_safety.robots.meshes.find_spec", lambda name: None)
    assert shown_mesh(path) == path


def test_a_mesh_is_converted_once_until_it_or_its_colour_changes(cache, tower):
    first = shown_mesh(tower, "0.1 0.2 0.3 1")
    assert_colour(first, [0.1, 0.2, 0.3, 1.0])
    # A glTF file's y axis points up.
    np.testing.assert_allclose(trimesh.load_scene(first).extents, [1.0, 4.0, 2.0], atol=1e-6)
    written = first.stat().st_mtime_ns
    assert shown_mesh(tower, "0.1 0.2 0.3 1") == first
    assert first.stat().st_mtime_ns == written
    assert shown_mesh(tower, "1 0 0 1") != first
    trimesh.creation.box(extents=[1.0, 1.0, 1.0]).export(tower)
    assert shown_mesh(tower, "0.1 0.2 0.3 1") != first
    assert [path for path in first.parent.iterdir() if path.suffix != ".gltf"] == []


def test_a_hull_has_few_vertices_which_are_the_meshs_and_reaches_as_far_along_the_axes():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1).vertices
    points = np.vstack([ball, [[0.0, 0.0, 0.5]], [[0.3, 0.0, 0.0]]])
    hull = convex_hull(points)
    assert 4 <= len(hull.vertices) <= 42
    # It exceeds the mesh's hull nowhere.
    distances = np.linalg.norm(hull.vertices[:, None] - points[None], axis=2).min(axis=1)
    assert distances.max() < 1e-6
    np.testing.assert_allclose(hull.bounds, [points.min(axis=0), points.max(axis=0)], atol=1e-12)
    assert hull.volume > 0.8 * trimesh.convex.convex_hull(points).volume


def test_a_flat_mesh_becomes_the_box_around_it():
    points, edges = [[0.0, 0.0, 1.0], [0.2, 0.0, 1.0], [0.0, 0.1, 1.0]], [0.2, 0.1, 1e-3]
    hull = convex_hull(np.array(points))
    assert hull.extents == pytest.approx(edges)
    assert hull.volume == pytest.approx(np.prod(edges))
