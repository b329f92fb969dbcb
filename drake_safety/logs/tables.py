"""Readers of tables: CSV and Parquet."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.reading import is_number, reading
from drake_safety.logs.channel import Channel, listed
from drake_safety.logs.log_map import LogTime

if TYPE_CHECKING:
    import pandas as pd


def read_csv(path: Path, wanted: Sequence[str], time: LogTime) -> Channel:
    """Reads columns of a CSV file with a header line."""
    require_extra("logs", f"log '{path}'", "pandas")
    import pandas as pd

    # Parser errors are of several kinds.
    with reading(path, "not a CSV table: log", Exception):
        names = _checked_names(path, wanted, time, _header_of(path))
        # Read as text, so that errors can quote cells that are not numbers.
        frame = pd.read_csv(
            path, usecols=names, dtype=str, keep_default_na=False, skip_blank_lines=False
        )
        return _channel(path, frame, wanted, time, "line", 2)


def read_parquet(path: Path, wanted: Sequence[str], time: LogTime) -> Channel:
    """Reads columns of a Parquet file."""
    require_extra("logs", f"log '{path}'", "pandas", "pyarrow")
    import pyarrow.parquet as pq

    with (
        reading(path, "damaged, or not a Parquet file: log", Exception),
        pq.ParquetFile(path, page_checksum_verification=True) as file,
    ):
        names = _checked_names(path, wanted, time, file.schema_arrow.names)
        frame = file.read(columns=names).to_pandas(timestamp_as_object=False)
        return _channel(path, frame, wanted, time, "row", 0)


def _header_of(path: Path) -> list[str]:
    with path.open(newline="", encoding="utf-8-sig") as file:
        return next(csv.reader(file), [])


def _checked_names(
    path: Path, wanted: Sequence[str], time: LogTime, existing: list[str]
) -> list[str]:
    if not time.column:
        raise ValueError(
            f"log '{path}' is a table: 'time.column' of the map must name its time; it has "
            f"{existing}"
        )
    names = list(dict.fromkeys([time.column, *wanted]))
    missing = [name for name in names if name not in existing]
    if missing:
        raise ValueError(f"log '{path}' has no columns {missing}; it has {listed(existing)}")
    twice = [name for name in names if existing.count(name) > 1]
    if twice:
        raise ValueError(f"log '{path}' has columns of the same name: {twice}")
    return names


def _channel(
    path: Path,
    frame: pd.DataFrame,
    wanted: Sequence[str],
    time: LogTime,
    row_name: str,
    first_row: int,
) -> Channel:
    channel = Channel(
        path=path,
        topic="",
        time=np.zeros(len(frame)),
        time_unit=time.unit,
        time_name=time.column,
        columns={},
        row_name=row_name,
        first_row=first_row,
    )
    stamps = frame[time.column]
    if stamps.dtype.kind == "M":
        channel.time = stamps.to_numpy("datetime64[ns]").astype(np.int64)
        channel.time_unit = "ns"
    else:
        channel.time = _numbers(channel, frame, time.column)
    channel.columns = {name: _numbers(channel, frame, name).astype(float) for name in wanted}
    return channel


def _numbers(channel: Channel, frame: pd.DataFrame, name: str) -> np.ndarray:
    """A column as numbers; integers stay exact, as clocks in nanoseconds require."""
    values = frame[name].to_numpy()
    if values.dtype.kind in "iuf":
        return values
    if name != channel.time_name:
        # An empty cell is a missing value, as NaN is.
        values = np.array([math.nan if one is None or one == "" else one for one in values], object)
    for kind in (np.int64, np.float64):
        try:
            return values.astype(kind)
        except (ValueError, TypeError, OverflowError):
            continue
    row = next(i for i, value in enumerate(values) if not is_number(value))
    raise ValueError(f"{channel.where(row, name)}: '{values[row]}' is not a number")
