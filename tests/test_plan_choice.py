import numpy as np
import pytest

from drake_safety.planning.plan_choice import choose_plan, plan_inputs
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.rollouts import run_episode
from goal_field import FieldAssessment
from shuttle_task import shuttling

THRESHOLD = 0.5
SLOW_IS_SAFE = FieldAssessment(lambda state: np.exp(-state[:, 3]))


@pytest.fixture(scope="module")
def loop():
    return shuttling().make_loop()


@pytest.fixture
def context(loop):
    context = loop.CreateDefaultContext()
    loop.reset(context, np.random.default_rng(1))
    return context


def state(loop, context):
    return loop.GetOutputPort("state").Eval(context).copy()


def test_the_plan_with_the_highest_gamma_is_set_and_the_state_stays(loop, context):
    before = state(loop, context)
    plans = loop.candidate_plans(context, np.random.default_rng(0), 8)
    choice = choose_plan(
        loop, SLOW_IS_SAFE, context, threshold=THRESHOLD, rng=np.random.default_rng(0), num_plans=8
    )
    slowest = min(range(8), key=lambda i: plans[i][0])
    assert choice.index == slowest != 0
    np.testing.assert_allclose(choice.probability, np.exp([-plan[0] for plan in plans]))
    after = state(loop, context)
    np.testing.assert_array_equal(after[:3], before[:3])
    np.testing.assert_array_equal(after[3:], plans[slowest])


def test_judging_plans_changes_nothing(loop, context):
    before = state(loop, context)
    plans = loop.candidate_plans(context, np.random.default_rng(0), 5)
    seen, preview, features = plan_inputs(loop, context, plans)
    np.testing.assert_array_equal(state(loop, context), before)
    np.testing.assert_array_equal(seen[:, 3:], plans)
    assert len(np.unique(preview, axis=0)) == len(np.unique(features, axis=0)) == 5


def test_an_episode_can_begin_with_a_plan_that_was_chosen(loop):
    context = loop.CreateDefaultContext()
    default = run_episode(loop, 3, seed=1)
    loop.reset(context, np.random.default_rng(np.random.SeedSequence(1, spawn_key=(3,))))
    plans = loop.candidate_plans(context, np.random.default_rng(0), 2)
    same, other = (run_episode(loop, 3, seed=1, plan=plan) for plan in plans)
    np.testing.assert_array_equal(same.state, default.state)
    np.testing.assert_array_equal(other.state[0, :3], default.state[0, :3])
    np.testing.assert_array_equal(other.state[0, 3:], plans[1])


def test_a_task_that_offers_no_plans_says_so():
    loop = ClosedLoop(shuttling(), "nominal", None)
    with pytest.raises(ValueError, match="'ClosedLoop' has no plans to choose from"):
        choose_plan(loop, SLOW_IS_SAFE, None, threshold=0.5, rng=None)
    with pytest.raises(ValueError, match="'ClosedLoop' has no plans to choose from"):
        plan_inputs(loop, None, [])


def test_of_equally_good_plans_the_first_stays_and_is_taken_where_it_passes(loop, context):
    before, indifferent = state(loop, context), FieldAssessment(lambda goals: 0.7 + 0 * goals[:, 0])
    for threshold, is_accepted in ((0.5, True), (0.9, False)):
        rng = np.random.default_rng(0)
        choice = choose_plan(loop, indifferent, context, threshold=threshold, rng=rng)
        assert (choice.index, choice.is_accepted) == (0, is_accepted)
        np.testing.assert_array_equal(state(loop, context), before)
