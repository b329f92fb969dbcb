"""Tasks, feet and limits of a robot's whole-body programs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.math import RotationMatrix
from pydrake.multibody.tree import Frame, RigidBody

from drake_safety.control.kinematics import NUM_BASE_VELOCITIES, RobotKinematics
from drake_safety.robots.robot_model import ReachingFrame

EQUALITY = 5
"""daqp's value in ``sense`` for rows with equal bounds."""

_COINCIDENT_M = 1e-6  # Tolerance of collinear and coincident contact points.
_REST = np.zeros(3)
_REST.flags.writeable = False


@dataclass(kw_only=True)
class PointReference:
    """Reference of a point in the world frame."""

    position: np.ndarray
    """(3,) [m]."""
    rate: np.ndarray = field(default_factory=lambda: _REST)
    """(3,) [m/s]."""
    acceleration: np.ndarray = field(default_factory=lambda: _REST)
    """Feedforward (3,) [m/s²]."""


@dataclass(kw_only=True)
class WholeBodyReference:
    """References of all tasks."""

    center_of_mass: PointReference
    orientations: list[RotationMatrix]
    """R_WB of every body with an orientation task, in the order of ``model.body_names``."""
    posture: np.ndarray
    """Joint positions (n_j,) [rad]."""
    is_stance: np.ndarray
    """Whether each foot stands, (n_feet,)."""
    reaching: PointReference | None = None
    """Reference of the hand; required by models with a hand."""


class Hand:
    """A reaching point, its collision sphere and the joints of its arm."""

    def __init__(self, name: str, body: RigidBody, reaching_frame: ReachingFrame):
        self.name = name
        self.body = body
        self.frame: Frame = body.body_frame()
        self.point = np.array(reaching_frame.point, dtype=float)
        self.radius_m = reaching_frame.radius_m
        self.joints = list(reaching_frame.joints)

    def present_position(self, kinematics: RobotKinematics) -> np.ndarray:
        """Returns the reaching point in the world at the scratch Context's positions, (3,) [m]."""
        # A third quicker than RigidTransform's product, which is wrapped in Python.
        p_WH: np.ndarray = kinematics.plant.CalcPointsPositions(
            kinematics.context, self.frame, self.point, kinematics.world_frame
        )
        return p_WH[:, 0]


class StandingFoot:
    """A foot's contact points and its contact constraint.

    Rows for every point of a rigid foot would be redundant, and inconsistent while it rotates. The
    constraint has the velocity of the points' centre and the rotations that move any point: six
    rows for a sole, five for an edge, three for a point.
    """

    def __init__(self, body: RigidBody, points: np.ndarray):
        self.body = body
        self.frame: Frame = body.body_frame()
        self.points = points  # (3, n)
        self.num_points = points.shape[1]
        self.center = points.mean(axis=1)
        _, spread, directions = np.linalg.svd((points - self.center[:, np.newaxis]).T)
        dimensions = int(np.sum(spread > _COINCIDENT_M))
        self.num_rows = {0: 3, 1: 5}.get(dimensions, 6)
        self.edge_turns: np.ndarray | None = directions[1:] if dimensions == 1 else None
        """Axes across an edge in the body's frame, (2, 3)."""


