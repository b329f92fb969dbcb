"""Cost of training Γ, and of its first stages compared with other packages.

Every measurement has a fresh process, so that its peak memory is its own.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from costs import in_fresh_process, peak_memory_gb

MAX_MEMORY_GB = 2.0
MAX_CPU_S = {"paper": 90.0, "sharpened": 240.0}  # For 2048 episodes.
LEAST_SHARE = 0.5  # Of the limits, however few the episodes are: there are as many epochs.
TSNE_ITERATIONS = 750  # Of both: openTSNE's default; scikit-learn's own would be 1000.
MIN_FASTER = {"dtw": 8.0, "tsne": 1.0}
ROUNDS = 2


def load(folder: Path, num_episodes: int) -> Any:
    from drake_safety.simulation.dataset import load_episodes

    return load_episodes(folder)[:num_episodes]


def some_segments(folder: Path, num_episodes: int, num_segments: int) -> Any:
    """Segments that are evenly spread over all episodes, and the parameters."""
    from drake_safety.learning.assessment import AssessmentParameters
    from drake_safety.learning.segments import split

    parameters = AssessmentParameters(mode="paper")
    segments = split(load(folder, num_episodes), stride=1, discount=parameters.discount)
    num_segments = min(num_segments, len(segments))
    chosen = np.linspace(0, len(segments) - 1, num_segments).astype(int)
    return segments.take(chosen), parameters


def fit_cost(mode: str, folder: Path, num_episodes: int) -> dict[str, Any]:
    # What fitting imports on first use: memory is counted above it.
    import openTSNE  # noqa: F401
    import torch  # noqa: F401
    from dtaidistance import dtw_ndim  # noqa: F401

    from drake_safety import load_scenario
    from drake_safety.learning.assessment import SafetyAssessment

    parameters = load_scenario("laikago_balancing").assessment
    parameters.mode = mode
    imports_gb = peak_memory_gb()
    episodes = load(folder, num_episodes)
    stages: dict[str, float] = {}
    started = last = time.process_time()

    def progress(stage: str, done: int, wanted: int) -> None:
        nonlocal last
        now = time.process_time()
        stages[stage] = stages.get(stage, 0.0) + now - last
        last = now

    assessment = SafetyAssessment(parameters).fit(episodes, progress)
    cpu_s = time.process_time() - started
    return {
        "cpu_s": cpu_s,
        "memory_gb": peak_memory_gb() - imports_gb,
        "segments": int(assessment.training_.counts(assessment.grid_)[0].sum()),
        "stages": stages,
    }


def classifier_cost(folder: Path, num_episodes: int) -> float:
    """CPU seconds of scikit-learn's gradient boosting, fitted to the same episodes."""
    from studies.baselines import DirectClassifier

    episodes = load(folder, num_episodes)
    DirectClassifier("gradient_boosting").fit(episodes[:50])  # Imports are left out.
    started = time.process_time()
    DirectClassifier("gradient_boosting").fit(episodes)
    return time.process_time() - started


def our_cost(folder: Path, num_episodes: int, num_segments: int) -> dict[str, float]:
    """CPU time of DTW, Ω and t-SNE by this library."""
    from drake_safety.learning.distance import neighbour_graph
    from drake_safety.learning.points import tsne

    segments, parameters = some_segments(folder, num_episodes, num_segments)

    def candidates_of(num_neighbours: int) -> int | None:
        # As in training.
        return parameters.candidates_per_neighbour * num_neighbours or None

    def distances(chosen: Any, num_neighbours: int) -> Any:
        return neighbour_graph(
            chosen.error,
            chosen.length,
            chosen.score,
            score_weight=parameters.score_weight,
            num_neighbours=num_neighbours,
            num_candidates=candidates_of(num_neighbours),
            cost="squared",
        )

    def embed(graph: Any, perplexity: float) -> None:
        tsne(
            graph,
            perplexity=perplexity,
            exaggeration=parameters.exaggeration,
            seed=parameters.seed,
        )

    # Imports and first calls are left out, here as with the peers.
    embed(distances(segments.take(np.arange(100)), 15), 5.0)
    started = time.process_time()
    graph = distances(segments, int(3 * parameters.perplexity))
    dtw_s = time.process_time() - started
    embed(graph, parameters.perplexity)
    return {"dtw_s": dtw_s, "tsne_s": time.process_time() - started - dtw_s, "n": len(segments)}


