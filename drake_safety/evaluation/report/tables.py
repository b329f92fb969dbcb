"""Tables of estimates, written as HTML, Markdown, CSV or JSON."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from drake_safety.evaluation.metrics import Estimate

OURS = "sharpened"
"""Key of the row that baselines are compared with."""
_MODES = re.compile(r"^(sharpened|paper)\b")


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of a table.

    Attributes:
        key: Last part of the keys of its estimates.
        title: Its heading.
        meaning: Its definition, in a sentence.
        unit: "", "%", "ms", "s", "of" for counts out of n, "n" for a number of trials, "/h" for a
            rate, or "=" and "=%" for values without interval.
        better: 1 if larger is better, -1 if smaller is, 0 otherwise.
        digits: Digits after the decimal point.
    """

    key: str
    title: str
    meaning: str
    unit: str = ""
    better: int = 0
    digits: int = 3

    @property
    def is_share(self) -> bool:
        """Whether values lie between 0 and 1 and can be drawn as a bar."""
        return self.unit in ("", "%")

    def value_text(self, estimate: Estimate | None) -> str:
        """The value of an estimate; a dash if it has none."""
        if estimate is None or (math.isnan(estimate.value) and self.unit != "of"):
            return "–"
        if self.unit == "of":
            count = round(estimate.value * estimate.n) if estimate.n else 0
            return f"{count} of {estimate.n}"
        if math.isinf(estimate.value):
            return "never"
        if self.unit == "n":
            return f"{estimate.value:.0f}"
        unit = self.unit.removeprefix("=")
        space = "" if unit in ("", "/h") else f" {unit}"
        return f"{self._scale * estimate.value:.{self.digits}f}{space}"

    def interval_text(self, estimate: Estimate | None) -> str:
        """The interval of an estimate in brackets, if any."""
        if (
            estimate is None
            or self.unit not in ("", "%", "/h")
            or not math.isfinite(estimate.value)
        ):
            return ""
        if not (math.isfinite(estimate.low) and math.isfinite(estimate.high)):
            return ""
        low, high = (
            f"{self._scale * end:.{self.digits}f}" for end in (estimate.low, estimate.high)
        )
        return f"({low}–{high})"

    def text(self, estimate: Estimate | None) -> str:
        """The value and interval of an estimate."""
        return f"{self.value_text(estimate)} {self.interval_text(estimate)}".strip()

    @property
    def _scale(self) -> float:
        return {"%": 100.0, "=%": 100.0, "ms": 1000.0}.get(self.unit, 1.0)


@dataclass(frozen=True, kw_only=True)
class Row:
    """A row of a table, such as a method.

    Attributes:
        key: Its part of the keys of its estimates.
        label: Its label.
        estimates: One a column; None if missing.
        is_quoted: Whether they are quoted from a publication and excluded from comparisons.
    """

    key: str
    label: str
    estimates: Sequence[Estimate | None]
    is_quoted: bool = False


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of estimates.

    Attributes:
        key: Name of its files.
        title: Its heading.
        meaning: Its explanation.
        corner: Heading of the row labels.
        columns: The columns.
        rows: The rows.
    """

    key: str
    title: str
    meaning: str
    corner: str
    columns: Sequence[Column]
    rows: Sequence[Row] = field(default_factory=list)

    def best(self, column: int) -> set[int]:
        """Indices of the best rows of a column; empty if there is nothing to compare."""
        sign = self.columns[column].better
        values = {
            i: sign * row.estimates[column].value  # type: ignore[union-attr]
            for i, row in enumerate(self.rows)
            if not row.is_quoted and _is_known(row.estimates[column])
        }
        if not sign or len(values) < 2 or len(set(values.values())) == 1:
            return set()
        return {i for i, value in values.items() if value == max(values.values())}

    def better_baselines(self) -> list[str]:
        """Describes each column in which another row is better than `OURS`."""
        ours = next((i for i, row in enumerate(self.rows) if row.key == OURS), None)
        found: list[str] = []
        if ours is None:
            return found
        for number, column in enumerate(self.columns):
            best = self.best(number)
            mine = self.rows[ours].estimates[number]
            if not best or ours in best or mine is None:
                continue
            first = self.rows[min(best)]
            other = first.estimates[number]
            if other is None:
                continue
            is_clear = (other.low > mine.high) if column.better > 0 else (other.high < mine.low)
            certainty = "beyond both intervals" if is_clear else "the intervals overlap"
            found.append(
                f"{column.title}: {first.label}, {column.value_text(other)} against "
                f"{column.value_text(mine)} ({certainty})"
            )
        return found

    def to_csv(self) -> str:
        """The table as CSV: value, ends of the interval and n of every estimate."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        names = ("", ".low", ".high", ".n")
        writer.writerow([self.corner, *(f"{c.key}{end}" for c in self.columns for end in names)])
        for row in self.rows:
            cells: list[Any] = [row.key]
            for estimate in row.estimates:
                fields = {} if estimate is None else estimate.to_json()
                cells += [fields.get(name) for name in ("value", "low", "high", "n")]
            writer.writerow(["" if cell is None else cell for cell in cells])
        return out.getvalue()

    def to_json(self) -> dict[str, Any]:
        """The table as JSON types."""
        return {
            "title": self.title,
            "meaning": self.meaning,
            "columns": [
                {"key": c.key, "title": c.title, "meaning": c.meaning} for c in self.columns
            ],
            "rows": [
                {
                    "key": row.key,
                    "label": row.label,
                    "figures": {
                        column.key: None if estimate is None else estimate.to_json()
                        for column, estimate in zip(self.columns, row.estimates, strict=True)
                    },
                }
                for row in self.rows
            ],
        }

    def to_markdown(self) -> str:
        """The table as Markdown, estimates with their intervals."""
        lines = [
            "| " + " | ".join([self.corner, *(c.title for c in self.columns)]) + " |",
            "|" + "---|" * (1 + len(self.columns)),
        ]
        for row in self.rows:
            cells = [row.label if row.is_quoted else _MODES.sub(r"`\1`", row.label)]
            for column, estimate in zip(self.columns, row.estimates, strict=True):
                cells.append("" if estimate is None else column.text(estimate))
            if row.is_quoted:
                cells = [f"*{cell}*" if cell else "" for cell in cells]
            lines.append("| " + " | ".join(cells).replace("|  |", "| |") + " |")
        return "\n".join(lines).replace("|  |", "| |")


def _is_known(estimate: Estimate | None) -> bool:
    return estimate is not None and math.isfinite(estimate.value)
