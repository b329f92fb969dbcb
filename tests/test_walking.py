from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

from drake_safety import load_scenario, run_episode
from drake_safety.control.observation import heading_velocity, walking_state
from drake_safety.diagrams.walking.parameters import CommandSampling, WalkingRecovery, profile
from drake_safety.simulation.contract import check_contract
from drake_safety.simulation.rollouts import episode_rng

NAMES = ["g1_walking", "go2_walking", "t1_walking"]


@pytest.fixture(scope="module", params=NAMES)
def loop(request):
    return load_scenario(request.param).make_loop()


def walk(loop, command, duration_s):
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    plan = PiecewisePolynomial(np.array(command)[:, None])
    loop.reset_to(context, None, replace(loop.standing_start(), plan=plan))
    simulator.Initialize()
    velocities, margins = [], []
    for tick in range(1, round(duration_s / 0.1) + 1):
        simulator.AdvanceTo(0.1 * tick)
        velocities.append(loop.GetOutputPort("output").Eval(context))
        margins.append(loop.GetOutputPort("margins").Eval(context))
    return np.array(velocities), np.array(margins)


def test_the_robot_walks_where_it_is_told_without_leaving_its_safe_set(loop):
    velocities, margins = walk(loop, [0.5, 0.0, 0.0], 10.0)
    assert margins.min() > 0
    mean = velocities[15:].mean(axis=0)
    assert mean[0] == pytest.approx(0.5, abs=0.15)
    assert abs(mean[1]) < 0.15
    velocities, margins = walk(loop, [0.0, 0.0, 0.8], 4.0)
    assert margins.min() > 0
    assert velocities[15:, 2].mean() == pytest.approx(0.8, abs=0.25)


def test_the_contract_is_kept(loop):
    findings = check_contract(loop)
    assert [finding for finding in findings if not finding.is_ok] == []


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
    kinematics = loop.kinematics
    start = loop.rehearse(np.array([0.3, 0.0, 0.0]), 1.0)
    q, v = start.q, start.v
    turn = RigidTransform(RollPitchYaw(0, 0, 1.3), [4.0, -2.0, 0.0])
    R = turn.rotation()
    quaternion = R.ToQuaternion().multiply(Quaternion(q[:4] / np.linalg.norm(q[:4])))
    q_turned = np.concatenate([quaternion.wxyz(), turn @ q[4:7], q[7:]])
    v_turned = np.concatenate([R @ v[:3], R @ v[3:6], v[6:]])
    np.testing.assert_allclose(
        walking_state(kinematics, q, v), walking_state(kinematics, q_turned, v_turned), atol=1e-9
    )
    np.testing.assert_allclose(
        heading_velocity(q, v), heading_velocity(q_turned, v_turned), atol=1e-9
    )


def test_a_hard_push_ends_an_episode_with_its_cause(loop):
    ends = [run_episode(loop, index, seed=11) for index in range(14)]
    assert {episode.is_safe for episode in ends} == {True, False}
    unsafe = [episode for episode in ends if not episode.is_safe]
    assert all(episode.cause in loop.constraint_names for episode in unsafe)


def test_profiles_go_from_one_command_to_the_next_within_their_ranges():
    plan = profile([np.zeros(3), np.ones(3)], [1.0], 4.0)
    np.testing.assert_allclose(plan.value(0.9).ravel(), 0.0)
    np.testing.assert_allclose(plan.value(1.2).ravel(), 1.0)
    np.testing.assert_allclose(plan.value(4.0).ravel(), 1.0)
    sampling, limits = CommandSampling(reach=2.0), load_scenario("go2_walking")
    limits = limits.make_loop().policy.parameters.command
    rng = np.random.default_rng(0)
    values = np.concatenate(
        [sampling.sample(limits, rng, 4.0).vector_values([0.0, 2.0, 4.0]).T for _ in range(200)]
    )
    assert np.all(values <= 2.0 * np.array(limits.highest) + 1e-9)
    assert np.any(np.abs(values) > np.array(limits.highest) + 0.2)


