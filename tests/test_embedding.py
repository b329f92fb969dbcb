from dataclasses import replace

import numpy as np
import pytest

from drake_safety.learning.assessment_parameters import AssessmentParameters, PaperReading
from drake_safety.learning.distance import neighbour_graph
from drake_safety.learning.maps import stack_members, train_map
from drake_safety.learning.points import tsne
from drake_safety.learning.segments import split
from drake_safety.learning.trained_maps import Embedding
from lip_assessments import map_data
from lip_episodes import make_episodes

pytestmark = pytest.mark.train

OPTIONS = {"hidden_sizes": [32, 32], "dropout": 0.0, "epochs": 30}
SETTINGS = AssessmentParameters(batch_size=64, learning_rate=5e-3, **OPTIONS)


@pytest.fixture(scope="module")
def data():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(600, 4)) * [1.0, 10.0, 0.1, 1.0] + [0.0, 5.0, 1.0, 0.0]
    x[:, 3] = 2.0
    target = np.column_stack([20.0 * x[:, 0], 2.0 * (x[:, 1] - 5.0)])
    has_target = rng.uniform(size=600) < 0.5
    data = map_data(x, target[has_target], has_target=has_target)
    return replace(data, is_unsafe=x[:, 0] > 0.5, margins=0.02 * (0.5 - x[:, :1]))


@pytest.fixture(scope="module")
def embedding(data):
    return stack_members([train_map(data, SETTINGS, seed=seed) for seed in (0, 1)])


def test_tsne_puts_neighbours_near_each_other_the_same_for_a_seed():
    segments = split(make_episodes(50), stride=5, discount=0.99)
    graph = neighbour_graph(
        segments.error, segments.length, segments.score, score_weight=0.1, num_neighbours=30
    )
    points, again, other = (
        tsne(graph, perplexity=10, exaggeration=1.0, seed=seed) for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(points, again)
    assert not np.array_equal(points, other)
    to_neighbours = np.linalg.norm(points[:, None] - points[graph.indices[:, :5]], axis=2)
    shuffled = points[np.random.default_rng(0).permutation(len(points))]
    to_others = np.linalg.norm(points - shuffled, axis=1)
    assert np.median(to_neighbours) < 0.2 * np.median(to_others)


def test_papers_map_reproduces_its_targets_also_where_it_has_none(data):
    reading = PaperReading(standardized=True, **OPTIONS)
    trained = train_map(data, replace(SETTINGS, mode="paper", paper=reading), seed=0)
    expected = np.column_stack([20.0 * data.x[:, 0], 2.0 * (data.x[:, 1] - 5.0)])
    error = np.linalg.norm(stack_members([trained]).embed(data.x)[0] - expected, axis=1)
    assert np.median(error[~data.has_target]) < 0.1 * expected.std()


def test_training_gives_the_same_weights_for_a_seed_and_leaves_torchs_state_alone(data):
    import torch

    quick = replace(SETTINGS, epochs=3)
    state, num_threads = torch.get_rng_state(), torch.get_num_threads()
    first, again = (train_map(data, quick, seed=7) for _ in range(2))
    assert torch.equal(state, torch.get_rng_state())
    assert num_threads == torch.get_num_threads()
    for name in first:
        np.testing.assert_array_equal(first[name], again[name])


def test_input_beyond_the_range_is_clipped_to_its_edge(embedding):
    x = np.array([[9.0, 5.0, 1.0, -9.0], [0.1, 4.0, 1.1, 2.0]])
    low, high = [-1.0, 0.0, 0.5, -2.0], [1.0, 8.0, 1.5, 3.0]
    clipping = Embedding(embedding.weights, np.array([low, high]))
    edge = np.array([[1.0, 5.0, 1.0, -2.0], [0.1, 4.0, 1.1, 2.0]])
    np.testing.assert_array_equal(clipping.embed(x), clipping.embed(edge))
    np.testing.assert_allclose(clipping.embed(x), embedding.embed(edge), rtol=1e-3)
    np.testing.assert_array_equal(clipping.activations(x), clipping.activations(edge))
    assert np.abs(embedding.embed(x)[:, 0] - embedding.embed(edge)[:, 0]).min() > 1.0
    assert not clipping.is_same(embedding)
    logit, gradient = clipping.logit_gradient(x)
    expected_logit, expected = embedding.logit_gradient(edge)
    np.testing.assert_allclose(logit, expected_logit)
    expected[0, [0, 3]] = 0.0  # Clipped.
    np.testing.assert_array_equal(gradient, expected)


def test_what_does_not_fit_the_maps_is_refused(embedding):
    with pytest.raises(ValueError, match="read-only"):
        embedding.weights["output.bias"].fill(0.0)
    with pytest.raises(ValueError, match=r"inputs have shape \(2, 3\), expected \(N, 4\)"):
        embedding.evaluate(np.zeros((2, 3)))
