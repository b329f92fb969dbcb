"""The safety distance Omega between segments, as a graph of nearest neighbours.

The paper names "the dynamic time warping operator" without a definition. Here it is the sum of
squared distances along the warping path. The Euclidean distance of two error sequences, the shorter
one held at its last value, bounds DTW from above. A tree finds the candidates with the smallest
bounds; DTW is computed for these alone, together for segments that are close in the tree.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, get_args

import numpy as np

from drake_safety.files.progress import ignore

Backend = Literal["dtaidistance", "tslearn"]
BACKENDS = get_args(Backend)

_ROWS = 32  # Segments that share their candidates.
_BLOCK = 512
_SLACK = 1e-9
_SCORE_STEPS = 64
_KEPT_VARIANCE = 0.999


@dataclass(frozen=True, kw_only=True, eq=False)
class NeighbourGraph:
    """The k nearest neighbours of each segment under Omega, nearest first, itself excluded."""

    indices: np.ndarray  # (N, k)
    distances: np.ndarray  # Omega to each neighbour, (N, k), dimensionless.
    max_dtw: float  # w_max, the largest DTW of all pairs [squared unit of the errors].


def neighbour_graph(
    error: np.ndarray,
    length: np.ndarray,
    score: np.ndarray,
    *,
    score_weight: float,
    num_neighbours: int,
    num_candidates: int | None = None,
    backend: Backend = "dtaidistance",
    progress: Callable[[float], object] = ignore,
) -> NeighbourGraph:
    """Finds nearest neighbours under Omega = DTW / w_max + delta |lambda_i - lambda_j|.

    Args:
        error: Error sequences z* - z [m], (N, H, n_z).
        length: Number of valid samples of each sequence, (N,).
        score: Unsafety scores lambda, (N,).
        score_weight: delta, the weight of a score difference.
        num_neighbours: k, below N.
        num_candidates: Segments with the smallest bounds of Omega among which neighbours are
            sought, at least k; None for all others, with the cost N².
        backend: "dtaidistance", or "tslearn", which ignores the bounds.
    """
    from scipy.spatial import cKDTree

    num_segments = len(error)
    if not np.all(np.isfinite(error)):
        raise ValueError("neighbour_graph: the errors contain values that are not finite")
    series = [np.ascontiguousarray(e[:n]) for e, n in zip(error, length, strict=True)]
    # Each with its last counted sample repeated, flattened, (N, H*n_z).
    steps = np.minimum(np.arange(error.shape[1]), np.asarray(length)[:, None] - 1)
    held = np.take_along_axis(error, steps[:, :, None], axis=1).reshape(num_segments, -1)
    dtw = partial(_dtw, series, backend=backend)
    largest = _max_dtw(held, dtw)
    scale = largest**-2.0 if largest > 0.0 else 0.0

    def omega(rows: np.ndarray, columns: np.ndarray, warping: np.ndarray) -> np.ndarray:
        # Omega^ij = w^ij / w_max + delta |lambda^i - lambda^j|
        warping **= 2.0
        warping *= scale
        warping += score_weight * np.abs(score[rows, None] - score[columns])
        warping[rows[:, None] == columns] = np.inf
        return warping

    places = _places(held * scale**0.5, score * score_weight)
    tree = cKDTree(places, leafsize=_ROWS)
    columns = np.arange(num_segments)
    distances = np.empty((num_segments, num_neighbours))
    indices = np.empty((num_segments, num_neighbours), dtype=int)
    for start in range(0, num_segments, _ROWS):
        # Successive indices of the tree belong to one leaf.
        rows = tree.indices[start : start + _ROWS]
        if num_candidates is not None and num_candidates < num_segments - 1:
            columns = np.unique(tree.query(places[rows], num_candidates + 1)[1])
        bound = omega(rows, columns, _euclidean(held[rows], held[columns]))
        radius = np.partition(bound, num_neighbours - 1, axis=1)[:, num_neighbours - 1].max()
        limit = (radius * (1.0 + _SLACK)) ** 0.5 * largest * (1.0 + _SLACK)
        omegas = omega(rows, columns, dtw(rows, columns, limit=limit))
        nearest = np.argpartition(omegas, num_neighbours - 1, axis=1)[:, :num_neighbours]
        omegas = np.take_along_axis(omegas, nearest, axis=1)
        order = np.lexsort((columns[nearest], omegas), axis=1)
        distances[rows] = np.take_along_axis(omegas, order, axis=1)
        indices[rows] = np.take_along_axis(columns[nearest], order, axis=1)
        progress(min(start + _ROWS, num_segments) / num_segments)
    return NeighbourGraph(indices=indices, distances=distances, max_dtw=largest**2.0)


def _places(held: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Points whose squared distances are the bounds of Omega, nearly, (N, m).

    Scores are rounded, and the components with the least variance are left out.
    """
    # Points on a staircase of steps of equal size: ||p_i - p_j||^2 = |lambda_i - lambda_j|.
    step = max(float(score.max()), np.finfo(float).tiny) / _SCORE_STEPS
    stairs = np.sqrt(step) * (score[:, None] > step * (np.arange(_SCORE_STEPS) + 0.5))
    points = np.hstack([held, stairs])
    points -= points.mean(axis=0)
    variance, axes = np.linalg.eigh(points.T @ points)
    share = np.cumsum(variance[::-1]) / max(variance.sum(), np.finfo(float).tiny)
    # A tree is quick in few dimensions.
    num_kept = int(np.searchsorted(share, _KEPT_VARIANCE)) + 1
    return points @ axes[:, ::-1][:, :num_kept]


