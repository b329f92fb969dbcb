"""The safety distance Omega between segments, as a graph of nearest neighbours.

The paper names "the dynamic time warping operator" without a definition. `WARPING_COSTS` are the
definitions in use: the sum of squared distances along the warping path, its root (tslearn,
dtaidistance), and the sum of distances (fastdtw).

Two exact bounds make the graph cheap. The Euclidean distance of two error sequences, the shorter
one held at its last value, is the cost of one admissible warping path and so bounds DTW from above;
it gives each segment a radius that contains its neighbours. Sorted by that radius, a block of
segments needs DTW only up to its own largest radius, and dtaidistance's C implementation abandons
a pair as soon as it exceeds it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

BACKENDS = ("dtaidistance", "tslearn")
WARPING_COSTS = ("squared", "rooted", "absolute")
"""Cost of a warping path: sum ||.||^2, its square root, or sum ||.||."""

_BLOCK = 512
_SLACK = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class NeighbourGraph:
    """The nearest neighbours of each segment under Omega, nearest first, itself excluded.

    Attributes:
        indices: Neighbours, (N, k).
        distances: Omega to each neighbour, (N, k), dimensionless.
        max_dtw: w_max, the largest DTW distance over all pairs [unit of the errors; its square for
            the cost "squared"].
    """

    indices: np.ndarray
    distances: np.ndarray
    max_dtw: float


def neighbour_graph(
    error: np.ndarray,
    length: np.ndarray,
    score: np.ndarray,
    *,
    score_weight: float,
    num_neighbours: int,
    cost: str = "squared",
    backend: str = "dtaidistance",
    progress: Callable[[float], None] | None = None,
) -> NeighbourGraph:
    """Finds the exact nearest neighbours under the safety distance Omega.

    Args:
        error: Error sequences z* - z [m], each held at its last value beyond its length, (N, H,
            n_z).
        length: Number of valid samples of each sequence, (N,).
        score: Unsafety scores lambda, (N,).
        score_weight: delta, the weight of a score difference.
        num_neighbours: k, below N.
        cost: One of `WARPING_COSTS`.
        backend: "dtaidistance", or "tslearn", which ignores the bounds and has no "absolute" cost.
        progress: Called with the fraction done.

    Returns:
        The graph, with distances Omega = DTW / w_max + delta |lambda_i - lambda_j|.

    Raises:
        ValueError: Unknown backend or cost, errors that are not finite, or too few segments.
    """
    for name, value, known in (("backend", backend, BACKENDS), ("cost", cost, WARPING_COSTS)):
        if value not in known:
            raise ValueError(f"distance: unknown {name} '{value}'; it is one of {list(known)}")
    if backend == "tslearn" and cost == "absolute":
        raise ValueError("distance: the backend 'tslearn' has no cost 'absolute'")
    error = np.asarray(error, dtype=float)
    score = np.asarray(score, dtype=float)
    num_segments = len(error)
    if not 0 < num_neighbours < num_segments:
        raise ValueError(
            f"neighbour_graph: got {num_neighbours} neighbours among {num_segments} segments, "
            "expected fewer neighbours than segments"
        )
    if not np.all(np.isfinite(error)):
        raise ValueError("neighbour_graph: the errors contain values that are not finite")
    series = _series(error, length)
    held = _hold_last(error, length)
    # Omega is 1 / w_max * DTW ** power; bounds and DTW itself are those without the power.
    power = 2.0 if cost == "squared" else 1.0
    # sum ||.|| over H pairs is at most sqrt(H) times the root of sum ||.||^2.
    looseness = np.sqrt(error.shape[1]) if cost == "absolute" else 1.0
    dtw = partial(_dtw_block, backend=backend, is_absolute=cost == "absolute")
    largest = _max_dtw(series, held, dtw, looseness)
    scale = largest**-power if largest > 0.0 else 0.0
    radius = np.empty(num_segments)
    for rows, bound in _euclidean_blocks(held):
        bound *= looseness
        bound **= power
        bound *= scale
        bound += score_weight * np.abs(score[rows, None] - score)
        bound[np.arange(len(bound)), np.arange(rows.start, rows.stop)] = np.inf
        radius[rows] = np.partition(bound, num_neighbours - 1, axis=1)[:, num_neighbours - 1]
    radius *= 1.0 + _SLACK

    order = np.argsort(radius, kind="stable")
    radius, sorted_score = radius[order], score[order]
    series = [series[i] for i in order]
    distances = np.full((num_segments, num_neighbours), np.inf)
    indices = np.full((num_segments, num_neighbours), -1)
    for start in range(0, num_segments, _BLOCK):
        stop = min(start + _BLOCK, num_segments)
        limit = radius[stop - 1] ** (1.0 / power) * largest * (1.0 + _SLACK)
        omega = dtw(series, slice(0, stop), slice(start, stop), limit=limit)
        # Omega^ij = w^ij / w_max + delta |lambda^i - lambda^j|
        omega **= power
        omega *= scale
        omega += score_weight * np.abs(sorted_score[:stop, None] - sorted_score[start:stop])
        omega[np.arange(start, stop), np.arange(stop - start)] = np.inf
        columns = np.broadcast_to(np.arange(stop), (stop - start, stop))
        _keep_nearest(distances, indices, np.arange(start, stop), omega.T, columns)
        earlier = np.flatnonzero(np.any(omega[:start] <= radius[:start, None], axis=1))
        columns = np.broadcast_to(np.arange(start, stop), (len(earlier), stop - start))
        _keep_nearest(distances, indices, earlier, omega[earlier], columns)
        if progress is not None:
            progress((stop / num_segments) ** 2)
    original = order[indices]
    rank = np.lexsort((original, distances), axis=1)
    result_indices, result_distances = np.empty_like(original), np.empty_like(distances)
    result_indices[order] = np.take_along_axis(original, rank, axis=1)
    result_distances[order] = np.take_along_axis(distances, rank, axis=1)
    return NeighbourGraph(
        indices=result_indices, distances=result_distances, max_dtw=largest**power
    )


def _series(error: np.ndarray, length: np.ndarray) -> list[np.ndarray]:
    return [
        np.ascontiguousarray(sequence[:count], dtype=float)
        for sequence, count in zip(error, length, strict=True)
    ]


def _hold_last(error: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Each sequence with its last counted sample repeated, flattened, (N, H*n_z)."""
    steps = np.minimum(np.arange(error.shape[1]), np.asarray(length)[:, None] - 1)
    return np.take_along_axis(error, steps[:, :, None], axis=1).reshape(len(error), -1)


