"""Episodes on disk: a folder with an ``info.json`` and Parquet shards, written as they finish.

A shard has one row per (episode, step); arrays are columns of fixed-size lists of float64.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import logging
import os
import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.atomic import lock_folder, replacing, write_file
from drake_safety.files.reading import check_memory, reading
from drake_safety.files.schema import load_typed
from drake_safety.learning.segments import DIVERGED, LARGEST, Episode, Episodes, EpisodesInfo

if TYPE_CHECKING:
    import pyarrow as pa

FLUSH_EPISODES = 64  # Pending, that are written as a shard.
FLUSH_S = 10.0  # Age of the last shard at which the next episode is written at once.
_SCHEMA_VERSION = 1
_INFO_NAME = "info.json"
_SHARD_NAME = re.compile(r"episodes-\d{5,}\.parquet")
_FAILURES = "num_controller_failures"
_LABELS = {"is_safe": bool, "cause": str, "first_step": int, _FAILURES: int}
_LOGGER = logging.getLogger("drake_safety")


class EpisodeWriter:
    """Appends episodes to a folder, a shard at a time; a context manager.

    Leaving the ``with`` block writes the pending episodes, after an exception or Ctrl-C too. The
    folder is locked until then. ``extra`` is further content of ``info.json``.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        info: EpisodesInfo,
        extra: Mapping[str, Any] | None = None,
    ) -> None:
        require_extra("train", f"episodes in {path}", "pyarrow")
        self.path = Path(path)
        self.info = info
        self._pending: list[Episode] = []
        self._lock = lock_folder(self.path)
        try:
            for left_behind in self.path.glob(".*.tmp"):
                left_behind.unlink()
            # Before info.json is written: a folder with shards but no info.json is refused.
            self._indices = completed(self.path)
            _open_folder(self.path, info, extra or {})
        except BaseException:
            self._lock.release()
            raise
        self._next_shard = 1 + max(map(_number, _shards_in(self.path)), default=-1)
        self._flushed_s = time.monotonic()

    def append(self, episode: Episode) -> None:
        """Adds one episode; it is on disk after the next flush."""
        if not self._lock.is_locked:
            raise ValueError(f"EpisodeWriter of {self.path} is closed; open it again to append")
        if episode.index in self._indices:
            raise ValueError(f"episode {episode.index} is already in {self.path}; see completed()")
        Episodes(self.info, [episode])  # Checks the shapes.
        self._pending.append(episode)
        self._indices.add(episode.index)
        age_s = time.monotonic() - self._flushed_s
        if len(self._pending) >= FLUSH_EPISODES or age_s >= FLUSH_S:
            self.flush()

    def flush(self) -> None:
        """Writes the pending episodes as one shard."""
        if not self._pending:
            return
        import pyarrow.parquet as pq

        columns = [f"{name}.list.element" for name, width in self.info.widths.items() if width]
        with replacing(self.path / f"episodes-{self._next_shard:05d}.parquet") as temporary:
            # float64 compresses better with its bytes split by significance; checksums detect
            # damaged pages.
            pq.write_table(
                _table_of(self._pending, self.info),
                temporary,
                compression="zstd",
                use_dictionary=["cause"],
                use_byte_stream_split=["time_s", *columns],
                write_page_checksum=True,
            )
        self._next_shard += 1
        self._pending, self._flushed_s = [], time.monotonic()

    def close(self) -> None:
        """Writes the pending episodes and unlocks the folder; the writer takes no more."""
        try:
            self.flush()
        finally:
            self._lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def read_info(path: str | os.PathLike[str]) -> tuple[EpisodesInfo, dict[str, Any]]:
    """Reads the metadata of a folder's episodes, and the extra stored with it."""
    file = Path(path) / _INFO_NAME
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"{path} holds no episodes: it has no {_INFO_NAME}") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file} is not JSON: {error}") from error
    who = f"{file} does not describe episodes"
    content = content if isinstance(content, dict) else {}
    version, fields, extra = (content.get(name) for name in ("schema_version", "info", "extra"))
    if version != _SCHEMA_VERSION or not isinstance(fields, dict) or not isinstance(extra, dict):
        raise ValueError(f"{who}: expected schema version {_SCHEMA_VERSION}, info and extra")
    # Fields that older folders lack have defaults that mean "unknown"; others mean nothing now.
    known = {field.name for field in dataclasses.fields(EpisodesInfo)} & fields.keys()
    return load_typed(EpisodesInfo, {name: fields[name] for name in known}, who), extra


