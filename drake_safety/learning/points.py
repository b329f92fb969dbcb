"""The points of segments in the plane: t-SNE under the safety distance Omega."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drake_safety.files.progress import StageProgress, ignore, stage_of
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.distance import NeighbourGraph, neighbour_graph
from drake_safety.learning.grid import Grid
from drake_safety.learning.mode_settings import mode_settings
from drake_safety.learning.segments import Segments


@dataclass(frozen=True, kw_only=True, eq=False)
class Points:
    """Which segments have a point of t-SNE, (N,), and these points, scaled to the grid, (M, 2)."""

    has_target: np.ndarray
    target: np.ndarray


def embedded_points(
    segments: Segments,
    grid: Grid,
    parameters: AssessmentParameters,
    progress: StageProgress | None = None,
) -> Points:
    """Embeds segments by t-SNE, scaled to the grid; when sharpened, a segment every H/2 samples."""
    _, first, episode = np.unique(segments.episode, return_index=True, return_inverse=True)
    since_start = segments.start_row - segments.start_row[first][episode]
    has_target = since_start % mode_settings(parameters).target_stride == 0
    num_targeted, num_neighbours = int(has_target.sum()), int(3 * parameters.perplexity)
    if num_targeted <= num_neighbours:
        raise ValueError(
            f"SafetyAssessment: perplexity {parameters.perplexity} needs more than "
            f"{num_neighbours} segments, {len(first)} episodes give {num_targeted}: record more"
        )
    targeted = segments.take(has_target)
    graph = neighbour_graph(
        targeted.error,
        targeted.length,
        targeted.score,
        score_weight=parameters.score_weight,
        num_neighbours=num_neighbours,
        num_candidates=parameters.candidates_per_neighbour * num_neighbours or None,
        backend=parameters.distance_backend,
        progress=stage_of(progress, "distances"),
    )
    points = tsne(
        graph,
        perplexity=parameters.perplexity,
        exaggeration=parameters.exaggeration,
        seed=parameters.seed,
        progress=stage_of(progress, "t-SNE"),
    )
    return Points(has_target=has_target, target=grid.scale(points))


def tsne(
    graph: NeighbourGraph,
    *,
    perplexity: float,
    exaggeration: float,
    seed: int,
    progress: Callable[[float], object] = ignore,
) -> np.ndarray:
    """Computes the t-SNE embedding of a neighbour graph, (N, 2), deterministically for a seed."""
    import openTSNE
    from openTSNE.affinity import PerplexityBasedNN
    from openTSNE.initialization import spectral
    from openTSNE.nearest_neighbors import PrecomputedNeighbors

    done = 0

    def report(*state: object) -> bool:
        nonlocal done
        done += 50
        progress(min(done / 750, 1.0))
        return False

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        affinities = PerplexityBasedNN(
            knn_index=PrecomputedNeighbors(graph.indices, graph.distances),
            perplexity=perplexity,
            random_state=seed,
            n_jobs=1,
        )
        embedding = openTSNE.TSNE(
            initialization=spectral(affinities.P, random_state=seed),
            exaggeration=exaggeration,
            random_state=seed,
            n_jobs=1,
            callbacks=report,
            callbacks_every_iters=50,
        ).fit(affinities=affinities)
    return np.asarray(embedding, dtype=float).copy()
