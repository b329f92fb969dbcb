"""Episodes on disk: a folder with an ``info.json`` and Parquet shards, written as they finish.

``info.json`` holds what all episodes share. Each ``episodes-NNNNN.parquet`` has one row per
(episode, step); arrays are columns of fixed-size lists of float64 in SI units. A file is written
under a temporary name, which starts with a dot, and renamed: a file with its final name is
complete, and an interrupted run loses at most the episodes that were not flushed. pandas reads the
rows by ``pandas.read_parquet(sorted(folder.glob("episodes-*.parquet")))``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import logging
import os
import re
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from drake_safety.learning.segments import DIVERGED, Episode, Episodes, EpisodesInfo
from drake_safety.robots.reading import reading, shortened

if TYPE_CHECKING:
    import pyarrow as pa
    from filelock import BaseFileLock

_SCHEMA_VERSION = 1
_INFO_NAME = "info.json"
_FAILURES = "num_controller_failures"
_EARLIER_CODE = "earlier_code"
_LARGEST = 1e12  # Of any quantity in SI units.
_SHARD_NAME = re.compile(r"episodes-\d{5,}\.parquet")
_LOGGER = logging.getLogger("drake_safety")


class EpisodeWriter:
    """Appends episodes to a folder, a shard at a time; a context manager.

    Leaving the ``with`` block writes the pending episodes, after an exception or Ctrl-C too. A
    folder that holds episodes is continued: ``completed(path)`` gives their indices. The folder is
    locked until the writer is closed or its process ends.

    Args:
        path: The folder; made if it does not exist.
        info: Metadata common to all episodes.
        extra: Further content of ``info.json``, as JSON types (the command, the scenario's text,
            ...). In a folder that is continued, it replaces entries of the same names.
        flush_episodes: Number of pending episodes that are written as a shard.
        flush_seconds: Age of the oldest pending episode at which they are written [s].
        accept_code_change: See :func:`open_folder`.

    Raises:
        ValueError: The folder holds another set of episodes, or something else, or has a writer.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        info: EpisodesInfo,
        extra: Mapping[str, Any] | None = None,
        *,
        flush_episodes: int = 64,
        flush_seconds: float = 10.0,
        accept_code_change: bool = False,
    ) -> None:
        if flush_episodes < 1:
            raise ValueError(f"EpisodeWriter: flush_episodes must be >= 1; got {flush_episodes}")
        if not flush_seconds > 0:
            raise ValueError(f"EpisodeWriter: flush_seconds must be > 0; got {flush_seconds}")
        self.path = Path(path)
        self.info = info
        self._flush_episodes = flush_episodes
        self._flush_seconds = flush_seconds
        self._pending: list[Episode] = []
        self._timer: threading.Timer | None = None
        self._access = threading.RLock()  # Of the pending episodes.
        self._is_closed = False
        self._lock = _locked(self.path)
        try:
            self._open(info, extra, accept_code_change)
        except BaseException:
            self._lock.release()
            raise

    def _open(
        self, info: EpisodesInfo, extra: Mapping[str, Any] | None, accept_code_change: bool
    ) -> None:
        for left_behind in self.path.glob(".*.tmp"):
            left_behind.unlink()
        # Before info.json is written: a folder with shards but no info.json is refused.
        self._indices = completed(self.path)
        open_folder(self.path, info, extra, accept_code_change=accept_code_change)
        self._next_shard = 1 + max(
            (_shard_number(shard) for shard in _shards(self.path)), default=-1
        )

    def append(self, episode: Episode) -> None:
        """Adds one episode; it is on disk after the next flush.

        Raises:
            ValueError: The writer is closed, the folder has an episode of this index, or the
                episode does not fit the info.
        """
        if self._is_closed:
            raise ValueError(f"EpisodeWriter of {self.path} is closed; open it again to append")
        if episode.index in self._indices:
            raise ValueError(f"episode {episode.index} is already in {self.path}; see completed()")
        Episodes(self.info, [episode])  # Checks the shapes.
        with self._access:
            self._pending.append(episode)
            self._indices.add(episode.index)
            if len(self._pending) >= self._flush_episodes:
                self.flush()
            elif self._timer is None:
                self._timer = threading.Timer(self._flush_seconds, self._flush_by_the_clock)
                self._timer.daemon = True
                self._timer.start()

    def _flush_by_the_clock(self) -> None:
        try:
            self.flush()
        except OSError as error:
            # They are still pending: the next flush tries again, and raises.
            _LOGGER.warning("%s: episodes could not be written yet: %s", self.path, error)

    def flush(self) -> None:
        """Writes the pending episodes as one shard."""
        with self._access:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
            if self._pending:
                self._write()

    def _write(self) -> None:
        import pyarrow.parquet as pq

        table = _to_table(self._pending, self.info)
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
        self._pending = []

    def close(self) -> None:
        """Writes the pending episodes and unlocks the folder; the writer takes no more."""
        try:
            self.flush()
        finally:
            self._is_closed = True
            self._lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def _locked(path: Path) -> BaseFileLock:
    """Makes the folder if it does not exist, and locks it."""
    from filelock import FileLock, Timeout

    path.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path / ".lock", thread_local=False)
    try:
        # The operating system unlocks it when the process ends, however that happens.
        lock.acquire(timeout=0)
    except Timeout:
        raise ValueError(
            f"{path} is being written by another process or another EpisodeWriter: wait for it, "
            "stop it, or choose another folder"
        ) from None
    return lock


