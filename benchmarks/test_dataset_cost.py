"""Cost of episodes on disk, compared with numpy's archives and pyarrow's defaults."""

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from costs import alternate

from drake_safety.learning.segments import Episodes
from drake_safety.simulation.dataset import EpisodeWriter, load_episodes
from drake_safety.simulation.episode_shards import to_table

NUM_EPISODES = 256  # Four shards.
ROUNDS = 5
MAX_MS = {"writing": 2.0, "reading": 1.0}


@pytest.fixture(scope="module")
def some(episodes: Episodes) -> Episodes:
    return episodes[:NUM_EPISODES]


def arrays(episodes: Episodes) -> dict[str, np.ndarray]:
    """The same values as one array per column, as a user of numpy would keep them."""
    names = ("time_s", *(name for name, width in episodes.info.widths.items() if width))
    columns = {name: np.concatenate([getattr(e, name) for e in episodes]) for name in names}
    return columns | {"lengths": np.array([len(e.time_s) for e in episodes])}


def write_ours(episodes: Episodes, folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    with EpisodeWriter(folder, episodes.info) as writer:
        for episode in episodes:
            writer.append(episode)


def load_npz(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        return dict(archive)


def megabytes(path: Path) -> float:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files) / 1e6


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize("way", ["writing", "reading"])
def test_episodes_on_disk(
    benchmark: Any, report: Callable[..., None], some: Episodes, tmp_path: Path, way: str
) -> None:
    columns, table = arrays(some), to_table(list(some), some.info)
    ours, npz, packed, parquet = (
        tmp_path / name for name in ("episodes", "plain.npz", "packed.npz", "plain.parquet")
    )
    writers = {
        "np.savez": lambda: np.savez(npz, **columns),
        "np.savez_compressed": lambda: np.savez_compressed(packed, **columns),
        "pyarrow.parquet.write_table": lambda: pq.write_table(table, parquet),
    }
    readers = {
        "np.load": lambda: load_npz(npz),
        "np.load, compressed": lambda: load_npz(packed),
        "pyarrow.parquet.read_table": lambda: pq.read_table(parquet),
    }
    for write in (lambda: write_ours(some, ours), *writers.values()):
        write()
    for episode, read in zip(some, load_episodes(ours), strict=True):
        np.testing.assert_array_equal(episode.state, read.state)
    cost_s, peers_s = (
        alternate(benchmark, lambda: write_ours(some, ours), writers, rounds=ROUNDS)
        if way == "writing"
        else alternate(benchmark, lambda: load_episodes(ours), readers, rounds=ROUNDS)
    )
    sizes = ", ".join(f"{megabytes(path):.1f}" for path in (ours, npz, packed, parquet))
    report(
        f"{way} of episodes",
        1e3 * cost_s / len(some),
        "ms CPU/episode",
        at_most=MAX_MS[way],
        peers={name: 1e3 * seconds / len(some) for name, seconds in peers_s.items()},
        note=f"{len(some)} episodes; on disk, in this order, {sizes} MB",
    )
