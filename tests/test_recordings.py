"""Recordings as loggers, exporters and recorders leave them say what a clean one says."""

import dataclasses

import numpy as np
import pytest

from drake_safety.logs.robot_log import read_log
from log_files import (
    ANGLES,
    BASE,
    GOAL,
    QUATERNION,
    RATES,
    frame_of,
    part,
    read,
    save,
    walked,
    write,
)

pytestmark = pytest.mark.train
pd = pytest.importorskip("pandas")
PLAIN = part(walked(), 0, 60)


def assert_reads(found, log=PLAIN, atol=1e-8):
    (one,) = found.pieces
    for name in ("time_s", "q", "v", "desired_output"):
        one_s, log_s = getattr(one, name), getattr(log, name)
        np.testing.assert_allclose(one_s, log_s, atol=atol, err_msg=name)


@pytest.mark.parametrize(
    ("old", "new", "end"), [(",", ", ", ""), (",", ";", ""), ("\n", "\n\n", "17000")]
)
def test_dialects_of_csv_are_read_without_a_last_line_that_was_cut_off(old, new, end, tmp_path):
    text = frame_of(PLAIN).to_csv(index=False).replace(old, new)
    (tmp_path / "run.csv").write_text(text + end)
    found = read(tmp_path / "run.csv")
    assert_reads(found)
    assert found.cuts == []


def test_a_date_as_the_index_of_a_parquet_file_is_a_column_without_a_unit(tmp_path):
    frame = frame_of(PLAIN)
    dates = pd.to_datetime(frame.stamp).dt.tz_localize("Asia/Tokyo")
    frame = frame.assign(stamp=dates).set_index("stamp")
    assert_reads(read(save(frame, tmp_path, "parquet"), ("unit: ns", "unit: s")))


SOURCES = {"base": 1, "quat": 1, "gyro": 2, "velo": 2, "goal": 4, "feet": 4}


def sparse(frame):
    """Each source's values in rows of its own, at times of its own, as exporters join topics."""
    parts, topics = [], dict.fromkeys(ANGLES + RATES, 3)
    for shift in range(1, 5):
        names = [n for n in frame.columns[1:] if (topics.get(n) or SOURCES[n[:4]]) == shift]
        rows = frame[["stamp", *names]] if shift < 4 else frame[["stamp", *names]][::2]
        parts.append(rows.assign(stamp=rows.stamp + 500_000 * shift))
    return pd.concat(parts).sort_values("stamp")


def test_a_sparse_table_has_every_quantity_at_its_own_rows(tmp_path):
    frame = frame_of(PLAIN)
    path = save(sparse(frame), tmp_path)
    found = read(path)
    (one,) = found.pieces
    assert len(one.time_s) >= len(frame) - 3
    first = round(one.begin_s / 0.005)
    for name, atol in (("q", 0.02), ("v", 0.6)):
        wanted = getattr(PLAIN, name)[first:][: len(one.time_s)]
        np.testing.assert_allclose(getattr(one, name), wanted, atol=atol)
    assert "0% of the rows have every value: each quantity is read at its own" in found.cuts[0]
    assert read(path, reader=read_log).piece == 0


def test_a_slow_source_has_fewer_rows_than_the_others(tmp_path):
    frame = frame_of(PLAIN)
    frame.loc[frame.index % 10 > 0, BASE] = np.nan
    (log,) = read(save(frame, tmp_path)).pieces
    np.testing.assert_allclose(log.q, PLAIN.q[::10], atol=1e-9)
    np.testing.assert_allclose(log.v, PLAIN.v[::10], atol=1e-9)


def test_a_goal_that_is_logged_when_it_changes_holds_until_the_next(tmp_path):
    log = dataclasses.replace(PLAIN, desired_output=PLAIN.desired_output.copy())
    log.desired_output[:20] = log.desired_output[0]
    log.desired_output[20:] = log.desired_output[20]
    frame = frame_of(log)
    frame.loc[~frame.index.isin([0, 20]), GOAL] = np.nan
    assert_reads(read(save(frame, tmp_path)), log)


