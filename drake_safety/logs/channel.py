"""Channel: the raw columns of a table or topic in a log, with their locations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.logs.log_map import TIME_UNITS, TimeUnit

if TYPE_CHECKING:
    import pandas as pd

Wanted = Mapping[str, Sequence[str]]
"""Names of the columns or fields to read, by topic; "" is a table's."""


@dataclass(kw_only=True, eq=False)
class Channel:
    """Columns of one table or topic, unconverted."""

    path: Path
    topic: str = ""
    time: np.ndarray  # In the log's unit, (N,); dates and durations become ns.
    time_unit: TimeUnit
    time_name: str
    frame: pd.DataFrame  # N rows of floats; the index is their number in the file.
    row_name: str  # "line", "row" or "message".
    origin: float | int = 0  # Instant from which ``time_s`` counts, in the log's unit.

    def __post_init__(self) -> None:
        if self.time.dtype.kind in "mM":
            self.time, self.time_unit = self.time.astype(np.int64), "ns"

    def where(self, row: int, column: str = "") -> str:
        """Describes the location of a row, and of a column if given."""
        text = f"log '{self.path}', {self.row_name} {self.frame.index[row]}"
        if self.topic:
            text += f" of topic '{self.topic}'"
        return f"{text}, column '{column}'" if column else text

    @cached_property
    def time_s(self) -> np.ndarray:
        """Time since the origin, exact for integers, (N,) [s]."""
        return (self.time - self.origin) / TIME_UNITS[self.time_unit]

    def select(self, rows: np.ndarray | slice) -> Channel:
        """Returns some of the rows."""
        return replace(self, time=self.time[rows], frame=self.frame.iloc[rows])


def listed(names: Iterable[str], many: int = 40) -> str:
    """Formats names for a message, at most as many as given."""
    names = list(names)
    return f"{names[:many]}" + f" and {len(names) - many} more" * (len(names) > many)
