"""Obstacles around a robot, and how far its arms and the points of a plan are from them."""

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
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder

from drake_safety.control.robot import add_robot, add_to_package_map, model_file
from drake_safety.control.robot_model import RobotModel


@dataclass(kw_only=True)
class Obstacle:
    """A model that stands in the world; one without collision geometry is only to be seen."""

    model: str = ""
    """``package://…`` or an absolute path of a model file with one root link."""
    position: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Of its root link in the world, (3,) [m]."""
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        if len(self.position) != 3 or not np.isfinite(self.position).all():
            raise ValueError(
                f"obstacle '{self.model}': position must be three numbers; got {self.position}"
            )


def add_obstacles(plant: MultibodyPlant, obstacles: list[Obstacle]) -> list[ModelInstanceIndex]:
    """Welds obstacles to the world of a plant that is not finalised.

    Args:
        plant: The plant.
        obstacles: What stands where.

    Raises:
        ValueError: A model cannot be read, or has no single root link.
    """
    parser = Parser(plant)
    parser.SetAutoRenaming(True)
    add_to_package_map(parser.package_map())
    instances = []
    for obstacle in obstacles:
        path = model_file(obstacle.model)
        if not (path.is_absolute() and path.is_file()):
            raise ValueError(
                f"obstacle: model must be a package:// URL or the absolute path of a file that "
                f"exists; got '{obstacle.model}'"
            )
        try:
            found = parser.AddModels(str(path))
        except RuntimeError as error:
            raise ValueError(f"obstacle '{obstacle.model}': {error}") from error
        if len(found) != 1:
            raise ValueError(
                f"obstacle '{obstacle.model}': one model is expected; the file has {len(found)}"
            )
        root = plant.get_body(plant.GetBodyIndices(found[0])[0])
        R_WO = RotationMatrix.MakeZRotation(obstacle.yaw_rad)
        X_WO = RigidTransform(R_WO, obstacle.position)
        plant.WeldFrames(plant.world_frame(), root.body_frame(), X_WO)
        instances.append(found[0])
    return instances


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
    arms = GeometrySet(arm_geometries(plant, robot))
    instance = plant.GetModelInstanceByName(robot.name)
    everything = [
        g
        for b in plant.GetBodyIndices(instance)
        for g in plant.GetCollisionGeometriesForBody(plant.get_body(b))
    ]
    rest = GeometrySet([g for g in everything if g not in set(arm_geometries(plant, robot))])
    shelf = GeometrySet(
        [
            g
            for model in obstacles
            for b in plant.GetBodyIndices(model)
            for g in plant.GetCollisionGeometriesForBody(plant.get_body(b))
        ]
    )
    ground = GeometrySet(plant.GetCollisionGeometriesForBody(plant.world_body()))
    declaration = CollisionFilterDeclaration()
    declaration.ExcludeWithin(GeometrySet(everything))
    declaration.ExcludeBetween(rest, shelf)
    declaration.ExcludeBetween(arms, ground)
    scene_graph.collision_filter_manager().Apply(declaration)


class Clearance:
    """Signed distances from a robot's arms, and from points, to obstacles.

    It has a plant and scene graph of its own, without ground, and keeps one scratch Context;
    every method sets what it needs first.

    Args:
        robot: The robot.
        obstacles: What stands where.
        range_m: Distances beyond this count as this [m].
    """

    def __init__(self, robot: RobotModel, obstacles: list[Obstacle], *, range_m: float):
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
        self._shelf = {
            g
            for model in instances
            for b in self._plant.GetBodyIndices(model)
            for g in self._plant.GetCollisionGeometriesForBody(self._plant.get_body(b))
        }
        self.range_m = range_m

    def _query(self) -> QueryObject:
        return self._scene_graph.get_query_output_port().Eval(self._scene_context)

    def of_arms(self, q: np.ndarray) -> float:
        """Distance of the arms to the nearest obstacle, negative when they touch it [m].

        Args:
            q: Positions of the robot (n_q,).
        """
        if not self._shelf:
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
        if self._shelf:
            for i, p in enumerate(p_WP):
                for found in query.ComputeSignedDistanceToPoint(p, range_m):
                    if found.id_G in self._shelf and found.distance < distances[i]:
                        distances[i] = found.distance
        return distances - radius_m
