"""Kinematics of a legged robot from its own model: contact points, the stance frame, statics."""

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import Context

from drake_safety.robots.robot import (
    PlantVariation,
    Scratch,
    add_robot,
    apply_masses,
    posture_positions,
    servo_joints,
)
from drake_safety.robots.robot_model import ReachingFrame, RobotModel

try:
    from scipy.linalg.lapack import dposv
except ImportError:  # Online environments lack scipy (docs/start.md); griffe needs the quotes.

    def dposv(a: "np.ndarray", b: "np.ndarray") -> "tuple[None, np.ndarray, int]":
        """Replaces LAPACK's routine, a few microseconds slower."""
        return None, np.linalg.solve(a, b), 0


NUM_BASE_POSITIONS = 7
NUM_BASE_VELOCITIES = 6
_LEAST_QUATERNION = 1e-3  # Norm of a quaternion that is an orientation.


def is_state(q: np.ndarray, *others: np.ndarray) -> bool:
    """Whether all entries are finite, and the base has an orientation: a dead sensor has none."""
    size = math.hypot(*(x for part in (q, *others) for x in part.ravel().tolist()))
    return size * size < math.inf and math.hypot(*q[:4].tolist()) > _LEAST_QUATERNION


@dataclass(eq=False)
class _Instant:
    """A scratch Context, with the positions of which contact points were last computed."""

    context: Context
    positions: bytes = b""
    contacts: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))


