"""Reader of message logs: MCAP files, ROS 1 bags and ROS 2 bags."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.reading import reading
from drake_safety.logs.channel import Channel, Wanted, listed
from drake_safety.logs.log_map import LogTime

_STEP = re.compile(r"([^.\[\]]+)|\[([^\[\]]+)\]|\.")
_REMEDIES = {
    ".mcap": " ('mcap recover' may repair it)",
    ".bag": ", cut off ('rosbag reindex' repairs it)",
}


def read_messages(
    path: Path, wanted: Wanted, time: LogTime
) -> tuple[dict[str, Channel], list[str]]:
    """Reads the wanted fields, by topic, of an MCAP file, a ROS 1 bag or the folder of a ROS 2 bag.

    Of an MCAP file that was cut off the whole chunks are read; the text says how much that is.
    """
    require_extra("logs", f"log '{path}'", "mcap", "rosbags")
    files, has_index = [path], (path / "metadata.yaml").is_file()
    if path.is_dir():
        files = sorted(one for one in path.iterdir() if one.suffix in (".mcap", ".db3"))
    if not (files or has_index):
        raise ValueError(f"log '{path}' is a folder without the metadata.yaml of a ROS 2 bag")
    # A damaged file makes the readers raise errors of any kind.
    what = f"damaged{_REMEDIES.get(path.suffix, '')}, or without ROS messages: log"
    with reading(path, what, Exception), TemporaryDirectory() as folder:
        try:
            return _channels(path, [path] if has_index else files, wanted, time), []
        except Exception as error:
            if str(error).startswith(f"log '{path}'"):  # Of what the map says, not of damage.
                raise
            copies = {one: Path(folder) / one.name for one in files if one.suffix == ".mcap"}
            shares = [_recover(one, copy, wanted) for one, copy in copies.items()]
            if not any(shares):
                raise
        channels = _channels(path, [*copies.values()], wanted, time)
        share = np.average(shares, weights=[one.stat().st_size for one in copies])
        cut = f"log '{path}' is cut off: what is whole is read, {share:.0%} of its bytes"
        return channels, [cut] if share < 1 else []


def _recover(source: Path, target: Path, wanted: Wanted) -> float:
    """Copies the whole chunks of an MCAP file; returns the share of its bytes.

    Topics that are not ROS messages are left out: one of them makes rosbags refuse the file.
    """
    from mcap.reader import NonSeekingReader
    from mcap.writer import Writer

    end, ids, others = 0, dict[int, int](), dict[str, str]()
    with source.open("rb") as old, target.open("wb") as new:
        writer = Writer(new)
        writer.start("ros2")
        with suppress(Exception):
            reader = NonSeekingReader(old, validate_crcs=True)
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                if channel.message_encoding != "cdr" or schema is None:
                    others[channel.topic] = channel.message_encoding
                    continue
                if channel.id not in ids:
                    kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                    ids[channel.id] = writer.register_channel(channel.topic, "cdr", kind)
                times = message.log_time, message.publish_time
                writer.add_message(ids[channel.id], times[0], message.data, times[1])
                end = old.tell()
            end = source.stat().st_size
        writer.finish()
    for topic in filter(others.get, wanted):
        raise ValueError(
            f"log '{source}': messages of topic '{topic}' are encoded as '{others[topic]}', "
            "expected ROS's 'cdr'"
        )
    return end / max(source.stat().st_size, 1)


def _channels(
    path: Path, files: Sequence[Path], wanted: Wanted, time: LogTime
) -> dict[str, Channel]:
    import pandas as pd
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    reads = {name: field_of(name) for names in wanted.values() for name in names}
    clock = field_of(time.column) if time.column else None
    stamps: dict[str, list[Any]] = {topic: [] for topic in wanted}
    rows: dict[str, list[list[float]]] = {topic: [] for topic in wanted}
    errors: dict[tuple[str, str], ValueError] = {}

    def value(name: str, read: Callable[[Any], Any]) -> Any:
        """A value of the message, or NaN if it lacks it: others may have it."""
        try:
            return _number(read(message))
        except (LookupError, TypeError) as error:
            where = f"log '{path}', message {len(rows[topic])} of topic '{topic}'"
            errors.setdefault((topic, name), ValueError(f"{where}: cannot read '{name}': {error}"))
            return math.nan

    with AnyReader(files, default_typestore=get_typestore(Stores.LATEST)) as reader:
        there = f"its topics are {listed(sorted({c.topic for c in reader.connections}))}"
        if "" in wanted:
            raise ValueError(
                f"log '{path}' has messages: the map must name the topic of {list(wanted[''])}; "
                f"{there}"
            )
        connections = [c for c in reader.connections if c.topic in wanted]
        if missing := wanted.keys() - {c.topic for c in connections}:
            raise ValueError(f"log '{path}' has no messages of topics {sorted(missing)}; {there}")
        for connection, recorded_ns, raw in reader.messages(connections=connections):
            topic = connection.topic
            # Some writers of MCAP omit the "msg" of "nav_msgs/msg/Odometry".
            kind = connection.msgtype.replace("/msg/", "/").replace("/", "/msg/")
            message = reader.deserialize(raw, kind)
            row = [value(name, reads[name]) for name in wanted[topic]]
            stamp = value(time.column, clock) if clock else np.timedelta64(recorded_ns, "ns")
            rows[topic].append(row)
            stamps[topic].append(stamp)
    channels = {}
    for topic, names in wanted.items():
        frame = pd.DataFrame(rows[topic], columns=names, dtype=float)
        empty = [name for name in names if frame[name].isna().all()]
        for name in (time.column, *empty):
            if (topic, name) in errors:
                raise errors[topic, name]
        is_known = frame.notna().any(axis=1)  # Other messages are of another part of the robot.
        channels[topic] = Channel(
            path=path,
            topic=topic,
            time=np.array(stamps[topic])[is_known],
            time_unit=time.unit,
            time_name=time.column or "time of recording",
            frame=frame[is_known],
            row_name="message",
        )
    return channels


def field_of(path: str) -> Callable[[Any], Any]:
    """Returns a function that reads a field of a message.

    A path is ``pose.pose.position.x``; ``position[3]``; or ``position[NAME]``, the entry with the
    index of NAME in the sibling field ``name``, as in sensor_msgs/JointState, or the entry with the
    ``child_frame_id`` or ``name`` NAME, as in ``transforms[base]``.
    """
    if not path or "".join(match.group() for match in _STEP.finditer(path)) != path:
        raise ValueError(f"'{path}' is not a field path, such as pose.position.x or q[3]")
    steps = [match.groups() for match in _STEP.finditer(path) if match.group() != "."]

    def field(owner: Any, name: str) -> Any:
        if not hasattr(owner, name):
            existing = [key for key in getattr(owner, "__dict__", ()) if key[0] != "_"]
            raise LookupError(f"there is no field '{name}'; the fields are {listed(existing)}")
        return getattr(owner, name)

    def read(message: Any) -> Any:
        value, owner = message, message
        for name, index in steps:
            if name is not None:
                owner, value = value, field(value, name)
            elif not len(value):
                return math.nan  # Not filled in, as sensor_msgs/JointState allows.
            elif index.isdecimal():
                value = value[int(index)]
            elif index in (names := _names_of(owner, value)):
                value = value[names.index(index)]
            else:
                raise LookupError(f"no entry is named '{index}'; the names are {listed(names)}")
        return value

    return read


def _names_of(owner: Any, entries: Any) -> list[str]:
    """Names of a field's entries: their own, as of transforms, or those beside the field."""
    for key in ("child_frame_id", "name"):
        if all(hasattr(one, key) for one in entries):
            return [str(getattr(one, key)).lstrip("/") for one in entries]
    if not hasattr(owner, "name"):
        raise LookupError(f"entries are selected by number, 0 to {len(entries) - 1}, or by name")
    return list(owner.name)


def _number(value: Any) -> Any:
    """A number; a ROS stamp as a duration."""
    if hasattr(value, "nanosec"):
        return np.timedelta64(int(value.sec) * 1_000_000_000 + int(value.nanosec), "ns")
    if isinstance(value, np.number | int | float):
        return value
    raise TypeError(f"expected a number, got {type(value).__name__}")
