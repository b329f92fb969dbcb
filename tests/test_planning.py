import math
from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from drake_safety.learning.assessment import Prediction, SafetyAssessment
from drake_safety.learning.trained_maps import Embedding
from drake_safety.planning.goal_verdict import SAFE, UNKNOWN, UNSAFE, assess_goal, goal_inputs
from drake_safety.planning.nearest_goal import nearest_accepted_goal

BOX = np.array([[0.0, -1.0, 0.0], [1.0, 1.0, 2.0]])
INSIDE = np.array([0.5, 0.0, 1.0])
GOAL = np.array([0.9, 0.5, 1.5])
NORMAL = np.array([0.48, 0.6, 0.64])
STEEPNESS, OFFSET = 30.0, 0.9


class GoalTask:
    """A loop whose plans have a goal; its state is the goal."""

    target_box = BOX
    named_targets: ClassVar[dict] = {}
    hand = None
    constraint_names = ("wall", "floor")

    def __init__(self):
        self.num_resets = 0

    def CreateDefaultContext(self):
        return {}

    def reset(self, *_):
        raise AssertionError("a verdict needs no episode")

    def reset_standing(self, context, goal, rng=None):
        self.num_resets += 1
        context["goal"] = np.array(goal, dtype=float)

    def GetOutputPort(self, name):
        return SimpleNamespace(Eval=lambda context: context["goal"])


class FieldAssessment:
    """Γ of a goal is a given function of it: `gamma(goals (N, 3)) -> (N,)`."""

    parameters = SimpleNamespace(initial_uncertainty=0.3, margin_unit=0.02)
    base_logit_ = object()
    embedding_ = SimpleNamespace(has_heads=False)

    def __init__(self, gamma, unknown=0.3):
        self._gamma = gamma
        self._unknown = unknown

    def predict(self, state, desired_preview, features):
        n = len(state)
        gamma = np.asarray(self._gamma(state), dtype=float)
        known = 1.0 - self._unknown
        unsafe = known * (1.0 - gamma)
        return Prediction(
            belief=np.column_stack([known * gamma, unsafe, np.full(n, self._unknown)]),
            embedding=np.zeros((n, 2)),
            cause_probability=np.column_stack([0.2 * unsafe, 0.8 * unsafe]),
            predicted_margins=np.column_stack([gamma - 0.5, np.full(n, 0.02)]),
            probability=gamma,
            novelty=np.zeros(len(gamma)),
            fall_probability=np.full(len(gamma), np.nan),
        )


def constant(gamma):
    return lambda goals: np.full(len(goals), gamma)


def step(signed_distance):
    """Γ is 1 where a signed distance is positive and 0 elsewhere."""
    return lambda goals: (signed_distance(goals) >= 0).astype(float)


def ask(gamma, goal=INSIDE, *, threshold=0.5, unsafe_below=None, **options):
    assessment = FieldAssessment(gamma, **options)
    return assess_goal(GoalTask(), assessment, goal, threshold=threshold, unsafe_below=unsafe_below)


def suggest(assessment, goal=GOAL, *, task=None, seed=0, **options):
    rng = np.random.default_rng(seed)
    return nearest_accepted_goal(
        task or GoalTask(), assessment, goal, threshold=0.5, rng=rng, **options
    )


def search(gamma, goal, **options):
    """Without a safety head there is no gradient to follow."""
    return suggest(FieldAssessment(gamma), goal, **options)


class PlaneAssessment(FieldAssessment):
    """Unsafe beyond a plane; its maps say so, with a logit that is straight across it."""

    def __init__(self, steepness=STEEPNESS):
        super().__init__(lambda goals: 1.0 / (1.0 + np.exp(STEEPNESS * (goals @ NORMAL - OFFSET))))
        # x is the goal three times: only the first counts. Offsets keep every unit active.
        first = np.zeros((1, 9, 1))
        first[0, :3, 0] = NORMAL
        self.embedding_ = Embedding(
            {
                "trunk.0.weight": first,
                "trunk.0.bias": np.full((1, 1), 10.0),
                "output.weight": np.array([[[1.0, 0.0]]]),
                "output.bias": np.zeros((1, 2)),
                "safety.0.weight": np.array([[[1.0], [0.0]]]),
                "safety.0.bias": np.full((1, 1), 10.0),
                "safety.1.weight": np.full((1, 1, 1), steepness),
                "safety.1.bias": np.full((1, 1), -steepness * (20.0 + OFFSET)),
            }
        )

    unsafe_logits = SafetyAssessment.unsafe_logits

    def inputs_of(self, *parts):
        return np.concatenate(parts, axis=1)


