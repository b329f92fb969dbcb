import numpy as np
import pytest
import yaml
from pydrake.systems.analysis import Simulator

from drake_safety import SafetyAssessment, load_scenario, run_episode, run_episodes
from drake_safety.control.mirror import Mirror
from drake_safety.learning.segments import RECORDED
from drake_safety.plants.pushes import Push
from drake_safety.simulation.closed_loop import ASSESSMENT_PORTS
from drake_safety.simulation.rollouts import episode_rng, run_to_goal
from legged_robots import edited
from reaching_loops import (
    EASY,
    LOOPS,
    atlas,
    easy_episode,
    evaluated,
    goal_of,
    porter,
    porter_path,
    porting,
    positions,
    started,
)

HANDS = ("left", "right")


@pytest.fixture(params=LOOPS)
def make_loop(request):
    """How to make loops of either robot, without noise."""
    return LOOPS[request.param]


def plant_state(loop, context):
    return np.split(evaluated(loop, context, "plant_state"), [loop.kinematics.num_positions])


@pytest.mark.parametrize("variation", ["nominal", "noisy"])
def test_the_inputs_at_plan_time_are_the_first_row_of_an_episode(variation):
    loop = porter(variation)
    context = loop.CreateDefaultContext()
    loop.reset(context, episode_rng(0, 0), EASY)
    episode = easy_episode(variation)
    for name in RECORDED[:-1]:
        np.testing.assert_array_equal(evaluated(loop, context, name), getattr(episode, name)[0])


def test_starts_stand_safely_and_targets_are_within_the_ranges_of_the_scenario(make_loop):
    loop = make_loop()
    kinematics, sampling = loop.kinematics, loop.scenario.parameters.start
    standing = kinematics.standing_positions()
    legs = {name for foot in loop.robot.feet.values() for name in foot.joints}
    is_free = np.array([name not in legs for name in kinematics.joint_names])
    standing[6] -= sampling.sink_m
    contacts = kinematics.contact_positions(standing)
    drawn, goals = [], []
    for seed in range(15):
        context = started(loop, seed)
        q, v = plant_state(loop, context)
        margins = loop.safe_set.margins(q, v)
        assert not v.any() and margins.min() > 0
        assert margins[loop.constraint_names.index("collision")] >= sampling.clearance_m
        np.testing.assert_allclose(kinematics.contact_positions(q), contacts, atol=3e-4)
        offset = q[4:7] - standing[4:7]
        assert (np.abs(offset[:2]) <= sampling.base_offset_m).all()
        assert -sampling.base_lowering_m <= offset[2] <= 0
        turn = np.abs(q[7:] - kinematics.posture)[is_free]
        assert turn.max() <= sampling.joint_offset_rad + 1e-12
        drawn.append(np.concatenate([offset, q[7:][is_free]]))
        goals.append(goal_of(loop, context))
    assert (np.ptp(drawn, axis=0) > 0).all()
    lowest, highest = loop.target_box
    assert ((goals >= lowest) & (goals <= highest)).all()
    assert (np.ptp(goals, axis=0) > 0.6 * (highest - lowest)).all()


def test_a_goal_takes_the_place_of_the_drawn_target_alone():
    loop = porter("noisy")
    drawn, given = started(loop, 2), started(loop, 2, EASY)
    np.testing.assert_allclose(goal_of(loop, given), EASY, atol=1e-12)
    assert not np.allclose(goal_of(loop, drawn), EASY, atol=1e-3)
    for name in ("plant_state", "state", "output"):
        np.testing.assert_array_equal(evaluated(loop, given, name), evaluated(loop, drawn, name))


def exploring(tmp_path, **options):
    """The porter, half of whose plans make detours and half of whose episodes are pushed."""
    changes = {
        "detours": {"share": 0.5, "lowest_m": [-0.05, -0.1, 0.0], "highest_m": [0.0, 0.1, 0.1]},
        "random_pushes": {"share": 0.5, "time_s": [0.1, 0.3], "force_n": [1.0, 5.0]},
    }
    return load_scenario(porting(tmp_path, parameters=changes)).make_loop(**options)


