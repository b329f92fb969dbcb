"""Cost of a tick of the inverse-kinematics controller, compared with Drake's own solvers."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from costs import alternate, tick_costs_us
from pydrake.multibody.inverse_kinematics import (
    DifferentialInverseKinematicsParameters,
    DoDifferentialInverseKinematics,
    InverseKinematics,
)
from pydrake.solvers import SnoptSolver
from pydrake.systems.analysis import Simulator

from drake_safety import Scenario
from drake_safety.control.inverse_kinematics import solve_from
from drake_safety.control.kinematics import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    RobotKinematics,
    fit_stance,
)
from drake_safety.models import load_robot
from drake_safety.simulation.rollouts import episode_rng
from drake_safety.systems.inverse_kinematics_controller import InverseKinematicsController

SEED, EPISODE = 0, 0
STIFFNESS = 300.0  # [N·m/rad], which does not change the cost.
ROUNDS = 7
PEER_STRIDE = 5  # Every fifth tick is solved by all.
TOLERANCE_M = 1e-4  # Of a foot, for all solvers.
TOLERANCE_RAD = 5e-3


class Balancing:
    """The inputs of the controller in every tick of an episode, and the joints that solve it."""

    def __init__(self, scenario: Scenario):
        loop = scenario.make_loop()
        self.period_s = scenario.control_period_s
        self.kinematics = kinematics = RobotKinematics(load_robot(scenario.robot))
        simulator = Simulator(loop)
        root = simulator.get_mutable_context()
        loop.reset(root, episode_rng(SEED, EPISODE))
        plant_context = loop.plant.GetMyContextFromRoot(root)
        plant, instance = loop.plant, loop.robot_instance
        state = plant.GetPositionsAndVelocities(plant_context, instance)
        self.feet = kinematics.contact_positions(state[: kinematics.num_positions])
        states, desired = [], []
        for tick in range(round(scenario.episode_duration_s / self.period_s)):
            # Between two ticks: rounding cannot move one to the wrong side.
            simulator.AdvanceTo((tick + 0.5) * self.period_s)
            states.append(plant.GetPositionsAndVelocities(plant_context, instance))
            desired.append(loop.GetOutputPort("desired_output").Eval(root).copy())
        self.inputs = {"plant_state": np.array(states), "desired_output": np.array(desired)}
        half_yaw = 0.5 * fit_stance(self.feet, kinematics.nominal_contacts)[2]
        self.quaternion = [np.cos(half_yaw), 0.0, 0.0, np.sin(half_yaw)]
        joints = [state[NUM_BASE_POSITIONS : kinematics.num_positions]]
        for position in desired:
            q = np.concatenate([self.quaternion, position, joints[-1]])
            joints.append(solve_from(kinematics, q, self.feet)[0])
        self.joints = np.array(joints)  # Those of tick k at k + 1.
        self.parameters = DifferentialInverseKinematicsParameters(
            kinematics.num_joints, kinematics.num_joints
        )
        self.parameters.set_time_step(self.period_s)
        self.parameters.set_joint_position_limits(tuple(kinematics.position_limits.T))

    def positions(self, tick: int) -> np.ndarray:
        """The base of a tick and the joints of the tick before it, (n_q,)."""
        desired = self.inputs["desired_output"][tick]
        return np.concatenate([self.quaternion, desired, self.joints[tick]])


def solve_one_step(balancing: Balancing, tick: int) -> np.ndarray:
    """Joints by Drake's differential inverse kinematics: one step of linearised QP."""
    kinematics, q = balancing.kinematics, balancing.positions(tick)
    p_WC, J = kinematics.contact_positions_and_jacobian(q)
    result = DoDifferentialInverseKinematics(
        balancing.joints[tick],
        np.zeros(kinematics.num_joints),
        (balancing.feet - p_WC).ravel() / balancing.period_s,
        J[:, NUM_BASE_VELOCITIES:],
        balancing.parameters,
    )
    return balancing.joints[tick] + balancing.period_s * result.joint_velocities


