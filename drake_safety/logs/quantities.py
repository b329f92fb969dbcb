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
                f"on, is 0 or missing in every row: the derivative of '{source}' is used"
            )
            log_map, columns[name] = replace(log_map, **{name: type(part)()}), []
    sparse = set()
    for topic, channel in topics.items():
        used = {one for name in QUANTITIES for one in columns[name] if one in channel.columns}
        # A topic of velocities that are left out is not used.
        is_whole = ~np.isnan(channel.table(used)).any(axis=1) if used else np.ones(0)
        if len(is_whole) and is_whole.mean() < _SPARSE:
            sparse.add(topic)
            rows = f"the messages of topic '{topic}'" if topic else "the rows"
            notes.append(
                f"log '{channel.path}': {is_whole.mean():.0%} of {rows} have every value: each "
                "quantity is read at its own rows and resampled"
            )
    found: dict[str, Channel] = {}
    for name in filter(columns.get, QUANTITIES):
        part = getattr(log_map, name)
        own = topics[part.topic]
        own = replace(own, columns={one: own.columns[one] for one in columns[name]})
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
    import pandas as pd

    frame = pd.DataFrame(channel.columns, index=channel.seconds_since(channel.time[0]))
    if not np.isfinite(channel.time).all() or not frame.notna().any(axis=None):
        return channel
    known_s = frame.notna().apply(lambda is_known: is_known.index.where(is_known))
    before_s, after_s = known_s.ffill(), known_s.bfill()
    filled = frame.interpolate("index").where(after_s - before_s <= max_gap_s)
    is_covered = (before_s.notna() & after_s.notna()) | frame.isna().all()
    most = frame.notna().sum().idxmax()
    columns = {name: filled[name].to_numpy() for name in filled}
    rows = is_covered.all(axis=1) & frame[most].notna()
    return replace(channel, columns=columns).select(rows.to_numpy())


def _without_holds(channel: Channel) -> tuple[Channel, float]:
    """The rows at which a value that is held for equally many rows changes, and that number."""
    values = np.nan_to_num(channel.table(channel.columns))
    hold = np.append(0, np.diff(values, axis=0).any(axis=1).cumsum())
    holds = np.bincount(hold)[1:-1]  # Rows of each but the first and the last.
    if len(holds) < _MANY_HOLDS:
        return channel, 1.0
    number = float(holds[holds < 3 * np.median(holds)].mean())
    is_regular = np.abs(holds - number) < max(1.0, number / 3)
    if number < 1.8 or is_regular.mean() < _REGULAR:
        return channel, 1.0
    since = np.arange(len(hold)) - np.searchsorted(hold, hold)
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
    return replace(channel, columns=columns)


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
    return replace(base, columns=columns).select(last >= 0)


def in_order(channel: Channel, max_gap_s: float) -> tuple[Channel, list[str]]:
    """Sorts rows that are a little out of order, and joins those of one time.

    Returns also what is lost by that: nothing where rows of one time have values of other columns,
    as messages have that name some joints only.
    """
    step = np.diff(channel.time)
    if (step > 0).all() or not (step >= -max_gap_s * TIME_UNITS[channel.time_unit]).all():
        return channel, []  # In order, or of another clock, which is refused.
    import pandas as pd

    groups = pd.DataFrame(channel.columns).groupby(channel.time)
    num_lost = (groups.count() - 1).clip(lower=0).sum().max()
    is_back, order = step < 0, np.argsort(channel.time, kind="stable")
    lost = []
    if is_back.any():
        where = channel.where(int(np.argmax(is_back)) + 1, channel.time_name)
        lost.append(f"{where}: time runs backwards in {is_back.mean():.1%} of the rows: sorted")
    if num_lost:
        again = order[1:][np.diff(channel.time[order]) == 0]
        where = channel.where(int(again[0]), channel.time_name)
        share = num_lost / len(channel.time)
        lost.append(f"{where}: time stands still in {share:.1%} of the rows: the first is kept")
    joined = channel.select(np.unique(channel.time, return_index=True)[1])
    firsts = groups.first()  # Of the values that are there.
    return replace(joined, columns={name: firsts[name].to_numpy() for name in firsts}), lost
