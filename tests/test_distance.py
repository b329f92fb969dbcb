import numpy as np
import pytest

import naive
from drake_safety.learning import distance
from drake_safety.learning.distance import neighbour_graph
from drake_safety.learning.segments import split
from lip_episodes import make_episodes

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def segments():
    return split(make_episodes(30), stride=4, discount=0.99)


@pytest.fixture(scope="module")
def warping(segments):
    return naive.dtw(segments.error, segments.length)


def graph_of(segments, **changes):
    options = {"score_weight": 0.05, "num_neighbours": 15} | changes
    return neighbour_graph(segments.error, segments.length, segments.score, **options)


@pytest.mark.parametrize("backend", distance.BACKENDS)
@pytest.mark.parametrize("rows", [32, 7])
@pytest.mark.parametrize("score_weight", [0.0, 0.01, 0.5])
def test_graph_of_all_candidates_holds_exactly_the_nearest_neighbours(
    segments, warping, rows, score_weight, backend, monkeypatch
):
    monkeypatch.setattr(distance, "_ROWS", rows)
    monkeypatch.setattr(distance, "_BLOCK", 4 * rows)
    unlike = np.abs(segments.score[:, None] - segments.score)
    done = []
    graph = graph_of(segments, score_weight=score_weight, backend=backend, progress=done.append)
    assert done == sorted(done) and done[-1] == 1.0
    assert all(len(set(row)) == 15 for row in graph.indices.tolist())
    assert graph.max_dtw == pytest.approx(warping.max(), rel=1e-12)
    omega = warping / warping.max() + score_weight * unlike
    np.fill_diagonal(omega, np.inf)
    nearest = np.sort(omega, axis=1)[:, :15]
    np.testing.assert_allclose(graph.distances, nearest, atol=1e-12)
    of_graph = np.take_along_axis(omega, graph.indices, axis=1)  # Infinite for itself.
    np.testing.assert_allclose(of_graph, nearest, atol=1e-12)


@pytest.mark.parametrize("score_weight", [0.0, 0.5])
def test_candidates_with_the_smallest_bounds_hold_most_of_the_neighbours(score_weight):
    segments = split(make_episodes(100), stride=2, discount=0.99)
    exact = graph_of(segments, score_weight=score_weight)
    graph = graph_of(segments, score_weight=score_weight, num_candidates=30)
    assert len(segments) > 30 * 30
    assert graph.max_dtw == exact.max_dtw
    # No candidate is nearer than a neighbour, and the distances are not the bounds.
    assert np.all(graph.distances >= exact.distances - 1e-12)
    pairs = zip(graph.indices, exact.indices, strict=True)
    share = np.mean([np.isin(a, b, assume_unique=True).mean() for a, b in pairs])
    assert share > 0.9


def test_cost_of_a_path_is_the_sum_of_squares_worked_by_hand():
    # (0, 3) against (1, 1): 0-1 at 1, 3-1 at 2.
    error = np.array([[[0.0], [3.0]], [[1.0], [1.0]], [[9.0], [9.0]]])
    graph = neighbour_graph(error, np.full(3, 2), np.zeros(3), score_weight=0.0, num_neighbours=1)
    assert float(graph.distances[0, 0] * graph.max_dtw) == pytest.approx(5.0)


def test_largest_dtw_is_found_though_euclidean_bound_misleads():
    # Shifted copies of one pulse lie far apart in the Euclidean sense and at DTW zero.
    pulses = np.array([np.eye(12)[i] for i in range(1, 11)])
    error = np.vstack([pulses, np.full((1, 12), 0.4), np.zeros((200, 12))])[:, :, None]
    length, score = np.full(len(error), 12), np.zeros(len(error))
    graph = neighbour_graph(error, length, score, score_weight=0.0, num_neighbours=3)
    assert graph.max_dtw == pytest.approx(naive.dtw(error, length).max(), rel=1e-12)
