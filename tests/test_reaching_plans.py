import numpy as np
import pytest

from drake_safety import load_scenario, run_episode
from drake_safety.control.mirror import Mirror
from drake_safety.learning.segments import Episode
from reaching_loops import EASY, LOOPS, evaluated, goal_of, porter, porting, started

# Feet, and so the frame of a plan, are placed by a search that ends at this error.
PLACED_M = 1e-4
HANDS = ("left", "right")
IN_A_BOARD = np.array([0.45, 0.15, 0.77])


def first_row(loop, context):
    """An episode that ended as it began: what there is to judge a plan by."""
    names = ("state", "true_state", "output", "desired_output", "desired_preview", "features")
    rows = {name: evaluated(loop, context, name)[None].copy() for name in (*names, "margins")}
    return Episode(index=0, time_s=np.zeros(1), is_safe=True, cause="", **rows)


def clearance_of(loop, episode):
    return episode.features[0, loop.feature_names.index("plan_clearance")]


@pytest.mark.parametrize(
    "make",
    [lambda robot=robot, hand=hand: LOOPS[robot](hand=hand) for robot in LOOPS for hand in HANDS]
    + [lambda: porter("noisy"), lambda: porter("blurred")],
)
def test_the_goal_of_an_episode_is_where_its_plan_ends(make):
    loop = make()
    for seed in range(4):
        context = started(loop, seed)
        # The porter's preview ends before its plan does.
        found = loop.goal_of(first_row(loop, context))
        np.testing.assert_allclose(found, goal_of(loop, context), atol=PLACED_M)


def test_an_episode_that_ended_early_still_has_its_goal():
    loop = porter()
    episode = run_episode(loop, 0, goal=IN_A_BOARD)
    assert not episode.is_safe
    np.testing.assert_allclose(loop.goal_of(episode), IN_A_BOARD, atol=PLACED_M)


def exploring(tmp_path, **options):
    """The porter, half of whose plans make detours and half of whose episodes are pushed."""
    changes = {
        "detours": {"share": 0.5, "lowest_m": [-0.05, -0.1, 0.0], "highest_m": [0.0, 0.1, 0.1]},
        "random_pushes": {"share": 0.5, "time_s": [0.1, 0.3], "force_n": [1.0, 5.0]},
    }
    return load_scenario(porting(tmp_path, parameters=changes)).make_loop(**options)


@pytest.mark.parametrize("hand", HANDS)
def test_the_goal_of_a_plan_with_a_detour_is_where_it_ends(hand, tmp_path):
    loop = exploring(tmp_path, hand=hand)
    detours = []
    for seed in range(8):
        context = started(loop, seed)
        episode = first_row(loop, context)
        np.testing.assert_allclose(loop.goal_of(episode), goal_of(loop, context), atol=PLACED_M)
        path = episode.desired_preview[0].reshape(-1, 3)
        along = (path[-1] - path[0]) / np.linalg.norm(path[-1] - path[0])
        beside = path - path[0] - np.outer((path - path[0]) @ along, along)
        detours.append(np.linalg.norm(beside, axis=1).max())
    assert min(detours) < 1e-6
    assert max(detours) > 0.01


def test_what_is_judged_is_the_straight_plan_undisturbed(tmp_path):
    training, judging = exploring(tmp_path), exploring(tmp_path, exploring=False)
    scenario = judging.scenario
    assert (
        scenario.options_for("evaluation") == scenario.options_for("paper") == {"exploring": False}
    )
    first_steps = {True: set(), False: set()}
    for seed in range(8):
        for loop in (training, judging):
            context = loop.CreateDefaultContext()
            first_step = loop.reset(context, np.random.default_rng(seed))
            first_steps[loop is judging].add(first_step)
        a, b = (first_row(loop, started(loop, seed)) for loop in (training, judging))
        np.testing.assert_array_equal(a.true_state, b.true_state)
        np.testing.assert_allclose(training.goal_of(a), judging.goal_of(b), atol=1e-9)
    assert first_steps[True] == {0}
    assert len(first_steps[False]) > 1
    # A goal of one's own is reached straight, too.
    assert training.reset(training.CreateDefaultContext(), np.random.default_rng(0), EASY) == 0


