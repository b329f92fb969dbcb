"""Episodes on disk: a folder with an ``info.json`` and Parquet shards, written as they finish.

``info.json`` holds what all episodes share. Each ``episodes-NNNNN.parquet`` has one row per
(episode, step); arrays are columns of fixed-size lists of float64 in SI units. A file is written
under a temporary name, which starts with a dot, and renamed: a file with its final name is
complete, and an interrupted run loses at most the episodes that were not flushed. pandas reads the
rows by ``pandas.read_parquet(sorted(folder.glob("episodes-*.parquet")))``.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.atomic import lock_folder, replacing, write_file
from drake_safety.files.reading import reading
from drake_safety.files.schema import load_typed
from drake_safety.learning.segments import Episode, Episodes, EpisodesInfo
from drake_safety.simulation.episode_shards import (
    from_table,
    read_shard,
    shard_number,
    shards_in,
    to_table,
)

FLUSH_EPISODES = 64
"""Number of pending episodes that are written as a shard."""
FLUSH_S = 10.0
"""Age of the last shard at which the next episode is written at once, with those pending [s]."""
_SCHEMA_VERSION = 1
_INFO_NAME = "info.json"
_LOGGER = logging.getLogger("drake_safety")


class EpisodeWriter:
    """Appends episodes to a folder, a shard at a time; a context manager.

    Leaving the ``with`` block writes the pending episodes, after an exception or Ctrl-C too. A
    folder that holds episodes is continued: ``completed(path)`` gives their indices. The folder is
    locked until the writer is closed or its process ends.

    Args:
        extra: Further content of ``info.json``, as JSON types (the command, the scenario's text,
            ...). In a folder that is continued, it replaces entries of the same names.
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
        self._next_shard = 1 + max(map(shard_number, shards_in(self.path)), default=-1)
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

        table = to_table(self._pending, self.info)
        columns = [f"{name}.list.element" for name, width in self.info.widths.items() if width]
        final = self.path / f"episodes-{self._next_shard:05d}.parquet"
        with replacing(final) as temporary:
            # float64 compresses better with its bytes split by significance; checksums detect
            # damaged pages.
            pq.write_table(
                table,
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
    schema_version = content.get("schema_version") if isinstance(content, dict) else None
    if schema_version != _SCHEMA_VERSION:
        raise ValueError(
            f"{file} has schema version {schema_version!r}; expected {_SCHEMA_VERSION}"
        )
    fields, extra = content.get("info"), content.get("extra")
    if not (isinstance(fields, dict) and isinstance(extra, dict)):
        raise ValueError(f"{file} does not describe episodes: it has no info, or no extra")
    # Fields that older folders lack have defaults that mean "unknown"; others mean nothing now.
    known = {field.name for field in dataclasses.fields(EpisodesInfo)} & fields.keys()
    who = f"{file} does not describe episodes"
    return load_typed(EpisodesInfo, {name: fields[name] for name in known}, who), extra


def completed(path: str | os.PathLike[str]) -> set[int]:
    """Indices of the episodes on disk; empty if nothing was written yet."""
    shards = shards_in(Path(path))
    if shards and not (Path(path) / _INFO_NAME).exists():
        raise ValueError(
            f"{path} holds {len(shards)} shards but no {_INFO_NAME}, so the set that they belong "
            "to is unknown"
        )
    indices: set[int] = set()
    for shard in shards:
        indices.update(read_shard(shard, ["episode"]).column("episode").unique().to_pylist())
    return indices


def load_episodes(path: str | os.PathLike[str]) -> Episodes:
    """Loads all episodes of a folder, sorted by index, bit for bit as they were appended.

    An episode in two shards is loaded once if both copies are identical.
    """
    info, _ = read_info(path)
    episodes: dict[int, tuple[Episode, Path]] = {}
    for shard in shards_in(Path(path)):
        with reading(shard):
            found = from_table(read_shard(shard), info, shard)
            Episodes(info, found)  # Checks them.
        for episode in found:
            known, where = episodes.setdefault(episode.index, (episode, shard))
            if known is not episode and not is_same(known, episode):
                raise ValueError(
                    f"episode {episode.index} of {where} differs from that of {shard.name}; remove "
                    "one of the shards"
                )
    return Episodes(info, [episodes[index][0] for index in sorted(episodes)])


def _open_folder(path: Path, info: EpisodesInfo, extra: Mapping[str, Any]) -> None:
    """Writes what a set shares, or checks that a folder holds the same set."""
    known = None
    if (path / _INFO_NAME).exists():
        stored, known = read_info(path)
        _check_same_set(path, stored, info)
        info, extra = stored, {**known, **extra}
    if extra == known:
        return
    content = {"schema_version": _SCHEMA_VERSION, "info": dataclasses.asdict(info), "extra": extra}
    try:
        text = json.dumps(content, indent=2, ensure_ascii=False)
    except TypeError as error:
        raise ValueError(f"{path}: info and extra must be made of JSON types: {error}") from error
    write_file(path / _INFO_NAME, text + "\n")


def _check_same_set(path: Path, stored: EpisodesInfo, given: EpisodesInfo) -> None:
    """Raises if the sets differ, and warns if only the package versions do."""
    there = dataclasses.asdict(stored)
    # Through JSON, like the stored info, so that tuples of names equal lists.
    here = json.loads(json.dumps(dataclasses.asdict(given)))
    differences = {
        name: f"{name}: there {there[name]!r}, here {here[name]!r}"
        for name in there
        if there[name] != here[name] and (name != "robot" or there[name])
    }
    versions = differences.pop("versions", None)
    if differences:
        raise ValueError(
            f"{path} holds episodes of another set and cannot be continued "
            f"({'; '.join(differences.values())})"
        )
    if versions:
        _LOGGER.warning("%s was begun with other package versions (%s)", path, versions)


def is_same(a: Episode, b: Episode) -> bool:
    """Whether two episodes are the same to the last bit."""
    for field in dataclasses.fields(Episode):
        left, right = (np.asarray(getattr(episode, field.name)) for episode in (a, b))
        # As bytes, NaN equals itself and 0.0 differs from -0.0.
        if left.shape != right.shape or left.tobytes() != right.tobytes():
            return False
    return True