class RobotKinematics:
    """Kinematics of a robot without ground or scene, with the masses of a variation.

    Positions are Drake's ``q = [q_WB (w, x, y, z), p_WB, joints]`` and velocities
    ``v = [w_WB, v_WB, joint rates]``. Every method overwrites the thread's scratch Context.
    """

    def __init__(self, robot: RobotModel, variation: PlantVariation | None = None):
        if not robot.feet:
            raise ValueError(f"robot '{robot.name}' has no feet to stand on")
        self.robot = robot
        self.plant = MultibodyPlant(time_step=0.0)
        add_robot(self.plant, robot)
        self.plant.Finalize()
        base = self.plant.GetBodyByName(robot.base)
        num_extra = self.plant.num_positions() - self.plant.num_velocities()
        if not base.is_floating_base_body() or num_extra != 1:
            what = f"base '{robot.base}' must be the floating body"
            raise ValueError(f"robot '{robot.name}': {what}, all joints of one degree of freedom")
        model = self.plant.CreateDefaultContext()
        apply_masses(self.plant, model, robot, variation or PlantVariation())
        self._scratch = Scratch(lambda: _Instant(model.Clone()))
        self.num_positions = self.plant.num_positions()
        self.num_velocities = self.plant.num_velocities()
        self.num_states = self.plant.num_multibody_states()
        self.num_joints = self.num_velocities - NUM_BASE_VELOCITIES
        self.joint_names = servo_joints(self.plant, robot)
        joints = [self.plant.GetJointByName(name) for name in self.joint_names]
        limits = [[j.position_lower_limit(), j.position_upper_limit()] for j in joints]
        self.position_limits = np.array(limits).reshape(-1, 2)
        self.velocity_limits = np.array([j.velocity_upper_limit() for j in joints])
        motors = map(self.plant.get_joint_actuator, self.plant.GetJointActuatorIndices())
        self.effort_limits = {motor.joint().name(): motor.effort_limit() for motor in motors}
        self.base = base
        self.world_frame = self.plant.world_frame()
        self.foot_names = list(robot.feet)
        feet = robot.feet.values()
        self.foot_points = [np.asfortranarray(np.array(foot.contact_points).T) for foot in feet]
        frames = [self.plant.GetFrameByName(foot.body) for foot in feet]
        self._feet = list(zip(frames, self.foot_points, strict=True))
        sizes = [len(foot.contact_points) for foot in feet]
        stops = np.cumsum(sizes).tolist()
        self.foot_slices = [slice(end - size, end) for end, size in zip(stops, sizes, strict=True)]
        self.foot_radii = np.repeat([foot.radius_m for foot in feet], sizes)
        self.num_contacts = len(self.foot_radii)
        posture = posture_positions(self.plant, robot)
        self.posture = np.array([posture[name] for name in self.joint_names])
        self.total_mass = self.plant.CalcTotalMass(self.context)
        q = self.positions_at(RigidTransform(), self.posture)
        p_WC = self.contact_positions(q)
        self.standing_height = -float(np.min(p_WC[:, 2] - self.foot_radii))
        centroid = p_WC.mean(axis=0)
        # Contact points (n_c, 2) and base (2,) of the standing posture from the points' centroid.
        self.nominal_contacts = p_WC[:, :2] - centroid[:2]
        self.nominal_base_offset = -centroid[:2]

    @property
    def context(self) -> Context:
        """The scratch Context of the calling thread."""
        return self._scratch.value.context

    def positions_at(self, X_WB: RigidTransform, joints: np.ndarray) -> np.ndarray:
        """Returns positions (n_q,) from a base pose and joint positions (n_j,) [rad]."""
        quaternion = X_WB.rotation().ToQuaternion().wxyz()
        return np.concatenate([quaternion, X_WB.translation(), joints])

    def standing_positions(self) -> np.ndarray:
        """Returns positions (n_q,) of the standing posture, upright at the world's origin."""
        return self.positions_at(RigidTransform([0.0, 0.0, self.standing_height]), self.posture)

    def set_positions(self, q: np.ndarray) -> None:
        """Sets the positions (n_q,) of the scratch Context."""
        # Drake's plant aborts the process for positions that are not finite, or without a rotation.
        if not is_state(q):
            raise ValueError(f"robot '{self.robot.name}': positions must be finite; got {q}")
        self.plant.SetPositions(self.context, q)

    def contact_positions(self, q: np.ndarray) -> np.ndarray:
        """Returns the contact spheres' centres in the world, (n_c, 3) [m], read-only."""
        # Margins, state and features of one instant need the same positions.
        key, instant = q.tobytes(), self._scratch.value
        if key == instant.positions:
            return instant.contacts
        self.set_positions(q)
        p_WC = self._contacts()
        p_WC.flags.writeable = False
        instant.positions, instant.contacts = key, p_WC
        return p_WC

    def planted_contacts(self, q: np.ndarray) -> np.ndarray:
        """Returns :meth:`contact_positions` put down on level ground, (n_c, 3) [m]."""
        p_WC = self.contact_positions(q).copy()
        p_WC[:, 2] = self.foot_radii
        return p_WC

    def contact_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Returns the Jacobian of the contact points in the velocities, (3 n_c, n_v)."""
        self.set_positions(q)
        return self._jacobian()

    def present_contacts(self) -> tuple[np.ndarray, np.ndarray]:
        """Contact positions and their Jacobian at the scratch Context's positions."""
        return self._contacts(), self._jacobian()

    def _contacts(self) -> np.ndarray:
        calculate, context, world = self.plant.CalcPointsPositions, self.context, self.world_frame
        parts = [calculate(context, frame, points, world).T for frame, points in self._feet]
        return np.concatenate(parts)

    def _jacobian(self) -> np.ndarray:
        calculate, context = self.plant.CalcJacobianTranslationalVelocity, self.context
        kind, world = JacobianWrtVariable.kV, self.world_frame
        parts = [calculate(context, kind, frame, p, world, world) for frame, p in self._feet]
        return np.concatenate(parts)

    def stance_pose(self, q: np.ndarray) -> np.ndarray:
        """Returns ``[x, y, yaw]`` of the stance frame S of the feet in the world, (3,)."""
        return fit_stance(self.contact_positions(q), self.nominal_contacts)

    def gravity_torques(
        self, q: np.ndarray, is_stance: np.ndarray, J: np.ndarray | None = None
    ) -> np.ndarray:
        """Joint torques (n_j,) [N·m] for static equilibrium on the stance points, (n_c,).

        The ground forces have the least squared norm subject to ``0 = g_b + J_bᵀ f`` of the base; J
        is the contact Jacobian at ``q``, if known.
        """
        self.set_positions(q)
        J = self._jacobian() if J is None else J
        g = self.plant.CalcGravityGeneralizedForces(self.context)
        if not is_stance.all():
            if not is_stance.any():
                return -g[NUM_BASE_VELOCITIES:]
            J = J[np.repeat(is_stance, 3)]
        A = J[:, :NUM_BASE_VELOCITIES].T
        # With two stance points the Gram matrix is singular; the diagonal regularises it.
        gram = A @ A.T
        gram.flat[:: NUM_BASE_VELOCITIES + 1] += 1e-4
        # For six unknowns numpy's checks cost more than the solution.
        _, weights, _ = dposv(gram, -g[:NUM_BASE_VELOCITIES])
        forces = A.T @ weights
        return -g[NUM_BASE_VELOCITIES:] - J[:, NUM_BASE_VELOCITIES:].T @ forces

    def reaching_position(self, q: np.ndarray, frame: ReachingFrame) -> np.ndarray:
        """Returns the reaching point in the world, (3,) [m]."""
        self.set_positions(q)
        body = self.plant.GetBodyByName(frame.body)
        return body.EvalPoseInWorld(self.context) @ np.array(frame.point)

    def center_of_mass(self, q: np.ndarray) -> np.ndarray:
        """Returns the centre of mass in the world, (3,) [m]."""
        self.set_positions(q)
        return self.plant.CalcCenterOfMassPositionInWorld(self.context)


def planar_pose(stance_pose: np.ndarray) -> RigidTransform:
    """Returns X_WS of a stance pose ``[x, y, yaw]`` on the ground."""
    x, y, yaw = stance_pose
    return RigidTransform(RotationMatrix.MakeZRotation(yaw), [x, y, 0.0])


def fit_stance(p_WC: np.ndarray, nominal_contacts: np.ndarray) -> np.ndarray:
    """The pose ``[x, y, yaw]`` of the stance frame S at contact points (n_c, 3) [m] in the world.

    The least-squares fit (planar Procrustes) of the standing posture's ``nominal_contacts``.
    """
    # Floats are several times faster than arrays for a few points.
    points, nominal = p_WC[:, :2].tolist(), nominal_contacts.tolist()
    n = len(points)
    x = y = sine = cosine = 0.0
    for px, py in points:
        x, y = x + px, y + py
    x, y = x / n, y / n
    for (px, py), (nx, ny) in zip(points, nominal, strict=True):
        dx, dy = px - x, py - y
        sine += nx * dy - ny * dx
        cosine += nx * dx + ny * dy
    return np.array([x, y, math.atan2(sine, cosine)])
