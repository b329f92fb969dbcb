"""Quantities of a log, such as the base's position, each at the rows where it is measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from drake_safety.logs.channel import Channel
from drake_safety.logs.log_map import COMMANDS, QUANTITIES, TIME_UNITS, VELOCITIES, LogMap, si_units

_SPARSE = 0.9  # Share of complete rows below which every quantity has rows of its own.
_MANY_HOLDS, _REGULAR = 5, 0.9  # Least number of holds of a value, and share of equally long ones.
_JUMPS = {"base_position": 0.1, "base_orientation": 0.1, "joint_positions": 0.3}
"""Least change from what is logged before an estimator starts [m, 1, rad]."""


def quantities(
    topics: Mapping[str, Channel], log_map: LogMap, joints: list[str]
) -> tuple[dict[str, Channel], LogMap, list[str]]:
    """Returns the channel of each mapped quantity, the map of them, and what was made of it.

    - Velocities that are 0 or missing in every row were never filled in: they are left out.
    - A table or topic of which few rows are complete has values of several sources: each quantity
      has the rows with a value of it, and a column that is missing there is interpolated.
    - Of values that are repeated until the next measurement the first is kept.
    - What is logged before an estimator starts is made missing: zero quaternions, and values that
      are repeated from the first row on and then jump.
    - Commands that come rarely are valid until the next one.
    """
    notes: list[str] = []
    columns = {name: getattr(log_map, name).names(joints) for name in QUANTITIES}
    for name, source in VELOCITIES.items():
        part = getattr(log_map, name)
        if columns[name] and not np.nan_to_num(topics[part.topic].table(columns[name])).any():
            notes.append(
                f"log '{topics[part.topic].path}': '{name}', column '{columns[name][0]}' and so "
                f"on, is 0 in every row: the derivative of '{source}' is used instead"
            )
            log_map, columns[name] = replace(log_map, **{name: type(part)()}), []
    sparse = set()
    for topic, channel in topics.items():
        used = {one for name in QUANTITIES for one in columns[name] if one in channel.columns}
        is_whole = ~np.isnan(channel.table(used)).any(axis=1)
        share = is_whole.sum() / max(len(is_whole), 1)
        if share < _SPARSE and len(is_whole):
            sparse.add(topic)
            rows = f"the messages of topic '{topic}'" if topic else "the rows"
            notes.append(
                f"log '{channel.path}': {share:.0%} of {rows} have every value: each quantity is "
                "read at its own rows and resampled"
            )
    found: dict[str, Channel] = {}
    for name in filter(columns.get, QUANTITIES):
        part = getattr(log_map, name)
        own = topics[part.topic]
        own = own.select(slice(None), {one: own.columns[one] for one in columns[name]})
        if part.topic in sparse:
            own = _present(own, log_map.max_gap_s)
        if name not in COMMANDS:
            own, number = _without_holds(own)
            if number > 1:
                notes.append(
                    f"log '{own.path}': '{name}', column '{columns[name][0]}' and so on, changes "
                    f"only at every {number:.3g}th row: the rows that repeat it are left out"
                )
        if name in _JUMPS:
            own = _started(own, _JUMPS[name] / si_units(part))
        found[name] = own
    for name in COMMANDS:
        if name in found:
            found[name] = _held(found[name], found["base_position"], log_map.max_gap_s)
    return found, log_map, notes


def _present(channel: Channel, max_gap_s: float) -> Channel:
    """The rows with most values; a column that is missing in one of them is interpolated."""
    has = ~np.isnan(channel.table(channel.columns))
    own = channel.select(has[:, has.sum(axis=0).argmax()])
    if not len(own.time):
        return channel
    at_s, time_s = (one.seconds_since(own.time[0]) for one in (own, channel))
    covered = np.ones(len(at_s), dtype=bool)
    for name, is_known in zip(channel.columns, has.T, strict=True):
        known_s = time_s[is_known]
        if not len(known_s):
            continue
        after = np.minimum(np.searchsorted(known_s, at_s), len(known_s) - 1)
        gap_s = known_s[after] - known_s[np.maximum(after - 1, 0)]
        filled = np.interp(at_s, known_s, channel.columns[name][is_known])
        is_near = (known_s[after] == at_s) | (gap_s <= max_gap_s)
        own.columns[name] = np.where(is_near, filled, np.nan)
        covered &= (at_s >= known_s[0]) & (at_s <= known_s[-1])
    return own.select(covered)


def _without_holds(channel: Channel) -> tuple[Channel, float]:
    """The rows at which a value that is held for equally many rows changes, and that number."""
    values = np.nan_to_num(channel.table(channel.columns))
    begins = np.concatenate([[0], np.flatnonzero(np.diff(values, axis=0).any(axis=1)) + 1])
    holds = np.diff(begins)[1:]
    if len(holds) < _MANY_HOLDS:
        return channel, 1.0
    number = float(holds[holds < 3 * np.median(holds)].mean())
    is_regular = np.abs(holds - number) < max(1.0, number / 3)
    if number < 1.8 or is_regular.mean() < _REGULAR:
        return channel, 1.0
    rows = np.arange(len(values))
    since = rows - begins[np.searchsorted(begins, rows, side="right") - 1]
    # A value that stays the same for longer was measured again.
    return channel.select(since % int(2 * number) == 0), number


def _started(channel: Channel, jump: float) -> Channel:
    """Makes missing what is logged before an estimator starts."""
    values = channel.table(channel.columns)
    is_unfilled = ~values.any(axis=1) & (values.shape[1] == 4)
    differs = np.flatnonzero((values != values[:1]).any(axis=1))
    first = int(differs[0]) if len(differs) else 0
    is_known = first > 1 or (first == 1 and not values[0].any())
    if is_known and np.abs(values[first] - values[0]).max() > jump:
        is_unfilled[:first] = True
    columns = {one: np.where(is_unfilled, np.nan, value) for one, value in channel.columns.items()}
    return channel.select(slice(None), columns)


def _held(command: Channel, base: Channel, max_gap_s: float) -> Channel:
    """A command that comes rarely, at the base's rows from its first value on: the last value."""
    steps = command.steps_s()
    if len(steps) > 1 and not (steps > max_gap_s).any():
        return command
    known = command.select(~np.isnan(command.table(command.columns)).any(axis=1))
    if not len(known.time) or not len(base.time):
        return command
    known_s, at_s = (one.seconds_since(base.time[0]) for one in (known, base))
    last = np.searchsorted(known_s, at_s, side="right") - 1
    columns = {name: values[last] for name, values in known.columns.items()}
    return base.select(last >= 0, columns)


