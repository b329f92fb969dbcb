"""Pieces of a log: what is left of it when it is cut at missing values and at gaps in time."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from drake_safety.learning.segments import LARGEST
from drake_safety.logs import checks
from drake_safety.logs.channel import Channel


def cut_channels(
    channels: Mapping[str, Channel], max_gap_s: float
) -> tuple[list[dict[str, Channel]], list[str]]:
    """Cuts quantities where a value is missing or a gap in time is longer than ``max_gap_s``.

    Returns the channels of each piece in order of time, whose common time is covered by all without
    a cut, and the reasons of the cuts.
    """
    pieces: list[tuple[float, float, dict[str, slice]]] = [(-math.inf, math.inf, {})]
    reasons: list[str] = []
    origin = min((one.time[0] for one in channels.values() if len(one.time)), default=0)
    for name, channel in channels.items():
        checks.check_clock(channel)
        rows, found = _unbroken(channel, max_gap_s)
        reasons += found
        time_s = channel.seconds_since(origin)
        parts = [(float(time_s[one.start]), float(time_s[one.stop - 1]), one) for one in rows]
        joined, i, k = [], 0, 0
        while i < len(pieces) and k < len(parts):
            (begin, end, piece), (first, last, part) = pieces[i], parts[k]
            if min(end, last) > max(begin, first):
                joined.append((max(begin, first), min(end, last), {**piece, name: part}))
            i, k = (i + 1, k) if end < last else (i, k + 1)
        pieces = joined
    found_pieces = [
        {name: channels[name].select(rows) for name, rows in piece.items()}
        for _, _, piece in pieces
    ]
    return found_pieces, list(dict.fromkeys(reasons))


def _unbroken(channel: Channel, max_gap_s: float) -> tuple[list[slice], list[str]]:
    """Stretches of rows without a missing value and without a gap, and what lies between them."""
    # A value that is missing, not finite or absurdly large is bad.
    bad = ~(np.abs(channel.table(channel.columns)) < LARGEST)
    is_bad, steps = bad.any(axis=1), channel.steps_s()
    is_bad_before = np.concatenate([[False], is_bad[:-1]])
    reasons = []
    for row in np.flatnonzero(is_bad & ~is_bad_before).tolist():
        name, value = list(channel.columns.items())[int(np.argmax(bad[row]))]
        reasons.append(f"{channel.where(row, name)}: the value is {value[row]}")
    # The tolerance covers rounding, so that a log of 10 Hz passes a limit of 0.1 s.
    is_after_gap = np.concatenate([[True], steps > max_gap_s * (1 + 1e-6)])
    reasons += [
        f"{channel.where(row, channel.time_name)}: a gap of {steps[row - 1]:g} s before it, "
        f"expected at most {max_gap_s:g} s ('max_gap_s' of the map)"
        for row in np.flatnonzero(is_after_gap)[1:].tolist()
    ]
    begins = ~is_bad & (is_bad_before | is_after_gap)
    rows = np.flatnonzero(~is_bad)
    found = np.split(rows, np.flatnonzero(begins[rows]))
    long = [one for one in found if len(one) >= checks.MIN_ROWS]
    return [slice(int(one[0]), int(one[-1]) + 1) for one in long], reasons
