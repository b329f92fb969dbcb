"""Obstacles around a robot, and the distances of its arms and of points to them."""

import math
from collections.abc import Iterable
from dataclasses import field

import numpy as np
from pydantic import FiniteFloat
from pydrake.geometry import CollisionFilterDeclaration, GeometryId, GeometrySet, SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context, DiagramBuilder

from drake_safety.files.schema import Triple, schema
from drake_safety.robots.meshes import check_meshes
from drake_safety.robots.model_files import model_file, package_parser
from drake_safety.robots.robot import Scratch, add_robot
from drake_safety.robots.robot_model import RobotModel


@schema(kw_only=True)
class Obstacle:
    """A static model in the world; without collision geometry it is a decoration."""

    model: str = ""  # ``package://…`` or an absolute path of a model file with one root link.
    position: Triple = field(default_factory=lambda: [0.0, 0.0, 0.0])  # Root link in the world [m].
    yaw_rad: FiniteFloat = 0.0


def add_obstacles(plant: MultibodyPlant, obstacles: Iterable[Obstacle]) -> list[ModelInstanceIndex]:
    """Welds obstacles to the world of a plant that is not finalised; returns their models."""
    parser, instances = package_parser(plant), []
    for obstacle in obstacles:
        who, path = f"obstacle '{obstacle.model}'", model_file(obstacle.model)
        if not (path.is_absolute() and path.is_file()):
            raise ValueError(f"{who}: model must be a package:// URL or an absolute path of a file")
        check_meshes(path)
        try:
            instance, *others = parser.AddModels(str(path))
        except RuntimeError as error:
            raise ValueError(f"{who}: {error}") from error
        joints = [plant.get_joint(i) for i in plant.GetJointIndices(instance)]
        held = {joint.child_body().index() for joint in joints}
        roots = [i for i in plant.GetBodyIndices(instance) if i not in held]
        if others or len(roots) != 1 or any(joint.num_velocities() for joint in joints):
            raise ValueError(f"{who}: expected one model with one root link, without moving joints")
        X_WO = RigidTransform(RotationMatrix.MakeZRotation(obstacle.yaw_rad), obstacle.position)
        plant.WeldFrames(plant.world_frame(), plant.get_body(roots[0]).body_frame(), X_WO)
        instances.append(instance)
    return instances


def collision_geometries(
    plant: MultibodyPlant, instances: Iterable[ModelInstanceIndex]
) -> list[GeometryId]:
    """Returns the collision geometries of all bodies of some models."""
    return [
        geometry
        for instance in instances
        for body in plant.GetBodyIndices(instance)
        for geometry in plant.GetCollisionGeometriesForBody(plant.get_body(body))
    ]


def arm_geometries(plant: MultibodyPlant, robot: RobotModel) -> list[GeometryId]:
    """Returns the collision geometries of all bodies moved by joints of reaching frames."""
    instance = plant.GetModelInstanceByName(robot.name)
    names = [name for frame in robot.reaching_frames.values() for name in frame.joints]
    joints = [plant.GetJointByName(name, instance).index() for name in names]
    bodies = plant.GetBodiesKinematicallyAffectedBy(joints)
    return [g for b in bodies for g in plant.GetCollisionGeometriesForBody(plant.get_body(b))]


def filter_collisions(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    robot: RobotModel,
    obstacles: list[ModelInstanceIndex],
) -> None:
    """Filters all contacts except of arms with obstacles and of other bodies with the ground."""
    arms = arm_geometries(plant, robot)
    everything = collision_geometries(plant, [plant.GetModelInstanceByName(robot.name)])
    rest = [geometry for geometry in everything if geometry not in set(arms)]
    ground = plant.GetCollisionGeometriesForBody(plant.world_body())
    others = collision_geometries(plant, obstacles)
    declaration = CollisionFilterDeclaration()
    declaration.ExcludeWithin(GeometrySet(everything))
    declaration.ExcludeBetween(GeometrySet(rest), GeometrySet(others))
    declaration.ExcludeBetween(GeometrySet(arms), GeometrySet(ground))
    scene_graph.collision_filter_manager().Apply(declaration)


def remove_visuals(plant: MultibodyPlant, scene_graph: SceneGraph, context: Context) -> None:
    """Removes all geometries except collision geometries from a root Context.

    Every query moves all geometries, and a robot's meshes are many times its collision shapes.
    """
    inspector, source = scene_graph.model_inspector(), plant.get_source_id()
    own_context = scene_graph.GetMyMutableContextFromRoot(context)
    for geometry in inspector.GetAllGeometryIds():
        if inspector.GetProximityProperties(geometry) is None:
            scene_graph.RemoveGeometry(own_context, source, geometry)


class Clearance:
    """Signed distances of a robot's arms, and of points, to obstacles, clipped to ``range_m``."""

    def __init__(self, robot: RobotModel, obstacles: list[Obstacle], *, range_m: float):
        builder = DiagramBuilder()
        self._plant, self._scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        add_robot(self._plant, robot)
        instances = add_obstacles(self._plant, obstacles)
        self._plant.Finalize()
        filter_collisions(self._plant, self._scene_graph, robot, instances)
        diagram = builder.Build()
        self._query_port = self._scene_graph.get_query_output_port()
        self._scratch = Scratch(lambda: self._contexts_of(diagram.CreateDefaultContext()))
        self._obstacles = set(collision_geometries(self._plant, instances))
        if self._obstacles and not arm_geometries(self._plant, robot):
            raise ValueError(f"robot '{robot.name}': its arms have no collision geometry")
        self.range_m = range_m

    def _contexts_of(self, root: Context) -> tuple[Context, Context, Context]:
        """A scratch Context, and its parts, as looking them up costs as much as a distance."""
        remove_visuals(self._plant, self._scene_graph, root)
        plant = self._plant.GetMyMutableContextFromRoot(root)
        return root, plant, self._scene_graph.GetMyContextFromRoot(root)

    def of_arms(self, q: np.ndarray) -> float:
        """Distance of the arms to the nearest obstacle at q (n_q,), negative in contact [m]."""
        # Drake's plant aborts the process for positions that are not finite.
        if not q.dot(q) < math.inf:
            raise ValueError(f"clearance: positions must be finite; got {q}")
        if not self._obstacles:
            return self.range_m
        self._plant.SetPositions(self._scratch.value[1], q)
        query = self._query_port.Eval(self._scratch.value[2])
        pairs = query.ComputeSignedDistancePairwiseClosestPoints(self.range_m)
        return min((pair.distance for pair in pairs), default=self.range_m)

    def of_points(self, p_WP: np.ndarray, radius_m: float = 0.0) -> np.ndarray:
        """Distance of spheres at p_WP, (N, 3) [m], to the nearest obstacle, (N,) [m]."""
        query, range_m = self._query_port.Eval(self._scratch.value[2]), self.range_m + radius_m
        distances = np.full(len(p_WP), range_m)
        for i, p in enumerate(p_WP if self._obstacles else ()):
            for near in query.ComputeSignedDistanceToPoint(p, range_m):
                if near.id_G in self._obstacles:
                    distances[i] = min(distances[i], near.distance)
        return distances - radius_m