def in_order(channel: Channel, max_gap_s: float) -> tuple[Channel, list[str]]:
    """Sorts rows that are a little out of order, and joins those of one time.

    Returns also what is lost by that: nothing where rows of one time have values of other columns,
    as messages have that name some joints only.
    """
    step = np.diff(channel.time)
    if (step > 0).all() or not (step >= -max_gap_s * TIME_UNITS[channel.time_unit]).all():
        return channel, []  # In order, or of another clock, which is refused.
    lost = []
    if (step < 0).any():
        where = channel.where(int(np.argmax(step < 0)) + 1, channel.time_name)
        lost.append(f"{where}: time runs backwards in {np.mean(step < 0):.1%} of the rows: sorted")
        channel = channel.select(np.argsort(channel.time, kind="stable"))
    is_new = np.concatenate([[True], np.diff(channel.time) > 0])
    group, joined, num_lost = np.cumsum(is_new) - 1, channel.select(is_new), 0
    for name, values in channel.columns.items():
        known = np.flatnonzero(~np.isnan(values))
        groups, places = np.unique(group[known], return_index=True)
        joined.columns[name] = np.full(len(joined.time), np.nan)
        joined.columns[name][groups] = values[known[places]]
        num_lost = max(num_lost, len(known) - len(groups))
    if num_lost:
        where = channel.where(int(np.argmin(is_new)), channel.time_name)
        share = num_lost / len(group)
        lost.append(f"{where}: time stands still in {share:.1%} of the rows: the first is kept")
    return joined, lost