def completed(path: str | os.PathLike[str]) -> set[int]:
    """Reads the indices of the episodes on disk."""
    shards = _shards_in(Path(path))
    if shards and not (Path(path) / _INFO_NAME).exists():
        raise ValueError(f"{path} holds {len(shards)} shards but no {_INFO_NAME}")
    columns = [_read_shard(shard, ["episode"]).column("episode") for shard in shards]
    return {index for column in columns for index in column.unique().to_pylist()}


def load_episodes(path: str | os.PathLike[str]) -> Episodes:
    """Loads all episodes of a folder, sorted by index, bit for bit as they were appended."""
    info, _ = read_info(path)
    episodes: dict[int, Episode] = {}
    for shard in _shards_in(Path(path)):
        with reading(shard):
            for episode in Episodes(info, _episodes_of(_read_shard(shard), info, shard)):
                if episode.index in episodes:
                    raise ValueError(f"episode {episode.index} of {shard} is in another shard, too")
                episodes[episode.index] = episode
    return Episodes(info, [episodes[index] for index in sorted(episodes)])


def _open_folder(path: Path, info: EpisodesInfo, extra: Mapping[str, Any]) -> None:
    known = None
    if (path / _INFO_NAME).exists():
        stored, known = read_info(path)
        there = dataclasses.asdict(stored)
        # Through JSON, like the stored info, so that tuples of names equal lists.
        here = json.loads(json.dumps(dataclasses.asdict(info)))
        differences = {
            name: f"{name}: there {there[name]!r}, here {here[name]!r}"
            for name in there
            if there[name] != here[name] and (name != "robot" or there[name])
        }
        if versions := differences.pop("versions", None):
            _LOGGER.warning("%s was begun with other package versions (%s)", path, versions)
        if differences:
            text = "; ".join(differences.values())
            raise ValueError(f"{path} holds episodes of another set ({text})")
        info, extra = stored, {**known, **extra}
    if extra == known:
        return
    content = {"schema_version": _SCHEMA_VERSION, "info": dataclasses.asdict(info), "extra": extra}
    write_file(path / _INFO_NAME, json.dumps(content, indent=2, ensure_ascii=False) + "\n")


def is_same(a: Episode, b: Episode) -> bool:
    """Whether two episodes are the same to the last bit."""
    # As bytes, NaN equals itself and 0.0 differs from -0.0.
    left, right = (
        [(value.shape, value.tobytes()) for value in map(np.asarray, vars(episode).values())]
        for episode in (a, b)
    )
    return left == right


def _schema_of(info: EpisodesInfo) -> pa.Schema:
    # Parquet has no lists of length 0.
    import pyarrow as pa

    arrays = {name: pa.list_(pa.float64(), n) for name, n in info.widths.items() if n}
    columns = {"episode": pa.int64(), "step": pa.int32(), "time_s": pa.float64(), **arrays}
    labels = {"is_safe": pa.bool_(), "cause": pa.string()}
    counts = {"first_step": pa.int32(), _FAILURES: pa.int32()}
    return pa.schema(list((columns | labels | counts).items()))


