"""Adds a robot to a MultibodyPlant, with plant variations that model a reality gap."""

import logging
import threading
from collections.abc import Callable
from dataclasses import field
from itertools import chain
from typing import Generic, Literal, TypeVar

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    CollisionFilterDeclaration,
    GeometrySet,
    ProximityProperties,
    RoleAssign,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    LinearSpringDamper,
    ModelInstanceIndex,
    PdControllerGains,
    SpatialInertia,
)
from pydrake.systems.framework import Context

from drake_safety.files.schema import NotNegative, Positive, Triple, schema
from drake_safety.robots.meshes import check_meshes
from drake_safety.robots.model_files import model_file, package_parser
from drake_safety.robots.robot_model import RobotModel, by_pattern, require_known
from drake_safety.robots.shift import JointShift, Shift
from drake_safety.robots.urdf import drake_urdf, empty_shapes, read_urdf

_T = TypeVar("_T")


@schema(kw_only=True)
class ObservationNoise:
    """Standard deviations of the noise on a measured state."""

    position: NotNegative = 0.0  # Base position [m], base orientation and joint positions [rad].
    velocity: NotNegative = 0.0  # Base and joint velocities [m/s, rad/s].


@schema(kw_only=True)
class Payload:
    """A small mass fixed to a body of the robot, by default to its base."""

    mass_kg: Positive = 1.0
    position_m: Triple = field(default_factory=lambda: [0.0, 0.0, 0.0])  # In the body's frame.
    body: str = ""


@schema(kw_only=True)
class PlantVariation:
    """Differences of a plant from the published robot."""

    engine: Literal["drake", "mujoco"] = "drake"
    mass_scale: Positive = 1.0  # Factor on every body's spatial inertia.
    joint_friction_nm: NotNegative = 0.0  # Dry (Coulomb) friction of every actuated joint [N·m].
    joint_damping: NotNegative = 0.0  # Viscous damping added to every actuated joint [N·m·s/rad].
    foot_friction: Positive | None = None  # Friction of the feet; the robot's own by default.
    # Noise on the measurements of controllers and assessor.
    observation_noise: ObservationNoise = field(default_factory=ObservationNoise)
    # Noise on the assessor's inputs alone; the motion does not depend on it.
    input_noise: ObservationNoise = field(default_factory=ObservationNoise)
    payload: Payload | None = None  # A mass that the controllers do not model.
    shift: Shift | None = None  # Lasting conditions that training does not have.
    # ``dc``: the torque of servos falls with speed; by default it is constant. See `MotorCurves`.
    motors: Literal["dc"] | None = None


PAYLOAD_RADIUS_M = 0.05
_SHAPE_FRICTION = 0.2  # Friction of all shapes but the feet.
_SPRING_LENGTH_M = 1e4  # Length of the spring that exerts a steady force.
_LOCKED_DAMPING = 1e5  # [N·m·s/rad]. Drake 1.51 crashes when a joint with a servo is locked.
_FRICTION_SUFFIX = "_friction"  # Suffix of actuators that model dry friction.
_FRICTION_DAMPING = 2000.0  # [N·m·s/rad]: a stuck joint creeps at no more than tau_c / 2000.


def servo_joints(plant: MultibodyPlant, robot: RobotModel) -> list[str]:
    """Returns the robot's one-degree-of-freedom joints, in the order of a finalised plant."""
    instance = plant.GetModelInstanceByName(robot.name)
    joints = [plant.get_joint(i) for i in plant.GetJointIndices(instance)]
    joints = [joint for joint in joints if joint.num_velocities() == 1]
    if plant.is_finalized():
        joints.sort(key=lambda joint: joint.velocity_start())
    return [joint.name() for joint in joints]


