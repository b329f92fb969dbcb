"""The gradient leads to the nearest accepted goal, with far fewer goals judged than by search."""

import numpy as np
import pytest

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.trained_maps import Embedding
from drake_safety.planning.nearest_goal import nearest_accepted_goal
from goal_field import BOX, FieldAssessment, GoalTask

GOAL = np.array([0.9, 0.5, 1.5])
NORMAL = np.array([0.48, 0.6, 0.64])
STEEPNESS, OFFSET = 30.0, 0.9


def random_maps(rng, sizes=(6, 8, 8), members=2):
    widths = [*sizes, 2]
    names = [f"trunk.{i}" for i in range(len(sizes) - 1)] + ["output"]
    weights = {}
    for name, n, m in zip(names, widths, widths[1:], strict=False):
        weights[f"{name}.weight"] = rng.normal(size=(members, n, m))
        weights[f"{name}.bias"] = rng.normal(size=(members, m))
    for name, n, m in (("safety.0", 2, 5), ("safety.1", 5, 1)):
        weights[f"{name}.weight"] = rng.normal(size=(members, n, m))
        weights[f"{name}.bias"] = rng.normal(size=(members, m))
    return Embedding(weights, num_margins=0)


def test_the_gradient_is_that_of_finite_differences():
    rng = np.random.default_rng(0)
    embedding = random_maps(rng)
    x = rng.normal(size=(4, 6))
    logit, gradient = embedding.logit_gradient(x)
    np.testing.assert_allclose(
        logit, embedding.evaluate(x).unsafe_logit.mean(axis=0), rtol=1e-4, atol=1e-4
    )
    for i in range(6):
        step = 1e-6 * np.eye(6)[i]
        change = embedding.logit_gradient(x + step)[0] - embedding.logit_gradient(x - step)[0]
        np.testing.assert_allclose(gradient[:, i], change / 2e-6, rtol=1e-5, atol=1e-6)


def test_maps_without_a_safety_head_have_no_gradient():
    embedding = random_maps(np.random.default_rng(0))
    weights = {k: v for k, v in embedding.weights.items() if not k.startswith("safety")}
    with pytest.raises(ValueError, match="have no safety head"):
        Embedding(weights, num_margins=0).logit_gradient(np.zeros((1, 6)))


class PlaneAssessment(FieldAssessment):
    """Unsafe beyond a plane; its maps say so, with a logit that is straight across it."""

    def __init__(self):
        super().__init__(lambda goals: 1.0 / (1.0 + np.exp(STEEPNESS * (goals @ NORMAL - OFFSET))))
        # x is the goal three times: only the first counts. Offsets keep every unit active.
        first = np.zeros((1, 9, 1))
        first[0, :3, 0] = NORMAL
        one = np.ones((1, 1, 1))
        output = np.array([[[1.0, 0.0]]])
        self.embedding_ = Embedding(
            {
                "trunk.0.weight": first,
                "trunk.0.bias": np.full((1, 1), 10.0),
                "output.weight": output,
                "output.bias": np.zeros((1, 2)),
                "safety.0.weight": np.array([[[1.0], [0.0]]]),
                "safety.0.bias": np.full((1, 1), 10.0),
                "safety.1.weight": STEEPNESS * one,
                "safety.1.bias": np.full((1, 1), -STEEPNESS * (20.0 + OFFSET)),
            },
            num_margins=0,
        )

    unsafe_logits = SafetyAssessment.unsafe_logits

    def inputs_of(self, *parts):
        return np.concatenate(parts, axis=1)


def suggest(task, assessment, goal=GOAL, **options):
    return nearest_accepted_goal(
        task, assessment, goal, threshold=0.5, rng=np.random.default_rng(0), **options
    )


def search(task, assessment):
    return suggest(task, assessment, method="search")


def descend(task, assessment, goal=GOAL):
    return suggest(task, assessment, goal, method="gradient")


def distance(verdict, goal=GOAL):
    return np.linalg.norm(verdict.goal - goal)