def open_folder(
    path: str | os.PathLike[str],
    info: EpisodesInfo,
    extra: Mapping[str, Any] | None = None,
    *,
    accept_code_change: bool = False,
) -> None:
    """Makes the folder of a set, or checks that an existing folder holds the same set.

    Args:
        path: The folder.
        info: Metadata of the set.
        extra: Further content of ``info.json``, as JSON types; replaces entries of the same names.
        accept_code_change: Whether a set begun with other source code may be continued; the
            digests of the earlier code are kept in ``info.json``.

    Raises:
        ValueError: The folder holds another set, a set begun with other source code, or something
            else.
    """
    path = Path(path)
    path.mkdir(parents=True, exist_ok=True)
    if (path / _INFO_NAME).exists():
        stored, known = read_info(path)
        _check_same_set(path, stored, info)
        merged = {**known, **(extra or {})}
        if stored.code != info.code:
            if not accept_code_change:
                raise ValueError(
                    f"{path} holds episodes that other source code simulated (digest there "
                    f"'{stored.code[:12]}', here '{info.code[:12]}'), so they may differ from new "
                    "ones; choose another folder, or accept it: accept_code_change=True, on the "
                    "command line --accept-code-change"
                )
            merged[_EARLIER_CODE] = [*known.get(_EARLIER_CODE, []), stored.code]
            stored = dataclasses.replace(stored, code=info.code)
        if known != merged:
            _write_info(path, stored, merged)
    else:
        _write_info(path, info, extra or {})


def read_info(path: str | os.PathLike[str]) -> tuple[EpisodesInfo, dict[str, Any]]:
    """Reads the metadata of a folder's episodes, and the extra stored with it.

    Raises:
        ValueError: There is no ``info.json``, or it has another schema.
    """
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
    try:
        if not isinstance(extra, dict):
            raise TypeError("it has no extra")
        # Fields that older folders lack have defaults that mean "unknown".
        return EpisodesInfo(**fields), extra
    except (TypeError, ValueError) as error:
        raise ValueError(f"{file} does not describe episodes: {shortened(str(error))}") from error


def completed(path: str | os.PathLike[str]) -> set[int]:
    """Indices of the episodes on disk; empty if nothing was written yet.

    Raises:
        ValueError: A shard is truncated or damaged, or there are shards but no ``info.json``.
    """
    shards = _shards(Path(path))
    if shards and not (Path(path) / _INFO_NAME).exists():
        raise ValueError(
            f"{path} holds {len(shards)} shards but no {_INFO_NAME}, so the set that they belong "
            "to is unknown"
        )
    indices: set[int] = set()
    for shard in shards:
        indices.update(_read_shard(shard, ["episode"]).column("episode").unique().to_pylist())
    return indices