def test_rows_before_the_estimator_starts_are_cut(tmp_path):
    size = 5
    for value, what in [(0.0, "quaternion is 0"), (np.nan, "value is nan")]:
        frame = frame_of(PLAIN)
        frame.loc[: size - 1, QUATERNION] = value
        found = read(save(frame, tmp_path))
        assert_reads(found, part(PLAIN, size, 60))
        assert found.kept_share < 1
        with pytest.raises(ValueError, match=rf"line 2, column .*: the {what}"):
            read(tmp_path / "run.csv", reader=read_log)


def test_rows_out_of_order_are_sorted_and_a_time_that_repeats_is_left_out(tmp_path):
    frame = frame_of(PLAIN)
    path = save(frame.iloc[[0, 1, 3, 2, 4, 4, 4, *range(5, 60)]], tmp_path)
    found = read(path)
    assert_reads(found)
    (told,) = found.cuts
    assert "line 7, column 'stamp': time stands still in 3.2% of the rows" in told
    with pytest.raises(ValueError, match="expected a log of which nothing is lost"):
        read(path, reader=read_log)
    with pytest.raises(ValueError, match="time runs backwards, from"):
        read(save(frame.sample(frac=1.0, random_state=0), tmp_path))


def test_a_time_that_begins_anew_is_another_log(tmp_path):
    frame = frame_of(PLAIN)
    path = save(pd.concat([frame, frame[:20]]), tmp_path)
    found = read(path)
    assert [(len(log.time_s), log.piece) for log in found.pieces] == [(60, 0), (20, 0)]
    assert found.kept_share == pytest.approx(1.0)
    assert "line 62, column 'stamp': time begins anew" in found.cuts[0]


def test_entries_of_lists_are_columns_of_parquet(tmp_path):
    frame = frame_of(PLAIN)
    listed = frame.drop(columns=BASE).assign(**{"state.base": [*frame[BASE].to_numpy()]})
    names = ("[base_x, base_y, base_z]", "['state.base[0]', 'state.base[1]', 'state.base[2]']")
    assert_reads(read(save(listed, tmp_path, "parquet"), names))


def split_joints(number, *, shift_ns=0):
    """Joint messages that name some of the joints each, in an order of their own."""

    def change(message, i):
        order = np.random.default_rng(i).permutation(12)
        for k in range(number):
            some = order[order * number // 12 == k]
            values = (np.array(message.name)[some].tolist(), message.position[some])
            yield named(message, *values, message.velocity[some]), k * shift_ns

    return change


def named(message, names, positions, velocities):
    return dataclasses.replace(message, name=names, position=positions, velocity=velocities)


def with_arm(message, i):
    yield message, 0
    yield named(message, ["arm", "grip"], np.zeros(2), np.zeros(2)), 10**6


JOINT_MESSAGES = {
    "shuffled": (split_joints(1), 1e-8),
    "one a leg": (split_joints(4), 1e-8),
    "one a leg, each later": (split_joints(4, shift_ns=2 * 10**5), 0.6),
    "another part's between them": (with_arm, 1e-8),
}


@pytest.mark.parametrize("kind", JOINT_MESSAGES)
def test_joints_are_gathered_from_messages_that_name_some_of_them(kind, tmp_path):
    change, atol = JOINT_MESSAGES[kind]
    found = read(write(PLAIN, tmp_path, "mcap", change=change))
    assert_reads(found, part(PLAIN, 1, 59) if atol > 1e-3 else PLAIN, atol)


def test_velocities_that_messages_leave_empty_are_derivatives(tmp_path):
    def without(message, i):
        yield named(message, message.name, message.position, np.zeros(0)), 0

    found = read(write(PLAIN, tmp_path, "ros2", change=without))
    assert_reads(found, atol=0.02)
    (note,) = found.notes
    assert "'joint_velocities'" in note and "derivative" in note


@pytest.mark.parametrize(
    ("kind", "end", "message"),
    [
        ("mcap", 500, "'mcap recover' may repair it"),
        ("ros1", -500, "'rosbag reindex' repairs it"),
        ("parquet", -500, "damaged, cut off, or not a Parquet file"),
    ],
)
def test_an_unreadable_recording_is_refused_with_a_remedy(kind, end, message, tmp_path):
    path = write(PLAIN, tmp_path, kind)
    path.write_bytes(path.read_bytes()[:end])
    with pytest.raises(ValueError, match=message):
        read(path)
