from dataclasses import replace

import numpy as np
import pytest

import naive
from drake_safety import SafetyAssessment, load_assessment, load_scenario
from drake_safety.learning.beliefs import EMPTY
from drake_safety.learning.novelty import Moments, Novelty

ROWS, EPISODES = 20, 200
NO_PLAN = slice(0)


def redundant(rng, num_episodes=EPISODES):
    """Inputs whose third column follows from the others, and whose fourth is constant."""
    free = rng.normal(size=(num_episodes * ROWS, 2)) * [1.0, 100.0]
    x = np.column_stack([free, free[:, 0] + 0.01 * free[:, 1], np.full(len(free), 7.0)])
    return x + 1e-6 * rng.normal(size=x.shape), np.repeat(np.arange(num_episodes), ROWS)


def fitted(x, episode, is_unsafe=False, plan=NO_PLAN, range_limit=1.25):
    is_unsafe = np.zeros(len(x), dtype=bool) | is_unsafe
    return Novelty.fit(x, episode, is_unsafe, rate=0.05, range_limit=range_limit, plan=plan)


@pytest.fixture(scope="module")
def novelty():
    return fitted(*redundant(np.random.default_rng(0)))


@pytest.mark.parametrize("name", ["atlas_reaching", "go2_walking"])
def test_the_distances_are_those_of_whitened_inputs_with_bounded_variances(name):
    novelty = load_assessment(name).novelty_
    known, rng = novelty.training, np.random.default_rng(0)
    root = np.linalg.cholesky(known.covariance + 1e-12 * np.eye(len(known.mean)))
    x = known.mean + rng.normal(size=(200, len(root))) @ root.T
    x[100:] += rng.normal(size=(100, len(root))) * 10.0 ** rng.integers(-6, 6, size=(100, 1))
    expected = naive.whitened_distances(known, x, novelty.plan)
    found = novelty.distances(x)
    np.testing.assert_allclose(found[:, :3], expected, rtol=1e-6)
    if known.least is not None:
        half_width = np.maximum(0.5 * (known.largest - known.least), 0.05)  # A constant column's.
        outside = np.abs(x - 0.5 * (known.least + known.largest)) / half_width
        expected = np.column_stack([expected, outside.max(axis=1)])
        np.testing.assert_allclose(found[:, 3], expected[:, 3], rtol=1e-6)
    np.testing.assert_allclose(novelty.of(x), (expected / novelty.limits).max(axis=1), rtol=1e-6)


def test_an_input_far_outside_the_range_is_novel_though_it_contradicts_nothing(novelty):
    along = np.array([[0.5, 50.0, 1.0, 0.0]])
    distances = novelty.distances(7.0 * np.eye(4)[3] + along * [[1.0], [20.0]]) / novelty.limits
    expected = [[False] * 4, [True, False, False, True]]
    np.testing.assert_array_equal(distances > 1.0, expected)


def test_one_entry_far_outside_its_range_is_novel_though_many_others_hide_it():
    rng = np.random.default_rng(0)
    # Columns with rare large values make the distance of all of x tolerant.
    others = rng.standard_t(3, size=(EPISODES * ROWS, 60))
    episode = np.repeat(np.arange(EPISODES), ROWS)
    x = np.column_stack([rng.uniform(0.2, 0.4, size=len(episode)), others])
    novelty = fitted(x, episode)
    lifted = x[:200] + 0.3 * np.eye(61)[0]
    assert (novelty.distances(lifted)[:, :3] < novelty.limits[:3]).all(axis=1).mean() > 0.9
    assert (novelty.of(lifted) > 1.0).all()
    assert (fitted(x, episode, range_limit=5.0).of(lifted) > 1.0).mean() < 0.1
    assert (novelty.of(x + [0.02, *[0.0] * 60]) > 1.0).mean() < 0.01


def test_a_contradiction_is_novel_though_every_entry_is_within_its_range(novelty):
    x, _ = redundant(np.random.default_rng(1))
    assert (novelty.of(x) > 1.0).mean() < 0.01
    shuffled = np.random.default_rng(2).permuted(x, axis=0)
    assert (novelty.of(shuffled) > 1.0).mean() > 0.9
    assert np.all(shuffled.max(axis=0) == x.max(axis=0))


