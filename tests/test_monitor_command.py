"""`drake-safety monitor`: logs and sequences of observations, judged by a detector."""

import copy
import dataclasses
import json

import numpy as np
import pytest

from command_line import call
from drake_safety import load_assessment, load_scenario
from drake_safety.learning.change_detector import rows_of
from drake_safety.logs.episodes import motions_from_log
from drake_safety.logs.robot_log import read_pieces
from drake_safety.logs.sequences import SequenceMap, read_sequences
from log_files import frame_of, map_beside, record, save
from sprung_motions import HORIZON, INFO, STEP_S, learned, motion

pytestmark = pytest.mark.train

OBSERVED = ["load", "unread", "q", "dq", "now", "next"]
COLUMNS = {
    "knee": "q",
    "knee_rate": "dq",
    "desired goal [0]": "now",
    "desired goal [1]": "next",
}
MAP = SequenceMap(step_s=STEP_S, columns=COLUMNS, scale={"knee_rate": 20.0}, offset={"knee": 0.5})


def observed(rows):
    """Observations of a policy, from rows (K, n): scaled rates, positions about another zero."""
    q, dq, now, later, load = rows[:, [0, 1, 2, 3, 2 + HORIZON]].T
    return np.stack([load, np.full(len(rows), np.nan), q - 0.5, dq / 20.0, now, later], axis=1)


def write(path, data, **arrays):
    np.savez(path, **{"observations": data, "observation_names": np.array(OBSERVED)} | arrays)
    return path


def test_sequences_are_rows_of_the_detector(tmp_path):
    rows = [motion(4.0, seed) for seed in (60, 61)]
    data = np.stack([observed(motion_) for motion_ in rows])
    file = write(tmp_path / "many.npz", data)
    names = np.array(OBSERVED, dtype="S")
    one_file = write(tmp_path / "one.npz", data[1], observation_names=names)
    sequences = read_sequences(file, MAP, learned(), INFO)
    for sequence, expected in zip(sequences, rows, strict=True):
        ((time_s, read),) = sequence
        np.testing.assert_allclose(time_s, STEP_S * np.arange(len(expected)))
        used = learned().columns
        np.testing.assert_allclose(read[:, used], expected[:, used], atol=1e-12)
        assert not read[:, np.setdiff1d(np.arange(read.shape[1]), used)].any()
    (alone,) = read_sequences(one_file, MAP, learned(), INFO)
    np.testing.assert_array_equal(alone[0][1], sequences[1][0][1])


def test_a_sequence_is_cut_at_missing_values_and_thinned_to_the_step_of_the_detector(tmp_path):
    data = np.repeat(observed(motion(4.0, 60)), 2, axis=0)  # At twice the rate.
    data[20:24, 2] = data[140:, 4] = np.nan
    file = write(tmp_path / "fast.npz", data)
    read_by = dataclasses.replace(MAP, step_s=0.5 * STEP_S)
    (sequence,) = read_sequences(file, read_by, learned(), INFO)
    first, second = (time_s for time_s, _ in sequence)
    np.testing.assert_allclose(first, STEP_S * np.arange(10))
    np.testing.assert_allclose(second, STEP_S * np.arange(12, 70))


@pytest.mark.parametrize("change", [{"columns": {}}, {"step_s": 0.04}])
def test_a_map_that_does_not_fit_is_refused(tmp_path, change):
    file = write(tmp_path / "runs.npz", observed(motion(2.0, 60)))
    with pytest.raises(ValueError, match=r"expected|no observations"):
        read_sequences(file, dataclasses.replace(MAP, **change), learned(), INFO)


