"""Reader of message logs: MCAP files, ROS 1 bags and ROS 2 bags."""

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.reading import parse_yaml, reading
from drake_safety.files.schema import load_typed
from drake_safety.logs.channel import Channel, Wanted, listed
from drake_safety.logs.log_map import ATTACHED_MAP, LogMap, LogTime

_STEP = re.compile(r"([^.\[\]]+)|\[([^\[\]]+)\]|\.")
_REMEDIES = {
    ".mcap": " ('mcap recover' may repair it)",
    ".bag": ", cut off ('rosbag reindex' repairs it)",
    "": ", cut off ('ros2 bag reindex' may repair it)",
}


def read_messages(path: Path, wanted: Wanted, time: LogTime) -> dict[str, Channel]:
    """Reads fields of an MCAP file, a ROS 1 bag or a ROS 2 bag's folder, by topic."""
    require_extra("logs", f"log '{path}'", "mcap", "rosbags")
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise ValueError(f"log '{path}' is a folder without the metadata.yaml of a ROS 2 bag")
    # A damaged file makes the readers raise errors of any kind.
    what = f"damaged{_REMEDIES.get(path.suffix, '')}, or with messages other than ROS's: log"
    with reading(path, what, Exception):
        return _channels(path, wanted, time)


def _channels(path: Path, wanted: Wanted, time: LogTime) -> dict[str, Channel]:
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

    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
        there = f"its topics are {listed(sorted({c.topic for c in reader.connections}))}"
        if "" in wanted:
            what = f"the map must name the topic of {list(wanted[''])}"
            raise ValueError(f"log '{path}' has messages: {what}; {there}")
        connections = [c for c in reader.connections if c.topic in wanted]
        if missing := wanted.keys() - {c.topic for c in connections}:
            raise ValueError(f"log '{path}' has no messages of topics {sorted(missing)}; {there}")
        for connection, recorded_ns, raw in reader.messages(connections=connections):
            topic = connection.topic
            # Some writers of MCAP omit the "msg" of "nav_msgs/msg/Odometry".
            kind = connection.msgtype.replace("/msg/", "/").replace("/", "/msg/")
            message = reader.deserialize(raw, kind)
            stamp = value(time.column, clock) if clock else np.timedelta64(recorded_ns, "ns")
            stamps[topic].append(stamp)
            rows[topic].append([value(name, reads[name]) for name in wanted[topic]])
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


def recorded_topics(path: Path) -> set[str]:
    """Topics of an MCAP file."""
    require_extra("logs", f"log '{path}'", "mcap")
    from mcap.reader import make_reader

    with reading(path, f"damaged{_REMEDIES['.mcap']}: log", Exception), path.open("rb") as file:
        summary = make_reader(file).get_summary()
    return {channel.topic for channel in summary.channels.values()} if summary else set()


def attached_map(path: Path) -> LogMap:
    """The map attached to an MCAP file, as `McapRecorder` attaches it."""
    if path.suffix.lower() == ".mcap":
        require_extra("logs", f"log '{path}'", "mcap")
        from mcap.reader import make_reader

        what, who = f"damaged{_REMEDIES['.mcap']}: log", f"map '{ATTACHED_MAP}' in '{path}'"
        with reading(path, what, Exception), path.open("rb") as file:
            for attachment in make_reader(file).iter_attachments():
                if attachment.name == ATTACHED_MAP:
                    return load_typed(LogMap, parse_yaml(attachment.data.decode(), who), who)
    raise ValueError(f"log '{path}' has no map of its own: pass --map")


def field_of(path: str) -> Callable[[Any], Any]:
    """Returns a function that reads a field of a message, with entries by number or by name."""
    if not path or "".join(match.group() for match in _STEP.finditer(path)) != path:
        raise ValueError(f"'{path}' is not a field path, such as pose.position.x or q[3]")
    steps = [match.groups() for match in _STEP.finditer(path) if match.group() != "."]

    def field(owner: Any, name: str) -> Any:
        if not hasattr(owner, name):
            existing = [key for key in getattr(owner, "__dict__", ()) if key[0] != "_"]
            raise LookupError(f"no field '{name}'; the fields are {listed(existing)}")
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
    """Names of a field's entries: their own, as of transforms, or beside it, as of joints."""
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