def test_a_plan_unlike_those_of_training_is_novel_whatever_the_state():
    rng = np.random.default_rng(0)
    episode = np.repeat(np.arange(EPISODES), ROWS)
    # A plan of five points is a line; one with a bend is within the range of every column.
    slope, noise = rng.normal(size=(len(episode), 1)), rng.normal(size=(len(episode), 5))
    state, bend = rng.normal(size=(len(episode), 30)), [0.3, -0.3, 0.3, -0.3, 0.3]
    x = np.column_stack([state, slope * np.arange(1, 6) + 0.02 * noise])
    bent = x + np.r_[np.zeros(30), bend]
    alone = fitted(x, episode)
    assert (alone.of(bent) > 1.0).mean() < 0.1
    novelty = fitted(x, episode, plan=slice(30, 35))
    assert (novelty.of(bent) > 1.0).mean() > 0.99
    assert (novelty.of(x) > 1.0).mean() < 0.01
    assert np.abs(novelty.contradictions(bent[0]))[:30].max() < 4.0
    assert np.abs(novelty.contradictions(bent[0]))[30:].max() > 10.0


def test_the_promised_share_of_other_safe_episodes_has_a_novel_input(novelty):
    x, episode = redundant(np.random.default_rng(3), num_episodes=2000)
    is_novel = novelty.of(x) > 1.0
    share = np.mean([is_novel[episode == i].any() for i in range(0, 2000, 2)])
    assert 0.01 < share < 0.12


def test_unsafe_episodes_widen_the_gaussian_and_not_the_limit():
    x, episode = redundant(np.random.default_rng(0))
    is_unsafe = episode % 4 == 0
    x[is_unsafe, :3] *= 3.0
    assert fitted(x, episode, is_unsafe).limits[0] < fitted(x, episode).limits[0]