@pytest.mark.parametrize("hand", HANDS)
def test_some_plans_of_exploring_episodes_make_detours(hand, tmp_path):
    loop = exploring(tmp_path, hand=hand)
    detours = []
    for seed in range(8):
        path = evaluated(loop, started(loop, seed), "desired_preview").reshape(-1, 3)
        along = (path[-1] - path[0]) / np.linalg.norm(path[-1] - path[0])
        beside = path - path[0] - np.outer((path - path[0]) @ along, along)
        detours.append(np.linalg.norm(beside, axis=1).max())
    assert min(detours) < 1e-6 and max(detours) > 0.01


def test_the_other_hands_loop_is_the_trained_ones_mirror_image(make_loop):
    left, right = make_loop(), make_loop(hand="right")
    assert left.mirror is None and left.view.mirrored() == right.view
    mirror = Mirror(left.kinematics)
    image = np.sort(mirror.points(left.target_box), axis=0)
    np.testing.assert_array_equal(right.target_box, image)
    for name in ("state_names", "output_names", "feature_names", "constraint_names"):
        assert getattr(left, name) == getattr(right, name)
    # The torso that Atlas was published with is not quite symmetric: its centre of mass lies some
    # millimetres to one side, and a far reach ends some hundredths of a radian otherwise.
    atol, compared = 0.03 if left.robot.name == "atlas" else 1e-6, 0
    for seed in range(6):
        contexts = [(left, started(left, seed)), (right, started(right, seed))]
        (q, v), actual = (plant_state(*one) for one in contexts)
        expected = mirror.plant_state(q, v, np.zeros(3))
        np.testing.assert_allclose(np.concatenate(actual), np.concatenate(expected), atol=1e-12)
        goals = [goal_of(*one) for one in contexts]
        np.testing.assert_allclose(goals[1], mirror.points(goals[0]), atol=1e-9)
        for name in ("state", "true_state", "desired_preview"):
            np.testing.assert_allclose(*(evaluated(*one, name) for one in contexts), atol=1e-9)
        for name in ("output", "desired_output"):
            values = [evaluated(*one, name) for one in contexts]
            np.testing.assert_allclose(values[1], mirror.points(values[0]), atol=1e-9)
        features = [evaluated(*one, "features") for one in contexts]
        # A hand that never arrives is previewed on its way, wherever it then is.
        if features[0][left.feature_names.index("preview_last_miss")] < 0.015:
            compared += 1
            np.testing.assert_allclose(*features, atol=atol)
    assert compared >= 2


@pytest.mark.train
def test_one_assessment_serves_both_hands():
    scenario = load_scenario(porter_path())
    episodes = run_episodes(scenario, 7, num_workers=1)
    assessment = SafetyAssessment(scenario.assessment).fit(episodes)
    probabilities = []
    for hand in HANDS:
        loop = porter(assessment=assessment, hand=hand)
        context = started(loop, 3)
        Simulator(loop, context).Initialize()
        values = {name: evaluated(loop, context, name) for name in ASSESSMENT_PORTS}
        assert values["belief"].sum() == pytest.approx(1.0)
        probabilities.append(values["safety_probability"][0])
    assert probabilities[0] == pytest.approx(probabilities[1], abs=1e-4)


def test_the_scenario_names_the_trained_hand_and_the_other_is_its_image(tmp_path):
    path = porting(tmp_path, parameters={"hand": "right"})
    frames = yaml.safe_load((tmp_path / "robot.yaml").read_text())["reaching_frames"]
    edited(tmp_path / "robot.yaml", reaching_frames=frames | {"head": {"body": "pelvis"}})
    scenario = load_scenario(path)
    right, left = scenario.make_loop(), scenario.make_loop(hand="left")
    assert (right.hand, left.hand) == ("right", "left")
    assert right.mirror is None and left.mirror is not None
    np.testing.assert_array_equal(right.target_box, scenario.parameters.target.box)
    with pytest.raises(ValueError, match="'right' and its mirror image 'left'"):
        scenario.make_loop(hand="head")


