"""Shapes fitted to meshes: around them, no larger than needed, and with few vertices."""

import io

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from drake_safety.robots.fitted_shapes import fitted_shape

trimesh = pytest.importorskip("trimesh")

X_LM = RigidTransform(RollPitchYaw(0.4, -0.7, 1.1), [0.3, -0.2, 0.5])


def posed(mesh):
    """Vertices of a mesh, turned and moved, (n, 3)."""
    return (X_LM @ mesh.vertices.T).T


def outside(shape, points):
    """By how much points lie outside a primitive [m]."""
    local = np.abs((shape.X_LS.inverse() @ points.T).T)
    if shape.kind == "box":
        return float((local - np.array(shape.sizes["size"]) / 2).max())
    radius, half = shape.sizes["radius"], shape.sizes.get("length", 0.0) / 2
    if shape.kind == "cylinder":
        sides = np.hypot(local[:, 0], local[:, 1]) - radius
        return float(max(sides.max(), (local[:, 2] - half).max()))
    local[:, 2] = np.maximum(local[:, 2] - half, 0.0)
    return float(np.linalg.norm(local, axis=1).max() - radius)


@pytest.mark.parametrize(
    ("mesh", "kind"),
    [
        (trimesh.creation.box(extents=[0.1, 0.3, 0.05]), "box"),
        (trimesh.creation.icosphere(subdivisions=3, radius=0.2), "sphere"),
        (trimesh.creation.cylinder(radius=0.1, height=0.15, sections=48), "cylinder"),
        (trimesh.creation.capsule(radius=0.05, height=0.3, count=[24, 24]), "capsule"),
    ],
)
def test_a_mesh_that_is_a_primitive_becomes_it(mesh, kind):
    shape = fitted_shape(posed(mesh))
    assert shape.kind == kind
    assert -0.01 < shape.excess < 0.1
    assert outside(shape, posed(mesh)) < 2e-3


def test_a_mesh_that_no_primitive_is_close_to_becomes_a_hull_of_few_vertices_inside_it():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1).vertices
    points = np.vstack([ball, [[0.0, 0.0, 0.5]], [[0.3, 0.0, 0.0]]])
    shape = fitted_shape(points)
    assert shape.kind == "hull" and shape.sizes == {}
    hull = trimesh.load_mesh(io.StringIO(shape.obj), file_type="obj")
    assert 4 <= len(hull.vertices) <= 42
    # Its vertices are the mesh's, so that it exceeds the mesh's hull nowhere.
    distances = np.linalg.norm(hull.vertices[:, None] - points[None], axis=2).min(axis=1)
    assert distances.max() < 1e-6
    assert -0.2 < shape.excess <= 0


def test_a_tight_shape_of_a_box_is_its_hull():
    shape = fitted_shape(posed(trimesh.creation.box(extents=[0.1, 0.3, 0.05])), is_tight=True)
    assert shape.kind == "hull"
    assert shape.excess == pytest.approx(0, abs=1e-9)


def test_a_flat_mesh_becomes_a_thin_box():
    shape = fitted_shape(np.array([[0.0, 0.0, 1.0], [0.2, 0.0, 1.0], [0.0, 0.1, 1.0]]))
    assert shape.kind == "box"
    assert shape.sizes["size"] == pytest.approx([0.2, 0.1, 1e-3])
    np.testing.assert_allclose(shape.X_LS.translation(), [0.1, 0.05, 1.0])


def test_what_is_below_a_floor_is_cut_off():
    points = np.array(trimesh.creation.box(extents=[0.1, 0.1, 0.4]).vertices)
    up = np.array([0.0, 0.0, 1.0])
    shape = fitted_shape(points, floor=(up, -0.1))
    assert shape.kind == "box"
    assert sorted(shape.sizes["size"]) == pytest.approx([0.1, 0.1, 0.3])
    np.testing.assert_allclose(shape.X_LS.translation(), [0.0, 0.0, 0.05], atol=1e-9)
    assert fitted_shape(points, floor=(up, 0.3)) is None