def test_what_is_not_finite_is_infinitely_far_and_a_constant_is_no_division_by_zero(novelty):
    distance = novelty.of(np.array([[np.nan, 0.0, 0.0, 7.0], [0.0, 0.0, 0.0, 7.0]]))
    assert distance[0] == np.inf
    assert distance[1] < 0.5
    assert novelty.of(np.array([[0.0, 0.0, 0.0, 7.1]]))[0] > 1.0
    alike = fitted(np.tile([1.0, 2.0], (40, 1)), np.arange(40) // 2)
    np.testing.assert_array_equal(alike.of(np.array([[1.0, 2.0]])), [0.0])
    assert alike.of(np.array([[1.0, 3.0]]))[0] > 1.0
    # One episode gives no limit, and what is not finite is novel all the same.
    alone = fitted(*redundant(np.random.default_rng(0), num_episodes=1))
    assert np.isinf(alone.limits).all()
    np.testing.assert_array_equal(alone.of(np.array([[np.nan] * 4, [1e3] * 4])), [np.inf, 0.0])


def test_the_entry_that_contradicts_the_others_is_named(novelty):
    x = np.array([0.5, 50.0, 1.0, 7.0])
    assert np.abs(novelty.contradictions(x)).max() < 3.0
    found = np.abs(novelty.contradictions(x + [0.0, 0.0, 0.3, 0.0]))
    assert set(np.argsort(found)[1:]) == {0, 1, 2}  # Any of the three may be wrong.
    assert found[2] > 100.0


def test_moments_are_joined_as_if_all_inputs_had_been_given_at_once():
    x, _ = redundant(np.random.default_rng(0))
    joined, whole = Moments.of(x[:700]).joined(Moments.of(x[700:] + 1.0)), x.copy()
    whole[700:] += 1.0
    expected = Moments.of(whole)
    assert joined.count == expected.count
    np.testing.assert_allclose(joined.mean, expected.mean, rtol=1e-12)
    np.testing.assert_allclose(joined.covariance, expected.covariance, rtol=1e-9, atol=1e-9)


def test_what_an_actual_robot_did_is_known_after_adaptation(novelty):
    x, _ = redundant(np.random.default_rng(4), num_episodes=100)
    heavy = x + [30.0, 0.0, 30.0, 0.0]
    assert (novelty.of(heavy) > 1.0).all()
    adapted = novelty.with_feedback(heavy[:1000], 0.05)
    assert (adapted.of(heavy[1000:]) > 1.0).mean() < 0.05
    assert (adapted.of(x) > 1.0).mean() < 0.01
    # Other feedback replaces it, and what neither did is still novel. A robot like the nominal one
    # changes nothing.
    assert adapted.with_feedback(x, 0.05).feedback is None
    assert (adapted.with_feedback(x, 0.05).of(heavy) > 1.0).all()
    assert (adapted.of(x + [300.0, 0.0, 300.0, 0.0]) > 1.0).all()


@pytest.fixture(scope="module", params=["laikago_balancing", "atlas_reaching"])
def robot(request):
    scenario = load_scenario(request.param)
    loop = scenario.make_loop(**scenario.options_for("evaluation"))
    context = loop.CreateDefaultContext()
    rng = np.random.default_rng(5)
    rows = []
    for _ in range(30):
        loop.reset(context, rng)
        names = ("state", "desired_preview", "features")
        rows.append([loop.GetOutputPort(name).Eval(context).copy() for name in names])
    return request.param, [np.array(column) for column in zip(*rows, strict=True)]


@pytest.mark.parametrize("mode", ["sharpened", "paper"])
def test_shuffled_inputs_of_a_robot_are_unknown_in_every_output(robot, mode):
    name, parts = robot
    assessment = load_assessment(name, mode)
    known = assessment.predict(*parts)
    assert (known.novelty <= 1.0).mean() > 0.9
    rng = np.random.default_rng(0)
    result = assessment.predict(*(rng.permuted(part, axis=0) for part in parts))
    assert (result.novelty > 1.0).all()
    np.testing.assert_array_equal(result.belief, np.tile(EMPTY, (30, 1)))
    assert not result.probability.any()
    assert not result.cause_probability.any()


def test_the_strangest_input_of_a_robot_is_called_by_its_name(robot):
    name, parts = robot
    assessment = load_assessment(name, "sharpened")
    state, *others = (part[0] for part in parts)
    names = assessment.columns_.names
    assert len(names) == len(assessment.novelty_.training.mean)
    column = assessment.info_.state_names.index(assessment.info_.state_names[-1])
    found, deviation = assessment.strangest_input(
        state + 100.0 * np.eye(len(state))[column], *others
    )
    assert found == assessment.info_.state_names[-1]
    assert deviation > 30.0


def test_a_file_keeps_what_is_known_from_training_and_from_feedback(robot, tmp_path):
    name, _ = robot
    assessment = load_assessment(name, "paper")
    x = np.random.default_rng(0).normal(size=(50, len(assessment.novelty_.training.mean)))
    assessment.novelty_ = assessment.novelty_.with_feedback(10.0 + x, 0.01)
    assessment.save(tmp_path / "adapted.safetensors")
    loaded = SafetyAssessment.load(tmp_path / "adapted.safetensors").novelty_
    assert loaded.feedback.count == 50
    np.testing.assert_array_equal(loaded.of(x), assessment.novelty_.of(x))


@pytest.mark.parametrize("name", ["laikago_balancing", "atlas_reaching"])
def test_a_robot_that_is_lifted_or_lies_is_in_no_state_of_training(name):
    loop = load_scenario(name).make_loop()
    context = loop.CreateDefaultContext()
    start = loop.standing_start()
    on_its_side = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
    for orientation, height_m in ((start.q[:4], 1.5), (on_its_side, 0.2)):
        q = start.q.copy()
        q[:4], q[6] = orientation, height_m
        loop.reset_to(context, None, replace(start, q=q))
        parts = [
            loop.GetOutputPort(port).Eval(context)
            for port in ("state", "desired_preview", "features")
        ]
        for mode in ("sharpened", "paper"):
            result = load_assessment(name, mode).predict_one(*parts)
            assert result.novelty > 1.0
            np.testing.assert_array_equal(result.belief, EMPTY)
