"""Channel: the numbers of one table or topic as a log holds them, and where each one stands."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drake_safety.logs.log_map import TIME_UNITS

_MANY = 40  # Names that a message lists before it says how many more there are.


@dataclass(kw_only=True, eq=False)
class Channel:
    """Columns of one table or topic, unconverted.

    Attributes:
        path: The log.
        topic: Of the messages; empty for a table.
        time: As it stands in the log, integers or floats, (N,).
        time_unit: Unit of ``time``.
        time_name: What the time is called there.
        columns: The wanted columns by name, (N,) floats each.
        row_name: What a row is called: "line", "row" or "message".
        first_row: Number of the first one.
    """

    path: Path
    topic: str
    time: np.ndarray
    time_unit: str
    time_name: str
    columns: dict[str, np.ndarray]
    row_name: str
    first_row: int

    def where(self, row: int, column: str = "") -> str:
        """A row, and a column if given, in words."""
        text = f"log '{self.path}', {self.row_name} {self.first_row + row}"
        if self.topic:
            text += f" of topic '{self.topic}'"
        return f"{text}, column '{column}'" if column else text

    def seconds_since(self, origin: float | int) -> np.ndarray:
        """Time since an instant of the log's own clock, exact for integer clocks, (N,) [s]."""
        return (self.time - origin) / TIME_UNITS[self.time_unit]

    def table(self, names: Iterable[str]) -> np.ndarray:
        """Columns side by side, (N, n)."""
        return np.stack([self.columns[name] for name in names], axis=1)


def listed(names: Iterable[str]) -> str:
    """Names for a message; of very many the first ones."""
    names = list(names)
    if len(names) <= _MANY:
        return str(names)
    return f"{names[:_MANY]} and {len(names) - _MANY} more"


def missing_extra(path: Path, error: ImportError) -> ValueError:
    """What to say when a package that reads a log is not installed."""
    return ValueError(
        f"log '{path}' needs the package '{error.name}': pip install 'drake_safety[logs]'"
    )
