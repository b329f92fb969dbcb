"""Quantities of a log, such as the base's position, each at the rows where it is measured."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from drake_safety.learning.segments import LARGEST
from drake_safety.logs.channel import Channel
from drake_safety.logs.log_map import COMMANDS, QUANTITIES, TIME_UNITS, VELOCITIES, LogMap

MIN_ROWS = 3  # For derivatives.
_INTERVALS_S = (1e-4, 0.5)  # Range of the median time between two rows.
_SPARSE = 0.9  # Share of complete rows below which every quantity has rows of its own.
_MANY_HELD, _REGULAR = 6, 0.9  # Least rows of whole holds of a value, and share of equal holds.
_MANY_SAME, _MANY_RESTARTS = 0.4, 0.1  # Shares of the rows.


def continued(channel: Channel, max_gap_s: float) -> tuple[Channel, dict[str, float]]:
    """Lets a time that begins anew go on after two long gaps; returns its times by location."""
    step, gap = np.diff(channel.time), max_gap_s * TIME_UNITS[channel.time_unit]
    rows = np.flatnonzero(step < -gap) + 1
    if not 0 < len(rows) <= _MANY_RESTARTS * len(step):
        return channel, {}
    shift = np.zeros_like(channel.time)
    shift[rows] = step.dtype.type(2 * gap) - step[rows - 1]
    channel = replace(channel, time=channel.time + np.cumsum(shift))
    return channel, {channel.where(i, channel.time_name): channel.time[i] for i in rows.tolist()}


def in_order(channel: Channel, max_gap_s: float) -> tuple[Channel, list[str]]:
    """Sorts rows that are a little out of order, joins rows of one time, and describes losses."""
    time, clock = channel.time, channel.time_name
    if (is_bad := ~np.isfinite(time)).any():
        row = int(np.argmax(is_bad))
        raise ValueError(f"{channel.where(row, clock)}: the time is {time[row]}")
    step = np.diff(time)
    if (is_back := step < -max_gap_s * TIME_UNITS[channel.time_unit]).any():
        row = int(np.argmax(is_back)) + 1
        what = f"from {time[row - 1]} to {time[row]} {channel.time_unit}"
        raise ValueError(f"{channel.where(row, clock)}: time runs backwards, {what}")
    if (step > 0).all():
        return channel, []
    import pandas as pd

    groups = channel.frame.groupby(time)  # Messages may name some joints only.
    num_lost = (groups.count() - 1).clip(lower=0).sum().max()
    lost = []
    if num_lost:
        where = channel.where(int(np.argmax(pd.Index(time).duplicated())), clock)
        share = num_lost / len(time)
        # Equal rows of one time are one measurement.
        if (groups.nunique() - 1).clip(lower=0).sum().max() > _MANY_SAME * len(time):
            what = f"{share:.1%} of the rows share a time with another row"
            raise ValueError(f"{where}: {what}: its stamps have too few digits")
        lost.append(f"{where}: time stands still in {share:.1%} of the rows: the first is kept")
    joined = channel.select(np.unique(time, return_index=True)[1])
    return replace(joined, frame=groups.first().set_axis(joined.frame.index)), lost


def quantities(
    topics: Mapping[str, Channel], log_map: LogMap, joints: list[str]
) -> tuple[dict[str, Channel], LogMap, list[str]]:
    """Returns the channel of each mapped quantity, the map of them, and what was made of it."""
    notes: list[str] = []
    own: dict[str, Channel] = {}
    for name in QUANTITIES:
        part = getattr(log_map, name)
        if not (columns := list(dict.fromkeys(part.names(joints)))):
            continue
        channel = topics[part.topic]
        channel = replace(channel, frame=channel.frame[columns])
        # Velocities that are 0 or missing in every row were never filled in.
        if name in VELOCITIES and not channel.frame.fillna(0.0).any(axis=None):
            what = f"0 or missing in every row: the derivative of '{VELOCITIES[name]}' is used"
            notes.append(f"{_start_of(name, channel)} is {what}")
            log_map = replace(log_map, **{name: type(part)()})
        else:
            own[name] = channel
    for topic, channel in topics.items():
        used = {name: part for name, part in own.items() if getattr(log_map, name).topic == topic}
        missing = [part.frame.isna().any(axis=1) for part in used.values()]
        share = 1.0 - np.any(missing, axis=0).sum() / max(len(channel.time), 1)
        if share < _SPARSE:  # The values are of several sources.
            own |= {name: _present(part, log_map.max_gap_s) for name, part in used.items()}
            rows = f"the messages of topic '{topic}'" if topic else "the rows"
            what = "each quantity is read at its own rows and resampled"
            notes.append(f"log '{channel.path}': {share:.0%} of {rows} have every value: {what}")
    for name, channel in own.items():
        if name in COMMANDS:
            own[name] = _held(channel, own["base_position"], log_map.max_gap_s)
            continue
        own[name], number = _without_holds(channel)
        if number > 1:
            what = f"changes only at every {number:.3g}th row: the others are left out"
            notes.append(f"{_start_of(name, channel)} {what}")
    return own, log_map, notes


def _start_of(name: str, channel: Channel) -> str:
    return f"log '{channel.path}': '{name}', column '{channel.frame.columns[0]}' and so on,"


def _present(channel: Channel, max_gap_s: float) -> Channel:
    """The rows with most values; a column that is missing in one of them is interpolated."""
    frame = channel.frame.set_axis(channel.time_s)
    if not (counts := frame.count()).any():
        return channel
    known_s = frame.notna().apply(lambda is_known: is_known.index.where(is_known))
    before_s, after_s = known_s.ffill(), known_s.bfill()
    filled = frame.interpolate("index").where(after_s - before_s <= max_gap_s)
    is_covered = (before_s.notna() & after_s.notna()) | (counts == 0)
    rows = (is_covered.all(axis=1) & frame[counts.idxmax()].notna()).to_numpy()
    return replace(channel, frame=filled.set_axis(channel.frame.index)).select(rows)


def _without_holds(channel: Channel) -> tuple[Channel, float]:
    """The rows at which a value that is held for equally many rows changes, and that number."""
    values = np.nan_to_num(channel.frame.to_numpy())
    hold = np.append(0, np.diff(values, axis=0).any(axis=1).cumsum())
    holds = np.bincount(hold)[1:-1]  # Rows of each but the first and the last.
    if len(holds) < 2 or holds.sum() < _MANY_HELD:
        return channel, 1.0
    number = float(holds[holds < 3 * np.median(holds)].mean())
    is_regular = np.abs(holds - number) < max(1.0, number / 3)
    if number < 1.8 or is_regular.mean() < _REGULAR:
        return channel, 1.0
    since = np.arange(len(hold)) - np.searchsorted(hold, hold)
    # A value that stays the same for longer was measured again.
    return channel.select(since % int(2 * number) == 0), number


def _held(command: Channel, base: Channel, max_gap_s: float) -> Channel:
    """A command that comes rarely, at the base's rows from its first value on: the last value."""
    known = command.frame.set_axis(command.time_s).dropna()
    steps_s = np.diff(command.time_s)
    if known.empty or (len(steps_s) > 1 and steps_s.max() <= max_gap_s):
        return command
    held = known.reindex(base.time_s, method="ffill").set_axis(base.frame.index)
    return replace(base, frame=held).select(held.notna().all(axis=1).to_numpy())


