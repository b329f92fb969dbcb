"""The whole-body controller: the program's torques, held commands, robots that stand and reach."""

import numpy as np
import pytest
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.whole_body_model import PointReference
from drake_safety.control.whole_body_qp import build_qp, solve_qp
from drake_safety.models import load_robot
from drake_safety.robots.robot import PlantVariation
from drake_safety.systems.whole_body_controller import NOT_FINITE, WholeBodyController
from legged_robots import robot_kinematics, robot_model
from system_doubles import Bench
from whole_body_loop import PERIOD_S, WholeBodyLoop


class Alone(Bench):
    """A controller alone, of a biped that stands and reaches with its head."""

    def __init__(self, **options):
        self.kinematics = robot_kinematics("biped")
        options = {"hand": "head", "period_s": PERIOD_S} | options
        super().__init__(WholeBodyController(self.kinematics, **options))
        self.q = self.kinematics.standing_positions()
        self.set_state(self.q)

    def set_state(self, q, v=None):
        v = np.zeros(self.kinematics.num_velocities) if v is None else v
        self.fix(plant_state=np.concatenate([q, v]))

    def ticks(self, number=1):
        self.advance(number * PERIOD_S)
        return self.get("solver_status")[0], self.get("num_failures")[0]

    def torques(self, reference):
        """The solution of the program itself, at rest."""
        v = np.zeros(self.kinematics.num_velocities)
        return solve_qp(build_qp(self.system.model, self.q, v, reference)).torques


def test_the_actuation_is_the_solution_of_the_program_in_the_actuators_order():
    bench = Alone()
    reference = bench.system.model.reference(bench.q)
    bench.begin()
    np.testing.assert_array_equal(bench.get("actuation"), bench.torques(reference))
    goal = reference.reaching.position + [0.02, 0.01, -0.01]
    reference.reaching = PointReference(position=goal, rate=np.array([0.1, 0.0, 0.0]))
    rng = np.random.default_rng(0)
    matrix = np.vstack([np.eye(12)[rng.permutation(12)], np.zeros((2, 12))])
    for benches, B in ((bench, np.eye(12)), (Alone(actuation_matrix=matrix), matrix)):
        benches.fix(desired_output=goal, desired_output_rate=[0.1, 0.0, 0.0])
        benches.begin()
        np.testing.assert_array_equal(benches.get("actuation"), B @ bench.torques(reference))
        assert benches.get("solver_status")[0] == 0
    with pytest.raises(ValueError, match=r"must have 12 columns.*left_knee.*shape \(3, 5\)"):
        Alone(actuation_matrix=np.zeros((3, 5)))


def test_a_reference_holds_for_the_context_it_was_set_in():
    bench = Alone()
    other = Bench(bench.system, plant_state=np.append(bench.q, np.zeros(len(bench.q) - 1)))
    reference = bench.system.model.reference(bench.q)
    reference.center_of_mass.position += [0.0, 0.0, -0.02]
    expected = bench.torques(reference)
    bench.system.set_reference(bench.context, reference)
    reference.center_of_mass.position[:] = 0.0  # The Context keeps a copy.
    bench.begin()
    np.testing.assert_array_equal(bench.get("actuation"), expected)
    standing = bench.torques(bench.system.model.reference(bench.q))
    np.testing.assert_array_equal(other.begin().get("actuation"), standing)


@pytest.mark.parametrize("entry", ["state", "orientation", "velocity", "desired_output"])
def test_an_input_that_is_not_finite_keeps_the_last_good_command(entry):
    bench = Alone()
    at_rest = {"desired_output_rate": np.zeros(3)}
    at_rest["desired_output"] = bench.system.model.reference(bench.q).reaching.position
    bench.fix(**at_rest)
    bench.begin()
    good = bench.get("actuation")
    q, v = bench.q.copy(), np.zeros(bench.kinematics.num_velocities)
    if entry == "state":
        q[9] = np.nan
    elif entry == "orientation":
        q[:] = 0.0
    elif entry == "velocity":
        v[:] = 1e100
    else:
        bench.fix(desired_output=[0.0, np.inf, 1.0])
    bench.set_state(q, v)
    status, num_failures = bench.ticks(3)
    assert status == NOT_FINITE and num_failures >= 3
    np.testing.assert_array_equal(bench.get("actuation"), good)
    bench.set_state(bench.q)
    bench.fix(**at_rest)
    assert bench.ticks() == (0, num_failures)


