import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.whole_body_model import PointReference
from drake_safety.control.whole_body_qp import build_qp, solve_qp
from drake_safety.models import load_robot, robot_names
from drake_safety.robots.robot import PlantVariation
from drake_safety.systems.whole_body_controller import NOT_FINITE, WholeBodyController
from legged_robots import ROBOT_NAMES, robot_kinematics, robot_model
from whole_body_loop import PERIOD_S, WholeBodyLoop

NAMES = sorted({*ROBOT_NAMES, *robot_names()})
STANDS_S = {"atlas": 10.0}  # Every other robot: 2 s.
HANDS = [(name, hand) for name in robot_names() for hand in load_robot(name).reaching_frames]


class Bench:
    """A controller alone, with its inputs fixed; the biped reaches with its head."""

    def __init__(self, name="biped", hand="head", **options):
        self.kinematics = robot_kinematics(name)
        self.controller = WholeBodyController(
            self.kinematics, hand=hand, **{"period_s": PERIOD_S} | options
        )
        self.simulator = Simulator(self.controller)
        self.context = self.simulator.get_mutable_context()
        self.q = self.kinematics.standing_positions()
        self.set_state(self.q)

    def set_state(self, q, v=None):
        v = np.zeros(self.kinematics.num_velocities) if v is None else v
        self.fix("plant_state", np.concatenate([q, v]))

    def fix(self, name, value):
        self.controller.GetInputPort(name).FixValue(self.context, value)

    def actuation(self):
        return self.controller.GetOutputPort("actuation").Eval(self.context)

    def status(self):
        return self.controller.GetOutputPort("solver_status").Eval(self.context)[0]

    def advance(self, num_ticks=1):
        time = self.simulator.get_context().get_time()
        self.simulator.AdvanceTo(time + num_ticks * PERIOD_S)

    def torques(self, reference, q=None):
        """What the program itself gives, at rest."""
        q = self.q if q is None else q
        v = np.zeros(self.kinematics.num_velocities)
        return solve_qp(build_qp(self.controller.model, q, v, reference)).torques


def test_the_actuation_is_the_solution_of_the_program():
    bench = Bench()
    reference = bench.controller.model.reference(bench.q)
    bench.simulator.Initialize()
    np.testing.assert_array_equal(bench.actuation(), bench.torques(reference))
    assert bench.status() == 0
    goal = reference.reaching.position + [0.02, 0.01, -0.01]
    reference.reaching = PointReference(position=goal, rate=np.array([0.1, 0.0, 0.0]))
    bench.fix("desired_output", goal)
    bench.fix("desired_output_rate", [0.1, 0.0, 0.0])
    bench.simulator.Initialize()
    np.testing.assert_array_equal(bench.actuation(), bench.torques(reference))


def test_a_reference_holds_for_the_context_it_was_set_in():
    bench = Bench()
    other = bench.controller.CreateDefaultContext()
    reference = bench.controller.model.reference(bench.q)
    reference.center_of_mass.position += [0.0, 0.0, -0.02]
    expected = bench.torques(reference)
    bench.controller.set_reference(bench.context, reference)
    reference.center_of_mass.position[:] = 0.0  # The Context keeps a copy.
    bench.simulator.Initialize()
    np.testing.assert_array_equal(bench.actuation(), expected)
    elsewhere = Simulator(bench.controller, other)
    bench.controller.GetInputPort("plant_state").FixValue(
        other, np.concatenate([bench.q, np.zeros(bench.kinematics.num_velocities)])
    )
    elsewhere.Initialize()
    standing = bench.torques(bench.controller.model.reference(bench.q))
    np.testing.assert_array_equal(bench.controller.GetOutputPort("actuation").Eval(other), standing)


def test_a_reference_of_another_robot_is_refused():
    reference = Bench("hexapod", hand=None).controller.model.reference(
        robot_kinematics("hexapod").standing_positions()
    )
    bench = Bench()
    with pytest.raises(ValueError, match="robot 'biped': the whole-body reference must have"):
        bench.controller.set_reference(bench.context, reference)


def test_torques_go_to_the_actuators_that_the_matrix_names():
    n_j = robot_kinematics("biped").num_joints
    rng = np.random.default_rng(0)
    matrix = np.vstack([np.eye(n_j)[rng.permutation(n_j)], np.zeros((2, n_j))])
    plain, mapped = Bench(), Bench(actuation_matrix=matrix)
    plain.simulator.Initialize()
    mapped.simulator.Initialize()
    np.testing.assert_array_equal(mapped.actuation(), matrix @ plain.actuation())


def test_a_matrix_for_other_joints_is_refused():
    with pytest.raises(ValueError, match=r"must have 12 columns.*left_knee.*shape \(3, 5\)"):
        Bench(actuation_matrix=np.zeros((3, 5)))


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
        bench.fix(how, [0.0, np.inf, 1.0])


@pytest.mark.parametrize(
    "how", ["state", "orientation", "velocity", "desired_output", "desired_output_rate"]
)
def test_an_input_that_is_not_finite_keeps_the_last_good_command(how):
    bench = Bench()
    reaching = bench.controller.model.reference(bench.q).reaching.position
    bench.fix("desired_output", reaching)
    bench.fix("desired_output_rate", np.zeros(3))
    bench.simulator.Initialize()
    good = bench.actuation()
    spoilt(bench, how)
    bench.advance(3)
    assert bench.status() == NOT_FINITE
    np.testing.assert_array_equal(bench.actuation(), good)
    num_failures = bench.controller.GetOutputPort("num_failures").Eval(bench.context)[0]
    assert num_failures >= 3
    bench.set_state(bench.q)
    bench.fix("desired_output", reaching)
    bench.fix("desired_output_rate", np.zeros(3))
    bench.advance()
    assert bench.status() == 0
    assert bench.controller.GetOutputPort("num_failures").Eval(bench.context)[0] == num_failures


def test_a_program_without_solution_keeps_the_last_good_command():
    bench = Bench()
    bench.simulator.Initialize()
    good = bench.actuation()
    v = np.zeros(bench.kinematics.num_velocities)
    v[6:] = 200.0  # No ankle can stop a foot that spins so fast.
    bench.set_state(bench.q, v)
    bench.advance()
    assert bench.status() < 0
    assert bench.controller.GetOutputPort("num_failures").Eval(bench.context)[0] >= 1
    np.testing.assert_array_equal(bench.actuation(), good)


def test_nothing_of_an_earlier_episode_is_left_after_the_initialisation():
    bench = Bench()
    bench.simulator.Initialize()
    spoilt(bench, "state")
    bench.advance(2)
    bench.simulator.Initialize()
    np.testing.assert_array_equal(bench.actuation(), 0.0)  # No command of this episode is good.
    assert bench.controller.GetOutputPort("num_failures").Eval(bench.context)[0] == 1
    bench.set_state(bench.q)
    bench.simulator.Initialize()
    assert bench.status() == 0
    assert bench.controller.GetOutputPort("num_failures").Eval(bench.context)[0] == 0


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


def test_an_episode_does_not_depend_on_the_one_before():
    loop = WholeBodyLoop(robot_model("biped"), hand="head")
    q = loop.q
    goal = loop.controller.model.reaching_position(q) + [0.02, 0.02, -0.05]
    reach(loop, goal, 0.2)
    first = loop.q
    loop.start(q, 0.05 * np.ones(loop.kinematics.num_velocities))
    loop.simulator.AdvanceTo(0.3)
    loop.start(q)
    reach(loop, goal, 0.2)
    np.testing.assert_array_equal(loop.q, first)