def _set_friction(
    scene_graph: SceneGraph, plant: MultibodyPlant, robot: RobotModel, variation: PlantVariation
) -> None:
    ground = variation.foot_friction or robot.foot_friction
    of_feet = variation.shift.foot_friction if variation.shift else {}
    require_known(robot.name, "foot for friction", of_feet, list(robot.feet))
    inspector = scene_graph.model_inspector()
    instance = plant.GetModelInstanceByName(robot.name)
    source = plant.get_source_id()
    for name, foot in robot.feet.items():
        body = plant.GetBodyByName(foot.body, instance)
        # Drake combines the coefficients of foot and ground, 2 m n / (m + n).
        mu = ground
        if name in of_feet:
            if (wanted := of_feet[name]) >= 2.0 * ground:
                text = f"friction of foot '{name}' must be below twice the ground's {ground:g}"
                raise ValueError(f"robot '{robot.name}': {text}; got {wanted:g}")
            mu = wanted * ground / (2.0 * ground - wanted)
        for geometry in plant.GetCollisionGeometriesForBody(body):
            centre = inspector.GetPoseInFrame(geometry).translation()
            offsets = np.linalg.norm(np.array(foot.contact_points) - centre, axis=1)
            if offsets.min() < 1e-3 and isinstance(inspector.GetShape(geometry), Sphere):
                properties = ProximityProperties(inspector.GetProximityProperties(geometry))
                properties.UpdateProperty("material", "coulomb_friction", CoulombFriction(mu, mu))
                scene_graph.AssignRole(source, geometry, properties, RoleAssign.kReplace)


def _add_description(plant: MultibodyPlant, robot: RobotModel) -> ModelInstanceIndex:
    """Adds a robot's bodies, joints and shapes; without a scene graph, geometry is left out."""
    parser = package_parser(plant, robot.urdf)
    path = model_file(robot.urdf, robot.source_dir, robot.requires)
    is_urdf, text = path.suffix == ".urdf", None
    if path.is_file():
        check_meshes(path)
    if is_urdf:
        has_scene, is_stated = plant.geometry_source_is_registered(), robot.collision == "stated"
        text = drake_urdf(path, with_collisions=not is_stated, with_visuals=has_scene)
    drake, is_packaged = logging.getLogger("drake"), robot.urdf.startswith("package://")

    def pass_on(record: logging.LogRecord) -> bool:
        """Drops warnings about files of packages, which no user can change."""
        return not is_packaged or record.levelno > logging.WARNING

    drake.addFilter(pass_on)
    try:
        if text is None:
            (instance,) = parser.AddModels(str(path))
        else:
            (instance,) = parser.AddModelsFromString(text, "urdf")
    except SystemExit as error:  # pydrake raises it where a condition of Drake's C++ fails.
        shapes = [x for *_, x in empty_shapes(read_urdf(path))] if is_urdf else []
        what = "; ".join([f"Drake cannot build '{path}'", *shapes, str(error)])
        raise ValueError(what) from error
    finally:
        drake.removeFilter(pass_on)
    plant.RenameModelInstance(instance, robot.name)
    return instance


def _add_stated_shapes(
    plant: MultibodyPlant, robot: RobotModel, instance: ModelInstanceIndex
) -> None:
    """Adds the collision geometry of robot.yaml: contact points and shapes."""
    bodies = {body.name(): body for body in map(plant.get_body, plant.GetBodyIndices(instance))}
    require_known(robot.name, "body for shapes", robot.shapes, list(bodies))
    material = CoulombFriction(_SHAPE_FRICTION, _SHAPE_FRICTION)
    for name, body in bodies.items():
        shapes = by_pattern(robot.shapes, name, "shapes", robot.name, "body") or []
        for i, stated in enumerate(shapes):
            shape: Shape = Box(*stated.box_m) if stated.box_m else Sphere(stated.radius_m)
            X_BG = RigidTransform(stated.position_m)
            if stated.to_m:
                start, end = np.array([stated.position_m, stated.to_m], dtype=float)
                length = float(np.linalg.norm(end - start))
                R_BG = RotationMatrix.MakeFromOneVector((end - start) / length, 2)
                X_BG = RigidTransform(R_BG, start + 0.5 * (end - start))
                shape = Capsule(stated.radius_m, length)
            plant.RegisterCollisionGeometry(body, X_BG, shape, f"{name}_shape_{i}", material)
    material = CoulombFriction(robot.foot_friction, robot.foot_friction)
    for name, foot in robot.feet.items():
        for i, point in enumerate(foot.contact_points):
            place = bodies[foot.body], RigidTransform(point), Sphere(foot.radius_m)
            plant.RegisterCollisionGeometry(*place, f"{name}_contact_{i}", material)


