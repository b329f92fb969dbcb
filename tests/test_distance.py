from dataclasses import replace

import numpy as np
import pytest

import naive
from drake_safety.learning import distance
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.distance import neighbour_graph
from drake_safety.learning.grid import Grid
from drake_safety.learning.inputs import InputColumns
from drake_safety.learning.maps import learned_maps
from drake_safety.learning.points import embedded_points
from drake_safety.learning.segments import split, training_segments
from lip_episodes import make_episodes

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def segments():
    return split(make_episodes(30), stride=4, discount=0.99)


@pytest.fixture(scope="module")
def warping(segments):
    return {
        cost: naive.dtw(segments.error, segments.length, cost) for cost in distance.WARPING_COSTS
    }


def dtw_matrix(error, length, **options):
    """DTW of every pair, which a graph of neighbours never holds."""
    series = [one[:count] for one, count in zip(error, length, strict=True)]
    return distance._dtw(series, range(len(error)), range(len(error)), **options)


def graph_of(segments, **changes):
    options = {"score_weight": 0.05, "num_neighbours": 15, "cost": "rooted"} | changes
    return neighbour_graph(segments.error, segments.length, segments.score, **options)


def test_dtw_is_the_value_worked_by_hand_and_symmetric(segments):
    # (0, 1, 2) against (0, 2): 0-0, 1-0 or 1-2 at cost 1, 2-2
    error = np.array([[[0.0], [1.0], [2.0]], [[0.0], [2.0], [99.0]]])
    for backend in distance.BACKENDS:
        matrix = dtw_matrix(error, np.array([3, 2]), backend=backend)
        np.testing.assert_allclose(matrix, [[0.0, 1.0], [1.0, 0.0]])
    assert np.any(segments.length < segments.error.shape[1])
    matrix = dtw_matrix(segments.error, segments.length)
    np.testing.assert_array_equal(matrix, matrix.T)
    np.testing.assert_array_equal(np.diag(matrix), 0.0)


WAYS = [*(("dtaidistance", cost) for cost in distance.WARPING_COSTS), ("tslearn", "rooted")]


@pytest.mark.parametrize("rows", [32, 7])
@pytest.mark.parametrize("score_weight", [0.0, 0.01, 0.5])
def test_among_all_segments_the_graph_holds_exactly_the_nearest_neighbours(
    segments, warping, rows, score_weight, monkeypatch
):
    monkeypatch.setattr(distance, "_ROWS", rows)
    monkeypatch.setattr(distance, "_BLOCK", 4 * rows)
    unlike = np.abs(segments.score[:, None] - segments.score)
    for backend, cost in WAYS:
        seen, options = [], {"score_weight": score_weight, "cost": cost}
        graph = graph_of(segments, **options, backend=backend, progress=seen.append)
        assert seen == sorted(seen) and seen[-1] == 1.0
        assert all(len(set(row)) == 15 for row in graph.indices.tolist())
        assert graph.max_dtw == pytest.approx(warping[cost].max(), rel=1e-12)
        omega = warping[cost] / warping[cost].max() + score_weight * unlike
        np.fill_diagonal(omega, np.inf)
        nearest = np.sort(omega, axis=1)[:, :15]
        np.testing.assert_allclose(graph.distances, nearest, atol=1e-12)
        found = np.take_along_axis(omega, graph.indices, axis=1)  # Infinite for itself.
        np.testing.assert_allclose(found, nearest, atol=1e-12)


@pytest.mark.parametrize(
    ("cost", "score_weight"),
    [("squared", 0.0), ("squared", 0.5), ("rooted", 0.01), ("absolute", 0.01)],
)
def test_candidates_with_the_smallest_bounds_hold_most_of_the_neighbours(cost, score_weight):
    segments = split(make_episodes(150), stride=2, discount=0.99)
    options = {"cost": cost, "score_weight": score_weight}
    exact = graph_of(segments, **options)
    found = graph_of(segments, **options, num_candidates=30)
    assert len(segments) > 40 * 30
    assert found.max_dtw == exact.max_dtw
    # No candidate is nearer than a neighbour, and the distances are not the bounds.
    assert np.all(found.distances >= exact.distances - 1e-12)
    pairs = zip(found.indices, exact.indices, strict=True)
    share = np.mean([np.isin(a, b, assume_unique=True).mean() for a, b in pairs])
    assert share > 0.9
    every = graph_of(segments, **options, num_candidates=len(segments) - 1)
    np.testing.assert_array_equal(every.indices, exact.indices)


def test_the_costs_of_a_path_are_the_values_worked_by_hand():
    # (0, 3) against (1, 1): 0-1 at 1, 3-1 at 2.
    error = np.array([[[0.0], [3.0]], [[1.0], [1.0]], [[9.0], [9.0]]])
    found = {}
    for cost in distance.WARPING_COSTS:
        graph = neighbour_graph(
            error, np.full(3, 2), np.zeros(3), score_weight=0.0, num_neighbours=1, cost=cost
        )
        found[cost] = float(graph.distances[0, 0] * graph.max_dtw)
    expected = {"squared": 5.0, "rooted": 5.0**0.5, "absolute": 3.0}
    assert found == pytest.approx(expected)


def test_a_user_chooses_what_computes_dtw_and_learns_the_same(monkeypatch):
    episodes, learned, asked = make_episodes(40), {}, []
    import tslearn.metrics

    cdist = tslearn.metrics.cdist_dtw
    monkeypatch.setattr(tslearn.metrics, "cdist_dtw", lambda *of: asked.append(of) or cdist(*of))
    for backend in distance.BACKENDS:
        parameters = AssessmentParameters(
            distance_backend=backend, mode="paper", perplexity=5.0, epochs=1
        )
        segments = training_segments(episodes, parameters)
        points = embedded_points(segments, Grid(resolution=14, cell_length=10.0), parameters)
        columns = InputColumns(episodes.info, parameters)
        learned[backend], *_ = learned_maps(segments, points, columns, parameters)
        assert bool(asked) == (backend == "tslearn")
    assert learned["tslearn"].is_same(learned["dtaidistance"])


def test_the_largest_dtw_is_found_though_the_euclidean_bound_misleads():
    # Shifted copies of one pulse lie far apart in the Euclidean sense and at DTW zero.
    pulses = np.array([np.eye(12)[i] for i in range(1, 11)])
    error = np.vstack([pulses, np.full((1, 12), 0.4), np.zeros((200, 12))])[:, :, None]
    length = np.full(len(error), 12)
    score = np.zeros(len(error))
    graph = neighbour_graph(error, length, score, score_weight=0.0, num_neighbours=3, cost="rooted")
    assert graph.max_dtw == pytest.approx(naive.dtw(error, length).max(), rel=1e-12)


def test_identical_segments_are_at_distance_zero_of_each_other():
    error = np.zeros((20, 5, 2))
    graph = neighbour_graph(error, np.full(20, 5), np.zeros(20), score_weight=0.1, num_neighbours=4)
    assert graph.max_dtw == 0.0
    np.testing.assert_array_equal(graph.distances, 0.0)


def test_a_graph_that_cannot_be_is_refused(segments):
    with pytest.raises(ValueError, match="'tslearn' has no cost 'absolute'"):
        graph_of(segments, backend="tslearn", cost="absolute")
    unknown = replace(segments, error=np.full_like(segments.error, np.nan))
    with pytest.raises(ValueError, match="not finite"):
        graph_of(unknown)
