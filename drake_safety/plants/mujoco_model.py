"""A robot and its scene as a MuJoCo model: mechanics from the URDF, contacts as in Drake."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ElementTree
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    SceneGraph,
    Sphere,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from drake_safety.extras import require_extra
from drake_safety.robots.model_files import model_file
from drake_safety.robots.robot import PAYLOAD_RADIUS_M, PlantVariation, servo_joints
from drake_safety.robots.robot_model import RobotModel
from drake_safety.robots.urdf import remove

if TYPE_CHECKING:
    import mujoco

_SHAPES = {
    Sphere: ("mjGEOM_SPHERE", lambda shape: [shape.radius(), 0.0, 0.0]),
    Box: ("mjGEOM_BOX", lambda shape: 0.5 * shape.size()),
    Capsule: ("mjGEOM_CAPSULE", lambda shape: [shape.radius(), 0.5 * shape.length(), 0.0]),
    Cylinder: ("mjGEOM_CYLINDER", lambda shape: [shape.radius(), 0.5 * shape.length(), 0.0]),
    Ellipsoid: ("mjGEOM_ELLIPSOID", lambda shape: [shape.a(), shape.b(), shape.c()]),
    Convex: ("mjGEOM_MESH", lambda _: np.zeros(3)),
    HalfSpace: ("mjGEOM_PLANE", lambda _: [0.0, 0.0, 1.0]),
}
"""MuJoCo's type and sizes of Drake's shapes."""


def import_mujoco() -> Any:
    """Imports the optional package ``mujoco``, or says how to install it."""
    require_extra("mujoco", "engine 'mujoco'")
    import mujoco

    return mujoco


def build_model(
    robot: RobotModel,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    variation: PlantVariation,
    *,
    time_step_s: float,
    servos: bool,
) -> tuple[mujoco.MjModel, list[int]]:
    """Compiles a robot and its scene; returns the model, and each control's place in the command.

    MuJoCo reads masses, inertias, joint frames, axes and stops from the URDF. The Drake plant gives
    actuators, effort limits, collision shapes, friction coefficients and collision filters. Other
    contact parameters are MuJoCo's defaults, with an elliptic friction cone.
    """
    mujoco = import_mujoco()
    path = model_file(robot.urdf, robot.source_dir, robot.requires)
    if path.suffix != ".urdf":
        raise ValueError(f"robot '{robot.name}': engine 'mujoco' reads URDF files; got '{path}'")
    spec = mujoco.MjSpec.from_string(_mechanics(path.read_text(encoding="utf-8")))
    # Keeps the names of welded links, among which feet and hands may be.
    spec.compiler.fusestatic = False
    spec.option.timestep = time_step_s
    # Implicit damping, including that of servos, as in Drake.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # By default a failed simulation is reset without an error.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.body(robot.base).add_freejoint()
    commands = _add_actuators(spec, plant, robot, variation, servos)
    _add_geometries(spec, plant, scene_graph, robot)
    if payload := variation.payload:
        name = payload.body or robot.base
        if (carrier := spec.body(name)) is None:
            raise ValueError(f"robot '{robot.name}' has no body '{name}' for the payload")
        # All masses are scaled after compiling; this cancels the payload's scale.
        mass_kg = payload.mass_kg / variation.mass_scale
        carrier.add_body(
            name="payload",
            pos=payload.position_m,
            ipos=[0.0, 0.0, 0.0],
            mass=mass_kg,
            inertia=[0.4 * mass_kg * PAYLOAD_RADIUS_M**2] * 3,
            explicitinertial=True,
        )
    model = spec.compile()
    if variation.mass_scale != 1.0:
        model.body_mass *= variation.mass_scale
        model.body_inertia *= variation.mass_scale
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model, commands


def _mechanics(urdf: str) -> str:
    """Reduces a URDF to links, inertias and joints, without visuals and collision shapes."""
    root = ElementTree.fromstring(urdf)
    for element in list(root):
        if element.tag not in ("link", "joint", "mujoco"):
            root.remove(element)
    for link in root.findall("link"):
        remove(link, "visual")
        remove(link, "collision")
    return ElementTree.tostring(root, encoding="unicode")


def _add_actuators(
    spec: mujoco.MjSpec,
    plant: MultibodyPlant,
    robot: RobotModel,
    variation: PlantVariation,
    servos: bool,
) -> list[int]:
    """Adds actuators, friction and damping; returns the commands of `build_model`."""
    mujoco = import_mujoco()
    instance = plant.GetModelInstanceByName(robot.name)
    # Drake's plant models dry friction by a second actuator, after the joint's own.
    limits: dict[str, float] = {}
    for index in plant.GetJointActuatorIndices(instance):
        actuator = plant.get_joint_actuator(index)
        limits.setdefault(actuator.joint().name(), actuator.effort_limit())
    names = servo_joints(plant, robot)
    commands, kind_of_target = [], mujoco.mjtTrn.mjTRN_JOINT

    def add(kind: str, name: str, gain: float, bias: list[float], command: int) -> None:
        actuator = spec.add_actuator(name=f"{name}_{kind}", target=name, trntype=kind_of_target)
        actuator.gainprm[0] = gain
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.biasprm[:3] = bias
        commands.append(command)

    for row, name in enumerate(names):
        if name not in limits:
            continue
        joint = spec.joint(name)
        joint.damping[0] += variation.joint_damping
        joint.frictionloss = variation.joint_friction_nm
        # The limit applies to the sum of a joint's actuators.
        is_limited = np.isfinite(limits[name])
        joint.actfrclimited = is_limited
        joint.actfrcrange = [-limits[name], limits[name]] if is_limited else [0.0, 0.0]
        gains = robot.gains_of(name)
        if not servos:
            add("torque", name, 1.0, [0.0, 0.0, 0.0], row)
        elif gains is not None:
            add("position", name, gains.stiffness, [0.0, -gains.stiffness, 0.0], row)
            add("velocity", name, gains.damping, [0.0, 0.0, -gains.damping], len(names) + row)
    return commands


def _add_geometries(
    spec: mujoco.MjSpec, plant: MultibodyPlant, scene_graph: SceneGraph, robot: RobotModel
) -> None:
    """Adds collision geometry of robot and scene, and collision filters."""
    mujoco = import_mujoco()
    inspector, context = scene_graph.model_inspector(), plant.CreateDefaultContext()
    instance = plant.GetModelInstanceByName(robot.name)
    touchable = []
    for body in (plant.get_body(BodyIndex(index)) for index in range(plant.num_bodies())):
        geometries = plant.GetCollisionGeometriesForBody(body)
        if not geometries:
            continue
        if body.model_instance() == instance:
            mujoco_body = spec.body(body.name())
        else:
            name = f"{plant.GetModelInstanceName(body.model_instance())}::{body.name()}"
            X_WB = plant.EvalBodyPoseInWorld(context, body)
            mujoco_body = spec.worldbody.add_body(
                name=name, pos=X_WB.translation(), quat=X_WB.rotation().ToQuaternion().wxyz()
            )
        touchable.append((mujoco_body.name, geometries))
        for geometry in geometries:
            shape = inspector.GetShape(geometry)
            if type(shape) not in _SHAPES:
                raise ValueError(f"engine 'mujoco' has no collision shape {type(shape).__name__}")
            kind, size = _SHAPES[type(shape)]
            X_BG = inspector.GetPoseInFrame(geometry)
            geom = mujoco_body.add_geom(
                type=getattr(mujoco.mjtGeom, kind),
                size=size(shape),
                pos=X_BG.translation(),
                quat=X_BG.rotation().ToQuaternion().wxyz(),
            )
            properties = inspector.GetProximityProperties(geometry)
            friction = properties.GetProperty("material", "coulomb_friction")
            geom.friction[0] = friction.dynamic_friction()
            if isinstance(shape, Convex):
                hull = inspector.GetConvexHull(geometry)
                corners = [hull.vertex(i) for i in range(hull.num_vertices())]
                geom.meshname = f"hull {inspector.GetName(geometry)}"
                spec.add_mesh(name=geom.meshname, uservert=np.concatenate(corners))
    for (name, ours), (other, theirs) in itertools.combinations(touchable, 2):
        filtered = [inspector.CollisionFiltered(a, b) for a in ours for b in theirs]
        if all(filtered):
            spec.add_exclude(bodyname1=name, bodyname2=other)
        elif any(filtered):
            raise ValueError(f"engine 'mujoco' cannot filter only some of '{name}' and '{other}'")
