"""The plant of a diagram, with the same interface for every physics engine.

With MuJoCo, a Drake plant still describes bodies, joints and shapes, for rendering.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import CollisionFilterDeclaration, GeometrySet, HalfSpace, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context, DiagramBuilder, InputPort, OutputPort
from pydrake.systems.primitives import ConstantVectorSource, MatrixGain
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from drake_safety.plants.balls import Ball, add_ball
from drake_safety.plants.mujoco_plant import MujocoPlant
from drake_safety.plants.obstacles import (
    Obstacle,
    add_obstacles,
    collision_geometries,
    filter_collisions,
)
from drake_safety.robots.model_files import package_parser
from drake_safety.robots.robot import (
    PlantVariation,
    actuation_matrix,
    add_robot,
    apply_masses,
    require_motors,
)
from drake_safety.robots.robot_model import RobotModel
from drake_safety.robots.shift import Shift


@dataclass(kw_only=True)
class Scene:
    """The surroundings of a robot besides the ground."""

    obstacles: Sequence[Obstacle] | None = None
    """With a list, even an empty list, only contacts of arms with obstacles and of other bodies
    with the ground are simulated; with None, the contacts of the model file."""
    decorations: Sequence[Obstacle] = ()  # Models without collision geometry.
    has_ball: bool = False


class DrakePhysics:
    """Physics by a MultibodyPlant; ``state`` and ``ball_state`` are ports of ``[q; v]``."""

    def __init__(
        self,
        plant: MultibodyPlant,
        scene_graph: SceneGraph,
        instance: ModelInstanceIndex,
        robot: RobotModel,
        variation: PlantVariation,
        ball: ModelInstanceIndex | None,
    ):
        self.plant, self.scene_graph, self.instance = plant, scene_graph, instance
        self._robot, self._variation = robot, variation
        self.state: OutputPort = plant.get_state_output_port(instance)
        self.applied_spatial_force: InputPort = plant.get_applied_spatial_force_input_port()
        self.ball = None if ball is None else Ball(plant, scene_graph, ball, robot.base)
        self.ball_state = None if ball is None else plant.get_state_output_port(ball)

    def actuation_matrix(self, joint_names: list[str]) -> np.ndarray:
        """Returns the map from joint torques (n_j,) to the input of :meth:`connect_torques`."""
        return actuation_matrix(self.plant, self._robot, joint_names)

    def connect_torques(self, builder: DiagramBuilder, torques: OutputPort) -> None:
        """Connects torques in actuator order to a robot without servos."""
        builder.Connect(torques, self.plant.get_actuation_input_port(self.instance))
        if self._variation.joint_friction_nm:
            # Without a desired state Drake deactivates the servos that model dry friction.
            port = self.plant.get_desired_state_input_port(self.instance)
            rest = builder.AddNamedSystem("rest", ConstantVectorSource(np.zeros(port.size())))
            builder.Connect(rest.get_output_port(), port)

    def connect_servos(
        self, builder: DiagramBuilder, joint_names: list[str], desired_joint_state: OutputPort
    ) -> None:
        """Connects joint positions and velocities (2 n_j,) to a robot with servos."""
        D = np.kron(np.eye(2), self.actuation_matrix(joint_names))
        servos = builder.AddNamedSystem("servo_map", MatrixGain(D=D))
        builder.Connect(desired_joint_state, servos.get_input_port())
        port = self.plant.get_desired_state_input_port(self.instance)
        builder.Connect(servos.get_output_port(), port)

    @contextmanager
    def edited(self, context: Context) -> Iterator[Context]:
        """Context manager for writing the plant's part of a root Context, with its masses."""
        plant_context = self.plant.GetMyMutableContextFromRoot(context)
        apply_masses(self.plant, plant_context, self._robot, self._variation)
        yield plant_context


class MujocoPhysics:
    """Physics by MuJoCo, with the interface of DrakePhysics; no balls and no shifts."""

    ball: Ball | None = None
    ball_state: OutputPort | None = None

    def __init__(
        self,
        builder: DiagramBuilder,
        plant: MultibodyPlant,
        scene_graph: SceneGraph,
        instance: ModelInstanceIndex,
        system: MujocoPlant,
    ):
        self.plant, self.scene_graph, self.instance = plant, scene_graph, instance
        self._system = builder.AddNamedSystem("plant", system)
        poses = builder.AddNamedSystem("geometry_pose", MultibodyPositionToGeometryPose(plant))
        builder.Connect(system.GetOutputPort("positions"), poses.get_input_port())
        source = scene_graph.get_source_pose_port(plant.get_source_id())
        builder.Connect(poses.get_output_port(), source)
        self.state: OutputPort = system.GetOutputPort("state")
        self.applied_spatial_force: InputPort = system.GetInputPort("applied_spatial_force")

    def actuation_matrix(self, joint_names: list[str]) -> np.ndarray:
        """Returns the identity: :meth:`connect_torques` has the order of the joints."""
        return np.eye(len(joint_names))

    def connect_torques(self, builder: DiagramBuilder, torques: OutputPort) -> None:
        """Connects joint torques to a robot without servos."""
        builder.Connect(torques, self._system.GetInputPort("command"))

    def connect_servos(
        self, builder: DiagramBuilder, joint_names: list[str], desired_joint_state: OutputPort
    ) -> None:
        """Connects joint positions and velocities (2 n_j,), in the order of the velocities."""
        builder.Connect(desired_joint_state, self._system.GetInputPort("command"))

    @contextmanager
    def edited(self, context: Context) -> Iterator[Context]:
        """Context manager for writing a Context of the Drake plant, copied to MuJoCo's state."""
        system_context = self._system.GetMyMutableContextFromRoot(context)
        plant_context = self.plant.CreateDefaultContext()
        state = self.state.Eval(system_context)
        self.plant.SetPositionsAndVelocities(plant_context, self.instance, state)
        yield plant_context
        state = self.plant.GetPositionsAndVelocities(plant_context, self.instance)
        self._system.set_state(system_context, state)


