"""Readers of tables: CSV and Parquet."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.reading import check_memory, is_number, reading
from drake_safety.logs.channel import Channel, Wanted, listed
from drake_safety.logs.log_map import LogTime

if TYPE_CHECKING:
    import pandas as pd

_SEPARATORS = (",", ";", "\t", "|", " ")
_NUM_HEAD_LINES = 60  # Among which the header is sought.
_COMMENT = "#%"
_MISSING = ["", "na", "n/a", "nan", "null", "none", "-"]


def read_csv(path: Path, wanted: Wanted, time: LogTime) -> tuple[dict[str, Channel], list[str]]:
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
        line, separator, names = max(headers, key=lambda one: len(keys & set(map(_key, one[2]))))
        places = _places(path, wanted, time, names)
        frame = pd.read_csv(
            io.StringIO(text),
            sep=r"\s+" if separator == " " else separator,
            skiprows=line + 1,
            names=range(len(names)),
            index_col=False,
            skip_blank_lines=False,
            skipinitialspace=True,
            usecols=[*places.values()],
            dtype={places[time.column]: str},  # Else nanoseconds beside an empty cell are floats.
            low_memory=False,  # Else the chunks of a column may be of several types.
        )
        frame = frame[[*places.values()]].set_axis([*places], axis=1)
        frame.index += line + 2
        cut = []
        if not text.endswith(("\n", "\r")):
            cut.append(f"log '{path}' is cut off: its last line has no end and is left out")
            frame = frame[:-1]
        return {"": _channel(path, _without_remarks(frame, time.column), time, "line")}, cut


def read_parquet(path: Path, wanted: Wanted, time: LogTime) -> tuple[dict[str, Channel], list[str]]:
    """Reads columns of a Parquet file; of one that is cut off nothing can be read."""
    require_extra("logs", f"log '{path}'", "pyarrow")
    import pandas as pd
    import pyarrow.parquet as pq

    # A list's entries are columns.
    roots, lists = {name.split("[")[0] for name in wanted.get("", ())}, dict[str, pd.Series]()
    with (
        reading(path, "damaged, cut off, or not a Parquet file: log", Exception),
        pq.ParquetFile(path, page_checksum_verification=True) as file,
    ):
        check_memory(8 * file.metadata.num_rows * len(wanted.get("", ())), f"'{path}'")
        existing = list(file.schema_arrow.names)
        for one in file.schema_arrow:
            if one.name in roots and hasattr(one.type, "value_field"):
                cells = file.read(columns=[one.name])[one.name].to_pylist()
                entries = pd.DataFrame([cell or [] for cell in cells]).add_prefix(f"{one.name}[")
                lists |= {f"{key}]": values for key, values in entries.items()}
                existing.remove(one.name)
        known = [*existing, *lists]
        places = _places(path, wanted, time, known)
        names = [known[place] for place in places.values()]
        table = file.read(columns=[name for name in names if name in existing])
        frame = table.to_pandas(timestamp_as_object=False, ignore_metadata=True)
        frame = frame.assign(**{name: lists[name] for name in names if name in lists})
        frame = frame[names].set_axis([*places], axis=1)
        return {"": _channel(path, frame, time, "row")}, []


def _cells(line: str, separator: str) -> list[str]:
    line = line.lstrip(_COMMENT + " ").rstrip(" ")
    return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])


def _key(name: str) -> str:
    return name.strip().lstrip(_COMMENT).strip()


def _places(path: Path, wanted: Wanted, time: LogTime, existing: list[str]) -> dict[str, int]:
    """Places of the columns by name."""
    if topics := [topic for topic in wanted if topic]:
        raise ValueError(f"log '{path}' is a table and has no topics; the map names {topics}")
    if not time.column:
        raise ValueError(
            f"log '{path}' is a table: 'time.column' of the map must name its time; it has "
            f"{existing}"
        )
    keys = list(map(_key, existing))
    counts = {name: keys.count(_key(name)) for name in (time.column, *wanted[""])}
    if missing := [name for name, count in counts.items() if not count]:
        raise ValueError(
            f"log '{path}' has no columns {listed(missing, 5)}; it has {listed(existing)}"
        )
    if twice := [name for name, count in counts.items() if count > 1]:
        raise ValueError(f"log '{path}' has columns of the same name: {twice}")
    return {name: keys.index(_key(name)) for name in counts}


def _without_remarks(frame: pd.DataFrame, clock: str) -> pd.DataFrame:
    """Leaves out rows that are comments or empty."""
    is_comment = frame[clock].fillna("").str.strip().str.startswith(tuple(_COMMENT))
    return frame[~is_comment & frame.notna().any(axis=1)]


def _channel(path: Path, frame: pd.DataFrame, time: LogTime, row_name: str) -> Channel:
    def numbers(name: str, kind: str = "number") -> np.ndarray:
        """A column as numbers; integers stay exact, as clocks in nanoseconds require."""
        if frame[name].dtype.kind in "iuf":
            return frame[name].to_numpy()
        # A decimal comma is a point.
        cells = frame[name].astype("string").str.strip().str.replace(",", ".")
        cells = cells.mask(cells.str.lower().isin(_MISSING))
        values = pd.to_numeric(cells.astype(object), errors="coerce")
        if (is_bad := (values.isna() & cells.notna()).to_numpy()).any():
            row = int(np.argmax(is_bad))
            where = f"log '{path}', {row_name} {frame.index[row]}, column '{name}'"
            raise ValueError(f"{where}: '{frame[name].iloc[row]}' is not a {kind}")
        return values.to_numpy()

    import pandas as pd

    if (dates := _dates(frame[time.column])) is None:
        stamps = numbers(time.column, "number or a date")
    else:
        stamps = dates.to_numpy(f"{dates.dtype.kind}8[ns]")
    columns = {name: numbers(name).astype(float) for name in frame.columns.drop(time.column)}
    return Channel(
        path=path,
        time=stamps,
        time_unit=time.unit,
        time_name=time.column,
        frame=pd.DataFrame(columns, index=frame.index),
        row_name=row_name,
    )


def _dates(stamps: pd.Series) -> pd.Series | None:
    """Dates, if all cells of a column are dates."""
    import pandas as pd

    if stamps.dtype.kind in "Mm":
        return stamps
    if stamps.dtype.kind in "iuf" or is_number(next(iter(stamps), 0)):
        return None
    text = stamps.astype(str).str.strip().str.replace(",", ".")
    dates = pd.to_datetime(text, utc=True, format="ISO8601", errors="coerce")
    return None if dates.isna().any() else dates