class WholeBodyModel:
    """Frames, gains and limits of a robot's whole-body program; no reaching without a hand."""

    def __init__(self, kinematics: RobotKinematics, hand: str | None = None):
        robot, plant = kinematics.robot, kinematics.plant
        self.kinematics = kinematics
        self.parameters = parameters = robot.whole_body
        self.num_joints = kinematics.num_joints
        self.num_velocities = kinematics.num_velocities
        self.mass = kinematics.total_mass
        self.weight_W = self.mass * plant.gravity_field().gravity_vector()
        # The cost of forces divided by this is their squared norm.
        self.force_scale = self.mass / math.sqrt(parameters.force_regularization)
        self.hand: Hand | None = None
        if hand is not None:
            frame = robot.reaching_frame(hand)
            self.hand = Hand(hand, plant.GetBodyByName(frame.body), frame)
        self.body_names = list(parameters.orientation)
        self.bodies = [plant.GetBodyByName(name) for name in self.body_names]
        # After the three of the centre of mass.
        self.orientation_rows = [slice(3 * i, 3 * i + 3) for i in range(1, len(self.bodies) + 1)]
        self.feet = [
            StandingFoot(plant.GetBodyByName(foot.body), points)
            for foot, points in zip(robot.feet.values(), kinematics.foot_points, strict=True)
        ]
        tasks = [parameters.center_of_mass, *parameters.orientation.values()]
        if hand is not None:
            tasks.append(parameters.reaching)
        # Three rows per task: the centre of mass, the bodies in order, the hand.
        self.num_task_rows = 3 * len(tasks)
        gains = np.array([[task.weight, task.stiffness, task.damping] for task in tasks])
        weights, self.stiffness, self.damping = np.repeat(gains, 3, axis=0).T.copy()
        self.task_weights = weights[:, np.newaxis]
        diagonal = np.full(self.num_velocities, parameters.regularization)
        diagonal[NUM_BASE_VELOCITIES:] += parameters.posture.weight
        self.H = np.diag(diagonal)
        """Part of the cost's matrix from regularisation and posture, (n_v, n_v)."""
        self.base_turns = np.eye(3, self.num_velocities)
        self.torque_limits = np.zeros(self.num_joints)
        """Largest torque of every joint (n_j,) [N·m]; zero for a joint without an actuator."""
        for index in plant.GetJointActuatorIndices():
            actuator = plant.get_joint_actuator(index)
            joint = kinematics.joint_names.index(actuator.joint().name())
            self.torque_limits[joint] = actuator.effort_limit()
        self._stances: dict[bytes, Stance] = {}

    def stance(self, is_stance: np.ndarray) -> Stance:
        """Returns the constant part of programs with these stance feet."""
        key = np.asarray(is_stance, dtype=bool).tobytes()
        if key not in self._stances:
            self._stances[key] = Stance(self, is_stance)
        return self._stances[key]

    def reference(self, q: np.ndarray) -> WholeBodyReference:
        """The reference for standing on the feet of ``q`` in the standing posture.

        The centre of mass is over the stance at its height in ``q``, the bodies have the
        orientations of the standing posture with the yaw of the stance, and the hand is at rest.
        """
        kinematics = self.kinematics
        (x, y, yaw), height = kinematics.stance_pose(q), kinematics.center_of_mass(q)[2]
        reference = WholeBodyReference(
            center_of_mass=PointReference(position=np.array([x, y, height])),
            orientations=[],
            posture=np.array(kinematics.posture, dtype=float),
            is_stance=np.ones(len(self.feet), bool),
        )
        if self.hand is not None:
            reference.reaching = PointReference(position=self.reaching_position(q))
        kinematics.set_positions(kinematics.standing_positions())
        R_WS = RotationMatrix.MakeZRotation(yaw)
        for body in self.bodies:
            R_SB = body.EvalPoseInWorld(kinematics.context).rotation()
            reference.orientations.append(R_WS @ R_SB)
        return reference

    def check_reference(self, reference: WholeBodyReference) -> None:
        """Checks that a reference is complete and finite, and of the right sizes."""
        who = f"robot '{self.kinematics.robot.name}': the whole-body reference"
        for name, entries in (
            ("posture", self.kinematics.joint_names),
            ("is_stance", self.kinematics.foot_names),
            ("orientations", self.body_names),
        ):
            size = len(getattr(reference, name))
            if size != len(entries):
                raise ValueError(f"{who} must have {name} for {entries}; got {size} entries")
        if self.hand is not None and reference.reaching is None:
            raise ValueError(f"{who} must have reaching for the hand; got none")
        vectors = [reference.posture]
        for point in filter(None, (reference.center_of_mass, reference.reaching)):
            vectors += [point.position, point.rate, point.acceleration]
        is_sized = all(np.shape(vector) == (3,) for vector in vectors[1:])
        if not is_sized or not np.isfinite(np.concatenate(vectors)).all():
            raise ValueError(f"{who} must have finite numbers, three for a point; got {reference}")

    def reaching_position(self, q: np.ndarray) -> np.ndarray:
        """Returns the reaching point in the world, (3,) [m]."""
        if self.hand is None:
            raise ValueError(f"robot '{self.kinematics.robot.name}': the model has no hand")
        self.kinematics.set_positions(q)
        return self.hand.present_position(self.kinematics)


class Stance:
    """Sizes and constant entries of programs with the same stance feet.

    The rows are the equations of motion (n_v), the contact constraints and the friction pyramids;
    the columns v̇ (n_v) and the forces of the stance feet's points (3 each).
    """

    def __init__(self, model: WholeBodyModel, is_stance: np.ndarray):
        n_v, parameters = model.num_velocities, model.parameters
        self.feet = [foot for foot, stands in zip(model.feet, is_stance, strict=True) if stands]
        num_points = sum(foot.num_points for foot in self.feet)
        num_still = sum(foot.num_rows for foot in self.feet)
        self.still_rows = slice(n_v, n_v + num_still)
        num_columns = n_v + 3 * num_points
        num_rows = n_v + num_still + 4 * num_points

        # |f_x| ≤ μ f_z and |f_y| ≤ μ f_z imply f_z ≥ 0.
        mu = parameters.friction
        pyramid = np.array([[1, 0, -mu], [-1, 0, -mu], [0, 1, -mu], [0, -1, -mu]])
        self.A = np.zeros((num_rows, num_columns))
        self.A[n_v + num_still :, n_v:] = np.kron(np.eye(num_points), pyramid)
        # The unactuated base has torque limits of zero.
        limits = np.concatenate([np.zeros(NUM_BASE_VELOCITIES), model.torque_limits])
        self.lower, self.upper = np.full(num_rows, -math.inf), np.zeros(num_rows)
        self.lower[:n_v], self.upper[:n_v] = -limits, limits
        self.sense = np.zeros(num_rows, np.int32)
        self.sense[:n_v][limits == 0.0] = EQUALITY
        self.sense[self.still_rows] = EQUALITY