def test_a_body_that_does_not_exist_is_named():
    scenario = load_scenario("go2_walking")
    scenario.parameters.safe_set.clearance_m["wing"] = 0.1
    with pytest.raises(ValueError, match=r"no bodies \['wing'\] for clearance_m; it has"):
        scenario.make_loop()


def test_a_start_carries_the_controller_so_that_the_motion_goes_on_as_it_was(loop):
    simulator = Simulator(loop)
    context = simulator.get_mutable_context()
    loop.reset_standing(context, np.array([0.4, 0.0, 0.3]))
    simulator.Initialize()
    simulator.AdvanceTo(0.6)
    start = loop.start_of(context)
    simulator.AdvanceTo(1.0)
    expected = loop.GetOutputPort("plant_state").Eval(context).copy()
    again = Simulator(loop)
    loop.reset_to(again.get_mutable_context(), None, start)
    again.Initialize()
    again.AdvanceTo(0.4)
    found = loop.GetOutputPort("plant_state").Eval(again.get_context())
    np.testing.assert_allclose(found, expected, atol=1e-3)
    without = replace(start, controller_state=None)
    loop.reset_to(again.get_mutable_context(), None, without)
    again.Initialize()
    again.AdvanceTo(0.4)
    forgotten = loop.GetOutputPort("plant_state").Eval(again.get_context())
    assert np.abs(forgotten - expected).max() > 0.01


def test_a_goal_is_a_command_which_may_end_before_the_episode():
    loop = load_scenario("go2_walking").make_loop(command_s=1.0)
    context = loop.CreateDefaultContext()
    loop.reset_standing(context, np.array([0.5, 0.1, -0.2]))
    preview = loop.GetOutputPort("desired_preview").Eval(context).reshape(-1, 3)
    np.testing.assert_allclose(preview[5], [0.5, 0.1, -0.2])
    outlook = loop.GetOutputPort("features").Eval(context)[
        [loop.feature_names.index(f"last_command_{axis}") for axis in ("forward", "left", "yaw")]
    ]
    np.testing.assert_allclose(outlook, np.zeros(3), atol=1e-12)
    assert np.all(loop.target_box[1] > loop.policy.parameters.command.highest)
    with pytest.raises(ValueError, match="a command is three finite numbers"):
        loop.reset_standing(context, np.array([0.5, np.nan, 0.0]))


def test_evaluation_starts_without_an_offset():
    scenario = load_scenario("go2_walking")
    calm, pushed = scenario.make_loop(disturbed=False), scenario.make_loop()
    speeds = {True: [], False: []}
    for loop, is_disturbed in ((calm, False), (pushed, True)):
        context = loop.CreateDefaultContext()
        for index in range(12):
            loop.reset(context, episode_rng(5, index))
            n_q = loop.kinematics.num_positions
            state = loop.GetOutputPort("plant_state").Eval(context)
            speeds[is_disturbed].append(np.linalg.norm(state[n_q + 3 : n_q + 5]))
    assert max(speeds[False]) < 1.6 < max(speeds[True])


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
    probability.FixValue(context, [1.0])
    loop.reset_standing(context, np.array([0.8, 0.0, 0.0]))
    simulator.Initialize()
    simulator.AdvanceTo(2.0)
    assert loop.GetOutputPort("recovery_active").Eval(context)[0] == 0.0
    speed = loop.GetOutputPort("output").Eval(context)[0]
    assert speed > 0.4
    probability.FixValue(context, [0.0])
    simulator.AdvanceTo(3.5)
    assert loop.GetOutputPort("recovery_active").Eval(context)[0] == 1.0
    slower = loop.GetOutputPort("output").Eval(context)[0]
    assert loop.GetOutputPort("margins").Eval(context)[loop.constraint_names.index("tilt")] > 0.4
    assert slowest < slower / speed < fastest


def test_what_a_diagram_lacks_is_named():
    scenario = load_scenario("go2_walking")
    with pytest.raises(ValueError, match="guard=True needs an assessment"):
        scenario.make_loop(guard=True)
    loop = scenario.make_loop()
    with pytest.raises(ValueError, match="built without a guard"):
        loop.set_guarded(loop.CreateDefaultContext(), True)
