import numpy as np
import pytest
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.whole_body_model import PointReference
from drake_safety.control.whole_body_qp import build_qp, solve_qp
from drake_safety.models import load_robot, robot_names
from drake_safety.robots.robot import PlantVariation
from drake_safety.systems.whole_body_controller import NOT_FINITE, WholeBodyController
from legged_robots import ROBOT_NAMES, robot_kinematics, robot_model
from system_doubles import Bench
from whole_body_loop import PERIOD_S, WholeBodyLoop

NAMES = sorted({*ROBOT_NAMES, *robot_names()})
STANDS_S = {"atlas": 10.0}  # Every other robot: 2 s.
HANDS = [(name, hand) for name in robot_names() for hand in load_robot(name).reaching_frames]


class Alone(Bench):
    """A controller alone, of a robot that stands; the biped reaches with its head."""

    def __init__(self, name="biped", hand="head", **options):
        self.kinematics = robot_kinematics(name)
        super().__init__(
            WholeBodyController(self.kinematics, hand=hand, period_s=PERIOD_S, **options)
        )
        self.q = self.kinematics.standing_positions()
        self.set_state(self.q)

    def set_state(self, q, v=None):
        v = np.zeros(self.kinematics.num_velocities) if v is None else v
        self.fix(plant_state=np.concatenate([q, v]))

    def ticks(self, number=1):
        self.advance(number * PERIOD_S)
        return self.get("solver_status")[0], self.get("num_failures")[0]

    def torques(self, reference, q=None):
        """What the program itself gives, at rest."""
        q = self.q if q is None else q
        v = np.zeros(self.kinematics.num_velocities)
        return solve_qp(build_qp(self.system.model, q, v, reference)).torques


def test_the_actuation_is_the_solution_of_the_program():
    bench = Alone()
    reference = bench.system.model.reference(bench.q)
    bench.begin()
    np.testing.assert_array_equal(bench.get("actuation"), bench.torques(reference))
    assert bench.get("solver_status")[0] == 0
    goal = reference.reaching.position + [0.02, 0.01, -0.01]
    reference.reaching = PointReference(position=goal, rate=np.array([0.1, 0.0, 0.0]))
    bench.fix(desired_output=goal, desired_output_rate=[0.1, 0.0, 0.0])
    bench.begin()
    np.testing.assert_array_equal(bench.get("actuation"), bench.torques(reference))


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


def test_a_reference_of_another_robot_is_refused():
    reference = Alone("hexapod", hand=None).system.model.reference(
        robot_kinematics("hexapod").standing_positions()
    )
    bench = Alone()
    with pytest.raises(ValueError, match="robot 'biped': the whole-body reference must have"):
        bench.system.set_reference(bench.context, reference)


def test_torques_go_to_the_actuators_that_the_matrix_names():
    n_j = robot_kinematics("biped").num_joints
    rng = np.random.default_rng(0)
    matrix = np.vstack([np.eye(n_j)[rng.permutation(n_j)], np.zeros((2, n_j))])
    plain, mapped = Alone(), Alone(actuation_matrix=matrix)
    plain.begin()
    mapped.begin()
    np.testing.assert_array_equal(mapped.get("actuation"), matrix @ plain.get("actuation"))


def test_a_matrix_for_other_joints_is_refused():
    with pytest.raises(ValueError, match=r"must have 12 columns.*left_knee.*shape \(3, 5\)"):
        Alone(actuation_matrix=np.zeros((3, 5)))


def spoilt(bench, how):
    """Sets an input that no controller can use."""
    if how == "state":
        q = bench.q.copy()
        q[9] = np.nan
        bench.set_state(q)
    elif how == "orientation":
        bench.set_state(np.zeros_like(bench.q))
    elif how == "velocity":
        bench.set_state(bench.q, np.full(bench.kinematics.num_velocities, 1e100))
    else:
        bench.fix(**{how: [0.0, np.inf, 1.0]})


@pytest.mark.parametrize(
    "how", ["state", "orientation", "velocity", "desired_output", "desired_output_rate"]
)
def test_an_input_that_is_not_finite_keeps_the_last_good_command(how):
    bench = Alone()
    at_rest = {"desired_output_rate": np.zeros(3)}
    at_rest["desired_output"] = bench.system.model.reference(bench.q).reaching.position
    bench.fix(**at_rest)
    bench.begin()
    good = bench.get("actuation")
    spoilt(bench, how)
    status, num_failures = bench.ticks(3)
    assert status == NOT_FINITE and num_failures >= 3
    np.testing.assert_array_equal(bench.get("actuation"), good)
    bench.set_state(bench.q)
    bench.fix(**at_rest)
    assert bench.ticks() == (0, num_failures)


