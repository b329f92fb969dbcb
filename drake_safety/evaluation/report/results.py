"""Results of an evaluation, read from ``evaluation.json``."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drake_safety.evaluation.metrics import Estimate

_KEY = re.compile(r"[\w -]+(\.[\w -]+)*")


@dataclass(frozen=True, kw_only=True)
class Results:
    """Results of an evaluation.

    Attributes:
        estimates: By dotted key.
        entries: Other entries, such as the command, the seeds and the versions.
    """

    estimates: dict[str, Estimate] = field(default_factory=dict)
    entries: dict[str, Any] = field(default_factory=dict)

    def has(self, prefix: str) -> bool:
        """Whether the key of any estimate has this prefix."""
        return any(key.startswith(prefix) for key in self.estimates)


def read_evaluation(path: Path) -> Results:
    """Reads an ``evaluation.json``.

    Raises:
        ValueError: The file holds no evaluation.
    """
    content = read_object(path)
    estimates = {}
    for key, value in content.items():
        if not is_estimate(value):
            continue
        # Tables are files named after keys.
        if not _KEY.fullmatch(key):
            raise ValueError(
                f"{path} holds an estimate '{key[:80]}', expected letters, digits, spaces, '_' "
                "and '-' between dots"
            )
        try:
            estimates[key] = as_estimate(value)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{path}: the estimate '{key[:80]}' is damaged: {error}") from error
    if not estimates:
        raise ValueError(f"{path} is no evaluation: it holds no estimate")
    return Results(
        estimates=estimates,
        entries={key: value for key, value in content.items() if key not in estimates},
    )


def read_object(path: Path) -> dict[str, Any]:
    """Reads a file that holds one JSON object.

    Raises:
        ValueError: The file holds something else.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds a {type(content).__name__}; expected a JSON object")
    return content


def is_estimate(value: Any) -> bool:
    """Whether a value has the form that :meth:`Estimate.to_json` returns."""
    return isinstance(value, Mapping) and set(value) == {"value", "low", "high", "n"}


def as_estimate(fields: Mapping[str, Any]) -> Estimate:
    """The inverse of :meth:`Estimate.to_json`."""
    value, low, high = (
        math.nan if fields[name] is None else float(fields[name])
        for name in ("value", "low", "high")
    )
    return Estimate(value, low, high, int(fields["n"]))