def test_a_program_without_solution_keeps_the_last_good_command_until_the_initialisation():
    bench = Alone()
    bench.begin()
    good = bench.get("actuation")
    v = np.zeros(bench.kinematics.num_velocities)
    v[6:] = 200.0  # No ankle can stop a foot that spins so fast.
    bench.set_state(bench.q, v)
    status, num_failures = bench.ticks(2)
    assert status < 0 and num_failures >= 1
    np.testing.assert_array_equal(bench.get("actuation"), good)
    bench.simulator.get_mutable_context().SetTime(0.0)  # Without it, the episode goes on.
    bench.begin()
    assert not bench.get("actuation").any()  # No command of this episode is good.
    assert bench.get("num_failures")[0] == 1
    bench.set_state(bench.q)
    bench.begin()
    assert (bench.get("solver_status")[0], bench.get("num_failures")[0]) == (0, 0)


@pytest.mark.parametrize("name", ["biped", "atlas"])
def test_robots_stand_and_come_to_rest_after_a_start_in_motion(name):
    loop = WholeBodyLoop(robot_model(name))
    kinematics, start = loop.kinematics, loop.q
    reference = loop.controller.model.reference(start)
    loop.simulator.AdvanceTo(2.0)
    assert loop.num_failures() == 0
    drift = kinematics.contact_positions(loop.q) - kinematics.contact_positions(start)
    np.testing.assert_allclose(drift, 0.0, atol=5e-3)
    com = kinematics.center_of_mass(loop.q)
    np.testing.assert_allclose(com, reference.center_of_mass.position, atol=5e-3)
    assert np.abs(loop.v).max() < 1e-2
    v = np.zeros(kinematics.num_velocities)
    v[3:6] = [0.15, 0.1, 0.0]
    loop.start(start, v)
    loop.simulator.AdvanceTo(2.0)
    com = kinematics.center_of_mass(loop.q)
    expected = loop.controller.model.reference(loop.q).center_of_mass.position
    np.testing.assert_allclose(com[:2], expected[:2], atol=0.01)
    assert np.abs(loop.v).max() < 0.02


def test_dry_friction_holds_joints_under_torques():
    variations = None, PlantVariation(joint_friction_nm=1.0)
    errors = []
    for variation in variations:
        loop = WholeBodyLoop(robot_model("laikago"), variation=variation)
        goal = loop.kinematics.center_of_mass(loop.q) + [0.03, 0.0, -0.03]
        loop.lead(goal, np.zeros(3))
        loop.simulator.AdvanceTo(2.0)
        assert loop.num_failures() == 0
        errors.append(np.linalg.norm(loop.kinematics.center_of_mass(loop.q) - goal))
    assert errors[0] < 2e-3
    assert errors[0] + 1e-3 < errors[1] < 0.02  # Friction stops it a little short.


@pytest.mark.parametrize(("name", "hand"), [("atlas", "left"), ("talos", "right")])
def test_hands_reach_goals_within_two_centimetres(name, hand):
    loop = WholeBodyLoop(load_robot(name), hand=hand)
    model, zero = loop.controller.model, np.zeros((3, 1))
    start = model.reaching_position(loop.q)
    goal = start + [0.15, -0.25 * np.sign(start[1]), 0.05]
    loop.follow(
        PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
            [0.0, 2.0], np.column_stack([start, goal]), zero, zero
        ),
        2.5,
    )
    assert np.linalg.norm(model.reaching_position(loop.q) - goal) < 0.02
    assert loop.num_failures() == 0
