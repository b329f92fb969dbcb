"""The whole-body program: mechanics hold, limits are kept, tasks are followed, solvers agree."""

import copy
import functools
from types import SimpleNamespace

import daqp
import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.tree import MultibodyForces
from pydrake.solvers import ClarabelSolver, MathematicalProgram, SolverOptions

from drake_safety.control import whole_body_qp
from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.observation import quaternion_of
from drake_safety.control.whole_body_model import EQUALITY, PointReference, WholeBodyModel
from drake_safety.control.whole_body_qp import ITERATION_LIMIT, SOLVED, build_qp, solve_qp
from legged_robots import robot_kinematics, robot_model

NAMES = ["atlas", "biped"]
G = 9.81


@functools.cache
def whole_body_model(name):
    """A robot's model with its first hand."""
    hand = next(iter(robot_model(name).reaching_frames))
    return WholeBodyModel(robot_kinematics(name), hand)


@pytest.fixture(params=NAMES)
def model(request):
    return whole_body_model(request.param)


def moving_state(model, rng, size=1.0):
    """A state near standing that moves, feet included."""
    kinematics = model.kinematics
    X_WB = RigidTransform(
        RollPitchYaw(0.02 * size * rng.normal(size=3)), [0, 0, kinematics.standing_height]
    )
    joints = kinematics.posture + 0.02 * size * rng.normal(size=model.num_joints)
    v = 0.05 * size * rng.normal(size=model.num_velocities)
    return kinematics.positions_at(X_WB, joints), v


def random_program(model, rng, size=1.0):
    q, v = moving_state(model, rng, size)
    reference = model.reference(model.kinematics.standing_positions())
    reference.center_of_mass.position += 0.01 * size * rng.normal(size=3)
    reference.center_of_mass.rate = 0.05 * size * rng.normal(size=3)
    reference.reaching.position += 0.03 * size * rng.normal(size=3)
    reference.reaching.rate = 0.1 * size * rng.normal(size=3)
    return q, v, reference


def solved(model, q, v, reference):
    solution = solve_qp(build_qp(model, q, v, reference))
    assert solution.status == SOLVED
    return solution


def clarabel_torques(qp, tolerance):
    """Joint torques of the same program by Drake's Clarabel."""
    program = MathematicalProgram()
    n_v, n = len(qp.g), qp.A.shape[1]
    x = program.NewContinuousVariables(n)
    program.AddQuadraticCost(qp.H, qp.g, x[:n_v], is_convex=True)
    program.AddQuadraticCost(np.eye(n - n_v), np.zeros(n - n_v), x[n_v:], is_convex=True)
    is_equality = qp.sense == EQUALITY
    program.AddLinearEqualityConstraint(qp.A[is_equality], qp.lower[is_equality], x)
    program.AddLinearConstraint(
        qp.A[~is_equality], qp.lower[~is_equality], qp.upper[~is_equality], x
    )
    options = SolverOptions()
    for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
        options.SetOption(ClarabelSolver.id(), name, tolerance)
    result = ClarabelSolver().Solve(program, None, options)
    assert result.is_success()
    return qp.torques(result.GetSolution(x))


def test_the_torques_are_those_of_inverse_dynamics_and_the_base_has_none(model):
    # Drake's own inverse dynamics, which shares no line with how the program is built.
    rng = np.random.default_rng(0)
    kinematics = model.kinematics
    plant, context = kinematics.plant, kinematics.context
    for _ in range(5):
        q, v, reference = random_program(model, rng)
        solution = solved(model, q, v, reference)
        J = kinematics.contact_jacobian(q)
        plant.SetPositionsAndVelocities(context, np.concatenate([q, v]))
        forces = MultibodyForces(plant)
        forces.mutable_generalized_forces()[:] = (
            plant.CalcGravityGeneralizedForces(context) + J.T @ solution.forces.ravel()
        )
        needed = plant.CalcInverseDynamics(context, solution.vdot, forces)
        np.testing.assert_allclose(needed[:6], 0.0, atol=1e-8)
        np.testing.assert_allclose(needed[6:], solution.torques, atol=1e-8)


def test_torques_and_forces_keep_their_limits(model):
    rng = np.random.default_rng(1)
    is_at_a_limit = False
    for size in (0.3, 1.0, 3.0, 6.0):
        for _ in range(5):
            solution = solve_qp(build_qp(model, *random_program(model, rng, size)))
            if solution.status != SOLVED:
                continue
            excess = np.abs(solution.torques) - model.torque_limits
            f_x, f_y, f_z = solution.forces.T
            slack = model.parameters.friction * f_z - np.maximum(np.abs(f_x), np.abs(f_y))
            assert excess.max() < 1e-3
            assert slack.min() > -1e-3
            assert f_z.min() > -1e-3
            is_at_a_limit |= max(excess.max(), -slack.min()) > -1e-3
    assert is_at_a_limit


