"""Compactly stored evaluations, for the tables of README and for shipped folders."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drake_safety.evaluation.report.results import Results, as_estimate, read_object

EVALUATION_FILE = "evaluation.json"
"""Of a shipped folder."""
SCHEMA = "drake_safety.results"
SCHEMA_VERSION = 1
_NUM_DIGITS = 6  # Significant digits, more than any table shows.
_FOLDER_OPTIONS = ("--assessment", "--out")


def read_results(path: Path) -> Results:
    """Reads a file of `store_results`.

    Raises:
        ValueError: The file holds no results.
    """
    content = read_object(path)
    if content.get("schema") != SCHEMA or content.get("schema_version") != SCHEMA_VERSION:
        raise ValueError(
            f"{path} holds no results: its schema is {content.get('schema')!r}, version "
            f"{content.get('schema_version')!r}; expected '{SCHEMA}', {SCHEMA_VERSION}"
        )
    try:
        return Results(
            estimates={
                key: as_estimate(dict(zip(("value", "low", "high", "n"), row, strict=True)))
                for key, row in content["figures"].items()
            },
            entries=dict(content["entries"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"{path} holds damaged results: {error!r}") from error


def store_results(results: Results, path: Path, *, train_command: str | None = None) -> None:
    """Writes a compact copy of an evaluation, one estimate a line.

    Numbers have six significant digits. Absolute paths of folders in commands are replaced by
    ``runs/NAME``.

    Args:
        results: Results of an evaluation.
        path: The file; its folder is created.
        train_command: Command of the training.
    """
    entries = dict(results.entries)
    if train_command is not None:
        entries["train_command"] = train_command
    for key, value in entries.items():
        if key in ("command", "train_command"):
            entries[key] = _portable(value)
        elif isinstance(value, dict) and "command" in value:
            entries[key] = value | {"command": _portable(value["command"])}
    rows = ",\n".join(
        f"    {json.dumps(key)}: {json.dumps([*map(_rounded, (f.value, f.low, f.high)), f.n])}"
        for key, f in results.estimates.items()
    )
    text = (
        "{\n"
        f'  "schema": {json.dumps(SCHEMA)},\n'
        f'  "schema_version": {SCHEMA_VERSION},\n'
        f'  "entries": {_indented(entries)},\n'
        f'  "figures": {{\n{rows}\n  }}\n'
        "}\n"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _rounded(number: float) -> float | None:
    return float(f"{number:.{_NUM_DIGITS}g}") if math.isfinite(number) else None


def _indented(entries: Mapping[str, Any]) -> str:
    return json.dumps(entries, indent=2, ensure_ascii=False).replace("\n", "\n  ")


def _portable(command: str) -> str:
    # A resumed training equals a single one.
    words = [word for word in shlex.split(command) if word != "--resume"]
    for i, word in enumerate(words):
        option, equals, value = word.partition("=")
        if equals and option in _FOLDER_OPTIONS and Path(value).is_absolute():
            words[i] = f"{option}=runs/{Path(value).name}"
        elif i and words[i - 1] in _FOLDER_OPTIONS and Path(word).is_absolute():
            words[i] = f"runs/{Path(word).name}"
    return shlex.join(words)
