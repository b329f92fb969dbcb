"""Replaces the collision meshes that Drake does not read by fitted shapes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drake_safety.extras import MissingExtraError
from drake_safety.robots.fitted_shapes import FittedShape, fitted_shape
from drake_safety.robots.mesh_cache import mesh_points
from drake_safety.robots.urdf_copy import LostMesh, UrdfCopy
from drake_safety.robots.urdf_survey import Limb, Survey

_Floor = tuple[np.ndarray, float]


def replace_lost_meshes(
    copy: UrdfCopy, survey: Survey, legs: list[Limb], posture: dict[str, float], scratch: Path
) -> Survey:
    """Writes a shape in place of each lost collision mesh, but for those of the feet.

    The feet have their contact spheres. Shapes of links that are welded to a foot end above its
    spheres, which alone touch the ground. Where two links overlap in the standing posture, convex
    hulls replace primitives, which are larger.

    Args:
        copy: The URDF, to which shapes are added.
        survey: The robot.
        legs: Its legs.
        posture: Its standing joint positions [rad].
        scratch: File that the copy is written to.

    Returns:
        The robot with these shapes, standing.
    """
    survey.set_joints(posture)
    floors = {link: _floor(survey, leg, link) for leg in legs for link in survey.welded(leg.body)}
    feet = {leg.body for leg in legs}
    links = [link for link in copy.lost_meshes if link not in feet]
    shapes = {link: _fitted(copy, link, floors.get(link), is_tight=False) for link in links}
    shapes = {link: fitted for link, fitted in shapes.items() if fitted}
    if not shapes:
        return survey
    survey = _rewritten(copy, shapes, posture, scratch)
    loose = {link for pair in survey.overlaps() for link in pair} & set(shapes)
    if loose:
        tight = {link: _fitted(copy, link, floors.get(link), is_tight=True) for link in loose}
        shapes |= tight
        survey = _rewritten(copy, tight, posture, scratch)
    words = [
        f"'{link}' {', '.join(f'{one.kind} ({100 * one.excess:+.0f} %)' for one in fitted)}"
        for link, fitted in shapes.items()
    ]
    copy.notes.append(
        f"{len(words)} links have shapes fitted to these collision meshes, with the difference of "
        f"their volume from that of the mesh's convex hull: {'; '.join(words)}"
    )
    return survey


def _floor(survey: Survey, leg: Limb, link: str) -> _Floor:
    """Upward vector in a link's frame, and the height of its foot's contact points along it."""
    X_LW = survey.pose(link).inverse()
    up = X_LW.rotation().matrix() @ [0.0, 0.0, 1.0]
    heights = (X_LW @ survey.positions(leg).T).T @ up
    return up, float(heights.min())


def _fitted(
    copy: UrdfCopy, link: str, floor: _Floor | None, *, is_tight: bool
) -> list[FittedShape]:
    shapes = []
    for mesh in copy.lost_meshes[link]:
        points = _points(copy, mesh)
        if points is None:
            continue
        shape = fitted_shape(points, is_tight=is_tight, floor=floor)
        if shape is not None:
            shapes.append(shape)
    return shapes


def _points(copy: UrdfCopy, mesh: LostMesh) -> np.ndarray | None:
    """Vertices in the link's frame, (n, 3); None, with a note, if the mesh cannot be read."""
    if mesh.file is None:
        return None
    try:
        points = mesh_points(mesh.file)
    except MissingExtraError as error:
        note = (
            "no shapes are fitted to collision meshes that Drake does not read; install what does "
            f"it by `pip install '{error.needs}'` and write the folder again"
        )
    except ValueError as error:
        note = f"no shape is fitted to a collision mesh: {error}"
    else:
        return (mesh.X_LM @ (points * mesh.scale).T).T
    if note not in copy.left_out:
        copy.left_out.append(note)
        copy.notes.append(note)
    return None


def _rewritten(
    copy: UrdfCopy,
    shapes: dict[str, list[FittedShape]],
    posture: dict[str, float],
    scratch: Path,
) -> Survey:
    for link, fitted in shapes.items():
        copy.set_fitted(link, fitted)
    copy.write(scratch)
    survey = Survey(scratch)
    survey.set_joints(posture)
    return survey
