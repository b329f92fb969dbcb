"""The study of RAPT's recordings, on made recordings of the same layout."""

import re

import numpy as np
import pytest

from command_line import study
from studies.rapt import ALL, NOMINAL, read

pytestmark = pytest.mark.train

TASK, NAMES, ONSET = "oscillator", ["x", "y", "x_rate", "y_rate"], 50
KINDS = ("sensor_zero", "noise")
SIZES = {"train": (20, 1000), "calibration": (30, 400), "test": (50, 400)}


def sequence(num_rows, rng):
    """Observations (T, 4) of two noisy masses on springs, and the forces on them (T, 2)."""
    force = np.repeat(rng.normal(size=(num_rows // 25 + 1, 2)), 25, axis=0)[:num_rows]
    state, rows = rng.normal(size=4), np.zeros((num_rows, 4))
    for k in range(num_rows):
        rows[k] = state + 0.01 * rng.normal(size=4)
        acceleration = 10.0 * force[k] - 20.0 * state[:2] - 2.0 * state[2:]
        state = state + 0.02 * np.concatenate([state[2:], acceleration])
    return rows, force


def write(folder, split, **changes):
    """Writes a split in half precision; the first 20 sequences of `test` are anomalous."""
    number, num_rows = SIZES[split]
    rng, arrays = np.random.default_rng([*split.encode()]), {"dim_names": np.array(NAMES)}
    fault = np.array([KINDS[i % 2] if i < 20 else "none" for i in range(number)])
    for i, kind in enumerate(fault if split == "test" else [""] * number):
        rows, force = sequence(num_rows, rng)
        if kind == "sensor_zero":
            rows[ONSET:, i % 4] = 0.0
        if kind == "noise":
            rows[ONSET:] += 0.1 * rng.normal(size=rows[ONSET:].shape)
        arrays |= {f"seq_{i:05d}": rows.astype("f2"), f"act_{i:05d}": force.astype("f2")}
    if split == "test":
        arrays |= {"labels": (fault != "none").astype(int), "fault": fault}
    folder.mkdir(exist_ok=True)
    arrays = {k: v for k, v in (arrays | changes).items() if v is not None}
    np.savez(folder / f"{split}.npz", **arrays)


@pytest.fixture
def data(tmp_path):
    for split in SIZES:
        write(tmp_path / TASK, split)
    return tmp_path


def test_anomalies_are_found_and_nominal_sequences_are_not(monkeypatch, capsys, data):
    assert study(monkeypatch, "rapt", "--data", data, "--task", TASK) == 0
    printed = capsys.readouterr().out
    shares = {
        name: float(re.search(rf"{name} +│ +([\d.]+) %", printed)[1])
        for name in (ALL, NOMINAL, *(kind.replace("_", " ") for kind in KINDS))
    }
    assert shares.pop(NOMINAL) <= 10.0 and set(shares.values()) == {100.0}
    assert "from 30 nominal episodes" in printed


@pytest.mark.parametrize(
    ("split", "changes", "message"),
    [
        ("test", {"fault": None}, r"no array 'fault', but \['dim_names', .*; expected DIR/TASK/"),
        ("train", {"act_00003": None}, "no array 'act_00003'"),
        ("train", {"seq_00003": np.zeros((1000, 5))}, r"\(1000, 5\).*, expected \[\(1000, 4\)"),
        ("test", {"labels": np.ones(3), "fault": np.array(["noise"])}, "3 labels, of 50 sequences"),
    ],
)
def test_another_layout_is_an_error_that_says_what_there_is(tmp_path, split, changes, message):
    write(tmp_path / TASK, split, **changes)
    with pytest.raises(ValueError, match=rf"{split}\.npz.*{message}"):
        read(tmp_path / TASK / f"{split}.npz")


def test_missing_or_differing_splits_are_errors(monkeypatch, capsys, data):
    arguments = ("rapt", "--data", data, "--task")
    assert study(monkeypatch, *arguments, "g1_velocity") == 2
    assert "has ['oscillator/calibration.npz', 'oscillator/test.npz'" in capsys.readouterr().out
    write(data / TASK, "calibration", dim_names=np.array([*NAMES[:3], "z"]))
    assert study(monkeypatch, *arguments, TASK) == 2
    assert "in some only: ['y_rate', 'z']" in capsys.readouterr().out
