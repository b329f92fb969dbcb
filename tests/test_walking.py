import copy
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

from drake_safety import load_assessment, load_scenario
from drake_safety.control.observation import heading_velocity, walking_state
from drake_safety.diagrams.walking.parameters import WalkingRecovery
from drake_safety.learning.beliefs import empty
from drake_safety.simulation.contract import check_contract
from drake_safety.simulation.rollouts import episode_rng
from system_doubles import HORIZON, OUTLOOK, Bench, SlowIsSafe, begun, guard


@pytest.fixture(scope="module")
def loop():
    return load_scenario("go2_walking").make_loop()


def walk(loop, command, duration_s):
    plan = PiecewisePolynomial(np.array(command)[:, None])
    start = replace(loop.standing_start(), plan=plan)
    simulator, context = begun(loop, loop.reset_to, None, start)
    velocities, margins = [], []
    for tick in range(1, round(duration_s / 0.1) + 1):
        simulator.AdvanceTo(0.1 * tick)
        velocities.append(loop.GetOutputPort("output").Eval(context))
        margins.append(loop.GetOutputPort("margins").Eval(context))
    return np.array(velocities), np.array(margins)


@pytest.mark.parametrize("name", ["g1_walking", "go2_walking", "t1_walking"])
def test_a_robot_walks_as_commanded_inside_its_safe_set(name):
    loop = load_scenario(name).make_loop()
    velocities, margins = walk(loop, [0.5, 0.0, 0.0], 5.0)
    assert margins.min() > 0
    np.testing.assert_allclose(velocities[15:, :2].mean(axis=0), [0.5, 0.0], atol=0.15)
    velocities, margins = walk(loop, [0.0, 0.0, 0.8], 4.0)
    assert margins.min() > 0
    assert velocities[15:, 2].mean() == pytest.approx(0.8, abs=0.25)
    assert [finding for finding in check_contract(loop) if not finding.is_ok] == []


def test_a_scenario_leaves_features_out(loop):
    without = ["foot_height_*", "capture_point_*", "clearance_margin", "action_change"]
    fewer = load_scenario("go2_walking", {"without_features": without}).make_loop()
    left_out = {*loop.feature_names} - {*fewer.feature_names}
    assert len(left_out) == 9 and not left_out & {*fewer.monitored["features"]}
    values = []
    for one in (loop, fewer):
        one.reset(context := one.CreateDefaultContext(), episode_rng(0, 3))
        read = one.GetOutputPort("features").Eval(context)
        values.append(dict(zip(one.feature_names, read, strict=True)))
    assert values[1] == {name: values[0][name] for name in fewer.feature_names}
    assert fewer.scenario.simulation_hash() != loop.scenario.simulation_hash()
    with pytest.raises(ValueError, match=r"\['toe_\*'\] match no feature; there are .*tilt"):
        load_scenario("go2_walking", {"without_features": ["toe_*"]}).make_loop()
    with pytest.raises(ValueError, match=r"'Pendulum' keeps features of .* \['track\*'\]"):
        load_scenario("pendulum", {"without_features": ["track*"]}).make_loop()
    assessment = load_assessment("go2_walking")
    assessment.info_.feature_names.remove("largest_command_yaw")
    with pytest.raises(ValueError, match=r"a guard needs the features \['largest_command_yaw'\]"):
        loop.scenario.make_loop(assessment=assessment, guard=True)


def test_episodes_begin_in_mid_stride_and_depend_on_their_number_alone(loop):
    states = []
    for index in (3, 4, 3):
        context = loop.CreateDefaultContext()
        loop.reset(context, episode_rng(0, index))
        states.append(loop.GetOutputPort("state").Eval(context))
    np.testing.assert_array_equal(states[0], states[2])
    rates = slice(10 + loop.kinematics.num_joints, None)
    assert np.abs(states[0][rates]).max() > 0.1
    assert np.abs(states[0] - states[1]).max() > 0.1


def test_state_and_output_do_not_depend_on_place_and_heading(loop):
    start = loop.rehearse(np.array([0.3, 0.0, 0.0]), 1.0)
    q, v = start.q, start.v
    X = RigidTransform(RollPitchYaw(0, 0, 1.3), [4.0, -2.0, 0.0])
    R = X.rotation()
    quaternion = R.ToQuaternion().multiply(Quaternion(q[:4] / np.linalg.norm(q[:4])))
    moved = (
        np.concatenate([quaternion.wxyz(), X @ q[4:7], q[7:]]),
        np.concatenate([R @ v[:3], R @ v[3:6], v[6:]]),
    )
    states = [walking_state(loop.kinematics, *one) for one in ((q, v), moved)]
    np.testing.assert_allclose(*states, atol=1e-9)
    np.testing.assert_allclose(heading_velocity(q, v), heading_velocity(*moved), atol=1e-9)


def test_a_start_has_the_controllers_memory_so_that_the_motion_continues(loop):
    simulator, context = begun(loop, loop.reset_standing, np.array([0.4, 0.0, 0.3]))
    simulator.AdvanceTo(0.6)
    start = loop.start_of(context)
    simulator.AdvanceTo(1.0)
    expected = loop.GetOutputPort("plant_state").Eval(context).copy()

    def continued(start):
        again, context = begun(loop, loop.reset_to, None, start)
        again.AdvanceTo(0.4)
        return loop.GetOutputPort("plant_state").Eval(context)

    np.testing.assert_allclose(continued(start), expected, atol=1e-3)
    forgotten = continued(replace(start, controller_state=None))
    assert np.abs(forgotten - expected).max() > 0.01