def _dtw_block(
    series: list[np.ndarray],
    rows: slice,
    columns: slice,
    *,
    backend: str = BACKENDS[0],
    is_absolute: bool = False,
    limit: float = np.inf,
) -> np.ndarray:
    """DTW of `rows` against `columns`, sqrt(sum ||.||^2) or, if absolute, sum ||.||.

    Values above `limit` may be infinite.
    """
    if backend == "tslearn":
        from tslearn.metrics import cdist_dtw
        from tslearn.utils import to_time_series_dataset

        sides = (to_time_series_dataset(series[part]) for part in (rows, columns))
        return np.asarray(cdist_dtw(*sides))
    from dtaidistance import dtw_ndim

    distances = dtw_ndim.distance_matrix_fast(
        series,
        ndim=series[0].shape[1],
        block=((rows.start, rows.stop), (columns.start, columns.stop), False),
        max_dist=max(limit, np.finfo(float).tiny) if np.isfinite(limit) else None,
        compact=True,
        parallel=True,
        inner_dist="euclidean" if is_absolute else "squared euclidean",
    )
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    return np.frombuffer(distances, dtype=float).reshape(shape).copy()


def _euclidean_blocks(held: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
    """Row blocks of the Euclidean distance matrix, rounded up."""
    squares = np.einsum("ij,ij->i", held, held)
    for start in range(0, len(held), _BLOCK):
        rows = slice(start, min(start + _BLOCK, len(held)))
        block = held[rows] @ held.T
        block *= -2.0
        block += (1.0 + 1e-12) * squares[rows, None]
        block += (1.0 + 1e-12) * squares
        np.maximum(block, 0.0, out=block)
        yield rows, np.sqrt(block, out=block)


def _max_dtw(
    series: list[np.ndarray],
    held: np.ndarray,
    dtw: Callable[..., np.ndarray],
    looseness: float,
) -> float:
    """Largest DTW over all pairs, with DTW only where its bound exceeds the largest yet."""
    by_size = np.argsort(-np.linalg.norm(held - held.mean(axis=0), axis=1), kind="stable")
    held = held[by_size] - held.mean(axis=0)
    first = [series[i] for i in by_size[:64]]
    largest = float(dtw(first, slice(0, len(first)), slice(0, len(first))).max())
    for rows, bound in _euclidean_blocks(held):
        is_open = looseness * bound > largest
        is_open[:, : rows.start] = False
        open_rows = rows.start + np.flatnonzero(is_open.any(axis=1))
        open_columns = np.flatnonzero(is_open.any(axis=0))
        for first_column in range(0, len(open_columns), 8 * _BLOCK):
            chosen = open_columns[first_column : first_column + 8 * _BLOCK]
            pool = [series[by_size[i]] for i in (*open_rows, *chosen)]
            split = len(open_rows)
            block = dtw(pool, slice(0, split), slice(split, len(pool)))
            largest = max(largest, float(block.max()))
    return largest


def _keep_nearest(
    distances: np.ndarray,
    indices: np.ndarray,
    rows: np.ndarray,
    candidates: np.ndarray,
    candidate_indices: np.ndarray,
) -> None:
    """Merges candidates (M, c) into the k nearest neighbours of `rows` (M,), in place."""
    if len(rows) == 0:
        return
    num_neighbours = distances.shape[1]
    pool = np.concatenate([distances[rows], candidates], axis=1)
    pool_indices = np.concatenate([indices[rows], candidate_indices], axis=1)
    nearest = np.argpartition(pool, num_neighbours - 1, axis=1)[:, :num_neighbours]
    distances[rows] = np.take_along_axis(pool, nearest, axis=1)
    indices[rows] = np.take_along_axis(pool_indices, nearest, axis=1)
