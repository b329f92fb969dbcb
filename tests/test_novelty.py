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


def test_distances_are_those_of_whitened_inputs_with_bounded_variances():
    novelty = load_assessment("atlas_reaching").novelty_
    known, rng = novelty.training, np.random.default_rng(0)
    root = np.linalg.cholesky(known.covariance + 1e-12 * np.eye(len(known.mean)))
    x = known.mean + rng.normal(size=(200, len(root))) @ root.T
    x[100:] += rng.normal(size=(100, len(root))) * 10.0 ** rng.integers(-6, 6, size=(100, 1))
    expected = naive.whitened_distances(known, x, novelty.plan)
    half_width = np.maximum(0.5 * (known.largest - known.least), 0.05)  # A constant column's.
    outside = np.abs(x - 0.5 * (known.least + known.largest)) / half_width
    expected = np.column_stack([expected, outside.max(axis=1)])
    np.testing.assert_allclose(novelty.distances(x), expected, rtol=1e-6)
    np.testing.assert_allclose(novelty.of(x), (expected / novelty.limits).max(axis=1), rtol=1e-6)


def test_input_far_outside_the_range_is_novel_though_it_contradicts_nothing(novelty):
    along = np.array([[0.5, 50.0, 1.0, 0.0]])
    distances = novelty.distances(7.0 * np.eye(4)[3] + along * [[1.0], [20.0]]) / novelty.limits
    expected = [[False] * 4, [True, False, False, True]]
    np.testing.assert_array_equal(distances > 1.0, expected)


def test_entry_far_outside_its_range_is_novel_though_many_others_hide_it():
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


def test_contradiction_is_novel_and_named_though_every_entry_is_within_its_range(novelty):
    x, _ = redundant(np.random.default_rng(1))
    assert (novelty.of(x) > 1.0).mean() < 0.01
    shuffled = np.random.default_rng(2).permuted(x, axis=0)
    assert (novelty.of(shuffled) > 1.0).mean() > 0.9
    x = np.array([0.5, 50.0, 1.0, 7.0])
    assert np.abs(novelty.contradictions(x)).max() < 3.0
    size = np.abs(novelty.contradictions(x + [0.0, 0.0, 0.3, 0.0]))
    assert set(np.argsort(size)[1:]) == {0, 1, 2}  # Any of the three may be wrong.
    assert size[2] > 100.0


def test_plan_unlike_those_of_training_is_novel_whatever_the_state():
    rng = np.random.default_rng(0)
    episode = np.repeat(np.arange(EPISODES), ROWS)
    # A plan of five points is a line; one with a bend is within the range of every column.
    slope, noise = rng.normal(size=(len(episode), 1)), rng.normal(size=(len(episode), 5))
    state, bend = rng.normal(size=(len(episode), 30)), [0.3, -0.3, 0.3, -0.3, 0.3]
    x = np.column_stack([state, slope * np.arange(1, 6) + 0.02 * noise])
    bent = x + np.r_[np.zeros(30), bend]
    assert (fitted(x, episode).of(bent) > 1.0).mean() < 0.1
    novelty = fitted(x, episode, plan=slice(30, 35))
    assert (novelty.of(bent) > 1.0).mean() > 0.99
    assert (novelty.of(x) > 1.0).mean() < 0.01


def test_promised_share_of_other_safe_episodes_has_a_novel_input(novelty):
    x, episode = redundant(np.random.default_rng(3), num_episodes=1000)
    is_novel = novelty.of(x) > 1.0
    assert 0.01 < np.mean([is_novel[episode == i].any() for i in range(1000)]) < 0.12
    # Unsafe episodes widen the Gaussian and not the limit.
    x, episode = redundant(np.random.default_rng(0))
    is_unsafe = episode % 4 == 0
    x[is_unsafe, :3] *= 3.0
    assert fitted(x, episode, is_unsafe).limits[0] < fitted(x, episode).limits[0]


