"""Evaluations stored for the tables of README and for shipped folders."""

from __future__ import annotations

import shlex
from pathlib import Path

from drake_safety.evaluation.results import Results

EVALUATION_FILE = "evaluation.json"
"""Of a shipped folder."""
_FOLDER_OPTIONS = ("--assessment", "--out")


def store_results(results: Results, path: Path, *, train_command: str | None = None) -> None:
    """Writes a copy of an evaluation; absolute paths in its commands become ``runs/NAME``.

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
    path.parent.mkdir(parents=True, exist_ok=True)
    Results(results, entries).write(path)


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
