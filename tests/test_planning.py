import json
import math
from dataclasses import replace

import numpy as np
import pytest

from drake_safety.planning.goal_verdict import SAFE, UNKNOWN, UNSAFE, assess_goal, goal_inputs
from drake_safety.planning.nearest_goal import nearest_accepted_goal, on_grid
from drake_safety.simulation.closed_loop import ClosedLoop
from goal_field import BOX, FieldAssessment, GoalTask
from shuttle_task import shuttling

INSIDE = np.array([0.5, 0.0, 1.0])


def constant(gamma):
    return lambda goals: np.full(len(goals), gamma)


def step(signed_distance):
    """Γ is 1 where a signed distance is positive and 0 elsewhere."""
    return lambda goals: (signed_distance(goals) >= 0).astype(float)


def ask(gamma, goal=INSIDE, *, threshold=0.5, **options):
    return assess_goal(GoalTask(), FieldAssessment(gamma, **options), goal, threshold=threshold)


def search(gamma, goal, *, seed=0, **options):
    return nearest_accepted_goal(
        GoalTask(),
        FieldAssessment(gamma),
        goal,
        threshold=0.5,
        rng=np.random.default_rng(seed),
        method="search",
        **options,
    )


def test_a_goal_is_safe_from_the_threshold_on():
    assert ask(constant(0.6), threshold=0.6).verdict == SAFE
    assert ask(constant(0.6), threshold=0.6).is_accepted
    assert ask(constant(0.6), threshold=0.61).verdict == UNSAFE
    assert not ask(constant(0.6), threshold=0.61).is_accepted
    # The corners of the region belong to it.
    assert all(ask(constant(1.0), corner).is_accepted for corner in BOX)
    for part in goal_inputs(GoalTask(), np.array([INSIDE, BOX[0]])):
        np.testing.assert_array_equal(part, [INSIDE, BOX[0]])


def test_between_the_thresholds_of_a_calibration_a_goal_is_not_known():
    for gamma, expected in [(0.8, SAFE), (0.79, UNKNOWN), (0.3, UNKNOWN), (0.29, UNSAFE)]:
        verdict = assess_goal(
            GoalTask(), FieldAssessment(constant(gamma)), INSIDE, threshold=0.8, unsafe_below=0.3
        )
        assert verdict.verdict == expected
        assert ("between 0.300 and 0.800" in verdict.reason) == (expected == UNKNOWN)


def test_a_goal_is_not_known_when_most_of_its_belief_rests_on_cells_that_know_nothing():
    # μ = 0.3 + 0.7 e, e the share of empty cells: 0.65 is half of them.
    assert ask(constant(1.0), unknown=0.64).verdict == SAFE
    verdict = ask(constant(1.0), unknown=0.66)
    assert verdict.verdict == UNKNOWN
    assert not verdict.is_accepted
    assert verdict.reason


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        ([1.5, 0.0, 1.0], "is outside the region"),
        ([0.5, -1.0001, 1.0], "is outside the region"),
        ([math.nan, 0.0, 1.0], "is not finite"),
        ([math.inf, 0.0, 1.0], "is not finite"),
    ],
)
def test_outside_what_was_trained_the_answer_is_the_region_and_no_number(goal, words):
    task = GoalTask()
    verdict = assess_goal(task, FieldAssessment(constant(1.0)), np.array(goal), threshold=0.5)
    assert verdict.verdict == UNKNOWN
    assert words in verdict.reason
    assert "x 0…1, y -1…1, z 0…2 m" in verdict.reason
    assert math.isnan(verdict.probability)
    np.testing.assert_array_equal(verdict.belief, [0.0, 0.0, 1.0])
    assert task.num_resets == 0
    told = json.loads(json.dumps(verdict.to_json(), allow_nan=False))
    assert told["probability"] is None
    assert told["cause_margin"] is None
    assert told["cause"] is None


def test_a_refusal_names_the_constraint_whose_margin_comes_nearest_to_violation():
    # Most of the unsafe mass is the floor's, but it is the wall that the margins tell of.
    verdict = ask(constant(0.25))
    assert verdict.cause == "wall"
    assert verdict.cause_margin == -0.25
    told = verdict.to_json()
    assert told["cause"] == "wall"
    assert told["cause_margin"] == -0.25
    assert sum(told["belief"].values()) == pytest.approx(1.0)
    assert sum(told["cause_probability"].values()) == pytest.approx(told["belief"]["unsafe"])
    assert verdict.cause_words(()) == ("likely cause", "wall, -25.0 cm")
    unsure = replace(verdict, reason="of two minds")
    assert unsure.cause_words(()) == ("nearest to its limit", "wall, -25.0 cm")