def test_the_torques_are_those_of_an_interior_point_solver(model):
    rng = np.random.default_rng(2)
    for size in (0.0, 0.3, 1.0):
        qp = build_qp(model, *random_program(model, rng, size))
        expected = clarabel_torques(qp, 1e-10)
        np.testing.assert_allclose(solve_qp(qp).torques, expected, rtol=0, atol=1e-3)


def test_the_same_program_has_the_same_solution_to_the_last_bit(model):
    rng = np.random.default_rng(3)
    qp = build_qp(model, *random_program(model, rng))
    first = solve_qp(qp)
    for _ in range(3):
        solve_qp(build_qp(model, *random_program(model, rng, 3.0)))
    np.testing.assert_array_equal(solve_qp(qp).torques, first.torques)


def rate_of_change(model, q, v, vdot, quantity, step=1e-5):
    """Time derivative of a quantity of (q, v) along a motion of given acceleration."""
    kinematics = model.kinematics

    def after(time):
        kinematics.set_positions(q)  # The Context whose map turns v into q̇.
        kinematics.plant.SetPositions(kinematics.context, q)
        qdot = kinematics.plant.MapVelocityToQDot(kinematics.context, v + 0.5 * time * vdot)
        return quantity(q + time * qdot, v + time * vdot)

    return (after(step) - after(-step)) / (2 * step)


def test_a_standing_foot_loses_its_velocity_at_the_rate_of_the_contact_damping(model):
    kinematics = model.kinematics
    q, v, reference = random_program(model, np.random.default_rng(4))
    solution = solved(model, q, v, reference)

    def foot_rates(q, v):
        rates = (kinematics.contact_jacobian(q) @ v).reshape(-1, 3)
        return np.array([rates[points].mean(axis=0) for points in kinematics.foot_slices])

    changes = rate_of_change(model, q, v, solution.vdot, foot_rates)
    damping = model.parameters.contact_damping
    np.testing.assert_allclose(changes, -damping * foot_rates(q, v), rtol=1e-3, atol=1e-3)


def turning_of(model, body_name):
    """A function of q and v: the angular velocity of a body in the world."""
    plant, context = model.kinematics.plant, model.kinematics.context
    body = plant.GetBodyByName(body_name)

    def turning(q, v):
        plant.SetPositionsAndVelocities(context, np.concatenate([q, v]))
        return body.EvalSpatialVelocityInWorld(context).rotational()

    return turning


def test_a_sole_loses_its_turning_and_an_edge_may_turn_about_itself():
    robot = copy.deepcopy(robot_model("biped"))
    robot.feet["left"].contact_points = [[-0.06, 0.0, -0.05], [0.1, 0.0, -0.05]]
    model = WholeBodyModel(RobotKinematics(robot), "head")
    kinematics = model.kinematics
    q, v, reference = random_program(model, np.random.default_rng(5))
    solution = solved(model, q, v, reference)
    turnings = [turning_of(model, foot.body) for foot in robot.feet.values()]
    left, right = (rate_of_change(model, q, v, solution.vdot, turning) for turning in turnings)
    w_left, w_right = (turning(q, v) for turning in turnings)
    damping = model.parameters.contact_damping
    np.testing.assert_allclose(right, -damping * w_right, rtol=1e-3, atol=1e-3)
    body = kinematics.plant.GetBodyByName(robot.feet["left"].body)
    edge = body.EvalPoseInWorld(kinematics.context).rotation().matrix()[:, 0]
    across = np.eye(3) - np.outer(edge, edge)
    np.testing.assert_allclose(across @ left, -damping * across @ w_left, rtol=1e-3, atol=1e-2)
    assert abs(edge @ left + damping * edge @ w_left) > 0.1


def only(model, task):
    """The same model with one task that outweighs all others."""
    robot = copy.deepcopy(model.kinematics.robot)
    whole = robot.whole_body
    for gains in (whole.center_of_mass, whole.reaching, whole.posture, *whole.orientation.values()):
        gains.weight = 1e-3
    bodies = {f"orientation.{body}": gains for body, gains in whole.orientation.items()}
    gains = bodies.get(task) or getattr(whole, task)
    gains.weight, gains.stiffness, gains.damping = 1e3, 64.0, 11.0
    return WholeBodyModel(RobotKinematics(robot), next(iter(robot.reaching_frames)))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("task", ["center_of_mass", "reaching"])
