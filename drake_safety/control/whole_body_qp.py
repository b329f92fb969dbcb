"""Whole-body control as a quadratic program in accelerations and contact forces."""

import math
from dataclasses import dataclass

import daqp
import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable
from scipy.linalg.lapack import dpotrf, dtrtrs

from drake_safety.control.kinematics import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from drake_safety.control.observation import rotation_vector
from drake_safety.control.whole_body_model import WholeBodyModel, WholeBodyReference
from drake_safety.learning.blas_threads import ONE_BLAS_THREAD

SOLVED = 0  # Status of a solved program; other values are daqp's negative exit flags.
ITERATION_LIMIT = -4  # Status of a program that was given up, as of a fallen robot.

# Before 0.10 daqp has no elimination of equations to switch off.
_OPTIONS = {"eq_reduction": daqp.EQ_REDUCTION_OFF} if hasattr(daqp, "EQ_REDUCTION_OFF") else {}
_ITERATIONS_PER_ROW = 1.5  # Random episodes and pushes take up to 0.8 until the robot has fallen.
_BOUNDLESS = 1e12  # Squared norms from this size on count as not finite.
_TINY = 1e-300
_FIRST, _LAST = slice(0, 3), slice(-3, None)


class NotFiniteError(ValueError):
    """A state or set point is not finite."""


@dataclass(kw_only=True)
class WholeBodyQP:
    """Minimise ½ v̇ᵀHv̇ + gᵀv̇ + ½|y|² subject to lower ≤ A [v̇; y] ≤ upper, with forces f = s y.

    The first n_v rows are the equations of motion, whose value is the generalised force less its
    bias: zero for the floating base, a joint torque within its limits otherwise.
    """

    H: np.ndarray
    g: np.ndarray
    A: np.ndarray
    num_vdot_rows: int  # Number of the first rows of A, in which v̇ has nonzero entries.
    lower: np.ndarray
    upper: np.ndarray
    sense: np.ndarray  # ``EQUALITY`` for rows of A with equal bounds, else 0.
    bias: np.ndarray  # h in the equations of motion M v̇ + h = S τ + Jᵀf, (n_v,).
    force_scale: float  # s [N].

    def torques(self, x: np.ndarray) -> np.ndarray:
        """Returns the joint torques (n_j,) [N·m] at x = [v̇; y]."""
        joints = slice(NUM_BASE_VELOCITIES, len(self.bias))
        return self.A[joints] @ x + self.bias[joints]


@dataclass(kw_only=True)
class WholeBodySolution:
    """A solution of the program, valid if its status is ``SOLVED``."""

    vdot: np.ndarray
    forces: np.ndarray  # Forces at the contact points in the world, (n_points, 3) [N].
    torques: np.ndarray
    status: int