def _table_of(episodes: Sequence[Episode], info: EpisodesInfo) -> pa.Table:
    import pyarrow as pa

    counts = [len(episode.time_s) for episode in episodes]
    columns: dict[str, Any] = {"step": np.concatenate([np.arange(count) for count in counts])}
    for name, attribute in {"episode": "index", **{label: label for label in _LABELS}}.items():
        columns[name] = np.repeat([getattr(episode, attribute) for episode in episodes], counts)
    for name, width in {"time_s": 0, **info.widths}.items():
        rows = [np.asarray(getattr(e, name), dtype=np.float64).reshape(-1) for e in episodes]
        flat = pa.array(np.concatenate(rows))
        columns[name] = pa.FixedSizeListArray.from_arrays(flat, width) if width else flat
    schema = _schema_of(info)
    return pa.table({name: columns[name] for name in schema.names}, schema=schema)


def _episodes_of(table: pa.Table, info: EpisodesInfo, shard: Path) -> list[Episode]:
    schema, widths, num_rows = _schema_of(info), info.widths, table.num_rows
    is_full = num_rows and not any(column.null_count for column in table.columns)
    if not is_full or not table.schema.equals(schema):
        raise ValueError(f"{shard} holds no episodes of this set: expected columns\n{schema}")
    arrays = {name: np.empty((num_rows, 0)) for name in widths}
    for name in table.column_names:
        column, width = table.column(name), widths.get(name)
        if width:
            column = column.combine_chunks().flatten()
        arrays[name] = column.to_numpy().reshape((num_rows, width) if width else num_rows)
    watched = slice(None) if not info.until else [info.constraint_names.index(info.until)]
    bounds = [0, *(np.flatnonzero(np.diff(arrays["episode"])) + 1), num_rows]
    episodes = []
    for first, last in itertools.pairwise(bounds):
        part = {name: array[first:last] for name, array in arrays.items()}
        labels: dict[str, Any] = {name: kind(part[name][0]) for name, kind in _LABELS.items()}
        longest = info.num_steps or num_rows
        large = [n for n in ("time_s", *widths) if not (np.abs(part[n]) < LARGEST).all()]
        faults = {
            "its steps are not 0, 1, 2, ...": (part["step"] != np.arange(last - first)).any(),
            "its time does not increase": not (np.diff(part["time_s"]) > 0.0).all(),
            f"it has more than {longest} steps": last - first > longest + 1,
            f"its rows differ in {[*_LABELS]}": any((part[n] != part[n][0]).any() for n in _LABELS),
            "it is safe, and a margin is negative": (
                labels["is_safe"] and (part["margins"][:, watched] < 0.0).any()
            ),
            f"{large} hold values that are not finite numbers below {LARGEST:g}": (
                large and labels["cause"] != DIVERGED
            ),
        }
        index = int(part["episode"][0])
        for what, is_wrong in faults.items():
            if is_wrong:
                raise ValueError(f"{shard}: episode {index}: {what}")
        copies: dict[str, Any] = {name: part[name].copy() for name in ("time_s", *widths)}
        episodes.append(Episode(index=index, plant=info.plant_of(index), **copies, **labels))
    return episodes


def _shards_in(path: Path) -> list[Path]:
    files = path.glob("episodes-*.parquet")
    return sorted((file for file in files if _SHARD_NAME.fullmatch(file.name)), key=_number)


def _number(shard: Path) -> int:
    return int(shard.stem.removeprefix("episodes-"))


def _read_shard(shard: Path, columns: list[str] | None = None) -> pa.Table:
    require_extra("train", f"episodes in {shard.parent}", "pyarrow")
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        # ParquetFile and not read_table, which adds columns for folders named like `seed=1`.
        with pq.ParquetFile(shard, page_checksum_verification=True) as file:
            sizes = (getattr(column.type, "list_size", 1) for column in file.schema_arrow)
            check_memory(8 * file.metadata.num_rows * sum(sizes), f"{shard}")
            table = file.read(columns=columns)
    except (pa.ArrowException, OSError) as error:
        raise ValueError(f"shard {shard} is truncated or damaged: {error}") from error
    if columns is not None and table.column_names != columns:
        raise ValueError(f"{shard} holds no episodes: expected columns {columns}")
    return table