def test_the_nearest_accepted_goal_of_a_plane_is_found_with_few_judged():
    task, whole = GoalTask(), GoalTask()
    found = descend(task, PlaneAssessment())
    # Γ ≥ 0.9 is ln 9 below the middle of the slope.
    expected = GOAL @ NORMAL - (OFFSET - np.log(9.0) / STEEPNESS)
    assert found.probability >= 0.9
    assert found.threshold == 0.5
    assert distance(found) == pytest.approx(expected, abs=0.02)
    searched = search(whole, PlaneAssessment())
    assert task.num_resets < 0.3 * whole.num_resets
    assert distance(found) <= distance(searched) + 0.005


def test_what_is_found_lies_in_the_region_and_a_flat_field_leads_nowhere():
    found = descend(GoalTask(), PlaneAssessment(), np.array([0.9, 3.0, 1.5]))
    assert np.all((found.goal >= BOX[0]) & (found.goal <= BOX[1]))
    flat = PlaneAssessment()
    weights = {k: v * (k != "trunk.0.weight") for k, v in flat.embedding_.weights.items()}
    flat.embedding_ = Embedding(weights, num_margins=0)
    assert descend(GoalTask(), flat) is None


def test_the_reserve_of_the_papers_mode_ends_at_its_largest_probability():
    paper = PlaneAssessment()
    shape = paper._gamma
    paper._gamma = lambda goals: 0.7 * shape(goals)
    paper.base_logit_ = None
    assert 0.66 <= search(GoalTask(), paper).probability <= 0.7


def test_a_suggestion_is_as_near_as_that_of_the_search_with_fewer_goals_judged():
    task, whole = GoalTask(), GoalTask()
    found, searched = suggest(task, PlaneAssessment()), search(whole, PlaneAssessment())
    assert distance(found) <= distance(searched) + 0.002
    assert found.probability >= 0.9
    assert found.threshold == 0.5
    assert task.num_resets < 0.6 * whole.num_resets


def test_a_nearer_goal_than_the_gradient_leads_to_is_found():
    class Pocketed(PlaneAssessment):
        """The maps do not know of a ball of accepted goals, in another direction than down."""

        def __init__(self):
            super().__init__()
            beyond = self._gamma
            centre = GOAL + 0.2 * np.array([0.0, -0.6, 0.8])
            self._gamma = lambda goals: np.where(
                np.linalg.norm(goals - centre, axis=1) < 0.12, 1.0, beyond(goals)
            )

    led = descend(GoalTask(), Pocketed())
    found = suggest(GoalTask(), Pocketed())
    assert distance(led) > 0.5
    assert distance(found) == pytest.approx(0.08, abs=0.02)


def test_without_a_gradient_a_suggestion_is_that_of_the_search():
    headless, flat = PlaneAssessment(), PlaneAssessment()
    weights = {k: v for k, v in headless.embedding_.weights.items() if "safety" not in k}
    headless.embedding_ = Embedding(weights, num_margins=0)
    weights = {k: v * (k != "trunk.0.weight") for k, v in flat.embedding_.weights.items()}
    flat.embedding_ = Embedding(weights, num_margins=0)
    expected = search(GoalTask(), PlaneAssessment()).goal
    for assessment in (headless, flat):
        np.testing.assert_array_equal(suggest(GoalTask(), assessment).goal, expected)


def test_what_cannot_be_suggested_for_is_none_or_an_error():
    task = GoalTask()
    assert suggest(task, PlaneAssessment(), np.array([0.5, np.nan, 1.0])) is None
    with pytest.raises(ValueError, match=r"three numbers; got \[0.5, 0.0\]"):
        suggest(task, PlaneAssessment(), GOAL[:2] * 0.0 + [0.5, 0.0])
    with pytest.raises(ValueError, match=r"reserve is -0\.1, expected a value in \[0, 1\]"):
        suggest(task, PlaneAssessment(), reserve=-0.1)
    with pytest.raises(ValueError, match=r"method must be one of \('both',.*\); got 'best'"):
        suggest(task, PlaneAssessment(), method="best")
    assert task.num_resets == 0
