"""Tables of results: a row a method or set, a column a metric."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import rich.table

from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.results import Results

_OURS = "sharpened"  # The method that baselines are compared with.
_SCALES = {"%": 100.0, "points": 100.0, "=%": 100.0, "ms": 1000.0}


@dataclass(frozen=True)
class Column:
    """A column of a table: a metric and how it is written."""

    key: str
    title: str
    unit: str = ""  # "%", "points", "ms", "s", "/h", "of" n, or "=", "=%" without interval.
    better: int = 0  # 1 if larger is better, -1 if smaller is.
    digits: int = 3

    def value_text(self, estimate: Estimate | None) -> str:
        """The value of an estimate; a dash if it has none."""
        if estimate is None or (math.isnan(estimate.value) and self.unit != "of"):
            return "–"
        if self.unit == "of":
            count = round(estimate.value * estimate.n) if estimate.n else 0
            return f"{count} of {estimate.n}"
        if math.isinf(estimate.value):
            return "never"
        unit = self.unit.removeprefix("=")
        space = "" if unit in ("", "/h", "points") else f" {unit}"
        return f"{_SCALES.get(self.unit, 1.0) * estimate.value:.{self.digits}f}{space}"

    def interval_text(self, estimate: Estimate | None) -> str:
        """The interval of an estimate in brackets, if any."""
        if estimate is None or self.unit not in ("", "%", "points", "/h"):
            return ""
        if not all(map(math.isfinite, (estimate.value, estimate.low, estimate.high))):
            return ""
        scale = _SCALES.get(self.unit, 1.0)
        low, high = (f"{scale * end:.{self.digits}f}" for end in (estimate.low, estimate.high))
        return f"({low} to {high})" if estimate.low < 0.0 else f"({low}–{high})"

    def text(self, estimate: Estimate | None) -> str:
        """The value and interval of an estimate."""
        return f"{self.value_text(estimate)} {self.interval_text(estimate)}".strip()


@dataclass(frozen=True)
class Row:
    """A row of a table: an estimate for each column, None if missing."""

    method: str
    label: str
    estimates: Sequence[Estimate | None]


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of estimates."""

    corner: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    title: str = ""
    meaning: str = ""

    def best(self, column: int) -> set[int]:
        """Indices of the best rows of a column; empty if there is nothing to compare."""
        sign = self.columns[column].better
        values = {
            i: sign * estimate.value
            for i, row in enumerate(self.rows)
            if (estimate := row.estimates[column]) is not None and math.isfinite(estimate.value)
        }
        if not sign or len(set(values.values())) < 2:
            return set()
        return {i for i, value in values.items() if value == max(values.values())}

    def better_baselines(self) -> list[str]:
        """Describes each column in which another row is better than "sharpened"."""
        methods, described = [row.method for row in self.rows], []
        for k, column in enumerate(self.columns if _OURS in methods else ()):
            best, ours = self.best(k), methods.index(_OURS)
            first = min(best, default=ours)
            mine, other = (self.rows[i].estimates[k] for i in (ours, first))
            if not best or ours in best or mine is None or other is None:
                continue
            is_clear = other.low > mine.high if column.better > 0 else other.high < mine.low
            certainty = "beyond both intervals" if is_clear else "the intervals overlap"
            values = f"{column.value_text(other)} against {column.value_text(mine)} ({certainty})"
            described.append(f"{column.title}: {self.rows[first].label}, {values}")
        return described

    def to_rich(self) -> rich.table.Table:
        """The table for a terminal, with its explanation; cells fold if they do not fit."""
        table = rich.table.Table(title=self.title or None, caption=self.meaning or None)
        for title in (self.corner, *(column.title for column in self.columns)):
            table.add_column(title, overflow="fold")
        for row in self.rows:
            table.add_row(row.label, *map(Column.text, self.columns, row.estimates))
        return table


def rows_of(
    results: Results, labels: Mapping[tuple[str, str], str], columns: Sequence[Column]
) -> list[Row]:
    """Rows of the results by set and method, and their labels; empty rows are left out."""
    rows = [
        Row(method, label, [results.get((set, method, column.key)) for column in columns])
        for (set, method), label in labels.items()
    ]
    return [row for row in rows if any(row.estimates)]
