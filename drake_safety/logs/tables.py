"""Readers of tables: CSV and Parquet."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.extras import require_extra
from drake_safety.files.reading import check_memory, reading
from drake_safety.logs.channel import Channel, Wanted, listed
from drake_safety.logs.log_map import LogTime

if TYPE_CHECKING:
    import pandas as pd

_MISSING = ["", "na", "n/a", "nan", "null", "none", "-"]


def read_csv(path: Path, wanted: Wanted, time: LogTime) -> dict[str, Channel]:
    """Reads columns of a CSV file; a last line without an end was cut off and is left out."""
    import pandas as pd

    # Parser errors are of several kinds.
    with reading(path, "not a CSV table: log", Exception):
        text = path.read_text(encoding="utf-8-sig")
        text = text[: text.rfind("\n") + 1]
        header = text.partition("\n")[0]
        frame = pd.read_csv(
            io.StringIO(text),
            sep=max(",;\t", key=header.count),
            header=None,  # Else columns of the same name get others.
            index_col=False,
            skip_blank_lines=False,
            skipinitialspace=True,
            dtype=str,
        )
        frame = frame.set_axis(frame.iloc[0].fillna("").str.strip(), axis=1)[1:]
        frame.index += 1
        frame = frame[_columns(path, wanted, time, list(frame.columns))]
        return {"": _channel(path, frame.dropna(how="all"), time, "line")}


def read_parquet(path: Path, wanted: Wanted, time: LogTime) -> dict[str, Channel]:
    """Reads columns of a Parquet file; the entries of lists are columns."""
    require_extra("logs", f"log '{path}'", "pyarrow")
    import pandas as pd
    import pyarrow.parquet as pq

    with (
        reading(path, "damaged, cut off, or not a Parquet file: log", Exception),
        pq.ParquetFile(path, page_checksum_verification=True) as file,
    ):
        check_memory(8 * file.metadata.num_rows * len(wanted.get("", ())), f"'{path}'")
        existing = list(file.schema_arrow.names)
        roots = {name.split("[")[0] for name in (time.column, *wanted.get("", ()))}
        table = file.read(columns=[name for name in existing if name in roots])
        frame = table.to_pandas(timestamp_as_object=False, ignore_metadata=True)
        for field in table.schema:
            if hasattr(field.type, "value_field"):
                cells = [[] if cell is None else cell for cell in frame.pop(field.name)]
                entries = pd.DataFrame(cells).add_prefix(f"{field.name}[").add_suffix("]")
                existing += list(entries.columns)
                frame = frame.join(entries)
        frame = frame[_columns(path, wanted, time, existing)]
        return {"": _channel(path, frame, time, "row")}


def _columns(path: Path, wanted: Wanted, time: LogTime, existing: list[str]) -> list[str]:
    """The columns of time and of wanted values; a table must have each once."""
    if topics := [topic for topic in wanted if topic]:
        raise ValueError(f"log '{path}' is a table and has no topics; the map names {topics}")
    if not time.column:
        raise ValueError(f"log '{path}' is a table: 'time.column' of the map must name its time")
    names = list(dict.fromkeys([time.column, *wanted[""]]))
    if missing := [name for name in names if name not in existing]:
        what = f"{listed(missing, 5)}; it has {listed(existing)}"
        raise ValueError(f"log '{path}' has no columns {what}")
    if twice := [name for name in names if existing.count(name) > 1]:
        raise ValueError(f"log '{path}' has columns of the same name: {twice}")
    return names


def _channel(path: Path, frame: pd.DataFrame, time: LogTime, row_name: str) -> Channel:
    import pandas as pd

    def numbers(name: str) -> np.ndarray:
        """A column as numbers; integers stay exact, as clocks in nanoseconds require."""
        if frame[name].dtype.kind in "iuf":
            return frame[name].to_numpy()
        if frame[name].dtype.kind in "Mm":
            return frame[name].to_numpy(f"{frame[name].dtype.kind}8[ns]")
        cells = frame[name].astype("string").str.strip()
        cells = cells.mask(cells.str.lower().isin(_MISSING))
        values = pd.to_numeric(cells.astype(object), errors="coerce")
        if (is_bad := (values.isna() & cells.notna()).to_numpy()).any():
            row = int(np.argmax(is_bad))
            where = f"log '{path}', {row_name} {frame.index[row]}, column '{name}'"
            raise ValueError(f"{where}: '{frame[name].iloc[row]}' is not a number")
        return values.to_numpy()

    columns = {name: numbers(name).astype(float) for name in frame.columns.drop(time.column)}
    return Channel(
        path=path,
        time=numbers(time.column),
        time_unit=time.unit,
        time_name=time.column,
        frame=pd.DataFrame(columns, index=frame.index),
        row_name=row_name,
    )