def test_a_file_of_objects_or_text_is_refused(tmp_path):
    text, objects = tmp_path / "text.npz", tmp_path / "objects.npz"
    text.write_text("time,q\n")
    for file in (text, write(objects, np.array([{}], dtype=object))):
        with pytest.raises(ValueError, match=rf"not an \.npz file: sequences '.*{file.name}'"):
            read_sequences(file, MAP, learned(), INFO)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An assessment with the detector of the mass on a spring, and a folder of runs."""
    folder = tmp_path / "spring"
    folder.mkdir()
    assessment = copy.copy(load_assessment("laikago_balancing"))
    names = ("state_names", "output_names", "feature_names", "horizon")
    changed = {name: getattr(INFO, name) for name in names}
    assessment.info_ = dataclasses.replace(assessment.info_, **changed)
    assessment.detector_ = learned()
    runs = folder / "runs"
    runs.mkdir()
    usual, pushed = motion(30.0, 60), motion(30.0, 50, slice(100, 140))
    write(runs / "a.npz", np.stack([observed(usual), observed(pushed)]))
    write(runs / "b.npz", observed(usual))
    (runs / "notes.txt").write_text("")  # No log.
    text = f"step_s: {STEP_S}\nscale: {{knee_rate: 20.0}}\noffset: {{knee: 0.5}}\ncolumns:\n"
    text += "".join(f"  {name}: {column}\n" for name, column in COLUMNS.items())
    (folder / "map.yaml").write_text(text)
    monkeypatch.setattr("drake_safety.cli.training_folder.load_assessment", lambda *_: assessment)
    return folder


def judge(monkeypatch, folder, *logs):
    """Calls the command for logs; returns its code, and entries of the logs in its file."""
    options = ("--map", folder / "map.yaml", "--assessment", folder, "--out", folder / "new/out")
    given = [word for log in logs for word in ("--log", log)]
    code = call(monkeypatch, "monitor", "laikago_balancing", *given, *options)
    file = folder / "new/out/monitor.json"
    return code, json.loads(file.read_text())["entries"]["logs"] if file.exists() else []


def test_the_command_judges_every_sequence_of_a_folder(folder, monkeypatch, capsys):
    code, logs = judge(monkeypatch, folder, folder / "runs")
    assert not code
    printed = " ".join(capsys.readouterr().out.split())
    for text in ("runs/a.npz [0]", "runs/a.npz [1]", "runs/b.npz [0]", "no alarm; largest: knee"):
        assert text in printed
    assert [(log["sequence"], len(log["alarms"])) for log in logs] == [(0, 0), (1, 1), (0, 0)]
    _, alarms = learned().watch([motion(30.0, 50, slice(100, 140))], INFO.state_names)
    ((begin, end, cause),) = alarms
    (alarm,) = logs[1]["alarms"]
    assert (alarm["begin_s"], alarm["end_s"]) == pytest.approx((begin * STEP_S, end * STEP_S))
    assert alarm["cause"] == cause
    assert alarm["level"] == logs[1]["level"] > 1.0 > logs[0]["level"] > 0.0
    pictures = {path.name for path in (folder / "new/out").iterdir()} - {"monitor.json"}
    assert pictures == {f"{n}.{kind}" for n in ("a-1", "a-2", "b-3") for kind in ("png", "svg")}


def test_a_log_is_judged_as_its_motions_are_with_its_own_times(monkeypatch, capsys, tmp_path):
    scenario = load_scenario("laikago_balancing")
    scenario.episode_duration_s = 2.0
    loop = scenario.make_loop("actual")
    frame = frame_of(record(loop, 3))
    frame.loc[300:320, "gyro_x"] = np.nan
    log = save(frame, tmp_path)
    options = ("--log", log, "--map", map_beside(log))
    assert not call(
        monkeypatch, "monitor", "laikago_balancing", *options, "--out", tmp_path / "out"
    )
    assert "are kept, in" in capsys.readouterr().out
    (judged,) = json.loads((tmp_path / "out" / "monitor.json").read_text())["entries"]["logs"]
    assessment = load_assessment("laikago_balancing")
    pieces = read_pieces(log, tmp_path / "columns.yaml", loop.robot).pieces
    motions = motions_from_log(pieces, loop)
    assert len(motions) == 2
    for begin_s, motion_ in zip((0.0, 321 * scenario.time_step_s), motions, strict=True):
        expected = begin_s + scenario.monitor_step_s * np.arange(len(motion_.time_s))
        np.testing.assert_allclose(motion_.time_s, expected, atol=1e-6)
    levels = assessment.detector_.watch([rows_of(motion_) for motion_ in motions])[0]
    assert judged["level"] == pytest.approx(levels.max())
    assert judged["end_s"] == pytest.approx(motions[1].time_s[-1])
    assert judged["left_safe_set"] == ""
    every_second = motions_from_log(pieces, loop, step_s=0.04)
    np.testing.assert_allclose(every_second[0].state, motions[0].state[::2], atol=1e-9)


@pytest.mark.parametrize("kept", [[], range(0, 50, 2)])
def test_a_log_with_too_few_values_is_not_judged(folder, kept, monkeypatch, capsys):
    rows = observed(motion(30.0, 60))
    rows[np.setdiff1d(np.arange(50), kept)] = rows[50:] = np.nan
    bad = write(folder / "bad.npz", rows)
    code, logs = judge(monkeypatch, folder, bad, folder / "runs" / "b.npz")
    assert code == 2
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.count("no alarm") == 1
    assert "not judged: 0." in printed
    assert "error: 1 of 2 logs have less than 1 s" in printed
    assert logs[0]["judged_s"] < 1.0 < logs[1]["judged_s"]
    assert logs[1]["judged_s"] == pytest.approx(logs[1]["duration_s"])


def test_a_table_of_a_walking_robot_is_refused_before_it_is_read(monkeypatch, capsys, tmp_path):
    (tmp_path / "walk.csv").write_text("t\n")
    given = ("--log", tmp_path / "walk.csv", "--map", tmp_path / "walk.csv", "--out", tmp_path)
    assert call(monkeypatch, "monitor", "go2_walking", *given) == 2
    assert "'monitor' takes .npz files" in " ".join(capsys.readouterr().out.split())
