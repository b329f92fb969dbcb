"""Speed-up of rollouts by a second worker of a cluster."""

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from bare_plant import SEED

from drake_safety import Scenario, run_episodes
from drake_safety.simulation.cluster import connected

NUM_EPISODES, WARM_UP, ROUNDS, PATIENCE_S = 256, 16, 3, 60.0
# Sockets of dask's client are closed by its own threads, after the test.
pytestmark = pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")


@contextmanager
def cluster(folder: Path, num_workers: int) -> Iterator[str]:
    """The address of a scheduler with workers in processes of their own, of one thread each."""
    folder.mkdir()
    file = folder / "scheduler.json"
    with ExitStack() as stack:

        def start(*arguments: str) -> None:
            command = [sys.executable, "-m", "dask", *arguments, "--scheduler-file", str(file)]
            quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            process = subprocess.Popen([*command, "--no-dashboard"], cwd=folder, **quiet)
            stack.callback(process.wait)
            stack.callback(process.terminate)

        start("scheduler", "--host", "127.0.0.1", "--port", "0")
        end = time.monotonic() + PATIENCE_S
        while not (file.is_file() and file.read_text().rstrip().endswith("}")):
            assert time.monotonic() < end
            time.sleep(0.1)
        for _ in range(num_workers):
            start("worker", "--nthreads", "1", "--no-nanny", "--local-directory", str(folder))
        yield json.loads(file.read_text())["address"]


def test_two_workers_of_a_cluster_beside_one(
    benchmark: Any, report: Callable[..., None], scenario: Scenario, tmp_path: Path
) -> None:
    wall_s: dict[int, list[float]] = {1: [], 2: []}

    def run(num_workers: int) -> None:
        folder = tmp_path / f"{num_workers}-{len(wall_s[num_workers])}"
        with cluster(folder, num_workers) as address, connected(address):
            run_episodes(scenario, WARM_UP, seed=SEED)
            started = time.perf_counter()
            run_episodes(scenario, NUM_EPISODES, seed=SEED)
            wall_s[num_workers].append(time.perf_counter() - started)

    benchmark.pedantic(run, args=(2,), setup=lambda: run(1), rounds=ROUNDS)
    one, two = min(wall_s[1]), min(wall_s[2])
    ratios = [a / b for a, b in zip(wall_s[1], wall_s[2], strict=True)]
    report(
        "two workers of a cluster / one, throughput",
        one / two,
        "x",
        at_least=1.8,
        peers={"one, episodes/s": NUM_EPISODES / one},
        note=f"two {NUM_EPISODES / two:.4g}, median of pairs {statistics.median(ratios):.2f}",
    )
