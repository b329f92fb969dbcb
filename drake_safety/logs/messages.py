"""Readers of message logs: MCAP files, ROS 1 bags and ROS 2 bags."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.reading import reading
from drake_safety.logs.channel import Channel, listed
from drake_safety.logs.log_map import LogTime

Message = tuple[str, int, Any]
"""Topic, recording time [ns] and decoded message."""

_STEP = re.compile(r"([^.\[\]]+)|\[([^\[\]]+)\]|\.")


def read_mcap(path: Path, wanted: Mapping[str, Sequence[str]], time: LogTime) -> dict[str, Channel]:
    """Reads the wanted fields, by topic, of an MCAP file with ROS 2 messages."""
    require_extra("logs", f"log '{path}'", "mcap", "mcap_ros2")
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    # A damaged file makes the reader raise errors of any kind.
    with reading(path, "damaged, or not an MCAP file: log", Exception), path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        if summary is None:
            raise ValueError(f"log '{path}' is cut off: it has no summary")
        _require_topics(path, wanted, {c.topic for c in summary.channels.values()})
        messages = (
            (channel.topic, message.log_time, decoded)
            for _, channel, message, decoded in reader.iter_decoded_messages(
                topics=list(wanted), log_time_order=True
            )
        )
        return _channels(path, messages, wanted, time)


def read_bag(path: Path, wanted: Mapping[str, Sequence[str]], time: LogTime) -> dict[str, Channel]:
    """Reads the wanted fields, by topic, of a ROS 1 bag (a file) or a ROS 2 bag (a folder)."""
    require_extra("logs", f"log '{path}'", "rosbags")
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    # A damaged bag makes the reader raise errors of any kind.
    with (
        reading(path, "damaged, or not a ROS bag: log", Exception),
        AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader,
    ):
        connections = [c for c in reader.connections if c.topic in wanted]
        _require_topics(path, wanted, {c.topic for c in reader.connections})
        messages = (
            (connection.topic, stamp, reader.deserialize(raw, connection.msgtype))
            for connection, stamp, raw in reader.messages(connections=connections)
        )
        return _channels(path, messages, wanted, time)


def _require_topics(path: Path, wanted: Mapping[str, Sequence[str]], existing: set[str]) -> None:
    if "" in wanted:
        raise ValueError(
            f"log '{path}' has messages: the map must name the topic of {list(wanted[''])}; its "
            f"topics are {listed(sorted(existing))}"
        )
    missing = [topic for topic in wanted if topic not in existing]
    if missing:
        raise ValueError(
            f"log '{path}' has no messages of topics {missing}; its topics are "
            f"{listed(sorted(existing))}"
        )


def _channels(
    path: Path, messages: Iterator[Message], wanted: Mapping[str, Sequence[str]], time: LogTime
) -> dict[str, Channel]:
    fields = {topic: [field_of(name) for name in names] for topic, names in wanted.items()}
    stamp_of = field_of(time.column) if time.column else None
    stamps: dict[str, list[float | int]] = {topic: [] for topic in wanted}
    rows: dict[str, list[list[float]]] = {topic: [] for topic in wanted}
    is_stamp = not time.column
    for topic, recorded_ns, message in messages:
        names = wanted[topic]
        name = time.column
        try:
            if stamp_of is None:
                stamps[topic].append(recorded_ns)
            else:
                stamp = stamp_of(message)
                is_stamp = hasattr(stamp, "nanosec") or hasattr(stamp, "nsec")
                stamps[topic].append(_nanoseconds(stamp) if is_stamp else _number(stamp))
            row = []
            for name, field in zip(names, fields[topic], strict=True):  # noqa: B007 (the error names it)
                row.append(float(_number(field(message))))
            rows[topic].append(row)
        except (LookupError, TypeError) as error:
            raise ValueError(
                f"log '{path}', message {len(rows[topic])} of topic '{topic}': cannot read "
                f"'{name}': {error}"
            ) from error
    return {
        topic: Channel(
            path=path,
            topic=topic,
            time=np.array(stamps[topic]),
            time_unit="ns" if is_stamp else time.unit,
            time_name=time.column or "time of recording",
            columns=dict(zip(names, np.array(rows[topic]).reshape(-1, len(names)).T, strict=True)),
            row_name="message",
            first_row=0,
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


def _nanoseconds(stamp: Any) -> int:
    if hasattr(stamp, "nanosec"):
        return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nsec)


def _number(value: Any) -> float | int:
    if isinstance(value, np.number):
        return value.item()
    if isinstance(value, int | float):
        return value
    raise TypeError(f"expected a number, got {type(value).__name__}")
