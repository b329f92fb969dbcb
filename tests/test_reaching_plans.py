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


def test_the_boxes_of_targets_of_both_hands_are_mirrored():
    left, right = (porter(hand=hand) for hand in HANDS)
    image = np.sort(Mirror(left.kinematics).points(left.target_box), axis=0)
    np.testing.assert_array_equal(right.target_box, image)
