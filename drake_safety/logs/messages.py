"""Readers of message logs: MCAP files, ROS 1 bags and ROS 2 bags."""

from __future__ import annotations

import math
import re
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.reading import reading
from drake_safety.logs.channel import Channel, Wanted, listed
from drake_safety.logs.log_map import LogTime

Message = tuple[str, int, Any]
"""Topic, recording time [ns] and decoded message."""

_STEP = re.compile(r"([^.\[\]]+)|\[([^\[\]]+)\]|\.")


def read_mcap(
    path: Path, wanted: Wanted, time: LogTime, files: Sequence[Path] = ()
) -> tuple[dict[str, Channel], str]:
    """Reads the wanted fields, by topic, of an MCAP file with ROS 2 messages, or of several files.

    Of a file that was cut off the whole chunks are read; the text says how much that is.
    """
    require_extra("logs", f"log '{path}'", "mcap", "mcap_ros2")
    from mcap.reader import NonSeekingReader
    from mcap_ros2.decoder import DecoderFactory

    existing: set[str] = set()
    found: list[tuple[int, DecoderFactory, Any]] = []
    kept, size = 0, 0
    # A damaged file makes the reader raise errors of any kind.
    what = "damaged ('mcap recover' may mend it), or not an MCAP file: log"
    with reading(path, what, Exception):
        for one in files or [path]:
            factory, end = DecoderFactory(), 0
            with one.open("rb") as file:
                reader = NonSeekingReader(file, validate_crcs=True)
                try:
                    for record in reader.iter_messages(log_time_order=False):
                        existing.add(record[1].topic)
                        if record[1].topic in wanted:
                            found.append((record[2].log_time, factory, record))
                        end = file.tell()
                    end = one.stat().st_size
                except Exception:
                    if not kept + end:
                        raise
            kept, size = kept + end, size + one.stat().st_size
        _require_topics(path, wanted, existing)
        messages = map(_decoded, sorted(found, key=lambda one: one[0]))
        cut = f"log '{path}' is cut off: its whole chunks are read, {kept / size:.0%} of its bytes"
        return _channels(path, messages, wanted, time), cut if kept < size else ""


def _decoded(found: tuple[int, Any, Any]) -> Message:
    stamp, factory, (schema, channel, message) = found
    decode = factory.decoder_for(channel.message_encoding, schema)
    if decode is None:
        raise ValueError(
            f"messages of topic '{channel.topic}' are encoded as '{channel.message_encoding}', "
            "expected ROS 2's 'cdr'"
        )
    return channel.topic, stamp, decode(message.data)


def read_bag(path: Path, wanted: Wanted, time: LogTime) -> tuple[dict[str, Channel], str]:
    """Reads the wanted fields, by topic, of a ROS 1 bag (a file) or a ROS 2 bag (a folder).

    Of a ROS 2 bag that was cut off what is left is read; the text says how much that is.
    """
    require_extra("logs", f"log '{path}'", "rosbags")
    hint = ", cut off ('rosbag reindex' mends it)" if path.suffix == ".bag" else ""
    # A damaged bag makes the reader raise errors of any kind.
    with reading(path, f"damaged{hint}, or not a ROS bag: log", Exception):
        chunked, files = (sorted(path.glob(f"*.{kind}")) for kind in ("mcap", "db3"))
        has_index = path.is_file() or (path / "metadata.yaml").is_file()
        try:
            return _read_bags(path, [path] if has_index else chunked + files, wanted, time), ""
        except Exception as error:
            if str(error).startswith(f"log '{path}'"):  # Of what the map says, not of damage.
                raise
            if chunked:
                return read_mcap(path, wanted, time, chunked)
            if not files:
                raise
            with TemporaryDirectory() as folder:
                copies = [Path(folder) / one.name for one in files]
                share = np.mean([_recover(*both) for both in zip(files, copies, strict=True)])
                channels = _read_bags(path, copies, wanted, time)
            return channels, f"log '{path}' is cut off: {share:.0%} of its bytes are left"


def _read_bags(
    path: Path, files: Sequence[Path], wanted: Wanted, time: LogTime
) -> dict[str, Channel]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader(files, default_typestore=get_typestore(Stores.LATEST)) as reader:
        connections = [c for c in reader.connections if c.topic in wanted]
        _require_topics(path, wanted, {c.topic for c in reader.connections})
        messages = (
            (connection.topic, stamp, reader.deserialize(raw, connection.msgtype))
            for connection, stamp, raw in reader.messages(connections=connections)
        )
        return _channels(path, messages, wanted, time)