def build_qp(
    model: WholeBodyModel, q: np.ndarray, v: np.ndarray, reference: WholeBodyReference
) -> WholeBodyQP:
    """Builds the quadratic program at one instant, or raises a `NotFiniteError`."""
    # Drake's plant aborts the process for a zero quaternion, as for a state that is not finite.
    _check_size(q.dot(q) + v.dot(v), 1.0 / max(q[:4].dot(q[:4]), _TINY))
    plant, context = model.kinematics.plant, model.kinematics.context
    plant.SetPositionsAndVelocities(context, np.concatenate([q, v]))
    M = plant.CalcMassMatrix(context)
    C = plant.CalcBiasTerm(context)
    # The base's translational rows of M v̇ + C are the rate of linear momentum; divided by the
    # mass they are the Jacobian and bias of the centre of mass.
    J_com = M[3:NUM_BASE_VELOCITIES] / model.mass
    bias = C - model.weight_W @ J_com

    n_v = model.num_velocities
    # Rows of the stacked tasks, three per task, with accelerations J v̇ + J̇v.
    J = np.empty((model.num_task_rows, n_v))
    Jdot_v, error, rate = np.zeros((3, model.num_task_rows))
    J[_FIRST] = J_com
    Jdot_v[_FIRST] = C[3:NUM_BASE_VELOCITIES] / model.mass
    # The base's columns of J_com contain -[p]x of the centre of mass relative to the base.
    p_com = q[4:7] + (J_com[1, 2], J_com[2, 0], J_com[0, 1])
    error[_FIRST] = reference.center_of_mass.position - p_com
    _set_body_rows(model, reference, J, error)
    _set_body_biases(model, Jdot_v)
    rate[_FIRST], rate[_LAST] = reference.center_of_mass.rate, reference.reaching.rate
    wanted = model.stiffness * error + model.damping * (rate - J @ v) - Jdot_v
    _check_size(wanted.dot(wanted))
    weighted = model.task_weights * J
    posture = model.parameters.posture
    g = -(wanted @ weighted)
    g[NUM_BASE_VELOCITIES:] += posture.weight * (
        posture.stiffness * (q[NUM_BASE_POSITIONS:] - reference.posture)
        + posture.damping * v[NUM_BASE_VELOCITIES:]
    )

    A, lower, upper = model.A.copy(), model.lower.copy(), model.upper.copy()
    A[:n_v, :n_v] = M
    lower[:n_v] -= bias
    upper[:n_v] -= bias
    _add_contacts(model, v, A, lower, upper)
    return WholeBodyQP(
        H=model.H + J.T @ weighted,
        g=g,
        A=A,
        num_vdot_rows=model.still_rows.stop,
        lower=lower,
        upper=upper,
        sense=model.sense,
        bias=bias,
        force_scale=model.force_scale,
    )


def _check_size(*squared_norms: float) -> None:
    if not all(squared < _BOUNDLESS for squared in squared_norms):
        raise NotFiniteError("state and set points must be finite, with an orientation")