def _dtw(
    series: Sequence[np.ndarray],
    rows: Iterable[int],
    columns: Iterable[int],
    *,
    backend: str = BACKENDS[0],
    limit: float = np.inf,
) -> np.ndarray:
    """DTW, sqrt(sum ||.||^2), of rows and columns; above `limit` it may be infinite."""
    sides = [series[i] for i in rows], [series[i] for i in columns]
    if backend == "tslearn":
        from tslearn.metrics import cdist_dtw
        from tslearn.utils import to_time_series_dataset

        return np.asarray(cdist_dtw(*map(to_time_series_dataset, sides)))
    from dtaidistance import dtw_ndim

    num_rows, num_columns = map(len, sides)
    distances = dtw_ndim.distance_matrix_fast(
        sides[0] + sides[1],
        ndim=series[0].shape[1],
        block=((0, num_rows), (num_rows, num_rows + num_columns), False),
        max_dist=max(limit, np.finfo(float).tiny) if np.isfinite(limit) else None,
        compact=True,
        parallel=False,
    )
    return np.frombuffer(distances, dtype=float).reshape(num_rows, num_columns).copy()


def _euclidean(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Euclidean distances of points, (M, m) and (N, m), rounded up, (M, N)."""
    block = rows @ columns.T
    block *= -2.0
    block += (1.0 + 1e-12) * np.einsum("ij,ij->i", rows, rows)[:, None]
    block += (1.0 + 1e-12) * np.einsum("ij,ij->i", columns, columns)
    np.maximum(block, 0.0, out=block)
    return np.sqrt(block, out=block)


def _max_dtw(held: np.ndarray, dtw: Callable[..., np.ndarray]) -> float:
    """Largest DTW over all pairs, with DTW only where its bound exceeds the largest yet."""
    held = held - held.mean(axis=0)
    size = np.linalg.norm(held, axis=1)
    by_size = np.argsort(-size, kind="stable")
    held, size = held[by_size], size[by_size]
    largest = float(dtw(by_size[:64], by_size[:64]).max())
    for start in range(0, len(held), _BLOCK):
        # The distance of two segments is at most the sum of their distances from the mean.
        reach = largest * (1.0 - _SLACK) - size[start]
        end = int(np.searchsorted(-size, -reach, side="right"))
        if end <= start:
            break
        is_open = _euclidean(held[start : start + _BLOCK], held[start:end]) > largest
        rows = by_size[start + np.flatnonzero(is_open.any(axis=1))]
        columns = by_size[start + np.flatnonzero(is_open.any(axis=0))]
        for first in range(0, len(columns), 8 * _BLOCK):
            distances = dtw(rows, columns[first : first + 8 * _BLOCK])
            largest = max(largest, float(distances.max()))
    return largest