def peer_cost(folder: Path, num_episodes: int, num_segments: int) -> dict[str, float]:
    """CPU time of the same by tslearn and scikit-learn."""
    from sklearn.manifold import TSNE
    from tslearn.metrics import cdist_dtw
    from tslearn.utils import to_time_series_dataset

    segments, parameters = some_segments(folder, num_episodes, num_segments)

    def distances(chosen: Any) -> np.ndarray:
        series = [e[:n] for e, n in zip(chosen.error, chosen.length, strict=True)]
        omega = cdist_dtw(to_time_series_dataset(series))
        omega /= omega.max()
        omega **= 2  # tslearn gives the root of the sum of squares.
        omega += parameters.score_weight * np.abs(chosen.score[:, None] - chosen.score)
        return omega

    def embed(omega: np.ndarray, perplexity: float) -> None:
        TSNE(
            metric="precomputed",
            init="random",
            perplexity=perplexity,
            max_iter=TSNE_ITERATIONS,
            random_state=parameters.seed,
        ).fit(omega)

    embed(distances(segments.take(np.arange(100))), 5.0)
    started = time.process_time()
    omega = distances(segments)
    dtw_s = time.process_time() - started
    embed(omega, parameters.perplexity)
    return {"dtw_s": dtw_s, "tsne_s": time.process_time() - started - dtw_s, "n": len(segments)}


@pytest.mark.parametrize("mode", list(MAX_CPU_S))
def test_learning_from_the_nominal_episodes(
    benchmark: Any, report: Callable[..., None], episodes_folder: Path, num_episodes: int, mode: str
) -> None:
    peer_s = in_fresh_process(classifier_cost, episodes_folder, num_episodes)
    cost = benchmark.pedantic(
        in_fresh_process, args=(fit_cost, mode, episodes_folder, num_episodes), rounds=1
    )
    name = f"training, {mode}, {num_episodes} episodes"
    stages = ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in cost["stages"].items())
    report(
        name,
        cost["cpu_s"],
        "s CPU",
        at_most=MAX_CPU_S[mode] * max(num_episodes / 2048, LEAST_SHARE),
        peers={"scikit-learn's gradient boosting": peer_s},
        note=f"{cost['segments']} segments: {stages}",
    )
    report(f"{name}, peak memory", cost["memory_gb"], "GB", at_most=MAX_MEMORY_GB)


def test_dtw_and_tsne_beside_other_packages(
    benchmark: Any,
    report: Callable[..., None],
    episodes_folder: Path,
    num_episodes: int,
    pytestconfig: pytest.Config,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # One thread each: threads that wait for each other would count as work.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        monkeypatch.setenv(name, "1")
    costs: dict[str, list[dict[str, float]]] = {"ours": [], "peers": []}

    def measure(whose: str, function: Callable[..., dict[str, float]]) -> None:
        arguments = (episodes_folder, num_episodes, pytestconfig.getoption("num_segments"))
        costs[whose].append(in_fresh_process(function, *arguments))

    benchmark.pedantic(
        measure, args=("ours", our_cost), setup=lambda: measure("peers", peer_cost), rounds=ROUNDS
    )
    (num_segments,) = {cost["n"] for both in costs.values() for cost in both}
    for name, key, peer, factor in (
        ("DTW and neighbours", "dtw_s", "tslearn", MIN_FASTER["dtw"]),
        ("t-SNE", "tsne_s", "scikit-learn", MIN_FASTER["tsne"]),
    ):
        ours, theirs = (min(cost[key] for cost in costs[whose]) for whose in ("ours", "peers"))
        report(
            f"{name}, {num_segments} segments",
            ours,
            "s CPU",
            at_most=theirs / factor,
            peers={peer: theirs},
            note=f"limit: {factor:g} times as fast",
        )
