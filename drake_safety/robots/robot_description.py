"""Adds a robot's model file to a plant, with the overrides of robot.yaml."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    CollisionFilterDeclaration,
    GeometrySet,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drake_safety.robots.model_files import model_file, package_parser
from drake_safety.robots.robot_model import CollisionShape, RobotModel, by_pattern
from drake_safety.robots.urdf_copy import FIXED_MIMIC, read_urdf

_logger = logging.getLogger("drake_safety")
_SHAPE_FRICTION = 0.2  # Of all shapes but the feet.


def add_description(plant: MultibodyPlant, robot: RobotModel) -> ModelInstanceIndex:
    """Adds a robot's bodies, joints and shapes; without a scene graph, geometry is left out."""
    parser = package_parser(plant, robot.urdf)
    path = model_file(robot.urdf, robot.source_dir, robot.requires)
    urdf = None
    if path.suffix == ".urdf":
        urdf = read_urdf(path)
        urdf.remove(*FIXED_MIMIC)
        if robot.collision == "stated":
            urdf.remove("link", "collision")
        if plant.geometry_source_is_registered():
            urdf.convert_visual_meshes()
    try:
        with _quiet_about(robot):
            if urdf is not None and urdf.is_changed:
                urdf.anchor_meshes()
                (instance,) = parser.AddModelsFromString(urdf.text(), "urdf")
            elif robot.urdf.startswith("package://"):
                (instance,) = parser.AddModels(url=robot.urdf)
            else:
                (instance,) = parser.AddModels(str(path))
    except SystemExit as error:  # pydrake raises it where a condition of Drake's C++ fails.
        shapes = [] if urdf is None else [words for _, _, words in urdf.empty_shapes()]
        what = [f"Drake cannot build '{path}'", *shapes, str(error)]
        raise ValueError("; ".join(what)) from error
    plant.RenameModelInstance(instance, robot.name)
    return instance


@contextmanager
def _quiet_about(robot: RobotModel) -> Iterator[None]:
    """Logs the parser's warnings about files of other packages at debug level.

    Users cannot change these files, and every worker process would repeat the warnings.
    """
    drake = logging.getLogger("drake")

    def pass_on(record: logging.LogRecord) -> bool:
        if not robot.urdf.startswith("package://") or record.levelno > logging.WARNING:
            return True
        _logger.debug("%s: %s", robot.name, record.getMessage())
        return False

    drake.addFilter(pass_on)
    try:
        yield
    finally:
        drake.removeFilter(pass_on)


def add_stated_shapes(
    plant: MultibodyPlant, robot: RobotModel, instance: ModelInstanceIndex
) -> None:
    """Adds the collision geometry of robot.yaml: contact points and shapes."""
    names = [plant.get_body(index).name() for index in plant.GetBodyIndices(instance)]
    unused = [one for one in robot.shapes if not any(re.fullmatch(one, body) for body in names)]
    if unused:
        raise ValueError(f"robot '{robot.name}' has no body for shapes {unused}; it has {names}")

    def add(body: str, name: str, X_BG: RigidTransform, shape: Shape, mu: float) -> None:
        plant.RegisterCollisionGeometry(
            plant.GetBodyByName(body, instance), X_BG, shape, name, CoulombFriction(mu, mu)
        )

    for body in names:
        shapes = by_pattern(robot.shapes, body, "shapes", robot.name, "body") or []
        for i, stated in enumerate(shapes):
            add(body, f"{body}_shape_{i}", *_shape_of(stated), _SHAPE_FRICTION)
    for name, foot in robot.feet.items():
        for i, point in enumerate(foot.contact_points):
            X_BG, sphere = RigidTransform(point), Sphere(foot.radius_m)
            add(foot.body, f"{name}_contact_{i}", X_BG, sphere, robot.foot_friction)


def ignore_neighbours(
    plant: MultibodyPlant, scene_graph: SceneGraph, instance: ModelInstanceIndex
) -> None:
    """Filters collisions of links connected by a joint, and of links welded to them.

    Drake filters the two bodies of a joint, but not bodies that are welded to them.
    """
    for joint in map(plant.get_joint, plant.GetJointIndices(instance)):
        ends = joint.parent_body(), joint.child_body()
        sides = [plant.GetBodiesWeldedTo(body) for body in ends]
        if joint.num_velocities() and any(len(side) > 1 for side in sides):
            shapes = (map(plant.GetCollisionGeometriesForBody, side) for side in sides)
            parent, child = (GeometrySet([*chain.from_iterable(side)]) for side in shapes)
            apart = CollisionFilterDeclaration().ExcludeBetween(parent, child)
            scene_graph.collision_filter_manager().Apply(apart)


def _shape_of(stated: CollisionShape) -> tuple[RigidTransform, Shape]:
    start = np.array(stated.position_m, dtype=float)
    if stated.box_m:
        return RigidTransform(start), Box(*stated.box_m)
    if not stated.to_m:
        return RigidTransform(start), Sphere(stated.radius_m)
    axis = np.array(stated.to_m, dtype=float) - start
    length = float(np.linalg.norm(axis))
    R_BG = RotationMatrix.MakeFromOneVector(axis / length, 2)
    return RigidTransform(R_BG, start + 0.5 * axis), Capsule(stated.radius_m, length)
