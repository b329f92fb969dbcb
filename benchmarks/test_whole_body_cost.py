"""Cost of a tick of the whole-body controller, and of its QP compared with other solvers."""

import time
from collections.abc import Callable
from typing import Any

import daqp
import numpy as np
import pytest
from costs import alternate, tick_costs_us
from pydrake.geometry import HalfSpace
from pydrake.math import RigidTransform
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    DiscreteContactApproximation,
)
from pydrake.solvers import ClarabelSolver, MathematicalProgram, SolverOptions
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.whole_body_model import EQUALITY, PointReference, WholeBodyModel
from drake_safety.control.whole_body_qp import SOLVED, WholeBodyQP, build_qp, solve_qp
from drake_safety.models import load_robot
from drake_safety.robots.robot import actuation_matrix, add_robot
from drake_safety.systems.whole_body_controller import WholeBodyController

ROBOT, HAND = "atlas", "left"
TIME_STEP_S, PERIOD_S, DURATION_S = 0.002, 0.004, 3.0
OFFSET_M = [0.15, -0.25, 0.15]  # Of the target from the hand's initial position.
ROUNDS, QP_ROUNDS = 10, 5
QP_STRIDE = 10  # Every tenth program is solved by all.
TOLERANCE_NM = 1e-3


class Reach:
    """The robot reaches once; every tick's inputs are logged."""

    def __init__(self) -> None:
        robot = load_robot(ROBOT)
        self.kinematics = RobotKinematics(robot)
        q = self.kinematics.standing_positions()
        self.model = WholeBodyModel(self.kinematics, HAND)
        start = self.model.reaching_position(q)
        zero = np.zeros((3, 1))
        plan = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
            [0.0, DURATION_S], np.column_stack([start, start + OFFSET_M]), zero, zero
        )
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, TIME_STEP_S)
        plant.set_discrete_contact_approximation(DiscreteContactApproximation.kLagged)
        instance = add_robot(plant, robot, scene_graph=scene_graph, servos=False)
        friction = CoulombFriction(robot.foot_friction, robot.foot_friction)
        plant.RegisterCollisionGeometry(
            plant.world_body(), RigidTransform(), HalfSpace(), "ground", friction
        )
        plant.Finalize()
        controller = builder.AddSystem(
            WholeBodyController(
                self.kinematics,
                hand=HAND,
                actuation_matrix=actuation_matrix(plant, robot, self.kinematics.joint_names),
                period_s=PERIOD_S,
            )
        )
        sources = {
            "desired_output": builder.AddSystem(TrajectorySource(plan)),
            "desired_output_rate": builder.AddSystem(TrajectorySource(plan.MakeDerivative())),
        }
        ports = {name: source.get_output_port() for name, source in sources.items()}
        ports["plant_state"] = plant.get_state_output_port(instance)
        for name, port in ports.items():
            builder.Connect(port, controller.GetInputPort(name))
        builder.Connect(
            controller.GetOutputPort("actuation"), plant.get_actuation_input_port(instance)
        )
        self._logs = {
            name: LogVectorOutput(port, builder, PERIOD_S) for name, port in ports.items()
        }
        self._plant, self._q, self._controller = plant, q, controller
        self._diagram: Diagram = builder.Build()
        self.target = start + OFFSET_M

    def simulate(self) -> None:
        """One reach from the start."""
        self.simulator = Simulator(self._diagram)
        root = self.simulator.get_mutable_context()
        self._plant.SetPositions(self._plant.GetMyMutableContextFromRoot(root), self._q)
        self.simulator.Initialize()
        self.simulator.AdvanceTo(DURATION_S)

    def inputs(self) -> dict[str, np.ndarray]:
        """Inputs of every update, (updates, size), of a successful reach."""
        root = self.simulator.get_context()
        q = self._plant.GetPositions(self._plant.GetMyContextFromRoot(root))
        assert np.linalg.norm(self.model.reaching_position(q) - self.target) < 0.02
        context = self._controller.GetMyContextFromRoot(root)
        assert self._controller.GetOutputPort("num_failures").Eval(context)[0] == 0
        return {name: log.FindLog(root).data().T.copy() for name, log in self._logs.items()}

    def program(self, inputs: dict[str, np.ndarray], tick: int) -> WholeBodyQP:
        """The program of one tick."""
        reference = self.model.reference(self._q)
        reference.reaching = PointReference(
            position=inputs["desired_output"][tick], rate=inputs["desired_output_rate"][tick]
        )
        state, n_q = inputs["plant_state"][tick], self.kinematics.num_positions
        return build_qp(self.model, state[:n_q], state[n_q:], reference)


