"""Readers of tables: CSV and Parquet."""

from __future__ import annotations

import csv
import io
import re
import warnings
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.reading import is_number, reading
from drake_safety.logs.channel import Channel, Wanted, listed
from drake_safety.logs.log_map import LogTime

if TYPE_CHECKING:
    import pandas as pd

_SEPARATORS = (",", ";", "\t", "|", " ")
_NUM_HEAD_LINES = 60  # Among which the header is sought.
_COMMENT = "#%"
_MISSING = {"", "na", "n/a", "nan", "null", "none", "-"}
_UNIT = re.compile(r"\s*[\[(]([^\[\]()]*)[\])]$")  # In brackets at the end of a name.


def read_csv(path: Path, wanted: Wanted, time: LogTime) -> tuple[dict[str, Channel], str]:
    """Reads columns of a CSV file with a header line, and says whether its end is cut off.

    The header is the line among the first ones that has the most of the names, and the separator
    the one that gives them.
    """
    import pandas as pd

    # Parser errors are of several kinds.
    with reading(path, "not a CSV table: log", Exception):
        data = path.read_bytes()
        encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
        text = data.decode(encoding).rstrip("\0")
        lines = text[: 1 << 20].splitlines()[:_NUM_HEAD_LINES] or [""]
        keys = {_key(name) for name in (time.column, *wanted.get("", ()))}
        headers = [(i, by, _cells(line, by)) for i, line in enumerate(lines) for by in _SEPARATORS]
        line, separator, names = max(
            headers, key=lambda one: sum(bool({_key(n), _bare(n)} & keys) for n in one[2])
        )
        places = _places(path, wanted, time, names)
        # Read as text, so that errors can quote cells that are not numbers.
        frame = pd.read_csv(
            io.StringIO(text),
            sep=r"\s+" if separator == " " else separator,
            skiprows=line + 1,
            names=range(len(names)),
            index_col=False,
            dtype=str,
            keep_default_na=False,
            skip_blank_lines=False,
            skipinitialspace=True,
            usecols=[*places.values()],
        )
        cut = ""
        if not text.endswith(("\n", "\r")):
            cut = f"log '{path}' is cut off: its last line has no end and is left out"
            frame = frame[:-1]
        frame = frame[[*places.values()]].set_axis([*places], axis=1)
        frame = frame[~_is_remark(frame, time.column)]
        return {"": _channel(path, frame, time, "line", line + 2)}, cut


def read_parquet(path: Path, wanted: Wanted, time: LogTime) -> tuple[dict[str, Channel], str]:
    """Reads columns of a Parquet file; of one that is cut off nothing can be read."""
    require_extra("logs", f"log '{path}'", "pyarrow")
    import pyarrow.parquet as pq

    with (
        reading(path, "damaged, cut off, or not a Parquet file: log", Exception),
        pq.ParquetFile(path, page_checksum_verification=True) as file,
    ):
        existing = file.schema_arrow.names
        places = _places(path, wanted, time, existing)
        names = [existing[place] for place in places.values()]
        table = file.read(columns=names).select(names).rename_columns([*places])
        frame = table.to_pandas(timestamp_as_object=False, ignore_metadata=True)
        return {"": _channel(path, frame, time, "row", 0)}, ""


def _cells(line: str, separator: str) -> list[str]:
    line = line.lstrip(_COMMENT + " ")
    if separator == " ":
        return line.split()
    return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])


def _key(name: str) -> str:
    return name.strip().lstrip(_COMMENT).strip()


def _bare(name: str) -> str:
    return _UNIT.sub("", _key(name))


def _places(path: Path, wanted: Wanted, time: LogTime, existing: list[str]) -> dict[str, int]:
    """Places of the columns, by their name or by that without a unit."""
    if topics := [topic for topic in wanted if topic]:
        raise ValueError(f"log '{path}' is a table and has no topics; the map names {topics}")
    if not time.column:
        raise ValueError(
            f"log '{path}' is a table: 'time.column' of the map must name its time; it has "
            f"{existing}"
        )
    keys, bare = list(map(_key, existing)), list(map(_bare, existing))
    columns = {name: keys if _key(name) in keys else bare for name in (time.column, *wanted[""])}
    counts = {name: among.count(_key(name)) for name, among in columns.items()}
    if missing := [name for name, count in counts.items() if not count]:
        raise ValueError(
            f"log '{path}' has no columns {listed(missing, 5)}; it has {listed(existing)}"
        )
    if twice := [name for name, count in counts.items() if count > 1]:
        raise ValueError(f"log '{path}' has columns of the same name: {twice}")
    return {name: among.index(_key(name)) for name, among in columns.items()}


def _is_remark(frame: pd.DataFrame, clock: str) -> np.ndarray:
    """Which rows (N,) are comments, units, empty, or the header once more."""
    stamps = frame[clock].fillna("").str.strip()
    is_remark = np.array(stamps.str.startswith(tuple(_COMMENT)), dtype=bool)
    for row in np.flatnonzero(~stamps.str.contains(r"\d").to_numpy(bool) | (stamps == clock)):
        is_remark[row] |= not any(map(is_number, frame.iloc[row]))
    return is_remark


def _channel(
    path: Path, frame: pd.DataFrame, time: LogTime, row_name: str, first_row: int
) -> Channel:
    channel = Channel(
        path=path,
        topic="",
        time=np.zeros(len(frame)),
        time_unit=time.unit,
        time_name=time.column,
        columns={},
        row_name=row_name,
        rows=first_row + frame.index.to_numpy(),
    )
    dates = _dates(frame[time.column])
    if dates is None:
        channel.time = _numbers(channel, frame, time.column)
    else:
        kind = "datetime64[ns]" if dates.dtype.kind == "M" else "timedelta64[ns]"
        channel.time, channel.time_unit = dates.to_numpy(kind).astype(np.int64), "ns"
    wanted = frame.columns.drop(time.column)
    channel.columns = {name: _numbers(channel, frame, name).astype(float) for name in wanted}
    return channel


def _dates(stamps: pd.Series) -> pd.Series | None:
    """Dates, or times of day, if the cells of a column are all of that kind."""
    import pandas as pd

    if stamps.dtype.kind in "Mm":
        return stamps
    if stamps.dtype.kind in "iuf" or is_number(next(iter(stamps), 0)):
        return None
    text = stamps.astype(str).str.strip().str.replace(",", ".")
    date = partial(pd.to_datetime, utc=True)
    for parse in (partial(date, format="ISO8601"), pd.to_timedelta, date):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # That the format had to be guessed.
            dates = parse(text, errors="coerce")
        if not dates.isna().any():
            return dates
    return None


def _numbers(channel: Channel, frame: pd.DataFrame, name: str) -> np.ndarray:
    """A column as numbers; integers stay exact, as clocks in nanoseconds require."""
    values = frame[name].to_numpy()
    if values.dtype.kind in "iuf":
        return values
    # An empty cell is a missing value, as NaN is; a decimal comma is a point.
    cells = ["" if one is None else str(one).strip().replace(",", ".") for one in values]
    if name != channel.time_name:
        cells = ["nan" if one.lower() in _MISSING else one for one in cells]
    for kind in (np.int64, np.float64):
        try:
            return np.array(cells, object).astype(kind)
        except (ValueError, TypeError, OverflowError):
            continue
    row = next(i for i, cell in enumerate(cells) if not is_number(cell))
    kinds = "number or a date" if name == channel.time_name else "number"
    raise ValueError(f"{channel.where(row, name)}: '{values[row]}' is not a {kinds}")