def test_a_goal_is_safe_from_the_threshold_on():
    assert ask(constant(0.6), threshold=0.6).is_accepted
    assert ask(constant(0.6), threshold=0.61).verdict == UNSAFE
    # The corners of the region belong to it.
    assert all(ask(constant(1.0), corner).is_accepted for corner in BOX)
    for part in goal_inputs(GoalTask(), np.array([INSIDE, BOX[0]])):
        np.testing.assert_array_equal(part, [INSIDE, BOX[0]])


@pytest.mark.parametrize(
    ("gamma", "expected"), [(0.8, SAFE), (0.79, UNKNOWN), (0.3, UNKNOWN), (0.29, UNSAFE)]
)
def test_between_the_thresholds_of_a_calibration_a_goal_is_not_known(gamma, expected):
    verdict = ask(constant(gamma), threshold=0.8, unsafe_below=0.3)
    assert verdict.verdict == expected
    assert ("between 0.300 and 0.800" in verdict.reason) == (expected == UNKNOWN)


def test_a_goal_is_not_known_when_most_of_its_belief_rests_on_cells_without_data():
    # μ = 0.3 + 0.7 e, e the share of empty cells: 0.65 is half of them.
    assert ask(constant(1.0), unknown=0.64).verdict == SAFE
    verdict = ask(constant(1.0), unknown=0.66)
    assert verdict.verdict == UNKNOWN and not verdict.is_accepted and verdict.reason


@pytest.mark.parametrize(
    ("goal", "words"),
    [([0.5, -1.0001, 1.0], "is outside the region"), ([math.nan, 0.0, 1.0], "is not finite")],
)
def test_outside_the_trained_region_the_answer_is_the_region_and_no_number(goal, words):
    task = GoalTask()
    verdict = assess_goal(task, FieldAssessment(constant(1.0)), np.array(goal), threshold=0.5)
    assert verdict.verdict == UNKNOWN and task.num_resets == 0
    assert words in verdict.reason and "x 0…1, y -1…1, z 0…2 m" in verdict.reason
    np.testing.assert_array_equal(verdict.belief, [0.0, 0.0, 1.0])
    assert math.isnan(verdict.probability) and verdict.cause == ""


def test_a_refusal_names_the_constraint_whose_margin_comes_nearest_to_violation():
    # Most of the unsafe mass is the floor's, but the smallest margin is the wall's.
    verdict = ask(constant(0.25))
    assert (verdict.cause, verdict.cause_margin) == ("wall", -0.25)
    assert verdict.cause_words(()) == ("likely cause", "wall, -25.0 cm")
    unsure = replace(verdict, reason="of two minds")
    assert unsure.cause_words(()) == ("nearest to its limit", "wall, -25.0 cm")
    without_margins = replace(verdict, predicted_margins=np.full(2, np.nan))
    assert without_margins.cause == "floor" and math.isnan(without_margins.cause_margin)
    assert replace(without_margins, cause_probability=np.zeros(2)).cause == ""


@pytest.mark.parametrize(
    ("signed_distance", "distance_m"),
    [
        (lambda goals: (goals - INSIDE) @ [0.6, 0.0, 0.8] - 0.15, 0.15),
        (lambda goals: 0.3 - np.linalg.norm(goals - [0.5, 0.7, 1.0], axis=1), 0.4),
        (lambda goals: np.abs(goals[:, 2] - 1.0) - 0.25, 0.25),
    ],
    ids=["plane", "ball", "gap"],
)
def test_the_search_finds_a_goal_nearly_as_near_as_the_boundary(signed_distance, distance_m):
    for seed in range(2):
        nearest = search(step(signed_distance), INSIDE, seed=seed)
        assert nearest.is_accepted and signed_distance(nearest.goal[None])[0] >= 0
        assert np.all((nearest.goal >= BOX[0]) & (nearest.goal <= BOX[1]))
        distance = np.linalg.norm(nearest.goal - INSIDE)
        assert distance_m - 1e-9 <= distance <= 1.05 * distance_m + 0.005
        # Rounded to the grid, it is what a user types.
        typed = np.array([float(f"{value:.3f}") for value in nearest.goal])
        np.testing.assert_array_equal(typed, nearest.goal)


