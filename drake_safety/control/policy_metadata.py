"""What the metadata of ONNX files say of their policies."""

from __future__ import annotations

import ast
import json
import math
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any


@dataclass(kw_only=True)
class PolicyMetadata:
    """What an ONNX file says of its policy; empty where it says nothing.

    Attributes:
        joints: Joint names in the network's order.
        stiffness, damping: Servo gains by regular expression [N·m/rad, N·m·s/rad].
        default_positions: Joint positions at zero action, by regular expression [rad].
        action_scale: Joint positions per unit of action, by regular expression [rad].
        observation: Terms in the network's order, as in ``policy.yaml``. A term without a scale or
            a history is one of which the file does not state it.
        command: Lowest and highest v_x, v_y and ω_z by name.
        unread: Entries that do not fit the joints, and why.
    """

    joints: list[str] = field(default_factory=list)
    stiffness: dict[str, float] = field(default_factory=dict)
    damping: dict[str, float] = field(default_factory=dict)
    default_positions: dict[str, float] = field(default_factory=dict)
    action_scale: dict[str, float] = field(default_factory=dict)
    observation: list[dict[str, Any]] = field(default_factory=list)
    command: dict[str, list[float]] = field(default_factory=dict)
    unread: list[str] = field(default_factory=list)


# Keys of Holosoma, then of Isaac Lab and mjlab.
_KEYS: dict[str, tuple[str, ...]] = {
    "stiffness": ("kp", "joint_stiffness"),
    "damping": ("kd", "joint_damping"),
    "default_positions": ("default_joint_pos",),
    "action_scale": ("action_scale",),
}
_JOINTS = ("dof_names", "joint_names")
_TERM_KEYS = {
    "scale": ("observation_terms_scale",),
    "clip": ("observation_terms_clip",),
    "history": ("observation_history_lengths", "observation_terms_history_length"),
}
TERM_NAMES = {
    "command": "velocity_commands",
    "keyboard_velocity_commands": "velocity_commands",
    "joint_pos": "joint_pos_rel",
    "joint_vel": "joint_vel_rel",
    "actions": "last_action",
}
"""Registered terms by the names of Isaac Lab's and mjlab's tasks, where these differ."""


def read_metadata(raw: Mapping[str, str]) -> PolicyMetadata:
    """Reads the entries of an ONNX file's metadata that describe its policy.

    Values are JSON, Python's, or words and numbers between commas. Numbers are one for all joints,
    one for each, or by regular expression.
    """
    found = PolicyMetadata(joints=_words(_first(raw, _JOINTS)))
    for name, keys in _KEYS.items():
        value = _parsed(_first(raw, keys))
        try:
            setattr(found, name, _by_joint(value, found.joints))
        except (TypeError, ValueError, re.error):
            found.unread.append(
                f"its metadata '{name}' must be a number for each of the joints {found.joints}, "
                f"one for all or by regular expression; got {value}"
            )
    command = _parsed(raw.get("command_ranges", ""))
    found.command = command if isinstance(command, dict) else {}
    names = _words(raw.get("observation_names", ""))
    found.observation = [{"name": TERM_NAMES.get(name, name)} for name in names]
    for key, keys in _TERM_KEYS.items():
        value = _parsed(_first(raw, keys))
        if value and names:
            try:
                _add_to_terms(found.observation, names, key, value)
            except (KeyError, TypeError, ValueError):
                for term in found.observation:
                    term.pop(key, None)
                found.unread.append(
                    f"its metadata '{key}' must be a value for each of the terms {names}; "
                    f"got {value}"
                )
    return found


def _by_joint(value: Any, joints: list[str]) -> dict[str, float]:
    if isinstance(value, int | float):
        value = {".*": value}
    elif not isinstance(value, dict):
        value = dict(zip(map(re.escape, joints), value, strict=True)) if value else {}
    numbers = {re.compile(pattern).pattern: float(number) for pattern, number in value.items()}
    if not all(map(math.isfinite, numbers.values())):
        raise ValueError(value)
    return numbers


def _add_to_terms(terms: list[dict[str, Any]], names: list[str], key: str, value: Any) -> None:
    """Adds a key of ``policy.yaml``; several numbers of a term are between semicolons."""
    if isinstance(value, dict):
        value = [value[name] for name in names]
    values = value if isinstance(value, list) else [value]
    for term, one in zip(terms, values, strict=True):
        numbers = [float(x) for x in (one if isinstance(one, list) else str(one).split(";"))]
        if key == "scale":
            term[key] = numbers
        elif key == "history":
            term[key] = max(1, int(numbers[0]))
        else:  # It is before the scale there.
            limits = {abs(x * factor) for x in numbers for factor in term.get("scale", [1.0])}
            if numbers[0] != -numbers[-1] or len(limits) != 1:
                raise ValueError("only one symmetric limit of a term is supported")
            term[key] = limits.pop()


def _first(raw: Mapping[str, str], keys: tuple[str, ...]) -> str:
    return next((raw[key] for key in keys if key in raw), "")


def _words(text: str) -> list[str]:
    """Names in a list, or between commas; they may be numbers."""
    value = _parsed(text)
    is_list = isinstance(value, list) and text.lstrip().startswith("[")
    return [str(x) for x in value] if is_list else [x.strip() for x in text.split(",") if x.strip()]


def _parsed(text: str) -> Any:
    for read in (json.loads, ast.literal_eval):
        with suppress(ValueError, SyntaxError, MemoryError, RecursionError):
            value = read(text)
            return list(value) if isinstance(value, tuple) else value
    return [word.strip() for word in text.split(",")] if text.strip() else None