def test_a_program_without_solution_keeps_the_last_good_command():
    bench = Alone()
    bench.begin()
    good = bench.get("actuation")
    v = np.zeros(bench.kinematics.num_velocities)
    v[6:] = 200.0  # No ankle can stop a foot that spins so fast.
    bench.set_state(bench.q, v)
    status, num_failures = bench.ticks()
    assert status < 0 and num_failures >= 1
    np.testing.assert_array_equal(bench.get("actuation"), good)


def test_nothing_of_an_earlier_episode_is_left_after_the_initialisation():
    bench = Alone()
    bench.begin()
    spoilt(bench, "state")
    bench.ticks(2)
    bench.simulator.get_mutable_context().SetTime(0.0)  # Without it, the episode goes on.
    bench.begin()
    np.testing.assert_array_equal(
        bench.get("actuation"), 0.0
    )  # No command of this episode is good.
    assert bench.get("num_failures")[0] == 1
    bench.set_state(bench.q)
    bench.begin()
    assert (bench.get("solver_status")[0], bench.get("num_failures")[0]) == (0, 0)


@pytest.mark.parametrize("name", NAMES)
def test_robots_stand(name):
    loop = WholeBodyLoop(robot_model(name))
    start = loop.q
    reference = loop.controller.model.reference(start)
    loop.simulator.AdvanceTo(STANDS_S.get(name, 2.0))
    assert loop.num_failures() == 0
    kinematics = loop.kinematics
    drift = kinematics.contact_positions(loop.q) - kinematics.contact_positions(start)
    np.testing.assert_allclose(drift, 0.0, atol=5e-3)
    com = kinematics.center_of_mass(loop.q)
    np.testing.assert_allclose(com, reference.center_of_mass.position, atol=5e-3)
    assert np.abs(loop.v).max() < 1e-2


@pytest.mark.parametrize("name", robot_names())
def test_robots_come_to_rest_after_a_start_in_motion(name):
    loop = WholeBodyLoop(robot_model(name))
    q, v = loop.q, loop.v
    v[3:6] = [0.15, 0.1, 0.0]
    loop.start(q, v)
    loop.simulator.AdvanceTo(2.0)
    com = loop.kinematics.center_of_mass(loop.q)
    reference = loop.controller.model.reference(loop.q).center_of_mass.position
    np.testing.assert_allclose(com[:2], reference[:2], atol=0.01)
    assert np.abs(loop.v).max() < 0.02


def test_dry_friction_holds_joints_under_torques():
    smooth = WholeBodyLoop(robot_model("laikago"))
    rough = WholeBodyLoop(robot_model("laikago"), variation=PlantVariation(joint_friction_nm=1.0))
    goal = smooth.kinematics.center_of_mass(smooth.q) + [0.03, 0.0, -0.03]
    for loop in (smooth, rough):
        loop.lead(goal, np.zeros(3))
        loop.simulator.AdvanceTo(2.0)
        assert loop.num_failures() == 0
    error = [
        np.linalg.norm(loop.kinematics.center_of_mass(loop.q) - goal) for loop in (smooth, rough)
    ]
    assert error[0] < 2e-3
    assert error[0] + 1e-3 < error[1] < 0.02  # Friction stops it a little short.


def reach(loop, goal, duration_s=2.0):
    start = loop.controller.model.reaching_position(loop.q)
    zero = np.zeros((3, 1))
    trajectory = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
        [0.0, duration_s], np.column_stack([start, goal]), zero, zero
    )
    loop.follow(trajectory, duration_s + 0.5)
    return np.linalg.norm(loop.controller.model.reaching_position(loop.q) - goal)


@pytest.mark.parametrize(("name", "hand"), HANDS)
def test_hands_reach_targets_within_two_centimetres(name, hand):
    loop = WholeBodyLoop(load_robot(name), hand=hand)
    start, q = loop.controller.model.reaching_position(loop.q), loop.q
    side = np.sign(start[1])
    offsets = [[0.15, -0.25 * side, 0.05], [0.1, 0.15 * side, 0.25]]
    if name == "atlas":  # Other hands hang too near their stops to go ahead and down.
        offsets.append([0.2, 0.0, -0.15])
    for offset in offsets:
        loop.start(q)
        assert reach(loop, start + offset) < 0.02
        assert loop.num_failures() == 0