def cut(
    channels: Mapping[str, Channel], max_gap_s: float
) -> tuple[list[dict[str, Channel]], list[str]]:
    """Cuts quantities at missing values and long gaps; returns channels by piece, and reasons."""
    pieces: list[tuple[float, float, dict[str, Channel]]] = [(-math.inf, math.inf, {})]
    reasons: dict[str, None] = {}
    for name, channel in channels.items():
        stretches, breaks = _unbroken(name, channel, max_gap_s)
        reasons |= dict.fromkeys(breaks)
        joined, i, k = [], 0, 0
        while i < len(pieces) and k < len(stretches):
            (begin, end, piece), part = pieces[i], stretches[k]
            first, last = part.time_s[[0, -1]]
            if min(end, last) > max(begin, first):
                joined.append((max(begin, first), min(end, last), {**piece, name: part}))
            i, k = (i + 1, k) if end < last else (i, k + 1)
        pieces = joined
    return [piece for _, _, piece in pieces], list(reasons)


def _unbroken(name: str, channel: Channel, max_gap_s: float) -> tuple[list[Channel], list[str]]:
    """Stretches of rows without a missing value and without a gap, and what lies between them."""
    steps_s, clock = np.diff(channel.time_s), channel.time_name
    if len(channel.time) < MIN_ROWS:
        of = f" of topic '{channel.topic}'" if channel.topic else ""
        what = f"has {len(channel.time)} rows with a value and a time of their own"
        raise ValueError(f"log '{channel.path}'{of} {what}, expected at least {MIN_ROWS}")
    low, high = _INTERVALS_S
    if not low <= (usual_s := float(np.median(steps_s))) <= high:
        usual = f"{usual_s * TIME_UNITS[channel.time_unit]:g} {channel.time_unit}"
        what = f"rows are {usual} apart, which is implausible: check 'time.unit' of the map"
        raise ValueError(f"{channel.where(0, clock)}: {what}")
    # A value that is missing, not finite or absurdly large is bad.
    bad = ~(channel.frame.abs() < LARGEST).to_numpy()
    if name == "base_orientation":  # Before an estimator starts, quaternions are zero.
        bad |= (channel.frame == 0).all(axis=1).to_numpy()[:, None]
    is_bad = bad.any(axis=1)
    is_bad_before = np.append(False, is_bad[:-1])
    reasons = []
    for row in np.flatnonzero(is_bad & ~is_bad_before).tolist():
        column = int(np.argmax(bad[row]))
        where = channel.where(row, channel.frame.columns[column])
        value = channel.frame.iat[row, column]
        reasons.append(f"{where}: {f'the value is {value}' if value else 'the quaternion is 0'}")
    # The tolerance covers rounding, so that a log of 10 Hz passes a limit of 0.1 s.
    is_after_gap = np.append(True, steps_s > max_gap_s * (1 + 1e-6))
    reasons += [
        f"{channel.where(row, clock)}: a gap of {steps_s[row - 1]:g} s before it, "
        f"expected at most {max_gap_s:g} s ('max_gap_s' of the map)"
        for row in np.flatnonzero(is_after_gap)[1:].tolist()
    ]
    rows = np.flatnonzero(~is_bad)
    parts = np.split(rows, np.flatnonzero((is_bad_before | is_after_gap)[rows]))
    return [channel.select(part) for part in parts if len(part) >= MIN_ROWS], reasons
