import os
import signal

import pytest

from cart_episodes import assert_identical
from drake_safety import load_scenario, run_episodes
from drake_safety.simulation import worker_processes
from drake_safety.simulation.cluster import connected
from drake_safety.simulation.worker_processes import map_items
from toy_tasks import gliding

NUM_EPISODES = 120
# Sockets of dask's client are closed by its own threads, after the test.
pytestmark = [
    pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning"),
    # Of joblib before 1.6.
    pytest.mark.filterwarnings("ignore:`apply_async` is deprecated:DeprecationWarning"),
]


@pytest.mark.train
def test_a_cluster_gives_the_same_bits_though_a_worker_is_killed():
    from distributed import LocalCluster

    pendulum, own_task = load_scenario("pendulum"), gliding()
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    seen, killed = [], []

    def kill_one(done, wanted):
        seen.append(done)
        if done >= 24 and not killed:
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

    with LocalCluster(**options) as cluster, connected(cluster.scheduler_address):
        glided = run_episodes(own_task, 8)
        found = run_episodes(pendulum, NUM_EPISODES, progress=kill_one)
        with pytest.raises(ValueError, match="DaskDistributedBackend has its own number"):
            run_episodes(pendulum, 8, num_workers=2)
    assert killed and seen == sorted(seen) and seen[-1] == NUM_EPISODES
    assert_identical(found, run_episodes(pendulum, NUM_EPISODES, num_workers=1))
    assert_identical(glided, run_episodes(own_task, 8, num_workers=1))


def test_a_worker_with_other_versions_is_refused_by_name(monkeypatch):
    monkeypatch.setattr(worker_processes, "_versions", iter([{"drake": "0.1"}, {}]).__next__)
    with pytest.raises(ValueError, match=r"has {}, expected {'drake': '0.1'}, as here"):
        next(map_items(abs, [1], num_workers=1))