def test_without_predicted_margins_the_cause_is_what_most_of_the_unsafe_mass_is_for():
    unknown = np.full(2, np.nan)
    verdict = replace(ask(constant(0.25)), predicted_margins=unknown)
    assert verdict.cause == "floor"
    assert math.isnan(verdict.cause_margin)
    assert replace(verdict, cause_probability=np.zeros(2)).cause == ""


def test_points_on_the_grid_are_the_numbers_that_their_digits_say():
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (200, 3))
    placed = on_grid(points, 1e-3)
    assert np.abs(placed - points).max() <= 0.5e-3 + 1e-9
    assert placed.tolist() == [[float(f"{value:.3f}") for value in row] for row in placed]
    np.testing.assert_array_equal(on_grid(placed, 1e-3), placed)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("signed_distance", "distance_m"),
    [
        (lambda goals: 0.2 - goals[:, 0], 0.3),
        (lambda goals: (goals - INSIDE) @ [0.6, 0.0, 0.8] - 0.15, 0.15),
        (lambda goals: 0.3 - np.linalg.norm(goals - [0.5, 0.7, 1.0], axis=1), 0.4),
        (lambda goals: np.abs(goals[:, 2] - 1.0) - 0.25, 0.25),
    ],
    ids=["plane", "oblique plane", "ball", "gap"],
)
def test_the_nearest_accepted_goal_is_nearly_as_near_as_the_region_s_boundary(
    signed_distance, distance_m, seed
):
    found = search(step(signed_distance), INSIDE, seed=seed)
    assert found.is_accepted
    assert signed_distance(found.goal[None])[0] >= 0
    assert np.all((found.goal >= BOX[0]) & (found.goal <= BOX[1]))
    distance = np.linalg.norm(found.goal - INSIDE)
    assert distance_m - 1e-9 <= distance <= 1.05 * distance_m + 0.005


def test_a_small_region_far_away_is_found_all_the_same():
    centre = np.array([0.9, -0.9, 1.9])
    found = search(step(lambda goals: 0.2 - np.linalg.norm(goals - centre, axis=1)), BOX[0])
    assert np.linalg.norm(found.goal - centre) <= 0.2


def test_an_accepted_goal_stays_one_when_it_is_typed_to_the_millimetre():
    gamma = step(lambda goals: (goals - INSIDE) @ [0.48, 0.6, 0.64] - 0.1234567)
    found = search(gamma, INSIDE)
    typed = np.array([float(f"{value:.3f}") for value in found.goal])
    np.testing.assert_array_equal(typed, found.goal)
    assert ask(gamma, typed).is_accepted


@pytest.mark.parametrize(("reserve", "x_m"), [(0.0, 0.5), (0.5, 0.25), (0.8, 0.1)])
def test_a_suggested_goal_exceeds_the_threshold_by_the_reserve(reserve, x_m):
    # Γ = 1 - x: the threshold 0.5 is met at x = 0.5, 0.5 + 0.5 reserve further down.
    found = search(lambda goals: 1.0 - goals[:, 0], np.array([0.9, 0.0, 1.0]), reserve=reserve)
    assert found.probability >= 0.5 + 0.5 * reserve
    assert x_m - 0.05 <= found.goal[0] <= x_m + 1e-9
    assert found.threshold == 0.5
    assert found.is_accepted


@pytest.mark.parametrize(
    ("goal", "nearest"),
    [(INSIDE, INSIDE), (np.array([0.5, 3.0, 1.0]), [0.5, 1.0, 1.0])],
    ids=["accepted", "outside the region"],
)
def test_what_is_accepted_is_its_own_nearest_and_what_is_outside_is_moved_in(goal, nearest):
    np.testing.assert_array_equal(search(constant(1.0), goal).goal, nearest)
    gamma = step(lambda goals: 0.2 - goals[:, 0])
    np.testing.assert_array_equal(search(gamma, goal).goal, search(gamma, goal).goal)


def test_where_nothing_is_accepted_with_reserve_nothing_is_suggested():
    for gamma in (0.0, 0.89):
        assert search(constant(gamma), INSIDE, num_candidates=4) is None
    assert search(constant(0.91), INSIDE, num_candidates=4) is not None


def test_a_goal_is_three_numbers_and_a_task_whose_plans_have_none_is_not_asked():
    with pytest.raises(ValueError, match=r"three numbers; got \[0.5, 0.0\]"):
        ask(constant(1.0), INSIDE[:2])
    loop = ClosedLoop(shuttling(), "nominal", None)
    with pytest.raises(ValueError, match="'ClosedLoop' has no plans with a goal"):
        assess_goal(loop, FieldAssessment(constant(1.0)), INSIDE, threshold=0.5)
