"""A log with a missing value or a gap is cut there, and the rest of it is kept."""

import dataclasses

import numpy as np
import pytest

from drake_safety.logs.episodes import cut_log
from drake_safety.logs.robot_log import read_log
from log_files import (
    SAFE,
    UNSAFE,
    balancing_loop,
    frame_of,
    part,
    read,
    recorded,
    save,
    write,
)

STEP_S = 0.0025


@pytest.mark.train
@pytest.mark.parametrize(
    ("missing", "begins", "ends"),
    [
        # Two empty cells in a row: one cut.
        ({40: "gyro_x", 41: "gyro_x", 100: "goal_y"}, [0, 42, 101], [40, 100, 241]),
        # A single row has no derivatives.
        ({40: "gyro_x", 42: "goal_y"}, [0, 43], [40, 241]),
    ],
)
def test_a_missing_value_costs_its_row_alone(missing, begins, ends, tmp_path):
    log = recorded(SAFE)
    frame = frame_of(log)
    for row, column in missing.items():
        frame.loc[row, column] = np.nan if column == "gyro_x" else np.inf
    found = read(save(frame, tmp_path))
    assert [one.piece for one in found.pieces] == list(range(len(begins)))
    for one, begin, end in zip(found.pieces, begins, ends, strict=True):
        expected = part(log, begin, end)
        np.testing.assert_allclose(one.q, expected.q, atol=1e-9)
        np.testing.assert_allclose(one.time_s, expected.time_s, atol=1e-9)
        assert one.begin_s == pytest.approx(STEP_S * begin)
    assert found.duration_s == pytest.approx(0.6)
    kept_s = STEP_S * (sum(ends) - sum(begins) - len(begins))
    assert found.kept_share == pytest.approx(kept_s / 0.6)
    told = [
        "line 42, column 'gyro_x': the value is nan",
        f"line {2 + max(missing)}, column 'goal_y': the value is inf",
    ]
    assert [cut.partition(", ")[2] for cut in found.cuts] == told
    with pytest.raises(ValueError, match=f"{told[0]}, expected a log of which nothing is lost"):
        read(tmp_path / "run.csv", reader=read_log)


@pytest.mark.train
@pytest.mark.parametrize("kind", ["csv", "ros2"])
def test_a_gap_in_a_log_of_any_format_is_where_it_is_cut(kind, tmp_path):
    log = recorded(SAFE)
    path = write(part(log, 0, 100, 180, 241), tmp_path, kind)
    found = read(path)
    assert [len(one.time_s) for one in found.pieces] == [100, 61]
    np.testing.assert_allclose(found.pieces[1].q, log.q[180:], atol=1e-9)
    assert all("a gap of 0.2025 s before it" in cut for cut in found.cuts)
    with pytest.raises(ValueError, match=r"a gap of 0\.2025 s before it, expected at most 0\.1 s"):
        read(path, reader=read_log)
    assert read(path, ("time:", "max_gap_s: 0.21\ntime:")).cuts == []


@pytest.mark.train
def test_a_log_of_which_nothing_is_left_is_refused_with_the_reason(tmp_path):
    path = save(frame_of(recorded(SAFE)).assign(goal_x=np.nan), tmp_path)
    with pytest.raises(ValueError, match=r"no 3 rows .*: .*line 2, column 'goal_x': the value is"):
        read(path)


def test_no_episode_reaches_over_a_cut():
    log = recorded(SAFE)
    pieces = [dataclasses.replace(part(log, 0, 170), piece=0)]
    pieces += [dataclasses.replace(part(log, 70, 241), piece=1)]
    episodes, starts = cut_log(pieces, balancing_loop())
    assert [len(episodes), len(starts)] == [2, 2]
    np.testing.assert_allclose(starts[1].q, log.q[70], atol=1e-12)
    assert [episode.index for episode in episodes] == [0, 1]


def test_after_a_fall_or_a_start_outside_the_safe_set_later_pieces_are_ignored():
    log, loop = recorded(SAFE), balancing_loop()
    again = dataclasses.replace(log, piece=1)
    (episode,) = cut_log([recorded(UNSAFE), again], loop)[0]
    assert not episode.is_safe
    assert len(cut_log([recorded(UNSAFE), again, log], loop)[0]) == 2  # Another log is not.
    low = dataclasses.replace(again, q=log.q - np.eye(log.q.shape[1])[6] * 0.1)
    assert len(cut_log([log, low, dataclasses.replace(log, piece=2)], loop)[0]) == 1