def _ignore_neighbours(
    plant: MultibodyPlant, scene_graph: SceneGraph, instance: ModelInstanceIndex
) -> None:
    """Filters collisions of links welded to the bodies of a joint, which Drake does not."""
    for joint in map(plant.get_joint, plant.GetJointIndices(instance)):
        ends = joint.parent_body(), joint.child_body()
        sides = [plant.GetBodiesWeldedTo(body) for body in ends]
        if joint.num_velocities() and any(len(side) > 1 for side in sides):
            shapes = (map(plant.GetCollisionGeometriesForBody, side) for side in sides)
            parent, child = (GeometrySet([*chain.from_iterable(side)]) for side in shapes)
            apart = CollisionFilterDeclaration().ExcludeBetween(parent, child)
            scene_graph.collision_filter_manager().Apply(apart)


def add_robot(
    plant: MultibodyPlant,
    robot: RobotModel,
    variation: PlantVariation | None = None,
    *,
    scene_graph: SceneGraph | None = None,
    servos: bool = True,
) -> ModelInstanceIndex:
    """Adds a robot, with robot.yaml's position ``servos`` or for torques, to a plant.

    The plant is not finalised. The variation's masses are parameters of the Context: see
    :func:`apply_masses`. Dry joint friction is a second actuator on the joint that holds velocity
    zero with at most the friction torque, solved implicitly with the contact. Without
    ``scene_graph`` the feet keep the model file's friction.
    """
    variation = variation or PlantVariation()
    instance = _add_description(plant, robot)
    shifts, joint_names = variation.shift or Shift(), servo_joints(plant, robot)
    require_known(robot.name, "joint for shift", shifts.joints, joint_names)
    if force_n := np.linalg.norm(shifts.base_force_n):
        # A spring so long that motion hardly changes its force or direction.
        far = _SPRING_LENGTH_M * np.array(shifts.base_force_n) / force_n
        rest_m = 1e-3 * _SPRING_LENGTH_M
        stiffness = force_n / (_SPRING_LENGTH_M - rest_m)
        ends = plant.world_body(), far, plant.GetBodyByName(robot.base, instance), np.zeros(3)
        plant.AddForceElement(LinearSpringDamper(*ends, rest_m, stiffness, damping=0.0))
    bodies = [plant.get_body(i).name() for i in plant.GetBodyIndices(instance)]
    joints = [plant.get_joint(i).name() for i in plant.GetJointIndices(instance)]
    links = (limb.body for limb in robot.limbs())
    require_known(robot.name, "body", (robot.base, *links, *robot.whole_body.orientation), bodies)
    of_limbs = (name for limb in robot.limbs() for name in limb.joints)
    require_known(robot.name, "joint", of_limbs, joints)
    for key in ("joint_gains", "effort_limits", "velocity_limits", "rotor_inertia"):
        what = f"joint for {key} pattern"
        require_known(robot.name, what, getattr(robot, key), joint_names)
    robot.mirror_partners(joint_names)
    if robot.collision == "stated" and plant.geometry_source_is_registered():
        _add_stated_shapes(plant, robot, instance)

    # Before Finalize, the plant cannot list actuators by model instance.
    actuators = map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
    actuated = {a.joint().name(): a for a in actuators if a.model_instance() == instance}
    for name in joint_names:
        joint = plant.GetJointByName(name, instance)
        actuator = actuated.get(name)
        limit = by_pattern(robot.effort_limits, name, "effort limit", robot.name)
        if actuator is None:
            if limit is None:
                continue
            actuator = actuated[name] = plant.AddJointActuator(f"{name}_actuator", joint, limit)
        elif limit is not None and np.isinf(actuator.effort_limit()):
            actuator.set_effort_limit(limit)
        shift = by_pattern(shifts.joints, name, "shift", robot.name) or JointShift()
        if shift.effort_scale != 1.0:
            actuator.set_effort_limit(shift.effort_scale * actuator.effort_limit())
        gains = robot.gains_of(name)
        if gains is not None and servos:
            p, d = shift.stiffness_scale * gains.stiffness, shift.stiffness_scale * gains.damping
            actuator.set_controller_gains(PdControllerGains(p=p, d=d))
        inertia = by_pattern(robot.rotor_inertia, name, "rotor inertia", robot.name)
        if inertia:
            actuator.set_default_rotor_inertia(inertia)
            actuator.set_default_gear_ratio(1.0)
        speed = by_pattern(robot.velocity_limits, name, "velocity limit", robot.name)
        if speed is not None:
            joint.set_velocity_limits([-speed], [speed])
        damping = variation.joint_damping + (_LOCKED_DAMPING if shift.is_locked else 0.0)
        if damping:
            joint.set_default_damping(joint.default_damping() + damping)
    if variation.joint_friction_nm:
        for name in actuated:
            joint, most = plant.GetJointByName(name, instance), variation.joint_friction_nm
            friction = plant.AddJointActuator(f"{name}{_FRICTION_SUFFIX}", joint, most)
            friction.set_controller_gains(PdControllerGains(p=0.0, d=_FRICTION_DAMPING))
    if scene_graph is not None:
        _set_friction(scene_graph, plant, robot, variation)
        _ignore_neighbours(plant, scene_graph, instance)
    for joint_name, position in posture_positions(plant, robot).items():
        plant.GetJointByName(joint_name, instance).set_default_positions([position])
    return instance


