"""Shapes that Drake simulates, fitted to collision meshes that it does not read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

if TYPE_CHECKING:
    import trimesh

_LARGEST_EXCESS = 0.5  # Of a primitive's volume over the hull's, as a share of the hull's.
_THINNEST_M = 1e-3  # Edge of the box around a flat mesh.
# Subdivisions of an icosahedron, in whose directions a hull's extreme vertices are kept.
_COARSE = 1  # 42 directions: a hull that is simulated.
_FINE = 3  # 642 directions: a hull that primitives are fitted to.


@dataclass(frozen=True, kw_only=True)
class FittedShape:
    """A shape in the frame of a link.

    Attributes:
        kind: ``box``, ``capsule``, ``cylinder``, ``sphere`` or ``hull``, a convex hull.
        X_LS: Its pose in the link's frame L; a hull's is the identity.
        sizes: Attributes of its element in a URDF [m]; none of a hull.
        excess: Its volume over that of the mesh's convex hull, less one.
        obj: A hull as OBJ.
    """

    kind: str
    X_LS: RigidTransform
    sizes: dict[str, float | list[float]]
    excess: float
    obj: str = ""


def fitted_shape(
    points: np.ndarray, *, is_tight: bool = False, floor: tuple[np.ndarray, float] | None = None
) -> FittedShape | None:
    """Fits a shape to a mesh: the smallest primitive around it, or its convex hull.

    Contacts of primitives are faster and smoother than those of hulls. A primitive more than half
    as large again as the mesh's hull is not used, as it touches where the mesh does not; nor is
    any with ``is_tight``. The hull has few vertices, all of them the mesh's.

    Args:
        points: Vertices of the mesh in the link's frame, (n, 3) [m].
        is_tight: Whether the shape must exceed the mesh's hull nowhere.
        floor: Upward unit vector (3,) and a height along it [m]; what is below is cut off.

    Returns:
        The shape; None if nothing is above the floor.
    """
    if floor is not None:
        points = _above(points, *floor)
        if not len(points):
            return None
    hull = _hull(points)
    if hull is None:
        low, high = points.min(axis=0), points.max(axis=0)
        edges = np.maximum(high - low, _THINNEST_M)
        pose = RigidTransform((low + high) / 2)
        return FittedShape(kind="box", X_LS=pose, sizes={"size": edges.tolist()}, excess=0.0)
    if not is_tight:
        best = min(_primitives(_thinned(hull, _FINE)), key=lambda shape: shape.excess)
        if best.excess <= _LARGEST_EXCESS:
            return best
    small = _thinned(hull, _COARSE)
    return FittedShape(
        kind="hull",
        X_LS=RigidTransform(),
        sizes={},
        excess=small.volume / hull.volume - 1,
        obj=str(small.export(file_type="obj", include_normals=False, header=None)),
    )


def _above(points: np.ndarray, up: np.ndarray, height: float) -> np.ndarray:
    """Vertices of the part of a mesh's hull above a floor, (n, 3)."""
    from trimesh.intersections import slice_faces_plane

    is_above = points @ up > height
    hull = _hull(points) if is_above.any() and not is_above.all() else None
    if hull is None:
        return points[is_above]
    return np.array(slice_faces_plane(hull.vertices, hull.faces, up, height * up)[0])


def _hull(points: np.ndarray) -> trimesh.Trimesh | None:
    """The convex hull; None for points in a plane."""
    from scipy.spatial import QhullError
    from trimesh.convex import convex_hull

    try:
        hull = convex_hull(points)
    except (QhullError, ValueError):
        return None
    return hull if hull.volume > 0 else None


def _thinned(hull: trimesh.Trimesh, subdivisions: int) -> trimesh.Trimesh:
    """The hull of a hull's extreme vertices in some directions."""
    from trimesh.creation import icosphere

    directions = icosphere(subdivisions=subdivisions).vertices
    corners = np.unique(np.argmax(hull.vertices @ directions.T, axis=0))
    thin = _hull(hull.vertices[corners])
    return hull if thin is None else thin


def _primitives(hull: trimesh.Trimesh) -> Iterator[FittedShape]:
    """Primitives around a hull."""
    from trimesh.nsphere import minimum_nsphere

    def shape(
        kind: str, X_LS: RigidTransform, volume: float, **sizes: float | list[float]
    ) -> FittedShape:
        excess = volume / hull.volume - 1
        return FittedShape(kind=kind, X_LS=X_LS, sizes=sizes, excess=excess)

    box, ball = hull.bounding_box_oriented, hull.bounding_sphere
    X_LO, edges = _pose(box.primitive.transform), box.primitive.extents.tolist()
    centre, radius = ball.primitive.center, float(ball.primitive.radius)
    yield shape("box", X_LO, box.volume, size=edges)
    yield shape("sphere", RigidTransform(centre), 4 / 3 * np.pi * radius**3, radius=radius)
    # Round shapes along the box's axes: trimesh's own smallest cylinder misses those of capsules.
    for axis in range(3):
        R_OA = RotationMatrix.MakeFromOneVector(np.eye(3)[axis], 2)
        X_LA = X_LO @ RigidTransform(R_OA, np.zeros(3))
        across, along = np.split((X_LA.inverse() @ hull.vertices.T).T, [2], axis=1)
        centre, radius = minimum_nsphere(across)
        distance = np.linalg.norm(across - centre, axis=1)
        # The caps of a capsule reach over the outermost vertices.
        caps = np.sqrt(np.maximum(radius**2 - distance**2, 0.0))
        for kind, cap, ends in (("cylinder", 0.0, 0.0), ("capsule", caps, 4 / 3 * radius)):
            low, high = float((along[:, 0] + cap).min()), float((along[:, 0] - cap).max())
            volume = np.pi * radius**2 * (high - low + ends)
            if high > low:
                X_LS = X_LA @ RigidTransform([*centre, (low + high) / 2])
                yield shape(kind, X_LS, volume, radius=float(radius), length=high - low)


def _pose(matrix: np.ndarray) -> RigidTransform:
    """A pose without the mirror image and rounding of trimesh's."""
    rotation = np.array(matrix[:3, :3])
    if np.linalg.det(rotation) < 0:
        rotation[:, 2] *= -1  # All primitives are symmetric.
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(rotation), matrix[:3, 3])
