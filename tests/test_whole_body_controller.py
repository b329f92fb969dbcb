"""The whole-body controller: the program's torques, and held commands."""

import itertools

import numpy as np
import pytest

from drake_safety.control.whole_body_model import PointReference
from drake_safety.control.whole_body_qp import build_qp, solve_qp
from drake_safety.systems.whole_body_controller import NOT_FINITE, WholeBodyController
from legged_robots import robot_kinematics
from system_doubles import Bench

PERIOD_S = 0.004


class Alone(Bench):
    """A controller alone, of a biped that stands and reaches with its head."""

    def __init__(self, **options):
        self.kinematics = robot_kinematics("biped")
        options = {"hand": "head", "period_s": PERIOD_S} | options
        super().__init__(WholeBodyController(self.kinematics, **options))
        self.q = self.kinematics.standing_positions()
        self.set_state(self.q)
        hand = self.system.model.reference(self.q).reaching.position
        self.at_rest = {"desired_output": hand, "desired_output_rate": np.zeros(3)}
        self.fix(**self.at_rest)

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


def test_a_reference_holds_for_the_context_it_was_set_in():
    bench = Alone()
    other = Bench(bench.system, **bench.at_rest)
    other.fix(plant_state=np.append(bench.q, np.zeros(len(bench.q) - 1)))
    reference = bench.system.model.reference(bench.q)
    reference.center_of_mass.position += [0.0, 0.0, -0.02]
    expected = bench.torques(reference)
    bench.system.set_reference(bench.context, reference)
    reference.center_of_mass.position[:] = 0.0  # The Context keeps a copy.
    bench.begin()
    np.testing.assert_array_equal(bench.get("actuation"), expected)
    standing = bench.torques(bench.system.model.reference(bench.q))
    np.testing.assert_array_equal(other.begin().get("actuation"), standing)


NUMBERS = (np.nan, np.inf, 1e9, 1e100)


@pytest.mark.parametrize(
    ("what", "entry", "value"),
    [("q", 9, np.nan), ("q", ..., 0.0), *itertools.product(["q", "v", "goal"], [1], NUMBERS)],
)
def test_an_input_that_is_not_finite_keeps_the_last_good_command(what, entry, value):
    bench = Alone()
    bench.begin()
    good, goal = bench.get("actuation"), bench.at_rest["desired_output"].copy()
    q, v = bench.q.copy(), np.zeros(bench.kinematics.num_velocities)
    reference = bench.system.model.reference(q)
    {"q": q, "v": v, "goal": goal}[what][entry] = value
    reference.reaching.position = goal
    with pytest.raises(ValueError, match="state and set points must be finite"):
        build_qp(bench.system.model, q, v, reference)
    bench.fix(desired_output=goal)
    bench.set_state(q, v)
    status, num_failures = bench.ticks(3)
    assert status == NOT_FINITE and num_failures >= 3
    np.testing.assert_array_equal(bench.get("actuation"), good)
    bench.set_state(bench.q)
    bench.fix(**bench.at_rest)
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