def require_motors(plant: MultibodyPlant, robot: RobotModel) -> None:
    """Checks that every joint of legs and arms has a motor."""
    instance = plant.GetModelInstanceByName(robot.name)
    actuators = map(plant.get_joint_actuator, plant.GetJointActuatorIndices(instance))
    driven = {actuator.joint().name() for actuator in actuators}
    names = dict.fromkeys(name for limb in robot.limbs() for name in limb.joints)
    # Limbs may leave out their joints; then all joints are checked.
    if without := [name for name in names or servo_joints(plant, robot) if name not in driven]:
        what = f"robot '{robot.name}': joints {without} have no motor"
        hint = "or their largest torques [N·m] to effort_limits in robot.yaml"
        raise ValueError(f"{what}: add a transmission to '{robot.urdf}', {hint}")


def posture_positions(plant: MultibodyPlant, robot: RobotModel) -> dict[str, float]:
    """Returns the standing position [rad] of every servo joint; zero if robot.yaml has none."""
    names = servo_joints(plant, robot)
    require_known(robot.name, "joint for posture pattern", robot.posture, names)
    return {name: by_pattern(robot.posture, name, "posture", robot.name) or 0.0 for name in names}


def actuation_matrix(
    plant: MultibodyPlant, robot: RobotModel, joint_names: list[str]
) -> np.ndarray:
    """The map (n_u, n_j) from joint values to actuators; friction actuators get zero."""
    instance = plant.GetModelInstanceByName(robot.name)
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(instance)]
    matrix = np.zeros((len(actuators), len(joint_names)))
    for row, actuator in enumerate(actuators):
        name = actuator.joint().name()
        if actuator.name() != f"{name}{_FRICTION_SUFFIX}":
            matrix[row, joint_names.index(name)] = 1.0
    return matrix


def apply_masses(
    plant: MultibodyPlant, context: Context, robot: RobotModel, variation: PlantVariation
) -> None:
    """Sets a robot's masses in a plant's Context by a variation, with its payload."""
    instance = plant.GetModelInstanceByName(robot.name)
    bodies = [plant.get_body(i) for i in plant.GetBodyIndices(instance)]
    for body in bodies:
        M_BBo_B = body.default_spatial_inertia()
        if M_BBo_B.get_mass() > 0:
            scaled_kg = variation.mass_scale * M_BBo_B.get_mass()
            scaled = SpatialInertia(scaled_kg, M_BBo_B.get_com(), M_BBo_B.get_unit_inertia())
            body.SetSpatialInertiaInBodyFrame(context, scaled)
    payload = variation.payload
    if payload is None:
        return
    name = payload.body or robot.base
    require_known(robot.name, "body", [name], [body.name() for body in bodies])
    body = plant.GetBodyByName(name, instance)
    M_PPo_P = SpatialInertia.SolidSphereWithMass(payload.mass_kg, PAYLOAD_RADIUS_M)
    M_BBo_B = body.CalcSpatialInertiaInBodyFrame(context)
    M_BBo_B += M_PPo_P.Shift(-np.array(payload.position_m))
    body.SetSpatialInertiaInBodyFrame(context, M_BBo_B)


class Scratch(threading.local, Generic[_T]):
    """A value that a calculation overwrites, one for each thread."""

    def __init__(self, make: Callable[[], _T]):
        # A subclass of threading.local is initialised anew in each thread.
        self.value = make()
