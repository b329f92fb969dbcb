"""Obstacles around a robot, and how far its arms and the points of a plan are from them."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from pydrake.geometry import (
    CollisionFilterDeclaration,
    GeometryId,
    GeometrySet,
    QueryObject,
    SceneGraph,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody
from pydrake.systems.framework import DiagramBuilder

from drake_safety.robots.model_files import model_file, package_parser
from drake_safety.robots.robot import add_robot
from drake_safety.robots.robot_model import RobotModel


@dataclass(kw_only=True)
class Obstacle:
    """A model that stands in the world; one without collision geometry is only to be seen."""

    model: str = ""
    """``package://…`` or an absolute path of a model file with one link that nothing holds."""
    position: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Of that link in the world, (3,) [m]."""
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        if len(self.position) != 3 or not np.isfinite(self.position).all():
            raise ValueError(
                f"obstacle '{self.model}': position must be three finite numbers [m]; got "
                f"{self.position}"
            )
        if not np.isfinite(self.yaw_rad):
            raise ValueError(f"obstacle '{self.model}': yaw_rad must be finite; got {self.yaw_rad}")


def add_obstacles(plant: MultibodyPlant, obstacles: list[Obstacle]) -> list[ModelInstanceIndex]:
    """Welds obstacles to the world of a plant that is not finalised.

    Args:
        plant: The plant.
        obstacles: What stands where.

    Returns:
        Their model instances, in the same order.

    Raises:
        ValueError: A model cannot be read, has not exactly one link that nothing holds, or moves.
    """
    parser = package_parser(plant)
    instances = []
    for obstacle in obstacles:
        who = f"obstacle '{obstacle.model}'"
        path = model_file(obstacle.model)
        if not (path.is_absolute() and path.is_file()):
            raise ValueError(
                f"{who}: model must be a package:// URL or the absolute path of a file that exists"
            )
        try:
            found = parser.AddModels(str(path))
        except RuntimeError as error:
            raise ValueError(f"{who}: {error}") from error
        if len(found) != 1:
            raise ValueError(f"{who}: one model is expected; the file has {len(found)}")
        root = _root_link(plant, found[0], who)
        R_WO = RotationMatrix.MakeZRotation(obstacle.yaw_rad)
        X_WO = RigidTransform(R_WO, obstacle.position)
        plant.WeldFrames(plant.world_frame(), root.body_frame(), X_WO)
        instances.append(found[0])
    return instances


def _root_link(plant: MultibodyPlant, instance: ModelInstanceIndex, who: str) -> RigidBody:
    """The only link of a rigid model that no joint holds."""
    joints = [plant.get_joint(i) for i in plant.GetJointIndices(instance)]
    moving = [joint.name() for joint in joints if joint.num_velocities() > 0]
    if moving:
        raise ValueError(f"{who}: obstacles do not move; the model has the joints {moving}")
    held = {joint.child_body().index() for joint in joints}
    links = [plant.get_body(i) for i in plant.GetBodyIndices(instance)]
    roots = [link for link in links if link.index() not in held]
    if len(roots) != 1:
        raise ValueError(
            f"{who}: one link that nothing holds is expected, to be put in its place; of the "
            f"links {[link.name() for link in links]} these are {[link.name() for link in roots]}"
        )
    return roots[0]


def collision_geometries(
    plant: MultibodyPlant, instances: Iterable[ModelInstanceIndex]
) -> list[GeometryId]:
    """Collision geometries of all bodies of some models."""
    return [
        geometry
        for instance in instances
        for body in plant.GetBodyIndices(instance)
        for geometry in plant.GetCollisionGeometriesForBody(plant.get_body(body))
    ]


def arm_geometries(plant: MultibodyPlant, robot: RobotModel) -> list[GeometryId]:
    """Collision geometries of every body that the joints of a reaching frame move."""
    instance = plant.GetModelInstanceByName(robot.name)
    joints = [
        plant.GetJointByName(name, instance).index()
        for frame in robot.reaching_frames.values()
        for name in frame.joints
    ]
    bodies = plant.GetBodiesKinematicallyAffectedBy(joints)
    return [g for b in bodies for g in plant.GetCollisionGeometriesForBody(plant.get_body(b))]


def filter_collisions(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    robot: RobotModel,
    obstacles: list[ModelInstanceIndex],
) -> None:
    """Leaves of all contacts those of arms with obstacles and of the rest with the ground.

    Args:
        plant: The plant, finalised.
        scene_graph: Its scene graph.
        robot: The robot.
        obstacles: Model instances of the obstacles.
    """
    arms = arm_geometries(plant, robot)
    everything = collision_geometries(plant, [plant.GetModelInstanceByName(robot.name)])
    rest = [geometry for geometry in everything if geometry not in set(arms)]
    ground = plant.GetCollisionGeometriesForBody(plant.world_body())
    declaration = CollisionFilterDeclaration()
    declaration.ExcludeWithin(GeometrySet(everything))
    declaration.ExcludeBetween(
        GeometrySet(rest), GeometrySet(collision_geometries(plant, obstacles))
    )
    declaration.ExcludeBetween(GeometrySet(arms), GeometrySet(ground))
    scene_graph.collision_filter_manager().Apply(declaration)


class Clearance:
    """Signed distances from a robot's arms, and from points, to obstacles.

    It has a plant and scene graph of its own, without ground, and keeps one scratch Context;
    every method sets what it needs first.

    Args:
        robot: The robot.
        obstacles: What stands where.
        range_m: Distances beyond this count as this [m].

    Raises:
        ValueError: The range is not positive, an obstacle is not to be read, or there is
            something to touch and the arms have no collision geometry to touch it with.
    """

    def __init__(self, robot: RobotModel, obstacles: list[Obstacle], *, range_m: float):
        if not 0 < range_m < math.inf:
            raise ValueError(f"clearance: range_m must be finite and positive; got {range_m}")
        builder = DiagramBuilder()
        self._plant, self._scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        add_robot(self._plant, robot)
        instances = add_obstacles(self._plant, obstacles)
        self._plant.Finalize()
        filter_collisions(self._plant, self._scene_graph, robot, instances)
        diagram = builder.Build()
        self._context = diagram.CreateDefaultContext()
        self._plant_context = self._plant.GetMyMutableContextFromRoot(self._context)
        self._scene_context = self._scene_graph.GetMyContextFromRoot(self._context)
        self._obstacles = set(collision_geometries(self._plant, instances))
        if self._obstacles and not arm_geometries(self._plant, robot):
            raise ValueError(
                f"robot '{robot.name}': none of the bodies that the joints of its reaching frames "
                f"{list(robot.reaching_frames)} move has collision geometry, so its arms could "
                "not be told to be clear of obstacles"
            )
        self.range_m = range_m

    def _query(self) -> QueryObject:
        return self._scene_graph.get_query_output_port().Eval(self._scene_context)

    def of_arms(self, q: np.ndarray) -> float:
        """Distance of the arms to the nearest obstacle, negative when they touch it [m].

        Args:
            q: Positions of the robot (n_q,).

        Raises:
            ValueError: The positions are not finite.
        """
        # A position that is not finite would end the process inside the plant.
        if not q.dot(q) < math.inf:
            raise ValueError(f"clearance: positions must be finite; got {q}")
        if not self._obstacles:
            return self.range_m
        self._plant.SetPositions(self._plant_context, q)
        pairs = self._query().ComputeSignedDistancePairwiseClosestPoints(self.range_m)
        return min((pair.distance for pair in pairs), default=self.range_m)

    def of_points(self, p_WP: np.ndarray, radius_m: float = 0.0) -> np.ndarray:
        """Distance of spheres to the nearest obstacle, (N,) [m].

        Args:
            p_WP: Centres in the world, (N, 3) [m].
            radius_m: Radius of the spheres [m].
        """
        query, range_m = self._query(), self.range_m + radius_m
        distances = np.full(len(p_WP), range_m)
        if self._obstacles:
            for i, p in enumerate(p_WP):
                for found in query.ComputeSignedDistanceToPoint(p, range_m):
                    if found.id_G in self._obstacles and found.distance < distances[i]:
                        distances[i] = found.distance
        return distances - radius_m
