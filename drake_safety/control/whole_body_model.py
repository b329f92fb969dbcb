"""Tasks, feet and limits of a robot's whole-body programs."""

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.math import RotationMatrix
from pydrake.multibody.tree import Frame, RigidBody

from drake_safety.control.kinematics import NUM_BASE_VELOCITIES, RobotKinematics
from drake_safety.robots.robot_model import ReachingFrame

EQUALITY = 5  # daqp's value in ``sense`` for rows with equal bounds.
_COINCIDENT_M = 1e-6  # Tolerance of collinear and coincident contact points.
_REST = np.zeros(3)
_REST.flags.writeable = False


@dataclass(kw_only=True)
class PointReference:
    """Reference of a point in the world frame."""

    position: np.ndarray  # (3,) [m].
    rate: np.ndarray = field(default_factory=lambda: _REST)  # (3,) [m/s].


@dataclass(kw_only=True)
class WholeBodyReference:
    """References of all tasks, with all feet at rest."""

    center_of_mass: PointReference
    orientations: list[RotationMatrix]  # R_WB of ``model.body_names``, in that order.
    posture: np.ndarray  # Joint positions (n_j,) [rad].
    reaching: PointReference  # Reference of the hand.


class Hand:
    """A reaching point, its collision sphere and the joints of its arm."""

    def __init__(self, body: RigidBody, reaching_frame: ReachingFrame):
        self.body = body
        self.frame: Frame = body.body_frame()
        self.point = np.array(reaching_frame.point, dtype=float)
        self.radius_m = reaching_frame.radius_m
        self.joints = list(reaching_frame.joints)

    def present_position(self, kinematics: RobotKinematics) -> np.ndarray:
        """Returns the reaching point in the world at the scratch Context's positions, (3,) [m]."""
        place = self.frame, self.point, kinematics.world_frame
        p_WH: np.ndarray = kinematics.plant.CalcPointsPositions(kinematics.context, *place)
        return p_WH[:, 0]


class StandingFoot:
    """A foot's contact points and its contact constraint.

    The constraint has the velocity of the points' centre and the rotations that move any point: six
    rows for a sole, five for an edge, three for a point. Rows for every point of a rigid foot would
    be redundant, and inconsistent while it rotates.
    """

    def __init__(self, body: RigidBody, points: np.ndarray):
        self.body = body
        self.frame: Frame = body.body_frame()
        self.points = points  # (3, n)
        self.center = points.mean(axis=1)
        _, spread, directions = np.linalg.svd((points - self.center[:, np.newaxis]).T)
        dimensions = int(np.sum(spread > _COINCIDENT_M))
        self.num_rows = {0: 3, 1: 5}.get(dimensions, 6)
        self.edge_turns: np.ndarray | None = directions[1:] if dimensions == 1 else None
        """Axes across an edge in the body's frame, (2, 3)."""


class WholeBodyModel:
    """Frames, gains and limits of a robot's whole-body program for reaching with a hand."""

    def __init__(self, kinematics: RobotKinematics, hand: str):
        robot, plant = kinematics.robot, kinematics.plant
        self.kinematics = kinematics
        self.parameters = parameters = robot.whole_body
        self.num_joints = kinematics.num_joints
        self.num_velocities = kinematics.num_velocities
        self.mass = kinematics.total_mass
        self.weight_W = self.mass * plant.gravity_field().gravity_vector()
        # The cost of forces divided by this is their squared norm.
        self.force_scale = self.mass / math.sqrt(parameters.force_regularization)
        frame = robot.reaching_frame(hand)
        self.hand = Hand(plant.GetBodyByName(frame.body), frame)
        self.body_names = list(parameters.orientation)
        self.bodies = [plant.GetBodyByName(name) for name in self.body_names]
        # After the three of the centre of mass.
        self.orientation_rows = [slice(3 * i, 3 * i + 3) for i in range(1, len(self.bodies) + 1)]
        self.feet = [
            StandingFoot(plant.GetBodyByName(foot.body), points)
            for foot, points in zip(robot.feet.values(), kinematics.foot_points, strict=True)
        ]
        tasks = [parameters.center_of_mass, *parameters.orientation.values(), parameters.reaching]
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
        motors, names = kinematics.effort_limits, kinematics.joint_names
        self.torque_limits = np.array([motors.get(name, 0.0) for name in names])
        """Largest torque of every joint (n_j,) [N·m]; zero for a joint without an actuator."""
        # Rows of constraints: equations of motion (n_v), contact constraints, friction pyramids.
        # Columns: v̇ (n_v), forces of the feet's points (3 each).
        n_v, num_points = self.num_velocities, kinematics.num_contacts
        num_still = sum(foot.num_rows for foot in self.feet)
        self.still_rows = slice(n_v, n_v + num_still)
        num_rows = n_v + num_still + 4 * num_points
        # |f_x| ≤ μ f_z and |f_y| ≤ μ f_z imply f_z ≥ 0.
        mu = parameters.friction
        pyramid = np.array([[1, 0, -mu], [-1, 0, -mu], [0, 1, -mu], [0, -1, -mu]])
        self.A = np.zeros((num_rows, n_v + 3 * num_points))
        self.A[n_v + num_still :, n_v:] = np.kron(np.eye(num_points), pyramid)
        # The unactuated base has torque limits of zero.
        limits = np.concatenate([np.zeros(NUM_BASE_VELOCITIES), self.torque_limits])
        self.lower, self.upper = np.full(num_rows, -math.inf), np.zeros(num_rows)
        self.lower[:n_v], self.upper[:n_v] = -limits, limits
        self.sense = np.zeros(num_rows, np.int32)
        self.sense[:n_v][limits == 0.0] = EQUALITY
        self.sense[self.still_rows] = EQUALITY

    def reference(self, q: np.ndarray) -> WholeBodyReference:
        """The reference for standing on the feet of ``q``, with its height and its hand at rest."""
        kinematics = self.kinematics
        (x, y, yaw), height = kinematics.stance_pose(q), kinematics.center_of_mass(q)[2]
        reference = WholeBodyReference(
            center_of_mass=PointReference(position=np.array([x, y, height])),
            orientations=[],
            posture=np.array(kinematics.posture, dtype=float),
            reaching=PointReference(position=self.reaching_position(q)),
        )
        kinematics.set_positions(kinematics.standing_positions())
        R_WS = RotationMatrix.MakeZRotation(yaw)
        for body in self.bodies:
            R_SB = body.EvalPoseInWorld(kinematics.context).rotation()
            reference.orientations.append(R_WS @ R_SB)
        return reference

    def check_reference(self, reference: WholeBodyReference) -> None:
        """Checks that a reference is complete and finite, and of the right sizes."""
        points = reference.center_of_mass, reference.reaching
        vectors = [vector for point in points for vector in (point.position, point.rate)]
        sizes = *map(np.shape, vectors), len(reference.orientations), len(reference.posture)
        is_sized = sizes == (*[(3,)] * 4, len(self.bodies), self.num_joints)
        if not (is_sized and np.isfinite(np.concatenate([*vectors, reference.posture])).all()):
            parts = f"orientations of {self.body_names}, a posture of {self.num_joints} joints"
            what = f"the whole-body reference needs finite points, {parts}; got {reference}"
            raise ValueError(f"robot '{self.kinematics.robot.name}': {what}")

    def reaching_position(self, q: np.ndarray) -> np.ndarray:
        """Returns the reaching point in the world, (3,) [m]."""
        self.kinematics.set_positions(q)
        return self.hand.present_position(self.kinematics)