def test_a_robot_of_ones_own_reaches_from_yaml_alone():
    episode = easy_episode()
    assert episode.is_safe and episode.num_controller_failures == 0
    assert np.linalg.norm(episode.output[-1] - EASY) < 0.02
    assert np.linalg.norm(episode.output - episode.desired_output, axis=1).max() < 0.05
    other = easy_episode("rough")
    assert other.is_safe and np.linalg.norm(other.output[-1] - EASY) < 0.04
    assert np.abs(other.true_state - episode.true_state).max() > 1e-5


def test_a_target_in_a_board_ends_in_a_collision():
    goal = np.array([0.5, 0.2, 0.475])  # Inside the board below the hand.
    episode = run_episode(porter(), 0, goal=goal)
    assert (episode.is_safe, episode.cause) == (False, "collision")
    assert episode.margins[-1, 1] < 0


def test_the_preview_foresees_the_joints_of_a_reach():
    loop, goal = atlas(), np.array([0.65, 0.3, 1.05])
    context = loop.CreateDefaultContext()
    loop.reset_standing(context, goal)
    x = dict(zip(loop.feature_names, evaluated(loop, context, "features"), strict=True))
    Simulator(loop, context).AdvanceTo(loop.scenario.episode_duration_s)
    q = positions(loop, context)
    assert np.linalg.norm(loop.safe_set.model.reaching_position(q) - goal) < 0.02
    margins = loop.safe_set.margins(q, np.zeros(loop.kinematics.num_velocities))
    for name, margin in zip(loop.constraint_names[:3], margins, strict=False):
        assert x[f"preview_last_{name}"] == pytest.approx(margin, abs=0.03)


def test_an_unsolved_program_is_in_the_solver_status():
    loop = porter()
    context = started(loop)
    simulator = Simulator(loop, context)
    simulator.AdvanceTo(0.02)
    assert evaluated(loop, context, "solver_status")[0] == 0
    v = np.zeros(loop.plant.num_velocities())
    v[6 : 6 + loop.kinematics.num_joints] = 200.0  # No ankle can stop a foot that spins so fast.
    plant_context = loop.plant.GetMyMutableContextFromRoot(context)
    loop.plant.SetVelocities(plant_context, loop.robot_instance, v)
    simulator.AdvanceTo(0.024)
    assert evaluated(loop, context, "solver_status")[0] != 0
    assert evaluated(loop, context, "num_controller_failures")[0] > 0


def test_a_motion_to_a_goal_depends_on_its_seed_and_on_its_push_once_that_begins():
    actual = load_scenario("atlas_reaching").make_loop("actual")
    goal = np.array(actual.named_targets["blue_box"])
    alone = run_to_goal(actual, goal, duration_s=0.3, ports=("safe",))
    np.testing.assert_allclose(alone.time_s, 0.02 * np.arange(16), atol=1e-12)
    assert np.all(alone["safe"] == 1.0) and not alone.has_left and alone.cause == ""
    other = run_to_goal(actual, goal, duration_s=0.1, seed=1)
    assert not np.array_equal(other["plant_state"], alone["plant_state"][: len(other.time_s)])
    push = Push(body="utorso", force_n=[0.0, 300.0, 0.0], time_s=0.1, duration_s=0.05)
    pushed = run_to_goal(actual, goal, push=push, duration_s=0.3)
    is_before = alone.time_s <= push.time_s
    np.testing.assert_array_equal(pushed["plant_state"][is_before], alone["plant_state"][is_before])
    y = 5  # The base's, among the positions.
    assert np.all(pushed["plant_state"][-3:, y] > alone["plant_state"][-3:, y])
    # The next motion is not pushed, and has the same noise.
    after = run_to_goal(actual, goal, duration_s=0.3)
    np.testing.assert_array_equal(after["plant_state"], alone["plant_state"])
