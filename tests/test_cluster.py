import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cart_episodes import assert_identical
from drake_safety import load_scenario, run_episodes
from drake_safety.simulation import worker_processes
from drake_safety.simulation.cluster import connected
from drake_safety.simulation.worker_processes import map_items
from gliding_task import gliding

NUM_EPISODES, PATIENCE_S = 120, 60.0
# Sockets of dask's client are closed by its own threads, after the test.
pytestmark = [
    pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning"),
    # Of joblib before 1.6.
    pytest.mark.filterwarnings("ignore:`apply_async` is deprecated:DeprecationWarning"),
]


def start(folder, *arguments):
    command = [sys.executable, "-m", "dask", *arguments, "--scheduler-file", "scheduler.json"]
    log = (folder / f"{arguments[0]}-{time.monotonic_ns()}.log").open("w")
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    with log:
        return subprocess.Popen(
            [*command, "--no-dashboard"],
            cwd=folder,
            env=environment,
            stdout=log,
            stderr=subprocess.STDOUT,
        )


@contextlib.contextmanager
def running_scheduler(folder):
    """The address of a scheduler."""
    process = start(folder, "scheduler", "--host", "127.0.0.1", "--port", "0")
    try:
        file, end = folder / "scheduler.json", time.monotonic() + PATIENCE_S
        while not (file.is_file() and file.read_text().rstrip().endswith("}")):
            assert time.monotonic() < end
            time.sleep(0.1)
        yield json.loads(file.read_text())["address"]
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


@pytest.fixture
def two_workers(tmp_path):
    """A scheduler's address and two workers, which can import what stands beside the tests."""
    with running_scheduler(tmp_path) as address:
        one = ("worker", "--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path))
        workers = [start(tmp_path, *one) for _ in range(2)]
        try:
            yield address, workers
        finally:
            for worker in workers:
                worker.terminate()
                worker.wait(PATIENCE_S)


@pytest.mark.train
def test_a_cluster_gives_the_same_bits_though_a_worker_is_killed(two_workers):
    address, workers = two_workers
    pendulum, own_task = load_scenario("pendulum"), gliding()
    seen = []

    def kill_one(done, wanted):
        seen.append(done)
        if done >= 24 and workers[0].poll() is None:
            os.kill(workers[0].pid, signal.SIGKILL)
            workers[0].wait()

    with connected(address):
        glided = run_episodes(own_task, 8)
        found = run_episodes(pendulum, NUM_EPISODES, progress=kill_one)
        with pytest.raises(ValueError, match="DaskDistributedBackend has its own number"):
            run_episodes(pendulum, 8, num_workers=2)
    assert workers[0].poll() == -signal.SIGKILL
    assert seen == sorted(seen)
    assert seen[-1] == NUM_EPISODES
    assert_identical(found, run_episodes(pendulum, NUM_EPISODES, num_workers=1))
    assert_identical(glided, run_episodes(own_task, 8, num_workers=1))


def test_a_worker_with_other_versions_is_refused_by_name(monkeypatch):
    monkeypatch.setattr(worker_processes, "_versions", iter([{"drake": "0.1"}, {}]).__next__)
    with pytest.raises(ValueError, match=r"has {}, expected {'drake': '0.1'}, as here"):
        next(map_items(abs, [1], num_workers=1))