@pytest.mark.parametrize(
    ("branch", "slowest", "fastest"), [("stop", -0.15, 0.15), ("slower", 0.1, 0.8)]
)
def test_recovery_switches_to_the_branch_that_the_scenario_names(branch, slowest, fastest):
    scenario = load_scenario("go2_walking")
    scenario.parameters.recovery = WalkingRecovery(branch=branch, slower_share=0.5)
    loop = scenario.make_loop(recovery=True)
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    probability = loop.GetInputPort("safety_probability")
    loop.reset_standing(context, np.array([0.8, 0.0, 0.0]))
    speeds = []
    for value, time_s in ((1.0, 2.0), (0.0, 3.5)):
        probability.FixValue(context, [value])
        simulator.AdvanceTo(time_s)
        assert loop.GetOutputPort("recovery_active").Eval(context)[0] == 1.0 - value
        speeds.append(loop.GetOutputPort("output").Eval(context)[0])
    assert speeds[0] > 0.4
    assert loop.GetOutputPort("margins").Eval(context)[loop.constraint_names.index("tilt")] > 0.4
    assert slowest < speeds[1] / speeds[0] < fastest


def passed_on(assessment, command, state=0.0, is_acting=True):
    bench = Bench(guard(assessment), command=command, state=state, features=np.zeros(3))
    bench.system.set_acting(bench.context, is_acting)
    return bench.begin().outputs()


def test_the_guard_passes_an_accepted_command_unchanged():
    assessment, command = SlowIsSafe(), [1.2, 0.3, 0.0]
    out = passed_on(assessment, command)
    np.testing.assert_array_equal(out["desired_output"], command)
    assert (out["is_changed"][0], out["safety_probability"][0]) == (0.0, 1.0)
    assert assessment.seen == [1]  # No other command is evaluated.
    np.testing.assert_array_equal(out["desired_preview"], np.tile(command, HORIZON))
    np.testing.assert_array_equal(out["desired_outlook"], np.tile(command, OUTLOOK))


def test_the_guard_replaces_a_refused_command_by_the_nearest_accepted_one():
    out = passed_on(SlowIsSafe(fastest=1.5), [2.5, 0.4, 0.0])
    # Shares of 2.5 are .5 apart, and the other entries stay.
    np.testing.assert_allclose(out["desired_output"], [1.5, 0.4, 0.0])
    assert (out["is_changed"][0], out["safety_probability"][0]) == (1.0, 0.0)


def test_the_guard_tries_the_nearest_commands_first_as_measured_in_the_policys_ranges():
    asked = np.array([2.5, 0.4, -3.0])
    commands = guard(SlowIsSafe()).candidates(asked)
    distance = np.linalg.norm((commands - asked) / [2.0, 1.0, 2.0], axis=1)
    np.testing.assert_array_equal(commands[[0, -1]], [asked, np.zeros(3)])
    assert (np.diff(distance) >= 0.0).all()


@pytest.mark.parametrize(
    ("assessment", "state"), [(SlowIsSafe(novelty=2.0), 0.0), (SlowIsSafe(), np.nan)]
)
def test_without_an_accepted_command_the_guard_keeps_to_the_ranges(assessment, state):
    out = passed_on(assessment, [2.5, 0.4, -3.0], state)
    np.testing.assert_array_equal(out["desired_output"], [1.0, 0.4, -1.0])
    assert out["safety_probability"][0] == 0.0


@pytest.mark.parametrize("state", [0.0, np.nan])
def test_a_guard_that_does_not_act_passes_on_everything(state):
    out = passed_on(SlowIsSafe(fastest=1.5), [2.5, 0.4, 0.0], state, is_acting=False)
    np.testing.assert_array_equal(out["desired_output"], [2.5, 0.4, 0.0])
    assert out["safety_probability"][0] == 0.0


@pytest.mark.parametrize("what", ["beliefs", "an alarm"])
def test_the_guard_judges_by_adopted_beliefs_and_by_none_during_an_alarm(what):
    assessment = load_assessment("go2_walking")
    loop = load_scenario("go2_walking").make_loop(assessment=assessment, guard=True)
    simulator, context = begun(loop, loop.reset_standing, np.array([0.3, 0.0, 0.0]))
    guard_system = loop.GetSubsystemByName("command_guard")
    assessor = loop.GetSubsystemByName("safety_assessor")

    def probability():
        port = guard_system.GetOutputPort("safety_probability")
        return port.Eval(guard_system.GetMyContextFromRoot(context))[0]

    simulator.AdvanceTo(0.01)
    assert probability() > 0.5
    if what == "beliefs":
        adapted = copy.copy(assessment)
        adapted.beliefs_ = empty(assessment.beliefs_.shape[:-1], assessment.beliefs_.shape[-1] - 3)
        assessor.adopt(assessor.GetMyMutableContextFromRoot(context), adapted)
    else:
        port = assessor.assessor.GetInputPort("alarm")
        port.FixValue(assessor.assessor.GetMyMutableContextFromRoot(context), [1.0])
    simulator.AdvanceTo(0.12)
    assert loop.GetOutputPort("safety_probability").Eval(context) == 0.0
    assert probability() == 0.0