def _add_contacts(
    model: WholeBodyModel, v: np.ndarray, A: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> None:
    """Sets the forces' columns in the equations of motion, and the contact constraints."""
    plant, context = model.kinematics.plant, model.kinematics.context
    world, n_v, kv = model.kinematics.world_frame, model.num_velocities, JacobianWrtVariable.kV
    Jdot_v = np.empty(model.still_rows.stop - n_v)
    row, column = n_v, n_v
    for foot in model.feet:
        of_points = kv, foot.frame, foot.points, world, world
        J = plant.CalcJacobianTranslationalVelocity(context, *of_points)
        A[:n_v, column : column + len(J)] = -model.force_scale * J.T
        column += len(J)
        of_center = kv, foot.frame, foot.center, world, world
        J_foot = plant.CalcJacobianSpatialVelocity(context, *of_center)
        foot_bias = plant.CalcBiasSpatialAcceleration(context, *of_center).get_coeffs()
        if foot.edge_turns is not None:
            turns_W = foot.edge_turns @ foot.body.EvalPoseInWorld(context).rotation().matrix().T
            J_foot = np.concatenate([turns_W @ J_foot[:3], J_foot[3:]])
            foot_bias = np.concatenate([turns_W @ foot_bias[:3], foot_bias[3:]])
        stop = row + foot.num_rows
        A[row:stop, :n_v] = J_foot[-foot.num_rows :]
        Jdot_v[row - n_v : stop - n_v] = foot_bias[-foot.num_rows :]
        row = stop
    # J v̇ = -J̇v - K_d J v lets a foot's velocity decay.
    rows = model.still_rows
    lower[rows] = upper[rows] = -Jdot_v - model.parameters.contact_damping * (A[rows, :n_v] @ v)


def task_errors(
    model: WholeBodyModel, reference: WholeBodyReference
) -> tuple[np.ndarray, np.ndarray]:
    """Returns Jacobian (num_task_rows, n_v) and error (num_task_rows,) of all tasks at rest."""
    plant, context = model.kinematics.plant, model.kinematics.context
    world, kv = model.kinematics.world_frame, JacobianWrtVariable.kV
    J = np.empty((model.num_task_rows, model.num_velocities))
    error = np.zeros(model.num_task_rows)
    J[_FIRST] = plant.CalcJacobianCenterOfMassTranslationalVelocity(context, kv, world, world)
    p_com = plant.CalcCenterOfMassPositionInWorld(context)
    error[_FIRST] = reference.center_of_mass.position - p_com
    _set_body_rows(model, reference, J, error)
    return J, error


def _set_body_rows(
    model: WholeBodyModel, reference: WholeBodyReference, J: np.ndarray, error: np.ndarray
) -> None:
    """Sets Jacobian and error of the bodies' orientations and of the hand."""
    kinematics, kv = model.kinematics, JacobianWrtVariable.kV
    plant, context, world = kinematics.plant, kinematics.context, kinematics.world_frame
    oriented = zip(model.orientation_rows, model.bodies, reference.orientations, strict=True)
    for rows, body, R_WBd in oriented:
        if body is kinematics.base:
            J[rows] = model.base_turns
        else:
            frame = body.body_frame()
            J[rows] = plant.CalcJacobianAngularVelocity(context, kv, frame, world, world)
        R_WB = body.EvalPoseInWorld(context).rotation()
        # R_WBd R_WBᵀ. Drake's product of rotations is wrapped in Python, and twice as slow.
        error[rows] = rotation_vector(R_WBd.inverse().InvertAndCompose(R_WB.inverse()))
    frame, p = model.hand.frame, model.hand.point
    J[_LAST] = plant.CalcJacobianTranslationalVelocity(context, kv, frame, p, world, world)
    error[_LAST] = reference.reaching.position - model.hand.present_position(kinematics)


def _set_body_biases(model: WholeBodyModel, Jdot_v: np.ndarray) -> None:
    """Sets J̇v of the bodies' orientations, zero for the base, and of the hand."""
    kinematics, kv = model.kinematics, JacobianWrtVariable.kV
    plant, context, world = kinematics.plant, kinematics.context, kinematics.world_frame
    for rows, body in zip(model.orientation_rows, model.bodies, strict=True):
        if body is not kinematics.base:
            of_body = kv, body.body_frame(), np.zeros(3), world, world
            Jdot_v[rows] = plant.CalcBiasSpatialAcceleration(context, *of_body).rotational()
    of_hand = kv, model.hand.frame, model.hand.point, world, world
    Jdot_v[_LAST] = plant.CalcBiasTranslationalAcceleration(context, *of_hand)[:, 0]


@ONE_BLAS_THREAD
def solve_qp(qp: WholeBodyQP) -> WholeBodySolution:
    """Solves the program by daqp's dual active-set method, deterministically without warm start.

    Iterations are limited: programs of a fallen robot have no solution, and would take many.
    """
    n_v, n = len(qp.bias), qp.A.shape[1]
    # With H = UᵀU and v̇ = U⁻¹z the quadratic cost is ½|[z; y]|². LAPACK's factorisation takes a
    # third of the time of daqp's, which ignores the matrix's structure.
    U, _ = dpotrf(qp.H.T)
    A, g = qp.A.copy(), np.zeros(n)
    A[: qp.num_vdot_rows, :n_v] = dtrtrs(U, qp.A[: qp.num_vdot_rows, :n_v].T, trans=1)[0].T
    g[:n_v] = dtrtrs(U, qp.g, trans=1)[0]
    limit = int(_ITERATIONS_PER_ROW * len(A))
    x, _, flag, _ = daqp.solve(
        np.eye(n), g, A, qp.upper, qp.lower, qp.sense, iter_limit=limit, **_OPTIONS
    )
    x[:n_v] = dtrtrs(U, x[:n_v])[0]
    is_solved = flag == 1 and x.dot(x) < math.inf
    return WholeBodySolution(
        vdot=x[:n_v],
        forces=qp.force_scale * x[n_v:].reshape(-1, 3),
        torques=qp.torques(x),
        status=SOLVED if is_solved else min(int(flag), -1),
    )