def test_a_point_accelerates_by_the_gains_times_its_errors(name, task):
    model = only(whole_body_model(name), task)
    kinematics = model.kinematics
    q, v = moving_state(model, np.random.default_rng(6), size=0.2)
    reference = model.reference(q)
    wanted = PointReference(
        position=np.array([0.002, -0.001, 0.003]), rate=np.array([0.01, 0.02, -0.02])
    )
    position = kinematics.center_of_mass if task == "center_of_mass" else model.reaching_position

    def rate(q, v):
        return rate_of_change(model, q, v, np.zeros_like(v), lambda q, v: position(q))

    wanted.position = wanted.position + position(q)
    setattr(reference, task, wanted)
    solution = solved(model, q, v, reference)
    acceleration = rate_of_change(model, q, v, solution.vdot, rate, step=1e-4)
    expected = 64.0 * (wanted.position - position(q))
    expected += 11.0 * (wanted.rate - rate(q, v))
    np.testing.assert_allclose(acceleration, expected, atol=0.01)


@pytest.mark.parametrize("name", NAMES)
def test_a_body_turns_towards_its_orientation(name):
    whole = whole_body_model(name)
    body_name = whole.body_names[-1]
    model = only(whole, f"orientation.{body_name}")
    kinematics = model.kinematics
    q, v = moving_state(model, np.random.default_rng(7), size=0.2)
    reference = model.reference(q)
    turn = np.array([0.01, -0.02, 0.005])
    kinematics.plant.SetPositions(kinematics.context, q)
    R_WB = kinematics.plant.GetBodyByName(body_name).EvalPoseInWorld(kinematics.context).rotation()
    angle = np.linalg.norm(turn)
    reference.orientations[-1] = RotationMatrix(AngleAxis(angle, turn / angle)) @ R_WB
    turning = turning_of(model, body_name)
    solution = solved(model, q, v, reference)
    acceleration = rate_of_change(model, q, v, solution.vdot, turning)
    np.testing.assert_allclose(acceleration, 64.0 * turn - 11.0 * turning(q, v), atol=0.02)


def test_free_joints_follow_the_posture():
    model = only(whole_body_model("porter"), "posture")
    q, v = moving_state(model, np.random.default_rng(8), size=0.2)
    reference = model.reference(q)
    arms = model.kinematics.robot.reaching_frames.values()
    free = [model.kinematics.joint_names.index(name) for arm in arms for name in arm.joints]
    expected = 64.0 * (reference.posture - q[7:]) - 11.0 * v[6:]
    vdot = solved(model, q, v, reference).vdot[6:]
    np.testing.assert_allclose(vdot[free], expected[free], atol=0.02)


def test_the_torques_do_not_depend_on_place_or_heading(model):
    # The friction pyramid points along the world's axes, so by a quarter turn.
    q, v, reference = random_program(model, np.random.default_rng(10), size=0.3)
    X = RigidTransform(RotationMatrix.MakeZRotation(np.pi / 2), [3.0, -2.0, 0.0])
    R, turn = X.rotation(), X.rotation().matrix()
    X_WB = RigidTransform(RotationMatrix(quaternion_of(q)), q[4:7])
    moved_q = model.kinematics.positions_at(X @ X_WB, q[7:])
    moved_v = np.concatenate([turn @ v[:3], turn @ v[3:6], v[6:]])
    moved = copy.deepcopy(reference)
    for point in (moved.center_of_mass, moved.reaching):
        point.position, point.rate = X @ point.position, turn @ point.rate
    moved.orientations = [R @ R_WB for R_WB in reference.orientations]
    torques = solved(model, moved_q, moved_v, moved).torques
    np.testing.assert_allclose(torques, solved(model, q, v, reference).torques, atol=1e-5)


def test_a_program_that_takes_long_is_given_up_and_says_so(monkeypatch):
    # Far from standing, as after a fall, programs of Talos take 230 iterations; near it, 61.
    counts = []

    def counted(*arguments, **options):
        result = daqp.solve(*arguments, **options)
        counts.append(result[3]["iterations"])
        return result

    monkeypatch.setattr(whole_body_qp, "daqp", SimpleNamespace(solve=counted))
    model = whole_body_model("talos")
    statuses = {}
    for size in (5.0, 50.0):
        programs = [
            build_qp(model, *random_program(model, np.random.default_rng(seed), size))
            for seed in range(20)
        ]
        statuses[size] = {solve_qp(qp).status for qp in programs}
    assert statuses[5.0] == {SOLVED}
    assert ITERATION_LIMIT in statuses[50.0]
    assert max(counts) <= 1.5 * len(programs[0].upper)
