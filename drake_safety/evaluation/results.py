"""Results of evaluations and studies: one tidy table, a row a figure."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drake_safety.evaluation.metrics import Estimate
from drake_safety.files.atomic import write_file

SCHEMA = "drake_safety.results"
SCHEMA_VERSION = 1
_NUM_DIGITS = 6  # Significant digits in a file, more than any table shows.
_DOT = re.compile(r"(?<!\d)\.|\.(?!\d)")  # A dot between digits belongs to a number.
_DAMAGES = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError)
_KEY = re.compile(r"[\w% -]+(\.[\w% -]+)*")
_OTHER = re.compile(rf"[^\w .-]|{_DOT.pattern}")  # Characters that a part of a key does not have.


def key_part(name: str) -> str:
    """Any name as one part of a key, as in an address: ``friction+10%`` → ``friction%2B10%25``."""
    return _OTHER.sub(lambda one: "".join(f"%{byte:02X}" for byte in one[0].encode()), name)


@dataclass(frozen=True, kw_only=True)
class Result(Estimate):
    """A row of the table: a figure with its interval.

    Attributes:
        set: What was judged, such as "episodes" or "plans.fair".
        method: What judged it, such as "sharpened"; "" for a figure of the set itself.
        metric: What was measured, such as "auc".
    """

    set: str
    method: str
    metric: str

    @classmethod
    def of(cls, key: str, estimate: Estimate) -> Result:
        """The row with a key "set.method.metric", "set.metric" or "metric"; a set may have dots."""
        if not _KEY.fullmatch(key):
            raise ValueError(
                f"a result has the key '{key[:80]}', expected letters, digits, spaces, '_', '%' "
                "and '-' between dots"
            )
        *rest, metric = _DOT.split(key)
        method = rest.pop() if len(rest) > 1 else ""
        ends = estimate.value, estimate.low, estimate.high, estimate.n
        return cls(*ends, set=".".join(rest), method=method, metric=metric)


class Results(dict[str, Result]):
    """Rows by key "set.method.metric", in their order, and what made them, as JSON types."""

    def __init__(self, estimates: Mapping[str, Estimate], entries: Mapping[str, Any] | None = None):
        super().__init__({key: Result.of(key, one) for key, one in estimates.items()})
        self.entries: dict[str, Any] = dict(entries or {})

    def select(
        self, *, set: str | None = None, method: str | None = None, metric: str | None = None
    ) -> list[Result]:
        """The rows of a set, a method and a metric; None takes all."""
        wanted = {"set": set, "method": method, "metric": metric}
        given = {name: value for name, value in wanted.items() if value is not None}
        return [row for row in self.values() if given.items() <= vars(row).items()]

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Results:
        """Reads a file that `write` wrote."""
        try:
            content = json.loads(Path(path).read_text(encoding="utf-8"))
            found = (content["schema"], content["schema_version"])
            if found != (SCHEMA, SCHEMA_VERSION):
                raise ValueError(f"schema and version are {found}")
            figures = {key: Estimate.of_row(row) for key, row in content["figures"].items()}
            return cls(figures, content["entries"])
        except _DAMAGES as error:
            raise ValueError(
                f"{path} holds no results, expected '{SCHEMA}', version {SCHEMA_VERSION}: "
                f"{type(error).__name__}: {str(error)[:200]}"
            ) from error

    def write(self, path: str | os.PathLike[str]) -> None:
        """Writes a JSON file, a row a line: key, then value, ends of the interval and n.

        Numbers have six significant digits; what is not finite becomes null.
        """
        figures = ",\n".join(
            f"    {json.dumps(key)}: "
            f"{json.dumps([*map(_rounded, (row.value, row.low, row.high)), int(row.n)])}"
            for key, row in self.items()
        )
        entries = json.dumps(self.entries, indent=2, ensure_ascii=False).replace("\n", "\n  ")
        head = f'  "schema": "{SCHEMA}",\n  "schema_version": {SCHEMA_VERSION},\n'
        text = f'{{\n{head}  "entries": {entries},\n  "figures": {{\n{figures}\n  }}\n}}\n'
        write_file(Path(path), text)


def _rounded(number: float) -> float | None:
    return float(f"{number:.{_NUM_DIGITS}g}") if math.isfinite(number) else None
