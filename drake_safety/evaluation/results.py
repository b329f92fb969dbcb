"""Results of evaluations and studies: one tidy table, a row a figure."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from drake_safety.evaluation.metrics import Estimate
from drake_safety.files.atomic import write_file
from drake_safety.files.reading import reading
from drake_safety.files.schema import load_typed

SCHEMA = "drake_safety.results"

Key = tuple[str, str, str]
"""Set, such as "episodes"; method, such as "sharpened", or "" for a figure of the set itself; and
metric, such as "auc"."""
_Number = float | None


@dataclass
class _File:
    schema: Literal["drake_safety.results"]
    schema_version: Literal[2]
    entries: dict[str, Any]
    rows: list[tuple[str, str, str, _Number, _Number, _Number, int]]


class Results(dict[Key, Estimate]):
    """Estimates by set, method and metric, in their order, and what made them, as JSON types."""

    def __init__(self, estimates: Mapping[Key, Estimate], entries: Mapping[str, Any] | None = None):
        super().__init__(estimates)
        self.entries: dict[str, Any] = dict(entries or {})

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Results:
        """Reads a file that `write` wrote."""
        with reading(Path(path)):
            raw = json.loads(Path(path).read_text(encoding="utf-8"))
            file = load_typed(_File, raw, f"{path} holds no results that can be read")
        estimates = {}
        for set, method, metric, *ends, n in file.rows:
            value, low, high = (math.nan if end is None else end for end in ends)
            estimates[set, method, metric] = Estimate(value, low, high, n)
        return cls(estimates, file.entries)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Writes a JSON file of rows (set, method, metric, value, low, high, n), in six digits."""
        rows = [
            [*key, *map(_rounded, (one.value, one.low, one.high)), int(one.n)]
            for key, one in self.items()
        ]
        lines = ",\n".join(f"    {json.dumps(row, ensure_ascii=False)}" for row in rows)
        entries = json.dumps(self.entries, indent=2, ensure_ascii=False).replace("\n", "\n  ")
        head = f'  "schema": "{SCHEMA}",\n  "schema_version": 2,\n'
        text = f'{{\n{head}  "entries": {entries},\n  "rows": [\n{lines}\n  ]\n}}\n'
        write_file(Path(path), text)


def _rounded(number: float) -> float | None:
    return float(f"{number:.6g}") if math.isfinite(number) else None