def _recover(source: Path, target: Path) -> float:
    """Copies an SQLite file up to the first row that is lost; returns the share of its bytes."""
    data, uri = source.read_bytes(), f"{source.resolve().as_uri()}?mode=ro"
    size = int.from_bytes(data[16:18], "big") * int.from_bytes(data[28:32], "big")
    with closing(sqlite3.connect(uri, uri=True)) as old, closing(sqlite3.connect(target)) as new:
        old.execute("PRAGMA writable_schema=ON")  # Else a file that lacks pages is not opened.
        tables = "SELECT name, sql FROM sqlite_master WHERE type = 'table'"
        for name, statement in old.execute(tables).fetchall():
            with suppress(sqlite3.DatabaseError):
                new.execute(statement)
                for row in old.execute(f'SELECT * FROM "{name}"'):
                    new.execute(f'INSERT INTO "{name}" VALUES ({",".join("?" * len(row))})', row)
        new.commit()
    return min(len(data) / max(size, 1), 1.0)


def _require_topics(path: Path, wanted: Wanted, existing: set[str]) -> None:
    there = f"its topics are {listed(sorted(existing))}"
    if "" in wanted:
        raise ValueError(
            f"log '{path}' has messages: the map must name the topic of {list(wanted[''])}; {there}"
        )
    if missing := [topic for topic in wanted if topic not in existing]:
        raise ValueError(f"log '{path}' has no messages of topics {missing}; {there}")


def _channels(
    path: Path, messages: Iterator[Message], wanted: Wanted, time: LogTime
) -> dict[str, Channel]:
    stamp_names = [time.column] if time.column else []
    fields = {one: {n: field_of(n) for n in (*wanted[one], *stamp_names)} for one in wanted}
    found: dict[str, list[tuple[int, float | int, list[float]]]] = {topic: [] for topic in wanted}
    failed: dict[tuple[str, str], ValueError] = {}
    counts: Counter[str] = Counter()
    is_stamp = not time.column

    def read(topic: str, name: str, message: Any) -> float | int:
        """A number, or NaN if the message lacks it: others may have it."""
        nonlocal is_stamp
        try:
            value = fields[topic][name](message)
            is_stamp = is_stamp or hasattr(value, "sec")
            return _number(value)
        except (LookupError, TypeError) as error:
            where = f"log '{path}', message {counts[topic]} of topic '{topic}'"
            failed.setdefault((topic, name), ValueError(f"{where}: cannot read '{name}': {error}"))
            return math.nan

    for topic, recorded_ns, message in messages:
        row = [float(read(topic, name, message)) for name in wanted[topic]]
        stamp = read(topic, time.column, message) if time.column else recorded_ns
        if not all(map(math.isnan, row)):  # Such as the joints of another part of the robot.
            found[topic].append((counts[topic], stamp, row))
        counts[topic] += 1
    rows = {topic: np.array([row for _, _, row in found[topic]]) for topic in wanted}
    tables = {topic: rows[topic].reshape(-1, len(names)) for topic, names in wanted.items()}
    for (topic, name), error in failed.items():
        if name == time.column or np.isnan(tables[topic][:, wanted[topic].index(name)]).all():
            raise error
    return {
        topic: Channel(
            path=path,
            topic=topic,
            time=np.array([stamp for _, stamp, _ in found[topic]]),
            time_unit="ns" if is_stamp else time.unit,
            time_name=time.column or "time of recording",
            columns=dict(zip(names, tables[topic].T, strict=True)),
            row_name="message",
            rows=np.array([number for number, _, _ in found[topic]], dtype=int),
        )
        for topic, names in wanted.items()
    }


def field_of(path: str) -> Callable[[Any], Any]:
    """Returns a function that reads a field of a message.

    A path is ``pose.pose.position.x``; ``position[3]``; or ``position[NAME]``, the entry with the
    index of NAME in the sibling field ``name``, as in sensor_msgs/JointState.
    """
    if not path or "".join(match.group() for match in _STEP.finditer(path)) != path:
        raise ValueError(f"'{path}' is not a field path, such as pose.position.x or q[3]")
    steps = [match.groups() for match in _STEP.finditer(path) if match.group() != "."]

    def read(message: Any) -> Any:
        value, owner = message, message
        for name, index in steps:
            if name is not None:
                owner, value = value, _attribute(value, name)
            elif index.isdecimal():
                value = value[int(index)]
            else:
                value = value[_place(owner, index)]
        return value

    return read


def _attribute(message: Any, name: str) -> Any:
    if not hasattr(message, name):
        existing = [key for key in getattr(message, "__slots__", None) or vars(message)]
        existing = [key for key in existing if not key.startswith("_")]
        raise LookupError(f"there is no field '{name}'; the fields are {listed(existing)}")
    return getattr(message, name)


def _place(owner: Any, name: str) -> int:
    names = list(_attribute(owner, "name"))
    if name not in names:
        raise LookupError(f"no entry is named '{name}'; the names are {listed(names)}")
    return names.index(name)


def _number(value: Any) -> float | int:
    """A number; a ROS stamp in nanoseconds."""
    if hasattr(value, "sec"):
        fraction = value.nanosec if hasattr(value, "nanosec") else value.nsec
        return int(value.sec) * 1_000_000_000 + int(fraction)
    if isinstance(value, np.number):
        return value.item()
    if isinstance(value, int | float):
        return value
    raise TypeError(f"expected a number, got {type(value).__name__}")
