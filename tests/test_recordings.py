"""Recordings as loggers, exporters and recorders leave them say what a clean one says."""

import dataclasses
import shutil
from datetime import UTC, datetime

import numpy as np
import pytest

from drake_safety.logs.robot_log import read_log, read_pieces
from log_files import (
    ORIGIN_NS,
    TABLE_MAP,
    balancing_loop,
    frame_of,
    map_text,
    part,
    recorded,
    walked,
    write,
)

pytestmark = pytest.mark.train
pd = pytest.importorskip("pandas")
ROBOT = balancing_loop().robot
JOINTS = balancing_loop().kinematics.joint_names
PLAIN = part(walked(), 0, 60)


def read(path, *changes, kind="csv", reader=read_pieces):
    text = map_text(kind)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (path.parent / "columns.yaml").write_text(text)
    return reader(path, path.parent / "columns.yaml", ROBOT)


def assert_reads(found, log=PLAIN, first=0, last=None, atol=1e-8):
    (one,) = found.pieces
    for name in ("time_s", "q", "v", "desired_output"):
        expected = getattr(part(log, first, last), name)
        np.testing.assert_allclose(getattr(one, name), expected, atol=atol, err_msg=name)


def with_units(text):
    units = dict.fromkeys(("base_x", "base_y", "base_z"), "[mm]") | {"gyro_x": "(deg/s)"}
    for name, unit in units.items():
        text = text.replace(f"{name},", f"{name} {unit},", 1)
    return text


def after_line(number, *lines):
    def change(text):
        whole = text.splitlines()
        return "\n".join([*whole[:number], *lines, *whole[number:], ""])

    return change


WIDTH = frame_of(PLAIN, JOINTS).shape[1]
TABLES = {
    "spaces after commas": lambda text: text.replace(",", ", "),
    "spaces before commas": lambda text: text.replace(",", " ,"),
    "semicolons": lambda text: text.replace(",", ";"),
    "semicolons and decimal commas": lambda text: text.replace(",", ";").replace(".", ","),
    "tabs": lambda text: text.replace(",", "\t"),
    "bars": lambda text: text.replace(",", "|"),
    "columns of spaces": lambda text: text.replace(",", "   "),
    "quotes": lambda text: '"' + text.replace(",", '","').replace("\n", '"\n"')[:-1],
    "a byte-order mark": lambda text: "\ufeff" + text,
    "UTF-16": lambda text: ("\ufeff" + text).encode("utf-16-le"),
    "Windows": lambda text: text.replace("\n", "\r\n"),
    "a comment sign before the header": lambda text: "# " + text,
    "a per cent sign before the header": lambda text: "%" + text,
    "comments before the header": lambda text: "# robot 7, run 3\n# firmware, 1.2\n\n" + text,
    "a preamble": lambda text: "Recorder;1.2\nDate;14.11.2023\n" + text,
    "comments between rows": after_line(20, "# push", "# marker, 5"),
    "units in the header": with_units,
    "a row of units": after_line(1, ",".join(["ns"] + ["mm"] * (WIDTH - 1))),
    "the header again": lambda text: after_line(30, text.splitlines()[0])(text),
    "empty lines": lambda text: text + "\n\n",
    "an empty row": after_line(20, "," * (WIDTH - 1)),
    "separators at the end of rows": lambda text: text.replace("\n", ",\n"),
}


@pytest.mark.parametrize("kind", TABLES)
def test_a_table_is_read_however_it_is_written(kind, tmp_path):
    changed = TABLES[kind](frame_of(PLAIN, JOINTS).to_csv(index=False))
    data = changed if isinstance(changed, bytes) else changed.encode()
    (tmp_path / "run.csv").write_bytes(data)
    found = read(tmp_path / "run.csv")
    assert_reads(found)
    assert found.cuts == []


