"""Pieces of a log: what is left of it when it is cut at missing values and at gaps in time."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from drake_safety.logs import checks
from drake_safety.logs.channel import Channel


def cut_channels(
    channels: Mapping[str, Channel], max_gap_s: float
) -> tuple[list[dict[str, Channel]], list[str]]:
    """Cuts tables or topics where a value is missing or a gap in time is longer than ``max_gap_s``.

    Returns the channels of each piece in order of time, whose common time is covered by all without
    a cut, and the reasons of the cuts.
    """
    pieces: list[dict[str, Channel]] = [{}]
    reasons: list[str] = []
    origin = min(channel.time[0] for channel in channels.values())
    for topic, channel in channels.items():
        checks.check_clock(channel)
        rows, found = _unbroken(channel, max_gap_s)
        reasons += found
        parts = [_part(channel, part) for part in rows]
        pieces = [
            joined
            for piece in pieces
            for part in parts
            if _overlap_s(joined := {**piece, topic: part}, origin) > 0.0
        ]
    return pieces, reasons


def _unbroken(channel: Channel, max_gap_s: float) -> tuple[list[slice], list[str]]:
    """Stretches of rows without a missing value and without a gap, and what lies between them."""
    bad = checks.bad_values(channel)
    is_bad = np.any([np.zeros(len(channel.time), dtype=bool), *bad.values()], axis=0)
    is_bad_before = np.concatenate([[False], is_bad[:-1]])
    reasons = []
    for row in np.flatnonzero(is_bad & ~is_bad_before).tolist():
        name = next(name for name, values in bad.items() if values[row])
        reasons.append(f"{channel.where(row, name)}: the value is {channel.columns[name][row]}")
    steps = channel.steps_s()
    after_gap = checks.rows_after_gaps(channel, max_gap_s)
    reasons += [
        f"{channel.where(row, channel.time_name)}: a gap of {steps[row - 1]:g} s before it"
        for row in after_gap.tolist()
    ]
    begins = ~is_bad & is_bad_before
    begins[0] = not is_bad[0]
    begins[after_gap] = ~is_bad[after_gap]
    starts = np.flatnonzero(begins)
    found = []
    for start, stop in itertools.pairwise([*starts, len(channel.time)]):
        ends = np.flatnonzero(is_bad[start:stop])
        found.append(slice(int(start), int(start + ends[0] if len(ends) else stop)))
    return [one for one in found if one.stop - one.start >= checks.MIN_ROWS], reasons


def _part(channel: Channel, rows: slice) -> Channel:
    return replace(
        channel,
        time=channel.time[rows],
        columns={name: values[rows] for name, values in channel.columns.items()},
        first_row=channel.first_row + rows.start,
    )


def _overlap_s(channels: Mapping[str, Channel], origin: float) -> float:
    spans = [channel.seconds_since(origin)[[0, -1]] for channel in channels.values()]
    return float(min(span[1] for span in spans) - max(span[0] for span in spans))
