"""Entries of files in which other projects describe their policies."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from drake_safety.control.policy_terms import registered_terms

_THREE = ("base_lin_vel", "base_ang_vel", "projected_gravity", "velocity_commands")
_PER_JOINT = ("joint_pos_rel", "joint_vel_rel", "last_action")


class Entries:
    """A mapping of a file, with errors that name the file and the entry.

    All methods but ``in`` raise a `ValueError` for an entry that is missing or of another form.

    Args:
        raw: The parsed mapping.
        who: The file, and the entry in it.
    """

    def __init__(self, raw: Any, who: str):
        if not isinstance(raw, dict):
            raise ValueError(f"{who} must be a mapping; got {raw}")
        self.raw, self.who = raw, who

    def __contains__(self, key: str) -> bool:
        return self.raw.get(key) is not None

    def only(self, known: Iterable[str]) -> None:
        """Refuses other keys."""
        unknown = [key for key in self.raw if key not in known]
        if unknown:
            raise ValueError(
                f"{self.who} has unknown keys {unknown}; known are {sorted(known)}. Delete them "
                "if the policy does not depend on them"
            )

    def get(self, key: str) -> Any:
        """A value that must be there."""
        if key not in self:
            raise ValueError(f"{self.who} has no '{key}'; it has {list(self.raw)}")
        return self.raw[key]

    def inner(self, key: str) -> Entries:
        """An inner mapping."""
        return Entries(self.get(key), f"{self.who}, {key},")

    def numbers(self, key: str, count: int) -> list[float]:
        """Numbers, one for all or ``count`` of them."""
        values = self.get(key)
        values = [values] * count if _is_number(values) else values
        if not isinstance(values, list) or not all(map(_is_number, values)):
            raise ValueError(f"{self.who}: '{key}' must be finite numbers; got {values}")
        if len(values) != count:
            raise ValueError(f"{self.who}: '{key}' must have {count} entries; got {len(values)}")
        return [float(value) for value in values]

    def number(self, key: str) -> float:
        """One number."""
        return self.numbers(key, 1)[0]

    def indices(self, key: str, below: float = math.inf) -> list[int]:
        """Different integers from 0 on."""
        values = self.get(key)
        if not (
            isinstance(values, list)
            and all(type(i) is int and 0 <= i < below for i in values)
            and len(set(values)) == len(values)
        ):
            raise ValueError(
                f"{self.who}: '{key}' must be different integers from 0 to {below - 1}; got "
                f"{values}"
            )
        return values

    def texts(self, key: str) -> list[str]:
        """A list of names."""
        values = self.get(key)
        if not isinstance(values, list) or not all(isinstance(x, str) for x in values):
            raise ValueError(f"{self.who}: '{key}' must be a list of names; got {values}")
        return values


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def shortest(scale: list[float]) -> list[float]:
    """One factor if all are the same."""
    return scale[:1] if len(set(scale)) == 1 else scale


def check_term(name: str, who: str) -> None:
    """Checks that an observation term is registered.

    Raises:
        ValueError: It is not.
    """
    known = registered_terms()
    if name not in known:
        raise ValueError(f"{who} unknown observation '{name}'; registered terms are {known}")


def term_width(term: str, count: int) -> int:
    """Entries of a term of a policy with ``count`` joints; 0 for terms of users."""
    sizes = {**dict.fromkeys(_THREE, 3), **dict.fromkeys(_PER_JOINT, count), "gait_phase": 2}
    return sizes.get(term, 0)


def file_beside(path: Path, names: Iterable[str]) -> str:
    """The first of some files that exists, relative to the folder of ``path``.

    Raises:
        ValueError: None exists.
    """
    for name in names:
        if (path.parent / name).is_file():
            return str((path.parent / name).resolve())
    raise ValueError(f"{path}: no network beside it, expected one of {list(names)}; state network")
