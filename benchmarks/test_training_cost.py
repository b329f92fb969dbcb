"""Cost of training Γ, and of its first stages compared with other packages.

Every measurement has a fresh process, so that its peak memory is its own.
"""

import multiprocessing
import resource
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

MAX_MEMORY_GB = 2.0
MAX_CPU_S = {"paper": 90.0, "sharpened": 240.0}
TSNE_ITERATIONS = 750  # Of both: openTSNE's default; scikit-learn's own would be 1000.
MAX_PEER_SEGMENTS = 10_000  # About 5 min and 1.5 GB of the peers.


def in_fresh_process(function: Callable[..., Any], *arguments: Any) -> Any:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(function, *arguments).result()


def peak_memory_gb() -> float:
    """Peak memory of this process."""
    status = Path("/proc/self/status")
    if status.is_file():
        # getrusage would count the parent's memory at the time of the fork.
        fields = dict(line.split(":", 1) for line in status.read_text().splitlines())
        return int(fields["VmHWM"].split()[0]) / 1024**2
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1024**3


def load(folder: Path, num_episodes: int) -> Any:
    from drake_safety.simulation.dataset import load_episodes

    return load_episodes(folder)[:num_episodes]


def paper_segments(folder: Path, num_episodes: int, num_segments: int | None) -> Any:
    """The segments of whole episodes, at most a given number; all by default."""
    from drake_safety.learning.assessment import AssessmentParameters
    from drake_safety.learning.segments import split

    parameters = AssessmentParameters(mode="paper")
    episodes = load(folder, num_episodes)
    stride = episodes.info.horizon
    segments = split(episodes, stride=stride, discount=parameters.discount)
    return segments.take(np.arange(len(segments))[:num_segments]), parameters


def fit_cost(mode: str, folder: Path, num_episodes: int) -> dict[str, float]:
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

    def progress(stage: str, fraction: float) -> None:
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
        **{f"{stage}, s": value for stage, value in stages.items()},
    }


def our_cost(folder: Path, num_episodes: int, num_segments: int | None) -> dict[str, float]:
    """CPU time of DTW, Ω and t-SNE by this library."""
    from drake_safety.learning.distance import neighbour_graph
    from drake_safety.learning.embedding import tsne

    segments, parameters = paper_segments(folder, num_episodes, num_segments)

    def distances(chosen: Any, num_neighbours: int) -> Any:
        return neighbour_graph(
            chosen.error,
            chosen.length,
            chosen.score,
            score_weight=parameters.score_weight,
            num_neighbours=num_neighbours,
        )

    # Imports and first calls are left out, here as with the peers.
    tsne(distances(segments.take(np.arange(100)), 15), perplexity=5.0, seed=0)
    started = time.process_time()
    graph = distances(segments, int(3 * parameters.perplexity))
    dtw_s = time.process_time() - started
    tsne(graph, perplexity=parameters.perplexity, seed=parameters.seed)
    return {"dtw_s": dtw_s, "tsne_s": time.process_time() - started - dtw_s, "n": len(segments)}


def peer_cost(folder: Path, num_episodes: int, num_segments: int | None) -> dict[str, float]:
    """CPU time of the same by tslearn and scikit-learn."""
    from sklearn.manifold import TSNE
    from tslearn.metrics import cdist_dtw
    from tslearn.utils import to_time_series_dataset

    segments, parameters = paper_segments(folder, num_episodes, num_segments)

    def distances(chosen: Any) -> np.ndarray:
        series = [e[:n] for e, n in zip(chosen.error, chosen.length, strict=True)]
        omega = cdist_dtw(to_time_series_dataset(series))
        omega /= omega.max()
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


@pytest.fixture
def num_episodes(pytestconfig: pytest.Config) -> int:
    return pytestconfig.getoption("num_episodes")


@pytest.mark.parametrize("mode", ["paper", "sharpened"])
def test_learning_from_the_nominal_episodes(
    benchmark: Any,
    report: Callable[..., None],
    episodes_folder: Path,
    num_episodes: int,
    mode: str,
) -> None:
    cost = benchmark.pedantic(
        in_fresh_process, args=(fit_cost, mode, episodes_folder, num_episodes), rounds=1
    )
    cpu_s, memory_gb = cost.pop("cpu_s"), cost.pop("memory_gb")
    name = f"segments to Γ, {mode}, {num_episodes} episodes"
    report(f"{name}, CPU", cpu_s, "s", at_most=MAX_CPU_S[mode], peers=cost)
    report(f"{name}, memory", memory_gb, "GB", at_most=MAX_MEMORY_GB)


def test_dtw_and_tsne_beside_other_packages(
    benchmark: Any,
    report: Callable[..., None],
    episodes_folder: Path,
    num_episodes: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # One thread each: threads that wait for each other would count as work.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        monkeypatch.setenv(name, "1")
    arguments = (episodes_folder, num_episodes, MAX_PEER_SEGMENTS)
    ours = benchmark.pedantic(in_fresh_process, args=(our_cost, *arguments), rounds=1)
    peers = in_fresh_process(peer_cost, *arguments)
    assert ours["n"] == peers["n"]
    report(
        f"DTW + t-SNE against tslearn + scikit-learn, {ours['n']} segments",
        (peers["dtw_s"] + peers["tsne_s"]) / (ours["dtw_s"] + ours["tsne_s"]),
        "x",
        at_least=8.0,
        peers={
            "our DTW, s": ours["dtw_s"],
            "our t-SNE, s": ours["tsne_s"],
            "tslearn, s": peers["dtw_s"],
            "scikit-learn, s": peers["tsne_s"],
        },
    )
