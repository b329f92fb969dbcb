"""Parquet shards of episodes: rows to episodes and back."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.reading import check_memory
from drake_safety.learning.segments import DIVERGED, LARGEST, Episode, EpisodesInfo

if TYPE_CHECKING:
    import pyarrow as pa

_FAILURES = "num_controller_failures"
_OF_EPISODES = {"is_safe": bool, "cause": str, "first_step": int, _FAILURES: int}
_KINDS = {"time_s": "f", "is_safe": "b", "cause": "O"}
_SHARD_NAME = re.compile(r"episodes-\d{5,}\.parquet")


def to_table(episodes: Sequence[Episode], info: EpisodesInfo) -> pa.Table:
    """The rows of episodes, one after another."""
    import pyarrow as pa

    counts = [len(episode.time_s) for episode in episodes]

    def repeated(name: str) -> np.ndarray:
        return np.repeat([getattr(episode, name) for episode in episodes], counts)

    columns: dict[str, Any] = {
        "episode": repeated("index"),
        "step": np.concatenate([np.arange(count, dtype=np.int32) for count in counts]),
        "time_s": np.concatenate([np.asarray(e.time_s, dtype=np.float64) for e in episodes]),
    }
    for name, width in info.widths.items():
        # Parquet has no lists of length 0: such an array has no column.
        if width:
            rows = [np.asarray(getattr(e, name), dtype=np.float64).reshape(-1) for e in episodes]
            columns[name] = pa.FixedSizeListArray.from_arrays(pa.array(np.concatenate(rows)), width)
    columns["is_safe"] = repeated("is_safe")
    columns["cause"] = pa.array(repeated("cause"), pa.string())
    for name in ("first_step", _FAILURES):
        columns[name] = pa.array(repeated(name), pa.int32())
    return pa.table(columns)


def from_table(table: pa.Table, info: EpisodesInfo, shard: Path) -> list[Episode]:
    """The episodes of a shard's rows; ValueError if they are damaged or of another set."""
    widths = info.widths
    names = ["episode", "step", "time_s", *(name for name, width in widths.items() if width)]
    names += ["is_safe", "cause", "first_step"]
    # Older shards have no count of failures; nothing is learned from it.
    if table.column_names not in ([*names, _FAILURES], names):
        raise ValueError(
            f"{shard} has columns {table.column_names}; expected {[*names, _FAILURES]}"
        )
    num_rows = table.num_rows
    if not num_rows:
        raise ValueError(f"{shard} holds no episodes")
    arrays = {name: np.empty((num_rows, 0)) for name in widths} | {_FAILURES: np.zeros(num_rows)}
    for name in table.column_names:
        column, width = table.column(name), widths.get(name)
        if width and getattr(column.type, "list_size", None) != width:
            raise ValueError(f"{shard}: {name} is {column.type}; expected lists of length {width}")
        if width:
            column = column.combine_chunks().flatten()
        arrays[name] = column.to_numpy().reshape((num_rows, width) if width else num_rows)
        if arrays[name].dtype.kind != ("f" if width else _KINDS.get(name, "i")):
            raise ValueError(f"{shard}: {name} is {column.type}; expected another type")
    episode = arrays["episode"]
    watched = slice(None) if not info.until else [info.constraint_names.index(info.until)]
    bounds = [0, *(np.flatnonzero(np.diff(episode)) + 1), num_rows]
    result = []
    for first, last in itertools.pairwise(bounds):
        rows, longest = slice(first, last), info.num_steps or num_rows
        large = [n for n in ("time_s", *widths) if not (np.abs(arrays[n][rows]) < LARGEST).all()]
        faults = {
            "its steps are not 0, 1, 2, ...": (
                arrays["step"][rows] != np.arange(last - first)
            ).any(),
            "its time does not increase": not (np.diff(arrays["time_s"][rows]) > 0.0).all(),
            f"it has more than {longest} steps": last - first > longest + 1,
            f"its rows differ in {[*_OF_EPISODES]}": any(
                (arrays[name][rows] != arrays[name][first]).any() for name in _OF_EPISODES
            ),
            "it is safe, and a margin is negative": (
                arrays["is_safe"][first] and (arrays["margins"][rows, watched] < 0.0).any()
            ),
            f"{large} hold values that are not finite numbers below {LARGEST:g}": (
                large and arrays["cause"][first] != DIVERGED
            ),
        }
        for what, is_wrong in faults.items():
            if is_wrong:
                raise ValueError(f"{shard}: episode {episode[first]}: {what}")
        one: dict[str, Any] = {name: arrays[name][rows].copy() for name in ("time_s", *widths)}
        for name, kind in _OF_EPISODES.items():
            one[name] = kind(arrays[name][first])
        result.append(Episode(index=int(episode[first]), **one))
    return result


def shards_in(path: Path) -> list[Path]:
    """The shards of a folder, in the order of their numbers; none if it does not exist."""
    files = path.glob("episodes-*.parquet")
    return sorted((one for one in files if _SHARD_NAME.fullmatch(one.name)), key=shard_number)


def shard_number(shard: Path) -> int:
    """The number in a shard's name."""
    return int(shard.stem.removeprefix("episodes-"))


def read_shard(shard: Path, columns: list[str] | None = None) -> pa.Table:
    """The rows of a shard, of all columns by default; ValueError if it is damaged."""
    require_extra("train", f"episodes in {shard.parent}", "pyarrow")
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        # ParquetFile and not read_table, which adds columns for folders named like `seed=1`.
        with pq.ParquetFile(shard, page_checksum_verification=True) as file:
            sizes = (getattr(one.type, "list_size", 1) for one in file.schema_arrow)
            check_memory(8 * file.metadata.num_rows * sum(sizes), f"{shard}")
            table = file.read(columns=columns)
    except (pa.ArrowException, OSError) as error:
        raise ValueError(
            f"shard {shard} is truncated or damaged ({error}); remove it and resume: its episodes "
            "will be run again"
        ) from error
    if columns is not None and table.column_names != columns:
        raise ValueError(f"{shard} holds no episodes: expected columns {columns}")
    return table
