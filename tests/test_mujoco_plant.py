"""MuJoCo behind the contract: the same robots, tasks and ports, another plant."""

import copy
import functools

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

import reaching_loops
from balancing_loops import scenario_of
from drake_safety import load_scenario, run_episode, run_episodes
from drake_safety.diagrams.balancing.throws import Violations
from drake_safety.plants.pushes import Push
from drake_safety.robots.robot import PlantVariation
from legged_robots import robot_kinematics

MUJOCO = PlantVariation(engine="mujoco")


@functools.cache
def standing_loop(name="laikago"):
    scenario = copy.deepcopy(scenario_of(name))
    scenario.variations["mujoco"] = MUJOCO
    return scenario.make_loop("mujoco")


def atlas_scenario():
    scenario = load_scenario("atlas_reaching")
    scenario.variations = {"nominal": PlantVariation(), "mujoco": MUJOCO}
    return scenario


@functools.cache
def atlas():
    return atlas_scenario().make_loop("mujoco")


def plant_of(loop):
    return loop.GetSubsystemByName("plant")


def read(loop, context, port="plant_state"):
    return loop.GetOutputPort(port).Eval(context).copy()


def advanced(loop, context, time_s):
    """The state after a simulation of a context that goes on where it stands."""
    simulator = Simulator(loop, context)
    simulator.Initialize()
    simulator.AdvanceTo(context.get_time() + time_s)
    return read(loop, context)


def started(loop, seed=0):
    context = loop.CreateDefaultContext()
    loop.reset(context, np.random.default_rng(seed))
    return context


@pytest.mark.parametrize("name", ["laikago", "hexapod"])
def test_robots_with_servos_stand_for_two_seconds_within_a_centimetre(name):
    episode = run_episode(standing_loop(name))
    assert episode.is_safe
    assert episode.time_s[-1] == pytest.approx(2.0)
    height = robot_kinematics(name).standing_height
    assert np.abs(episode.true_state[:, 2] - height).max() < 0.01


def test_a_humanoid_under_torques_stands_for_a_second_within_a_centimetre():
    loop = atlas()
    context = loop.CreateDefaultContext()
    hand = loop.GetOutputPort("output")
    loop.reset_standing(context, [0.6, 0.3, 1.0])
    loop.reset_standing(context, hand.Eval(context))
    before = read(loop, context)
    after = advanced(loop, context, 1.0)
    np.testing.assert_allclose(after[4:7], before[4:7], atol=0.01)
    assert read(loop, context, "safe")[0] == 1
    assert loop.GetOutputPort("num_controller_failures").Eval(context)[0] == 0


def test_what_reset_sets_is_what_the_state_port_says():
    scenario = load_scenario("laikago_balancing")
    nominal = scenario.make_loop("nominal", ball=False)
    other = scenario.make_loop("mujoco", ball=False)
    for seed in range(3):
        ours, theirs = started(other, seed), started(nominal, seed)
        np.testing.assert_allclose(read(other, ours), read(nominal, theirs), atol=1e-12)
        previews = (
            read(one, at, "desired_preview") for one, at in ((other, ours), (nominal, theirs))
        )
        np.testing.assert_allclose(*previews)


def test_both_engines_export_the_same_ports_and_names():
    scenario = load_scenario("laikago_balancing")
    loops = [scenario.make_loop(v, ball=False) for v in ("actual", "mujoco")]
    ports = [
        {p.get_name(): p.size() for p in map(loop.get_output_port, range(loop.num_output_ports()))}
        for loop in loops
    ]
    assert ports[0] == ports[1]
    assert loops[0].feature_names == loops[1].feature_names
    assert not plant_of(loops[1]).HasAnyDirectFeedthrough()


