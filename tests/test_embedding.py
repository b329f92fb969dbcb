from dataclasses import replace

import numpy as np
import pytest

from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.distance import neighbour_graph
from drake_safety.learning.maps import stack_members, train_map
from drake_safety.learning.points import tsne
from drake_safety.learning.segments import split
from drake_safety.learning.trained_maps import Embedding
from lip_assessments import map_data
from lip_episodes import make_episodes

pytestmark = pytest.mark.train

SETTINGS = AssessmentParameters(
    hidden_sizes=[32, 32],
    dropout=0.0,
    epochs=30,
    batch_size=64,
    learning_rate=5e-3,
    target_weight=1.0,
    safety_weight=1.0,
    margin_weight=1.0,
    margin_unit=0.02,
    margin_range=[-0.03, 0.10],
)

PLAIN = {"exaggeration": 1.0}


@pytest.fixture(scope="module")
def graph():
    segments = split(make_episodes(80), stride=5, discount=0.99)
    return segments, neighbour_graph(
        segments.error, segments.length, segments.score, score_weight=0.1, num_neighbours=30
    )


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
    members = [train_map(data, SETTINGS, seed=seed) for seed in (0, 1)]
    return stack_members(members, num_margins=1)


def test_tsne_puts_neighbours_of_the_graph_near_each_other(graph):
    segments, neighbours = graph
    points = tsne(neighbours, perplexity=10, **PLAIN, seed=0)
    to_neighbours = np.linalg.norm(points[:, None] - points[neighbours.indices[:, :5]], axis=2)
    rng = np.random.default_rng(0)
    to_others = np.linalg.norm(points - points[rng.permutation(len(points))], axis=1)
    assert points.shape == (len(segments), 2)
    assert np.median(to_neighbours) < 0.2 * np.median(to_others)


def test_tsne_gives_the_same_bits_for_the_same_seed(graph):
    first, again, other = (tsne(graph[1], perplexity=10, **PLAIN, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_map_reproduces_its_targets_also_where_it_saw_none(data, embedding):
    points = embedding.embed(data.x)
    expected = np.column_stack([20.0 * data.x[:, 0], 2.0 * (data.x[:, 1] - 5.0)])
    for member in points:
        error = np.linalg.norm(member - expected, axis=1)
        assert np.median(error[~data.has_target]) < 0.1 * expected.std()


def test_a_map_predicts_safety_and_margins_in_their_own_unit(data, embedding):
    output = embedding.evaluate(data.x)
    is_clear = np.abs(data.x[:, 0] - 0.5) > 0.2
    for logit, margins in zip(output.unsafe_logit, output.margins, strict=True):
        agrees = (logit > 0.0) == data.is_unsafe
        assert agrees[is_clear].mean() > 0.98
        clipped = np.clip(data.margins[:, 0], *SETTINGS.margin_range)
        assert np.median(np.abs(margins[:, 0] - clipped)) < 0.003


def test_numpy_evaluates_what_torch_trained(data):
    import torch

    embedding = stack_members([train_map(data, SETTINGS, seed=5)], num_margins=1)
    weights = {name: torch.from_numpy(w[0].copy()) for name, w in embedding.weights.items()}
    z = torch.from_numpy(data.x.astype(np.float32))
    for layer in ("trunk.0", "trunk.1"):
        z = torch.relu(z @ weights[f"{layer}.weight"] + weights[f"{layer}.bias"])
    z = z @ weights["output.weight"] + weights["output.bias"]
    np.testing.assert_allclose(embedding.embed(data.x)[0], z[:, :2].numpy(), atol=1e-3)


def test_training_gives_the_same_weights_for_the_same_seed_and_leaves_torchs_state_alone(data):
    import torch

    state, num_threads = torch.get_rng_state(), torch.get_num_threads()
    first, again = (train_map(data, SETTINGS, seed=7) for _ in range(2))
    assert torch.equal(state, torch.get_rng_state())
    assert num_threads == torch.get_num_threads()
    for name in first:
        np.testing.assert_array_equal(first[name], again[name])


def test_a_sample_weight_draws_the_map_towards_its_samples(data):
    contrary = np.arange(600) < 40
    is_unsafe = np.where(contrary, ~data.is_unsafe, data.is_unsafe)
    x = data.x.copy()
    x[contrary, 2] += 2.0
    settings = AssessmentParameters(**{**vars(SETTINGS), "epochs": 4})
    agreement = []
    for weight in (0.01, 20.0):
        sample_weight = np.where(contrary, weight, 1.0)
        changed = replace(data, x=x, is_unsafe=is_unsafe, sample_weight=sample_weight)
        trained = train_map(changed, settings, seed=0)
        logit = stack_members([trained], num_margins=1).evaluate(x[contrary]).unsafe_logit[0]
        agreement.append(((logit > 0.0) == is_unsafe[contrary]).mean())
    assert agreement[1] > agreement[0]


def test_a_row_that_is_not_finite_gives_nan_and_leaves_the_others_alone(data, embedding):
    x = data.x[:4].copy()
    x[1, 2], x[2, 0] = np.nan, np.inf
    output = embedding.evaluate(x)
    assert np.all(np.isnan(output.embedding[:, 1:3]))
    assert np.all(np.isnan(output.unsafe_logit[:, 1:3]))
    np.testing.assert_allclose(output.embedding[:, ::3], embedding.embed(data.x[:4])[:, ::3])


def test_an_input_beyond_the_range_is_that_at_its_edge(embedding):
    x = np.array([[9.0, 5.0, 1.0, -9.0], [0.1, 4.0, 1.1, 2.0]])
    low, high = [-1.0, 0.0, 0.5, -2.0], [1.0, 8.0, 1.5, 3.0]
    clipping = embedding.clipping(np.array([low, high]))
    edge = np.array([[1.0, 5.0, 1.0, -2.0], [0.1, 4.0, 1.1, 2.0]])
    np.testing.assert_array_equal(clipping.embed(x), clipping.embed(edge))
    np.testing.assert_allclose(clipping.embed(x), embedding.embed(edge), rtol=1e-3)
    np.testing.assert_array_equal(clipping.activations(x), clipping.activations(edge))
    assert np.abs(embedding.embed(x)[:, 0] - embedding.embed(edge)[:, 0]).min() > 1.0
    assert not clipping.is_same(embedding)
    np.testing.assert_array_equal(clipping.scaled(np.ones(2)).embed(x), clipping.embed(x))
    logit, gradient = clipping.logit_gradient(x)
    expected_logit, expected = embedding.logit_gradient(edge)
    np.testing.assert_allclose(logit, expected_logit)
    assert (gradient[0, [0, 3]] == 0.0).all()
    np.testing.assert_array_equal(gradient[0, 1:3], expected[0, 1:3])
    np.testing.assert_array_equal(gradient[1], expected[1])


def without_bias(embedding):
    return {name: w for name, w in embedding.weights.items() if name != "output.bias"}


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda e: e.weights["output.bias"].fill(0.0), "read-only"),
        (lambda e: e.evaluate(np.zeros((2, 3))), r"inputs have shape \(2, 3\), expected \(N, 4\)"),
        (lambda e: e.clipping(np.zeros((2, 3))), r"range of .* shape \(2, 3\), expected \(2, 4\)"),
        (lambda e: Embedding(without_bias(e), num_margins=1), r"output\.bias"),
    ],
)
def test_what_does_not_fit_the_maps_is_refused(embedding, ask, message):
    with pytest.raises(ValueError, match=message):
        ask(embedding)
