"""Replaces the collision meshes that Drake does not read by fitted shapes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drake_safety.robots.fitted_shapes import FittedShape, fitted_shape
from drake_safety.robots.urdf_copy import UrdfCopy
from drake_safety.robots.urdf_survey import Limb, Survey

_Floor = tuple[np.ndarray, float]


def replace_lost_meshes(
    copy: UrdfCopy, survey: Survey, legs: list[Limb], posture: dict[str, float], scratch: Path
) -> Survey:
    """Writes a shape in place of each lost collision mesh, and returns the robot, standing.

    The feet keep their contact spheres. Shapes of links that are welded to a foot end above its
    spheres, which alone touch the ground. Where two links overlap in the standing posture, convex
    hulls replace primitives, which are larger.
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
    shapes = (
        fitted_shape(points, is_tight=is_tight, floor=floor) for points in copy.lost_meshes[link]
    )
    return [shape for shape in shapes if shape is not None]


def _rewritten(
    copy: UrdfCopy, shapes: dict[str, list[FittedShape]], posture: dict[str, float], scratch: Path
) -> Survey:
    for link, fitted in shapes.items():
        copy.set_fitted(link, fitted)
    copy.write(scratch)
    survey = Survey(scratch)
    survey.set_joints(posture)
    return survey