def test_two_contexts_of_one_diagram_do_not_disturb_each_other():
    loop = standing_loop()
    kinematics = loop.kinematics
    # One stands, the other is dropped: contacts, torques and warm starts all differ.
    dropped = np.concatenate([kinematics.standing_positions(), np.zeros(kinematics.num_velocities)])
    dropped[6] += 0.02

    def fresh(state=None):
        context = started(loop)
        if state is not None:
            plant = plant_of(loop)
            plant.set_state(plant.GetMyMutableContextFromRoot(context), state)
        return context

    alone = [advanced(loop, fresh(state), 0.1) for state in (None, dropped)]
    simulators = [Simulator(loop, fresh(state)) for state in (None, dropped)]
    for simulator in simulators:
        simulator.Initialize()
    for step in range(1, 41):
        for simulator in simulators:
            simulator.AdvanceTo(step * 0.0025)
    for expected, simulator in zip(alone, simulators, strict=True):
        np.testing.assert_array_equal(read(loop, simulator.get_context()), expected)
    assert np.abs(alone[0] - alone[1]).max() > 1e-3
    context = simulators[0].get_context()
    clone, original = context.Clone(), context.Clone()
    np.testing.assert_array_equal(advanced(loop, clone, 0.05), advanced(loop, original, 0.05))


def test_episodes_depend_on_seed_and_number_alone():
    scenario = load_scenario("laikago_balancing")
    scenario.episode_duration_s = 0.4
    both = run_episodes(scenario, 2, variation="mujoco", seed=5, num_workers=1, ball=False)
    loop = scenario.make_loop("mujoco", ball=False)
    again = run_episode(loop, 1, seed=5)
    np.testing.assert_array_equal(both[1].true_state, again.true_state)
    assert "mujoco" in both.info.versions


def test_a_push_moves_the_robot_as_far_as_in_drake():
    scenario = atlas_scenario()
    push = Push(body="utorso", force_n=[0.0, 300.0, 0.0], time_s=0.0, duration_s=0.04)
    moved = []
    for variation in scenario.variations:
        loop = scenario.make_loop(variation)
        context = loop.CreateDefaultContext()
        loop.reset_standing(context, [0.6, 0.3, 1.0])
        loop.set_push(context, push)
        state = advanced(loop, context, 0.04)
        plant = loop.kinematics.plant
        robot_context = plant.CreateDefaultContext()
        plant.SetPositionsAndVelocities(robot_context, state)
        moved.append(plant.CalcCenterOfMassTranslationalVelocityInWorld(robot_context)[1])
    # The push gives at most F t / m; the ground takes some of it back.
    assert 0.3 * 300.0 * 0.04 / 175.1 < moved[0] < 300.0 * 0.04 / 175.1
    # MuJoCo's contacts are softer: the feet take less of it.
    assert moved[1] == pytest.approx(moved[0], rel=0.3)


def test_obstacles_stand_where_the_monitor_has_them_and_stop_an_arm():
    loop = atlas()
    model = plant_of(loop).dynamics.model
    scenario = loop.scenario
    (obstacle,) = scenario.parameters.obstacles
    body = model.body("bookshelf::bookshelf")
    np.testing.assert_allclose(body.pos, obstacle.position)
    assert body.geomnum[0] == 6
    boards = model.geom_bodyid == body.id
    np.testing.assert_allclose(model.geom_size[boards], [[0.15, 1.0, 0.025]] * 6)
    # Hands touch boards; chest and ground touch, but not chest and boards, nor hand and ground.
    excluded = {tuple(sorted(divmod(int(code), 1 << 16))) for code in model.exclude_signature}

    def ignore(one, other):
        return tuple(sorted((model.body(one).id, model.body(other).id))) in excluded

    assert not ignore("l_hand", "bookshelf::bookshelf")
    assert ignore("utorso", "bookshelf::bookshelf")
    assert ignore("l_hand", "WorldModelInstance::world")
    assert not ignore("l_foot", "WorldModelInstance::world")
    assert ignore("l_foot", "r_foot")


def test_a_ball_is_refused_by_default_too_where_pushes_are_sampled():
    scenario = load_scenario("laikago_balancing")
    for options in ({}, {"ball": True}):
        with pytest.raises(ValueError, match=r"engine 'mujoco' has no ball.*pass ball=False"):
            scenario.make_loop("mujoco", **options)
    with pytest.raises(ValueError, match=r"read from Drake's plant; variation 'mujoco'"):
        Violations(scenario.make_loop("mujoco", ball=False))


def test_a_robot_of_ones_own_reaches_in_mujoco():
    scenario = load_scenario(reaching_loops.porter_path())
    scenario.variations["nominal"] = MUJOCO
    episode = run_episode(scenario.make_loop(), 0, goal=reaching_loops.EASY)
    assert episode.is_safe
    assert np.linalg.norm(episode.output[-1] - reaching_loops.EASY) < 0.03
    assert episode.num_controller_failures == 0