def load_episodes(path: str | os.PathLike[str]) -> Episodes:
    """Loads all episodes of a folder, sorted by index, bit for bit as they were appended.

    An episode in two shards is loaded once if both copies are identical.

    Raises:
        ValueError: The folder has no ``info.json``, a shard is truncated, damaged or of another
            set, or two shards hold different episodes of the same index.
    """
    info, _ = read_info(path)
    episodes: dict[int, tuple[Episode, Path]] = {}
    for shard in _shards(Path(path)):
        with reading(shard):
            found = _from_table(_read_shard(shard), info, shard)
            Episodes(info, found)  # Checks them.
        for episode in found:
            known, where = episodes.setdefault(episode.index, (episode, shard))
            if known is not episode and not _is_same(known, episode):
                raise ValueError(
                    f"episode {episode.index} of {where} differs from that of {shard.name}; remove "
                    "one of the shards"
                )
    return Episodes(info, [episodes[index][0] for index in sorted(episodes)])


@contextlib.contextmanager
def replacing(final: Path) -> Iterator[Path]:
    """A temporary file beside a final one, renamed to it on success and removed on any exception.

    Args:
        final: Path of the complete file.
    """
    # Readers of folders (pyarrow, pandas) skip names that start with a dot.
    temporary = final.with_name(f".{final.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        # The bytes reach the disk before the name does.
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(final)
    finally:
        temporary.unlink(missing_ok=True)


def _write_info(path: Path, info: EpisodesInfo, extra: Mapping[str, Any]) -> None:
    content = {
        "schema_version": _SCHEMA_VERSION,
        "info": dataclasses.asdict(info),
        "extra": dict(extra),
    }
    try:
        text = json.dumps(content, indent=2, ensure_ascii=False)
    except TypeError as error:
        raise ValueError(f"{path}: info and extra must be made of JSON types: {error}") from error
    with replacing(path / _INFO_NAME) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def _check_same_set(path: Path, stored: EpisodesInfo, given: EpisodesInfo) -> None:
    """Raises if the sets differ, and warns if only the package versions do."""
    there = dataclasses.asdict(stored)
    # Through JSON, like the stored info, so that tuples of names equal lists.
    here = json.loads(json.dumps(dataclasses.asdict(given)))
    differences = {
        name: f"{name}: there {there[name]!r}, here {here[name]!r}"
        for name in there
        if there[name] != here[name]
    }
    versions = differences.pop("versions", None)
    differences.pop("code", None)  # Which may be accepted.
    if differences:
        raise ValueError(
            f"{path} holds episodes of another set and cannot be continued "
            f"({'; '.join(differences.values())})"
        )
    if versions:
        _LOGGER.warning("%s was begun with other package versions (%s)", path, versions)


def _to_table(episodes: Sequence[Episode], info: EpisodesInfo) -> pa.Table:
    import pyarrow as pa

    counts = [len(episode.time_s) for episode in episodes]

    def repeat(values: Sequence[Any], dtype: Any) -> np.ndarray:
        return np.repeat(np.asarray(values, dtype=dtype), counts)

    columns: dict[str, Any] = {
        "episode": repeat([episode.index for episode in episodes], np.int64),
        "step": np.concatenate([np.arange(count, dtype=np.int32) for count in counts]),
        "time_s": np.concatenate([np.asarray(e.time_s, dtype=np.float64) for e in episodes]),
    }
    for name, width in info.widths.items():
        # Parquet has no lists of length 0: such an array has no column.
        if width:
            rows = [np.asarray(getattr(e, name), dtype=np.float64).reshape(-1) for e in episodes]
            columns[name] = pa.FixedSizeListArray.from_arrays(pa.array(np.concatenate(rows)), width)
    causes = [episode.cause for episode in episodes]
    columns["is_safe"] = repeat([episode.is_safe for episode in episodes], np.bool_)
    columns["cause"] = pa.array(np.repeat(np.asarray(causes, dtype=object), counts), pa.string())
    columns["first_step"] = repeat([episode.first_step for episode in episodes], np.int32)
    failures = [episode.num_controller_failures for episode in episodes]
    columns[_FAILURES] = repeat(failures, np.int32)
    return pa.table(columns)


def _from_table(table: pa.Table, info: EpisodesInfo, shard: Path) -> list[Episode]:
    widths = info.widths
    names = ["episode", "step", "time_s", *(name for name, width in widths.items() if width)]
    names += ["is_safe", "cause", "first_step"]
    # Older shards have no count of failures; nothing is learned from it.
    if table.column_names not in ([*names, _FAILURES], names):
        raise ValueError(
            f"{shard} has columns {table.column_names}; expected {[*names, _FAILURES]}"
        )
    arrays: dict[str, np.ndarray] = {}
    for name, width in widths.items():
        if not width:
            arrays[name] = np.empty((table.num_rows, 0))
            continue
        column = table.column(name).combine_chunks()
        if getattr(column.type, "list_size", None) != width:
            raise ValueError(f"{shard}: {name} is {column.type}; expected lists of length {width}")
        arrays[name] = column.flatten().to_numpy().reshape(table.num_rows, width)
    for name in ["episode", "step", "time_s", "is_safe", "cause", "first_step"]:
        arrays[name] = table.column(name).to_numpy()
    failures = np.zeros(table.num_rows, dtype=int)
    if _FAILURES in table.column_names:
        failures = table.column(_FAILURES).to_numpy()
    episode = arrays["episode"]
    if not len(episode):
        raise ValueError(f"{shard} holds no episodes")
    bounds = [0, *(np.flatnonzero(np.diff(episode)) + 1), table.num_rows]
    result = []
    for first, last in itertools.pairwise(bounds):
        rows = slice(first, last)
        if not np.array_equal(arrays["step"][rows], np.arange(last - first)):
            raise ValueError(f"{shard}: the steps of episode {episode[first]} are not 0, 1, 2, ...")
        if not (np.diff(arrays["time_s"][rows]) > 0.0).all():
            raise ValueError(f"{shard}: the time of episode {episode[first]} does not increase")
        if arrays["cause"][first] != DIVERGED:
            for name in ("time_s", *widths):
                if not (np.abs(arrays[name][rows]) < _LARGEST).all():
                    raise ValueError(
                        f"{shard}: {name} of episode {episode[first]} holds values that are not "
                        f"finite numbers below {_LARGEST:g}"
                    )
        result.append(
            Episode(
                index=int(episode[first]),
                time_s=arrays["time_s"][rows].copy(),
                **{name: arrays[name][rows].copy() for name in widths},
                is_safe=bool(arrays["is_safe"][first]),
                cause=str(arrays["cause"][first]),
                first_step=int(arrays["first_step"][first]),
                num_controller_failures=int(failures[first]),
            )
        )
    return result


def _is_same(a: Episode, b: Episode) -> bool:
    for field in dataclasses.fields(Episode):
        left, right = getattr(a, field.name), getattr(b, field.name)
        if isinstance(left, np.ndarray):
            # As bytes, NaN equals itself and 0.0 differs from -0.0.
            if left.shape != right.shape or left.tobytes() != right.tobytes():
                return False
        elif left != right:
            return False
    return True


def _shards(path: Path) -> list[Path]:
    if not path.is_dir():
        return []
    return sorted(
        (file for file in path.iterdir() if _SHARD_NAME.fullmatch(file.name)), key=_shard_number
    )


def _shard_number(shard: Path) -> int:
    return int(shard.stem.removeprefix("episodes-"))


def _read_shard(shard: Path, columns: list[str] | None = None) -> pa.Table:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        # ParquetFile and not read_table, which adds columns for folders named like `seed=1`.
        with pq.ParquetFile(shard, page_checksum_verification=True) as file:
            table = file.read(columns=columns)
    except (pa.ArrowException, OSError) as error:
        raise ValueError(
            f"shard {shard} is truncated or damaged ({error}); remove it and resume: its episodes "
            "will be run again"
        ) from error
    if columns is not None and table.column_names != columns:
        raise ValueError(f"{shard} holds no episodes: expected columns {columns}")
    return table