def solve_by_snopt(balancing: Balancing, tick: int) -> np.ndarray:
    """Joints by Drake's InverseKinematics, a nonlinear program that SNOPT solves."""
    kinematics, q = balancing.kinematics, balancing.positions(tick)
    problem = InverseKinematics(kinematics.plant, kinematics.context)
    program, variables = problem.prog(), problem.q()
    base = slice(0, NUM_BASE_POSITIONS)
    program.AddBoundingBoxConstraint(q[base], q[base], variables[base])
    for name, points, rows in zip(
        kinematics.foot_names, kinematics.foot_points, kinematics.foot_slices, strict=True
    ):
        frame = kinematics.plant.GetFrameByName(kinematics.robot.feet[name].body)
        for point, p_W in zip(points.T, balancing.feet[rows], strict=True):
            problem.AddPositionConstraint(
                frame, point, kinematics.world_frame, p_W - TOLERANCE_M, p_W + TOLERANCE_M
            )
    result = SnoptSolver().Solve(program, q)
    assert result.is_success()
    return result.GetSolution(variables)[NUM_BASE_POSITIONS:]


@pytest.fixture(scope="module")
def balancing(scenario: Scenario) -> Balancing:
    return Balancing(scenario)


@pytest.mark.benchmark(timer=time.process_time)
def test_one_tick(
    benchmark: Any, report: Callable[..., None], scenario: Scenario, balancing: Balancing
) -> None:
    kinematics = balancing.kinematics
    controller = InverseKinematicsController(
        kinematics, np.full(kinematics.num_joints, STIFFNESS), period_s=balancing.period_s
    )
    context = controller.CreateDefaultContext()
    controller.set_foot_positions(context, balancing.feet)
    for name, rows in balancing.inputs.items():
        controller.GetInputPort(name).FixValue(context, rows[0])
    controller.start(context)
    rounds: list[np.ndarray] = []
    benchmark.pedantic(
        lambda: rounds.append(
            tick_costs_us(controller, context, balancing.inputs, "desired_joint_state")
        ),
        rounds=ROUNDS,
        warmup_rounds=1,
    )
    quickest = min(rounds, key=np.mean)
    report(
        f"IK tick, {scenario.robot}, mean",
        quickest.mean(),
        "us CPU",
        at_most=200.0,
        note=f"{len(quickest)} ticks of an episode, gravity torques included",
    )


@pytest.mark.benchmark(timer=time.process_time)
def test_its_solution_beside_drakes(
    benchmark: Any, report: Callable[..., None], scenario: Scenario, balancing: Balancing
) -> None:
    kinematics = balancing.kinematics
    ticks = range(1, len(balancing.joints) - 1, PEER_STRIDE)

    def ours(balancing: Balancing, tick: int) -> np.ndarray:
        return solve_from(kinematics, balancing.positions(tick), balancing.feet)[0]

    for tick in ticks:
        joints = ours(balancing, tick)
        for solve in (solve_one_step, solve_by_snopt):
            np.testing.assert_allclose(joints, solve(balancing, tick), rtol=0, atol=TOLERANCE_RAD)

    def solve_all(solve: Callable[[Balancing, int], np.ndarray]) -> Callable[[], None]:
        def run() -> None:
            for tick in ticks:
                solve(balancing, tick)

        return run

    cost_s, peers_s = alternate(
        benchmark,
        solve_all(ours),
        {
            "DoDifferentialInverseKinematics": solve_all(solve_one_step),
            "InverseKinematics, SNOPT": solve_all(solve_by_snopt),
        },
        rounds=ROUNDS,
    )
    peers = {name: 1e6 * seconds / len(ticks) for name, seconds in peers_s.items()}
    report(
        f"IK of a tick, {scenario.robot}",
        1e6 * cost_s / len(ticks),
        "us CPU",
        at_most=peers["DoDifferentialInverseKinematics"],
        peers=peers,
        note=f"{kinematics.num_joints} joints, {kinematics.num_contacts} feet",
    )