def mathematical_program(qp: WholeBodyQP) -> tuple[MathematicalProgram, np.ndarray]:
    """The same program for Drake's solvers, and its variables."""
    program = MathematicalProgram()
    n_v, n = len(qp.g), qp.A.shape[1]
    x = program.NewContinuousVariables(n)
    program.AddQuadraticCost(qp.H, qp.g, x[:n_v], is_convex=True)
    program.AddQuadraticCost(np.eye(n - n_v), np.zeros(n - n_v), x[n_v:], is_convex=True)
    equal = qp.sense == EQUALITY
    program.AddLinearEqualityConstraint(qp.A[equal], qp.lower[equal], x)
    program.AddLinearConstraint(qp.A[~equal], qp.lower[~equal], qp.upper[~equal], x)
    return program, x


def solve_by_daqp(qp: WholeBodyQP) -> np.ndarray:
    """The solution by daqp alone, which factorises the whole program itself."""
    n_v, n = len(qp.g), qp.A.shape[1]
    H, g = np.eye(n), np.zeros(n)
    H[:n_v, :n_v], g[:n_v] = qp.H, qp.g
    x, _, flag, _ = daqp.solve(H, g, qp.A, qp.upper, qp.lower, qp.sense)
    assert flag == 1
    return x


def solve_by_clarabel(qp: WholeBodyQP, options: SolverOptions | None = None) -> np.ndarray:
    """The solution by Clarabel through Drake's MathematicalProgram."""
    program, x = mathematical_program(qp)
    result = ClarabelSolver().Solve(program, None, options)
    assert result.is_success()
    return result.GetSolution(x)


def precise() -> SolverOptions:
    options = SolverOptions()
    for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
        options.SetOption(ClarabelSolver.id(), name, 1e-10)
    return options


@pytest.fixture(scope="module")
def reach() -> Reach:
    reach = Reach()
    reach.simulate()
    return reach


@pytest.mark.benchmark(timer=time.process_time)
def test_one_tick(benchmark: Any, report: Callable[..., None], reach: Reach) -> None:
    inputs = reach.inputs()
    controller = WholeBodyController(reach.kinematics, hand=HAND, period_s=PERIOD_S)
    context = controller.CreateDefaultContext()
    rounds: list[np.ndarray] = []
    benchmark.pedantic(
        lambda: rounds.append(tick_costs_us(controller, context, inputs, "actuation")),
        rounds=ROUNDS,
        warmup_rounds=1,
    )
    assert controller.GetOutputPort("num_failures").Eval(context)[0] == 0
    quickest = min(rounds, key=np.mean)
    note = f"{len(quickest)} ticks of a reach"
    report(f"whole-body tick, {ROBOT}, mean", quickest.mean(), "us CPU", at_most=350.0, note=note)
    report(
        f"whole-body tick, {ROBOT}, 99 %",
        np.percentile(quickest, 99),
        "us CPU",
        at_most=700.0,
        note=note,
    )


@pytest.mark.benchmark(timer=time.process_time)
def test_its_qp_beside_other_solvers(
    benchmark: Any, report: Callable[..., None], reach: Reach
) -> None:
    inputs = reach.inputs()
    programs = [
        reach.program(inputs, tick) for tick in range(0, len(inputs["plant_state"]), QP_STRIDE)
    ]
    for qp in programs:
        ours = solve_qp(qp)
        assert ours.status == SOLVED
        for theirs in (solve_by_daqp(qp), solve_by_clarabel(qp, precise())):
            np.testing.assert_allclose(ours.torques, qp.torques(theirs), rtol=0, atol=TOLERANCE_NM)

    def solve_all(solve: Callable[[WholeBodyQP], Any]) -> Callable[[], None]:
        def run() -> None:
            for qp in programs:
                solve(qp)

        return run

    cost_s, peers_s = alternate(
        benchmark,
        solve_all(solve_qp),
        {
            "daqp alone": solve_all(solve_by_daqp),
            "Clarabel through MathematicalProgram": solve_all(solve_by_clarabel),
        },
        rounds=QP_ROUNDS,
    )
    num_rows, num_variables = programs[0].A.shape
    peers = {name: 1e6 * seconds / len(programs) for name, seconds in peers_s.items()}
    report(
        f"QP of a whole-body tick, {ROBOT}",
        1e6 * cost_s / len(programs),
        "us CPU",
        at_most=peers["daqp alone"],
        peers=peers,
        note=f"{num_variables} variables, {num_rows} rows",
    )