def test_a_push_is_over_when_what_is_learned_from_begins(tmp_path):
    loop = exploring(tmp_path)
    episodes = [run_episode(loop, i) for i in range(6)]
    pushed = [e for e in episodes if e.first_step > 0]
    assert 0 < len(pushed) < len(episodes)
    assert all(e.time_s[e.first_step] >= 0.1 + 0.2 for e in pushed if e.is_safe)


def path_of(loop, context):
    """Where the hand shall be at the start, half-way and at the end, in the world, (3, 3)."""
    end_s, points = loop.scenario.parameters.plan_duration_s, []
    for time_s in (0.0, 0.5 * end_s, end_s):
        later = context.Clone()
        later.SetTime(time_s)
        points.append(evaluated(loop, later, "desired_output"))
    return np.array(points)


def test_plans_to_choose_from_lead_to_the_same_goal_and_make_detours_as_drawn(tmp_path):
    loop = exploring(tmp_path, exploring=False)
    context = started(loop, 1)
    start, middle, end = path_of(loop, context)
    plans = loop.candidate_plans(context, np.random.default_rng(0), 5)
    middles = []
    for plan in plans:
        loop.set_plan(context, plan)
        path = path_of(loop, context)
        np.testing.assert_allclose(path[[0, 2]], [start, end], atol=1e-9)
        middles.append(path[1])
    np.testing.assert_allclose(middles[0], middle, atol=1e-9)
    detours = np.array(middles[1:]) - middle
    assert len(np.unique(detours, axis=0)) == 4
    assert np.all(
        (detours >= np.array([-0.05, -0.1, 0.0]) - 1e-6) & (detours <= [0.0 + 1e-6, 0.1, 0.1])
    )


def test_where_training_makes_no_detours_there_is_no_plan_to_choose():
    loop = porter()
    assert len(loop.candidate_plans(started(loop), np.random.default_rng(0), 5)) == 1


@pytest.mark.parametrize("robot", LOOPS)
@pytest.mark.parametrize("hand", HANDS)
def test_fair_is_a_goal_in_the_box_whose_plan_is_clear_of_obstacles(robot, hand):
    loop = LOOPS[robot](hand=hand)
    low, high = loop.fair_box
    verdicts = []
    for seed in range(60):
        episode = first_row(loop, started(loop, seed))
        goal = loop.goal_of(episode)
        is_inside = bool(np.all((goal >= low) & (goal <= high)))
        clearance = clearance_of(loop, episode)
        # The features see the plan at other instants: within millimetres they may disagree.
        if abs(clearance) > 0.01:
            assert loop.is_fair(episode) == (is_inside and clearance > 0)
            verdicts.append(loop.is_fair(episode))
    assert any(verdicts)


@pytest.mark.parametrize("hand", HANDS)
def test_a_plan_into_an_obstacle_is_not_fair_though_its_goal_is_in_the_box(hand, tmp_path):
    bounds = {"x_m": [0.15, 0.5], "z_m": [0.5, 0.8]}
    scenario = load_scenario(porting(tmp_path, parameters={"fair": bounds}))
    loop = scenario.make_loop(hand=hand)
    side = [1.0, 1.0 if hand == "left" else -1.0, 1.0]
    clear, blocked = (first_row(loop, started(loop, 0, goal * side)) for goal in (EASY, IN_A_BOARD))
    low, high = loop.fair_box
    assert np.all((loop.goal_of(blocked) >= low) & (loop.goal_of(blocked) <= high))
    assert loop.is_fair(clear)
    assert not loop.is_fair(blocked)


@pytest.mark.parametrize("robot", LOOPS)
def test_each_hand_names_the_other_as_its_image_and_the_boxes_are_mirrored(robot):
    left, right = (LOOPS[robot](hand=hand) for hand in HANDS)
    assert left.mirror_options == {"hand": "right"}
    assert right.mirror_options == {"hand": "left"}
    mirror = Mirror(left.kinematics)
    image = np.sort(mirror.points(left.fair_box), axis=0)
    np.testing.assert_array_equal(right.fair_box, image)