Physics = DrakePhysics | MujocoPhysics


def add_physics(
    builder: DiagramBuilder,
    robot: RobotModel,
    variation: PlantVariation,
    scene: Scene,
    *,
    time_step_s: float,
    servos: bool,
) -> Physics:
    """Adds a robot, with servos or torque inputs, on level ground to a diagram."""
    if variation.engine == "drake":
        config = MultibodyPlantConfig(
            time_step=time_step_s,
            discrete_contact_approximation="lagged",
            # Output ports are evaluated at the present state, not sampled at the last step.
            use_sampled_output_ports=False,
        )
        plant, scene_graph = AddMultibodyPlant(config, builder)
        instance, ball = _add_robot_and_scene(plant, scene_graph, robot, variation, scene, servos)
        return DrakePhysics(plant, scene_graph, instance, robot, variation, ball)
    if scene.has_ball:
        raise ValueError("engine 'mujoco' has no ball to throw: pass ball=False")
    if variation.shift is not None:
        raise ValueError("engine 'mujoco' has no shifts; simulate them by engine 'drake'")
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    plant = MultibodyPlant(time_step_s)
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    instance, _ = _add_robot_and_scene(plant, scene_graph, robot, variation, scene, servos)
    system = MujocoPlant(
        robot, plant, scene_graph, variation, time_step_s=time_step_s, servos=servos
    )
    return MujocoPhysics(builder, plant, scene_graph, instance, system)


def add_ground(plant: MultibodyPlant, friction: float) -> None:
    """Adds level ground at z = 0, with a friction coefficient, to a plant not yet finalised."""
    # The URDF is the visual; the collision shape is an infinite half space.
    package_parser(plant).AddModels(url="package://drake_safety_models/scenes/ground.urdf")
    world, material = plant.world_body(), CoulombFriction(friction, friction)
    plant.RegisterCollisionGeometry(world, RigidTransform(), HalfSpace(), "ground", material)


def _add_holes(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    robot: RobotModel,
    instance: ModelInstanceIndex,
    depths_m: Mapping[str, float],
    friction: float,
) -> None:
    """Lowers the ground under some feet."""
    if unknown := [name for name in depths_m if name not in robot.feet]:
        raise ValueError(f"robot '{robot.name}' has no feet {unknown} for holes")
    material, holes = CoulombFriction(friction, friction), {}
    for name, depth_m in depths_m.items():
        hole = RigidTransform([0.0, 0.0, -depth_m]), HalfSpace(), f"hole_{name}", material
        body = robot.feet[name].body
        holes[body] = plant.RegisterCollisionGeometry(plant.world_body(), *hole)
    # After the registrations, which invalidate earlier lists of identifiers.
    everything = plant.GetCollisionGeometriesForBody(plant.world_body())
    ground = [geometry for geometry in everything if geometry not in holes.values()]
    filters = scene_graph.collision_filter_manager()
    for index in plant.GetBodyIndices(instance):
        body = plant.get_body(index)
        shapes = plant.GetCollisionGeometriesForBody(body)
        others = [hole for name, hole in holes.items() if name != body.name()]
        others += ground if body.name() in holes else []
        if shapes and others:
            sides = GeometrySet(shapes), GeometrySet(others)
            filters.Apply(CollisionFilterDeclaration().ExcludeBetween(*sides))


def _add_robot_and_scene(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    robot: RobotModel,
    variation: PlantVariation,
    scene: Scene,
    servos: bool,
) -> tuple[ModelInstanceIndex, ModelInstanceIndex | None]:
    """Fills and finalises a plant; returns the model instances of robot and ball."""
    plant.set_name("plant")
    # Disables preparation for deformable contact, which warns about the half space.
    config = scene_graph.get_config()
    config.default_proximity_properties.resolution_hint = None
    scene_graph.set_config(config)
    instance = add_robot(plant, robot, variation, scene_graph=scene_graph, servos=servos)
    friction = variation.foot_friction or robot.foot_friction
    add_ground(plant, friction)
    ball = add_ball(plant) if scene.has_ball else None
    shift = variation.shift or Shift()
    if shift.holes_m:
        _add_holes(plant, scene_graph, robot, instance, shift.holes_m, friction)
    slope, direction = shift.slope_rad, shift.slope_direction_rad
    if slope or shift.gravity_scale != 1.0:  # Gravity inclines: the ground stays at z = 0.
        gravity = plant.mutable_gravity_field()
        magnitude = shift.gravity_scale * np.linalg.norm(gravity.gravity_vector())
        downhill = math.sin(slope) * np.array([math.cos(direction), math.sin(direction)])
        gravity.set_gravity_vector(magnitude * np.append(downhill, -math.cos(slope)))
    obstacles = add_obstacles(plant, scene.obstacles or ())
    decorations = add_obstacles(plant, scene.decorations)
    plant.Finalize()
    require_motors(plant, robot)
    if collision_geometries(plant, decorations):
        raise ValueError("decorations with collision geometry belong under 'obstacles'")
    if scene.obstacles is not None:
        filter_collisions(plant, scene_graph, robot, obstacles)
    return instance, ball