def dated(shown):
    def change(stamps):
        return [shown(datetime.fromtimestamp(ns // 1000 / 1e6, UTC)) for ns in stamps]

    return change


DATES = {
    "ISO": dated(lambda t: t.isoformat()),
    "a space and no zone": dated(lambda t: t.strftime("%Y-%m-%d %H:%M:%S.%f")),
    "Z": dated(lambda t: t.strftime("%Y-%m-%dT%H:%M:%S.%fZ")),
    "a zone": dated(lambda t: t.strftime("%Y-%m-%dT%H:%M:%S.%f+05:30")),
    "a decimal comma": dated(lambda t: t.strftime('"%Y-%m-%d %H:%M:%S,%f"')),
    "whole seconds among them": dated(lambda t: t.isoformat().removesuffix(".000000")),
    "the month first": dated(lambda t: t.strftime("%m/%d/%Y %H:%M:%S.%f")),
    "the time of day": dated(lambda t: t.strftime("%H:%M:%S.%f")),
    "nanoseconds": lambda stamps: stamps,
    "microseconds": lambda stamps: stamps / 1e3,
    "seconds": lambda stamps: stamps / 1e9,
}


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
@pytest.mark.parametrize("kind", DATES)
def test_dates_need_no_unit(kind, suffix, tmp_path):
    frame = frame_of(PLAIN, JOINTS)
    stamps = [str(one).strip('"') for one in DATES[kind](frame.stamp.to_numpy())]
    path = tmp_path / f"run.{suffix}"
    frame = frame.assign(stamp=stamps)
    frame.to_csv(path, index=False) if suffix == "csv" else frame.to_parquet(path)
    unit = {"seconds": "s", "microseconds": "us"}.get(kind, "ns")
    assert_reads(read(path, ("unit: ns", f"unit: {unit}")), atol=1e-4)


def test_a_date_as_the_index_of_a_parquet_file_is_a_column(tmp_path):
    frame = frame_of(PLAIN, JOINTS)
    frame["stamp"] = pd.to_datetime(frame["stamp"])
    frame.set_index("stamp").to_parquet(tmp_path / "run.parquet")
    assert_reads(read(tmp_path / "run.parquet"))


SOURCES = {"base_": 1, "quat": 1, "gyro": 2, "velo": 2, "goal": 4, "feet": 4}


def sparse(frame, row_of=lambda name: SOURCES.get(name[:4], SOURCES.get(name[:5], 3))):
    """Each source's values in rows of its own, at times of its own, as exporters join topics."""
    parts = []
    for shift in range(1, 5):
        names = [name for name in frame.columns[1:] if row_of(name) == shift]
        rows = frame[["stamp", *names]] if shift < 4 else frame[["stamp", *names]][::2]
        parts.append(rows.assign(stamp=rows.stamp + 500_000 * shift))
    return pd.concat(parts).sort_values("stamp")


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
@pytest.mark.parametrize(
    "row_of", [None, lambda name: 1 + sum(map(ord, name)) % 3 if "_pos" in name else 2],
    ids=["topics", "each joint of its own"],
)  # fmt: skip
def test_a_sparse_table_has_every_quantity_at_its_own_rows(row_of, suffix, tmp_path):
    frame = frame_of(PLAIN, JOINTS)
    joined = sparse(frame, row_of) if row_of else sparse(frame)
    path = tmp_path / f"run.{suffix}"
    joined.to_csv(path, index=False) if suffix == "csv" else joined.to_parquet(path)
    found = read(path)
    (one,) = found.pieces
    assert len(one.time_s) >= len(frame) - 3
    first = round(one.begin_s / 0.005)
    for name, atol in (("q", 0.02), ("v", 0.6)):
        wanted = getattr(PLAIN, name)[first:][: len(one.time_s)]
        np.testing.assert_allclose(getattr(one, name), wanted, atol=atol)
    assert "0% of the rows have every value: each quantity is read at its own" in found.cuts[0]
    assert read(path, reader=read_log).piece == 0


@pytest.mark.parametrize("every", [2, 4, 10])
def test_a_slow_source_has_fewer_rows_than_the_others(every, tmp_path):
    frame = frame_of(PLAIN, JOINTS)
    frame.loc[frame.index % every > 0, ["base_x", "base_y", "base_z"]] = np.nan
    frame.to_csv(tmp_path / "run.csv", index=False)
    found = read(tmp_path / "run.csv")
    (one,) = found.pieces
    np.testing.assert_allclose(one.q, PLAIN.q[::every], atol=1e-9)
    np.testing.assert_allclose(one.v, PLAIN.v[::every], atol=1e-9)
    assert found.kept_share == pytest.approx(one.duration_s / PLAIN.duration_s)


def test_a_goal_that_is_logged_when_it_changes_holds_until_the_next(tmp_path):
    log = dataclasses.replace(PLAIN, desired_output=PLAIN.desired_output.copy())
    log.desired_output[:20] = log.desired_output[0]
    log.desired_output[20:] = log.desired_output[20]
    frame = frame_of(log, JOINTS)
    frame.loc[~frame.index.isin([0, 20]), ["goal_x", "goal_y", "goal_z"]] = np.nan
    frame.to_csv(tmp_path / "run.csv", index=False)
    assert_reads(read(tmp_path / "run.csv"), log)


@pytest.mark.parametrize("size", [2, 5], ids=["some", "all"])
def test_what_is_logged_before_the_estimator_starts_is_cut(size, tmp_path):
    for names, value in (
        (["quat_x", "quat_y", "quat_z", "quat_w"], 0.0),
        (["quat_x", "quat_y", "quat_z", "quat_w"], np.nan),
        (["quat_x", "quat_y", "quat_z", "quat_w"], [0.0, 0.0, 0.0, 1.0]),
        (["base_x", "base_y", "base_z"], 0.0),
        ([f"{joint}_pos" for joint in JOINTS], 0.0),
    ):
        frame = frame_of(PLAIN, JOINTS)
        frame.loc[: size - 1, names] = value
        frame.to_csv(tmp_path / "run.csv", index=False)
        found = read(tmp_path / "run.csv")
        assert_reads(found, first=size)
        assert found.kept_share < 1
        with pytest.raises(ValueError, match=r"line 2, column .*: the value is nan"):
            read(tmp_path / "run.csv", reader=read_log)


def test_rows_out_of_order_are_sorted_and_a_time_that_repeats_is_left_out(tmp_path):
    frame = frame_of(PLAIN, JOINTS)
    frame.iloc[[0, 1, 3, 2, 4, 4, 4, *range(5, 60)]].to_csv(tmp_path / "run.csv", index=False)
    found = read(tmp_path / "run.csv")
    assert_reads(found)
    assert "line 5, column 'stamp': time runs backwards in 1.6% of the rows" in found.cuts[0]
    assert "time stands still in 3.2% of the rows" in found.cuts[1]
    again = pd.concat([frame, frame])
    again.to_csv(tmp_path / "run.csv", index=False)
    with pytest.raises(ValueError, match="line 62, column 'stamp': time runs backwards"):
        read(tmp_path / "run.csv")


def split_joints(number, *, shift_ns=0):
    """Joint messages that name some of the joints each, in an order of their own."""

    def change(message, i):
        names = list(message.name)
        for k in range(number):
            order = np.random.default_rng(i).permutation(len(names))
            some = [j for j in order if j * number // len(names) == k]
            yield named(message, [names[j] for j in some], *(
                np.array(one)[some] for one in (message.position, message.velocity)
            )), k * shift_ns  # fmt: skip

    return change


def named(message, names, positions, velocities):
    is_list = isinstance(message.position, list)
    array = list if is_list else np.ascontiguousarray
    return dataclasses.replace(
        message, name=names, position=array(positions), velocity=array(velocities)
    )


def with_arm(message, i):
    yield message, 0
    yield named(message, ["arm", "grip"], np.zeros(2), np.zeros(2)), 10**6


JOINT_MESSAGES = {
    "shuffled": (split_joints(1), 1e-8),
    "one a leg": (split_joints(4), 1e-8),
    "one a leg, each later": (split_joints(4, shift_ns=2 * 10**5), 0.6),
    "another part's between them": (with_arm, 1e-8),
}


@pytest.mark.parametrize("format", ["ros2", "ros1", "mcap"])
@pytest.mark.parametrize("kind", JOINT_MESSAGES)
def test_joints_are_gathered_from_messages_that_name_some_of_them(kind, format, tmp_path):
    change, atol = JOINT_MESSAGES[kind]
    path = write(PLAIN, JOINTS, format, tmp_path, change=change)
    found = read(path, kind=format)
    ends = (1, 59) if atol > 1e-3 else (0, 60)
    assert_reads(found, PLAIN, *ends, atol=atol)


@pytest.mark.parametrize("kind", ["mcap", "ros2", "a file of it", "parquet", "csv", "zeros at end"])
def test_of_a_recording_that_was_cut_off_what_is_whole_is_read(kind, tmp_path):
    format = {"a file of it": "mcap", "zeros at end": "csv"}.get(kind, kind)
    log = recorded(0)
    path = write(log, JOINTS, format, tmp_path, chunk_size=40_000)
    inner = path if path.is_file() else next(path.glob("*.db3"))
    if kind == "a file of it":
        path = tmp_path / "bag"
        path.mkdir()
        inner = inner.rename(path / "bag_0.mcap")
    elif path.is_dir():
        (path / "metadata.yaml").unlink()
    whole = inner.read_bytes()
    end = len(whole) * 2 // 3 if format != "csv" else len(whole.rsplit(b",", 30)[0])
    inner.write_bytes(whole[:end] + (b"\0" * 5000 if kind == "zeros at end" else b""))
    if kind == "parquet":
        with pytest.raises(ValueError, match="damaged, cut off, or not a Parquet file"):
            read(path, kind=format)
        return
    found = read(path, kind=format)
    (one,) = found.pieces
    rows = len(one.time_s)
    assert 0.4 < rows / len(log.time_s) < 1
    assert_reads(found, log, last=rows)
    assert f"'{path}' is cut off: " in found.cuts[0] and ("%" in found.cuts[0] or format == "csv")
    with pytest.raises(ValueError, match="is cut off"):
        read(path, kind=format, reader=read_log)


def test_a_bag_without_its_metadata_is_read(tmp_path):
    path = write(PLAIN, JOINTS, "ros2", tmp_path)
    (path / "metadata.yaml").unlink()
    found = read(path, kind="ros2")
    assert_reads(found)
    assert found.cuts == []
    mcap = write(PLAIN, JOINTS, "mcap", tmp_path)
    shutil.rmtree(path)
    path.mkdir()
    mcap.rename(path / "bag_0.mcap")
    found = read(path, kind="mcap")
    assert_reads(found)
    assert found.cuts == []
    # Its next file was just begun.
    (path / "bag_1.mcap").write_bytes((path / "bag_0.mcap").read_bytes()[:300])
    found = read(path, kind="mcap")
    assert_reads(found)
    assert "is cut off" in found.cuts[0]


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_velocities_of_a_topic_that_was_never_filled_are_derivatives(value, tmp_path):
    log = dataclasses.replace(PLAIN, foot_positions=np.full_like(PLAIN.foot_positions, value))
    feet = map_text("mcap")[map_text("mcap").index("foot_positions") :]
    odometry = (
        "/odom\n  columns: [twist.twist.linear.x, twist.twist.linear.y, twist.twist.linear.z]"
    )
    empty = '/feet\n  columns: ["position[0]", "position[1]", "position[2]"]'
    path = write(log, JOINTS, "mcap", tmp_path)
    found = read(path, (feet, ""), (odometry, empty), kind="mcap")
    assert_reads(found, atol=0.02)
    assert "'base_linear_velocity'" in found.notes[0] and "derivative" in found.notes[0]


def test_a_recording_that_ends_before_its_first_chunk_says_what_may_help(tmp_path):
    path = write(PLAIN, JOINTS, "mcap", tmp_path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(ValueError, match="'mcap recover' may mend it"):
        read(path, kind="mcap")
    path = write(PLAIN, JOINTS, "ros1", tmp_path)
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(ValueError, match="'rosbag reindex' mends it"):
        read(path, kind="ros1")


def test_columns_that_are_missing_are_told_with_those_there_are(tmp_path):
    frame_of(PLAIN, JOINTS).to_csv(tmp_path / "run.csv", index=False)
    with pytest.raises(
        ValueError, match=r"has no columns \['l_.*, .*\] and 7 more; it has \['stamp'"
    ):
        read(tmp_path / "run.csv", ("{joint}_pos", "l_{joint}"))


def test_a_map_and_a_log_of_other_clocks_are_told(tmp_path):
    assert "stamp" in TABLE_MAP and ORIGIN_NS > 0
    log = dataclasses.replace(PLAIN, time_s=PLAIN.time_s)
    path = write(log, JOINTS, "mcap", tmp_path, change=lambda m, i: [(m, 10**12)])
    with pytest.raises(ValueError, match="its topics do not overlap"):
        read(path, kind="mcap")
