"""Tables of estimates: what page, README, CSV and JSON all show, each in its own way."""

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
"""Key of the row that the others are compared with."""
_MODES = re.compile(r"^(sharpened|paper)\b")


@dataclass(frozen=True, kw_only=True)
class Column:
    """What one column of a table shows.

    Attributes:
        key: The last part of an estimate's key.
        title: Its heading.
        meaning: A sentence for somebody who has not read the paper.
        unit: "", "%", "ms", "s", "of" for counts out of n, "n" for a number of trials, "/h" for a
            rate, or "=" and "=%" for what has no interval.
        better: 1 where more is better, -1 where less is, 0 where neither.
        digits: After the decimal point.
    """

    key: str
    title: str
    meaning: str
    unit: str = ""
    better: int = 0
    digits: int = 3

    @property
    def is_share(self) -> bool:
        """Whether it is a number between 0 and 1, which can be drawn as a bar."""
        return self.unit in ("", "%")

    def value_text(self, estimate: Estimate | None) -> str:
        """The estimate itself; a dash where there was nothing to see."""
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
        """Its interval in brackets, or nothing."""
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
        """The estimate and its interval."""
        return f"{self.value_text(estimate)} {self.interval_text(estimate)}".strip()

    @property
    def _scale(self) -> float:
        return {"%": 100.0, "=%": 100.0, "ms": 1000.0}.get(self.unit, 1.0)


@dataclass(frozen=True, kw_only=True)
class Row:
    """Who or what is judged.

    Attributes:
        key: Its part of the estimates' keys.
        label: How it is called.
        estimates: One a column; None where there is none.
        is_quoted: Whether somebody else printed them: they take no part in comparisons.
    """

    key: str
    label: str
    estimates: Sequence[Estimate | None]
    is_quoted: bool = False


@dataclass(frozen=True, kw_only=True)
class Table:
    """Figures of a few judges, side by side.

    Attributes:
        key: Its name among files.
        title: Its heading.
        meaning: What it is about, for somebody who has not read the paper.
        corner: What the rows are.
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
        """Rows whose estimate is the best of a column; none where there is nothing to compare."""
        sign = self.columns[column].better
        values = {
            i: sign * row.estimates[column].value  # type: ignore[union-attr]
            for i, row in enumerate(self.rows)
            if not row.is_quoted and _is_known(row.estimates[column])
        }
        if not sign or len(values) < 2 or len(set(values.values())) == 1:
            return set()
        return {i for i, value in values.items() if value == max(values.values())}

    def rivals_ahead(self) -> list[str]:
        """In words, each estimate in which another row is ahead of ours."""
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