def test_what_is_not_finite_is_infinitely_far_and_a_constant_is_no_division_by_zero(novelty):
    distance = novelty.of(np.array([[np.nan, 0.0, 0.0, 7.0], [0.0, 0.0, 0.0, 7.0]]))
    assert distance[0] == np.inf and distance[1] < 0.5
    assert novelty.of(np.array([[0.0, 0.0, 0.0, 7.1]]))[0] > 1.0
    alike = fitted(np.tile([1.0, 2.0], (40, 1)), np.arange(40) // 2)
    np.testing.assert_array_equal(alike.of(np.array([[1.0, 2.0]])), [0.0])
    assert alike.of(np.array([[1.0, 3.0]]))[0] > 1.0
    # One episode gives no limit, and what is not finite is novel all the same.
    alone = fitted(*redundant(np.random.default_rng(0), num_episodes=1))
    assert np.isinf(alone.limits).all()
    np.testing.assert_array_equal(alone.of(np.array([[np.nan] * 4, [1e3] * 4])), [np.inf, 0.0])


def test_actual_robots_inputs_are_known_after_adaptation(novelty):
    x, _ = redundant(np.random.default_rng(4), num_episodes=100)
    heavy = x + [30.0, 0.0, 30.0, 0.0]
    assert (novelty.of(heavy) > 1.0).all()
    adapted = novelty.with_feedback(heavy[:1000], 0.05)
    assert (adapted.of(heavy[1000:]) > 1.0).mean() < 0.05
    assert (adapted.of(x) > 1.0).mean() < 0.01
    assert (adapted.of(x + [300.0, 0.0, 300.0, 0.0]) > 1.0).all()
    # Other feedback replaces it; a robot like the nominal one changes nothing.
    assert adapted.with_feedback(x, 0.05).feedback is None
    # Moments are joined as if all inputs had been given at once.
    joined, expected = Moments.of(x).joined(Moments.of(heavy)), Moments.of(np.vstack([x, heavy]))
    for name, value in vars(expected).items():
        np.testing.assert_allclose(getattr(joined, name), value, rtol=1e-9, atol=1e-9)


def test_shuffled_inputs_of_a_robot_are_unknown_in_every_output():
    assessment, scenario = load_assessment("laikago_balancing"), load_scenario("laikago_balancing")
    loop = scenario.make_loop(**scenario.options_for("evaluation"))
    context, rng, rows = loop.CreateDefaultContext(), np.random.default_rng(5), []
    for _ in range(30):
        loop.reset(context, rng)
        names = ("state", "desired_preview", "features")
        rows.append([loop.GetOutputPort(name).Eval(context).copy() for name in names])
    inputs = [np.array(column) for column in zip(*rows, strict=True)]
    assert (assessment.predict(*inputs).novelty <= 1.0).mean() > 0.9
    rng = np.random.default_rng(0)
    result = assessment.predict(*(rng.permuted(part, axis=0) for part in inputs))
    assert (result.novelty > 1.0).all()
    np.testing.assert_array_equal(result.belief, np.tile(EMPTY, (30, 1)))
    assert not result.probability.any() and not result.cause_probability.any()
    # The strangest input is called by its name.
    state, *others = (part[0] for part in inputs)
    last = assessment.info_.state_names[-1]
    name, deviation = assessment.strangest_input(state + 100.0 * np.eye(len(state))[-1], *others)
    assert name == last and deviation > 30.0


def test_file_keeps_what_is_known_from_training_and_from_feedback(tmp_path):
    assessment = load_assessment("laikago_balancing", "paper")
    x = np.random.default_rng(0).normal(size=(50, len(assessment.novelty_.training.mean)))
    assessment.novelty_ = assessment.novelty_.with_feedback(10.0 + x, 0.01)
    assessment.save(tmp_path / "adapted.safetensors")
    loaded = SafetyAssessment.load(tmp_path / "adapted.safetensors").novelty_
    assert loaded.feedback.count == 50
    np.testing.assert_array_equal(loaded.of(x), assessment.novelty_.of(x))
