"""Channel: the raw columns of a table or topic in a log, with their locations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drake_safety.logs.log_map import TIME_UNITS, TimeUnit

Wanted = Mapping[str, Sequence[str]]
"""Names of the columns or fields to read, by topic; "" is a table's."""
_MANY = 40  # Largest number of names in a message.


@dataclass(kw_only=True, eq=False)
class Channel:
    """Columns of one table or topic, unconverted.

    Attributes:
        topic: Topic of the messages; empty for a table.
        time: Time in the log's unit, integers or floats, (N,).
        time_unit: Unit of ``time``.
        columns: The requested columns by name, (N,) floats each.
        row_name: Name of a row: "line", "row" or "message".
        rows: Numbers of the rows in the file, (N,).
    """

    path: Path
    topic: str
    time: np.ndarray
    time_unit: TimeUnit
    time_name: str
    columns: dict[str, np.ndarray]
    row_name: str
    rows: np.ndarray

    def where(self, row: int, column: str = "") -> str:
        """Describes the location of a row, and of a column if given."""
        text = f"log '{self.path}', {self.row_name} {self.rows[row]}"
        if self.topic:
            text += f" of topic '{self.topic}'"
        return f"{text}, column '{column}'" if column else text

    def seconds_since(self, origin: float | int) -> np.ndarray:
        """Returns the time since an instant of the log's clock, exact for integers, (N,) [s]."""
        return (self.time - origin) / TIME_UNITS[self.time_unit]

    def steps_s(self) -> np.ndarray:
        """Returns the time between consecutive rows, (N - 1,) [s]."""
        return np.diff(self.time) / TIME_UNITS[self.time_unit]

    def select(self, rows: np.ndarray | slice) -> Channel:
        """Returns some of the rows."""
        columns = {name: values[rows] for name, values in self.columns.items()}
        return replace(self, time=self.time[rows], columns=columns, rows=self.rows[rows])

    def table(self, names: Iterable[str]) -> np.ndarray:
        """Returns columns as an array, (N, n)."""
        return np.stack([self.columns[name] for name in names], axis=1)


def listed(names: Iterable[str], many: int = _MANY) -> str:
    """Formats names for a message, at most the first 40 or as many as given."""
    names = list(names)
    if len(names) <= many:
        return str(names)
    return f"{names[:many]} and {len(names) - many} more"
