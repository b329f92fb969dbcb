"""Rows of a ChangeDetector: recorded inputs, and observations in .npz files, such as a policy's."""

import math
from dataclasses import field
from pathlib import Path

import numpy as np

from drake_safety.files.reading import check_memory, reading
from drake_safety.files.schema import NotNegative, schema
from drake_safety.learning.causes import is_outside, violated
from drake_safety.learning.change_detector import ChangeDetector
from drake_safety.learning.inputs import preview_names
from drake_safety.learning.segments import EpisodesInfo
from drake_safety.logs.channel import listed
from drake_safety.logs.log_map import LogTime
from drake_safety.logs.mcap_recorder import WATCHED, field_names
from drake_safety.logs.messages import read_messages, recorded_topics

Motion = tuple[np.ndarray, np.ndarray]  # Times (K,) [s] of consecutive rows (K, n).


@schema(kw_only=True)
class SequenceMap:
    """The schema of the map of an ``.npz`` file."""

    step_s: NotNegative = 0.0  # Required: the detector's step, or an integer fraction of it [s].
    data: str = "observations"  # Sequences (num_sequences, num_steps, n), or one (num_steps, n).
    names: str = "observation_names"  # Array of the n names of observations.
    columns: dict[str, str] = field(default_factory=dict)
    """Observation that is an input of the detector, where its name differs."""
    scale: dict[str, float] = field(default_factory=dict)  # Factor by input; 1 by default.
    offset: dict[str, float] = field(default_factory=dict)
    """Added then, such as a joint's default position; 0 by default."""


def read_sequences(
    path: Path, sequence_map: SequenceMap, detector: ChangeDetector, info: EpisodesInfo
) -> list[list[Motion]]:
    """Reads the motions of each sequence in an ``.npz`` file; none reaches over a missing value."""
    # Only the detector's inputs are read; others are 0.
    inputs = dict(zip(detector.input_names(info), detector.columns.tolist(), strict=True))
    scale, offset = sequence_map.scale, sequence_map.offset
    for name in (*sequence_map.columns, *scale, *offset):
        if name not in inputs:
            raise ValueError(f"map: '{name}' is none of the monitor's inputs {list(inputs)}")
    given_s, step_s = sequence_map.step_s, detector.step_s
    stride = max(1, round(step_s / max(given_s, 1e-6)))
    if not math.isclose(stride * given_s, step_s, rel_tol=1e-6):
        what = f"expected {step_s}, the monitor's step, or an integer fraction of it [s]"
        raise ValueError(f"map: 'step_s' is {given_s}, {what}")
    data, names = _arrays(path, sequence_map)
    columns = {name: sequence_map.columns.get(name, name) for name in inputs}
    if missing := [column for column in dict.fromkeys(columns.values()) if column not in names]:
        what = f"observations {missing}, which the monitor reads; they have {listed(names)}"
        raise ValueError(f"sequences '{path}' have no {what}: see 'columns' of the map")
    rows = np.zeros((*data[:, ::stride].shape[:2], _num_entries(info)))
    for name, column in columns.items():
        values = data[:, ::stride, names.index(column)] * scale.get(name, 1.0)
        rows[:, :, inputs[name]] = values + offset.get(name, 0.0)
    time_s = step_s * np.arange(rows.shape[1])
    known = [np.isfinite(one).all(axis=1) for one in rows]
    return [_motions(time_s[k], one[k], step_s) for k, one in zip(known, rows, strict=True)]


def read_recording(
    path: Path, detector: ChangeDetector, info: EpisodesInfo
) -> tuple[list[Motion], str] | None:
    """Reads what the monitor saw in a file of `McapRecorder`; None of another file.

    Returns:
        Motions between disturbances, until the robot leaves the safe set, and the violated
        constraint, "" if there is none.
    """
    inputs, margins = f"/{WATCHED}", "/margins"
    if not {inputs, margins} <= recorded_topics(path):
        return None
    names = detector.input_names(info), info.constraint_names
    wanted = dict(zip((inputs, margins), map(field_names, names), strict=True))
    channels = read_messages(path, wanted, LogTime())
    leave_s, cause = math.inf, ""
    own = channels[margins].frame.to_numpy()
    if (outside := np.flatnonzero(is_outside(own))).size:
        leave_s = channels[margins].time_s[outside[0]]
        cause = info.constraint_names[violated(own[outside[0]])]
    # A row shows what the monitor took in the step before; while it waits there is none.
    time_s = (channels[inputs].time_s - detector.step_s).round(6)
    time_s = time_s[time_s <= leave_s]
    rows = np.zeros((len(time_s), _num_entries(info)))
    rows[:, detector.columns] = channels[inputs].frame.to_numpy()[: len(time_s)]
    return _motions(time_s, rows, detector.step_s), cause


def _num_entries(info: EpisodesInfo) -> int:
    return len(info.state_names) + len(preview_names(info)) + len(info.feature_names)


def _arrays(path: Path, sequence_map: SequenceMap) -> tuple[np.ndarray, list[str]]:
    """Observations (num_sequences, num_steps, n) and their names."""
    with reading(path, "not an .npz file: sequences", Exception), np.load(path) as file:
        for name in (sequence_map.data, sequence_map.names):
            if name not in file.files:
                raise ValueError(f"'{path}' has no array '{name}'; it has {file.files}")
        check_memory(sum(one.file_size for one in file.zip.infolist()), f"'{path}'")
        data = file[sequence_map.data]
        names = file[sequence_map.names].astype(str).ravel().tolist()
    if data.ndim not in (2, 3) or data.shape[-1] != len(names) or data.dtype.kind not in "fiu":
        what = f"expected numbers (num_sequences, num_steps, {len(names)})"
        got = f"'{sequence_map.data}' is {data.dtype} of shape {data.shape}"
        raise ValueError(f"sequences '{path}': {got}, {what}")
    return data.reshape(-1, *data.shape[-2:]), names


def _motions(time_s: np.ndarray, rows: np.ndarray, step_s: float) -> list[Motion]:
    """The motions of rows (K, n) that are a step apart, of three rows or more."""
    parts = np.split(np.arange(len(rows)), np.flatnonzero(np.diff(time_s) > 1.5 * step_s) + 1)
    return [(time_s[part], rows[part]) for part in parts if len(part) > 2]
