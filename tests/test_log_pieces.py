"""A log with a missing value or a gap is cut there, and the rest of it is kept."""

import dataclasses

import numpy as np
import pytest

from drake_safety.logs.episodes import cut_log
from drake_safety.logs.robot_log import read_log, read_pieces
from log_files import (
    FORMATS,
    SAFE,
    UNSAFE,
    balancing_loop,
    frame_of,
    map_text,
    part,
    recorded,
    write,
)

JOINTS = balancing_loop().kinematics.joint_names
ROBOT = balancing_loop().robot
STEP_S = 0.0025


def read(path, kind, **options):
    (path.parent / "columns.yaml").write_text(map_text(kind))
    return read_pieces(path, path.parent / "columns.yaml", ROBOT, **options)


def read_frame(frame, folder, **options):
    frame.to_csv(folder / "run.csv", index=False)
    return read(folder / "run.csv", "csv", **options)


def without(log, first, last):
    """A log that lacks the rows from one to another."""
    names = ("time_s", "q", "v", "desired_output", "foot_positions")
    rows = {name: np.delete(getattr(log, name), slice(first, last), axis=0) for name in names}
    return dataclasses.replace(log, **rows)


@pytest.mark.train
def test_a_missing_value_costs_its_row_alone(tmp_path):
    log = recorded(SAFE)
    frame = frame_of(log, JOINTS)
    frame.loc[[40, 41], "gyro_x"] = np.nan  # Two empty cells: one cut.
    frame.loc[100, "goal_y"] = np.inf
    found = read_frame(frame, tmp_path)
    assert [len(one.time_s) for one in found.pieces] == [40, 58, 140]
    assert [one.piece for one in found.pieces] == [0, 1, 2]
    for one, first in zip(found.pieces, (0, 42, 101), strict=True):
        np.testing.assert_allclose(one.q, log.q[first:][: len(one.q)], atol=1e-9)
        np.testing.assert_allclose(one.time_s, STEP_S * np.arange(len(one.q)), atol=1e-9)
    assert found.duration_s == pytest.approx(0.6)
    assert found.kept_share == pytest.approx(STEP_S * (39 + 57 + 139) / 0.6)
    assert [cut.partition(", ")[2] for cut in found.cuts] == [
        "line 42, column 'gyro_x': the value is nan",
        "line 102, column 'goal_y': the value is inf",
    ]


@pytest.mark.train
@pytest.mark.parametrize("kind", FORMATS)
def test_a_gap_in_a_log_of_any_format_is_where_it_is_cut(kind, tmp_path):
    log = recorded(SAFE)
    path = write(without(log, 100, 180), JOINTS, kind, tmp_path)
    found = read(path, kind)
    assert [len(one.time_s) for one in found.pieces] == [100, 61]
    np.testing.assert_allclose(found.pieces[1].q, log.q[180:], atol=1e-9)
    assert all("a gap of 0.2025 s before it" in cut for cut in found.cuts)
    with pytest.raises(ValueError, match=r"a gap of 0\.2025 s before it, expected at most 0\.1 s"):
        read_log(path, tmp_path / "columns.yaml", ROBOT)


@pytest.mark.train
def test_a_log_without_either_is_read_as_it_is(tmp_path):
    path = write(recorded(SAFE), JOINTS, "parquet", tmp_path)
    found = read(path, "parquet")
    (piece,) = found.pieces
    whole = read_log(path, tmp_path / "columns.yaml", ROBOT)
    np.testing.assert_array_equal(piece.q, whole.q)
    np.testing.assert_array_equal(piece.v, whole.v)
    assert (found.cuts, found.kept_share) == ([], 1.0)


@pytest.mark.train
def test_a_line_that_was_cut_off_is_left_out(tmp_path):
    path = write(part(recorded(SAFE), 0, 40), JOINTS, "csv", tmp_path)
    path.write_text(path.read_text().rsplit(",", 30)[0])
    (piece,) = read(path, "csv").pieces
    assert len(piece.time_s) == 39


@pytest.mark.train
def test_pieces_without_derivatives_are_dropped_and_not_counted(tmp_path):
    frame = frame_of(recorded(SAFE), JOINTS)
    frame.loc[40, "gyro_x"] = np.nan
    frame.loc[42, "gyro_x"] = np.nan
    found = read_frame(frame, tmp_path)
    assert [(one.piece, len(one.time_s)) for one in found.pieces] == [(0, 40), (1, 198)]
    assert found.kept_share == pytest.approx(STEP_S * (39 + 197) / 0.6)


@pytest.mark.train
def test_a_log_of_which_nothing_is_left_is_refused_with_the_reason(tmp_path):
    frame = frame_of(recorded(SAFE), JOINTS)
    with pytest.raises(
        ValueError, match=r"no 3 rows .*: .*line 2, column 'goal_x': the value is nan"
    ):
        read_frame(frame.assign(goal_x=np.nan), tmp_path)


@pytest.mark.train
def test_what_is_wrong_with_the_map_is_still_refused(tmp_path):
    frame = frame_of(recorded(SAFE), JOINTS)
    frame.loc[40, "gyro_x"] = np.nan
    with pytest.raises(ValueError, match=r"the desired output is .* m from the base"):
        read_frame(frame.assign(goal_z=1e3 * frame.goal_z), tmp_path)
    with pytest.raises(ValueError, match="'stop' is not a number"):
        read_frame(frame.assign(goal_x=["stop", *frame.goal_x[1:]]), tmp_path)


def test_no_episode_reaches_over_a_cut():
    log = recorded(SAFE)
    pieces = [dataclasses.replace(part(log, 0, 170), piece=0)]
    pieces += [dataclasses.replace(part(log, 70, 241), piece=1)]
    episodes, starts = cut_log(pieces, balancing_loop())
    assert [len(episodes), len(starts)] == [2, 2]
    np.testing.assert_allclose(starts[1].q, log.q[70], atol=1e-12)
    assert [episode.index for episode in episodes] == [0, 1]


def test_after_a_fall_later_pieces_of_the_log_are_ignored_and_other_logs_are_not():
    fallen = recorded(UNSAFE)
    again = dataclasses.replace(recorded(SAFE), piece=1)
    (episode,) = cut_log([fallen, again], balancing_loop())[0]
    assert not episode.is_safe
    other = recorded(SAFE)
    assert len(cut_log([fallen, again, other], balancing_loop())[0]) == 2


def test_a_later_piece_that_begins_outside_the_safe_set_ends_its_log():
    log = recorded(SAFE)
    low = dataclasses.replace(log, q=log.q - np.eye(log.q.shape[1])[6] * 0.1, piece=1)
    episodes, _ = cut_log([log, low, dataclasses.replace(log, piece=2)], balancing_loop())
    assert len(episodes) == 1


def test_pieces_that_are_all_too_short_are_refused():
    short = [dataclasses.replace(part(recorded(SAFE), 0, 41), piece=i) for i in range(2)]
    with pytest.raises(ValueError, match="too short for a segment of 10 steps"):
        cut_log(short, balancing_loop())