def test_a_suggested_goal_exceeds_the_threshold_by_the_reserve():
    # Γ = 1 - x: the threshold 0.5 is met at x = 0.5, the reserve of 0.8 by default at x = 0.1.
    nearest = search(lambda goals: 1.0 - goals[:, 0], np.array([0.9, 0.0, 1.0]))
    assert nearest.probability >= 0.9
    assert 0.05 <= nearest.goal[0] <= 0.1 + 1e-9
    assert nearest.threshold == 0.5 and nearest.is_accepted


def test_without_a_goal_accepted_with_reserve_nothing_is_suggested():
    assert search(constant(0.89), INSIDE, num_candidates=4) is None
    assert search(constant(0.91), INSIDE, num_candidates=4) is not None
    assert search(constant(1.0), np.array([0.5, np.nan, 1.0])) is None


def test_the_reserve_of_the_papers_mode_ends_at_its_largest_probability():
    paper = PlaneAssessment()
    gamma = paper._gamma
    paper._gamma = lambda goals: 0.7 * gamma(goals)
    paper.base_logit_ = None
    assert 0.66 <= suggest(paper).probability <= 0.7


def test_the_logits_gradient_is_that_of_finite_differences():
    rng = np.random.default_rng(0)
    sizes = {"trunk.0": (6, 8), "trunk.1": (8, 8), "output": (8, 2)}
    weights = {}
    for name, (n, m) in (sizes | {"safety.0": (2, 5), "safety.1": (5, 1)}).items():
        weights[f"{name}.weight"] = rng.normal(size=(2, n, m))
        weights[f"{name}.bias"] = rng.normal(size=(2, m))
    embedding = Embedding(weights)
    x = rng.normal(size=(4, 6))
    logit, gradient = embedding.logit_gradient(x)
    expected = embedding.evaluate(x).unsafe_logit.mean(axis=0)
    np.testing.assert_allclose(logit, expected, rtol=1e-4, atol=1e-4)
    for i in range(6):
        dx = 1e-6 * np.eye(6)[i]
        change = embedding.logit_gradient(x + dx)[0] - embedding.logit_gradient(x - dx)[0]
        np.testing.assert_allclose(gradient[:, i], change / 2e-6, rtol=1e-5, atol=1e-6)


def test_with_a_gradient_a_suggestion_is_as_near_with_fewer_goals_judged():
    led, whole = GoalTask(), GoalTask()
    nearest = suggest(PlaneAssessment(), task=led)
    searched = suggest(FieldAssessment(PlaneAssessment()._gamma), task=whole)
    distances = [np.linalg.norm(one.goal - GOAL) for one in (nearest, searched)]
    # Γ ≥ 0.9 is ln 9 below the middle of the slope.
    expected = GOAL @ NORMAL - (OFFSET - np.log(9.0) / STEEPNESS)
    assert distances[0] == pytest.approx(expected, abs=0.02)
    assert distances[0] <= distances[1] + 0.002
    assert nearest.probability >= 0.9 and nearest.threshold == 0.5
    assert led.num_resets < 0.6 * whole.num_resets


def test_a_nearer_goal_than_the_gradient_leads_to_is_found():
    # The maps do not know of a ball of accepted goals, in another direction than down.
    pocketed = PlaneAssessment()
    beyond, centre = pocketed._gamma, GOAL + 0.2 * np.array([0.0, -0.6, 0.8])
    pocketed._gamma = lambda goals: np.where(
        np.linalg.norm(goals - centre, axis=1) < 0.12, 1.0, beyond(goals)
    )
    assert np.linalg.norm(suggest(pocketed).goal - GOAL) == pytest.approx(0.08, abs=0.02)
