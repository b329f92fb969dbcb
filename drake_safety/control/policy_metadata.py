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
        default_positions, action_scale: As in ``policy.yaml``, by regular expression [rad].
        observation: As in ``policy.yaml``, but terms have only the keys that the file states.
        command: Lowest and highest v_x, v_y and ω_z by name [m/s, rad/s].
        unread: Entries that do not fit, and why.
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
_KEYS = {
    "stiffness": ("kp", "joint_stiffness"),
    "damping": ("kd", "joint_damping"),
    "default_positions": ("default_joint_pos",),
    "action_scale": ("action_scale",),
    "scale": ("observation_terms_scale",),
    "clip": ("observation_terms_clip",),
    "history": ("observation_history_lengths", "observation_terms_history_length"),
    "command": ("command_ranges",),
}
_VELOCITIES = ("lin_vel_x", "lin_vel_y", "ang_vel_z", "ang_vel_yaw")
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
    joints = _words(raw.get("dof_names", raw.get("joint_names", "")))
    names = _words(raw.get("observation_names", ""))
    terms: list[dict[str, Any]] = [{"name": TERM_NAMES.get(name, name)} for name in names]
    found = PolicyMetadata(joints=joints, observation=terms)
    for name, keys in _KEYS.items():
        text = next((raw[key] for key in keys if raw.get(key)), "")
        value = _parsed(text)
        expected = f"a value for each of the terms {names}"
        try:
            if text and name == "command":
                expected = "the lowest and highest velocity by name"
                found.command = _ranges(value)
            elif text and hasattr(found, name):
                expected = f"a number for each of the joints {joints}, one for all or by regular "
                expected += "expression"
                setattr(found, name, _by_joint(value, joints))
            elif text and names:
                values = _by_term(value, names, terms, name)
                for term, one in list(zip(terms, values, strict=True)):
                    term[name] = one
        except (KeyError, TypeError, ValueError, re.error):
            found.unread.append(f"its metadata '{name}' must be {expected}; got {value}")
    return found


def _ranges(value: Any) -> dict[str, list[float]]:
    stated = {name: pair for name, pair in dict(value).items() if name in _VELOCITIES}
    ranges = {name: [float(low), float(high)] for name, (low, high) in stated.items()}
    if not all(-math.inf < low <= high < math.inf for low, high in ranges.values()):
        raise ValueError(value)
    return ranges


def _by_joint(value: Any, joints: list[str]) -> dict[str, float]:
    if isinstance(value, list):
        value = dict(zip(map(re.escape, joints), value, strict=True))
    elif not isinstance(value, dict):
        value = {".*": value}
    numbers = {re.compile(pattern).pattern: float(number) for pattern, number in value.items()}
    if not all(map(math.isfinite, numbers.values())):
        raise ValueError(value)
    return numbers


def _by_term(value: Any, names: list[str], terms: list[dict[str, Any]], key: str) -> list[Any]:
    """Values of a key of ``policy.yaml``; several numbers of a term are between semicolons."""
    value = [value[name] for name in names] if isinstance(value, dict) else value
    texts = value if isinstance(value, list) else [value]
    numbers = [[float(x) for x in str(text).split(";")] for text in texts]
    if key == "history":
        return [max(1, int(length)) for (length,) in numbers]
    if key == "clip":
        clips = zip(terms, numbers, strict=True)
        return [limit(low, high, term.get("scale", [1.0])) for term, (low, high) in clips]
    return numbers


def limit(low: float, high: float, factors: list[float], who: str = "") -> float:
    """Returns the largest absolute value after scaling by factors, of limits before it."""
    limits = {abs(high * factor) for factor in factors}
    if low != -high or len(limits) != 1:
        raise ValueError(
            f"{who} clip must be symmetric, with one scale; got {[low, high]} and {factors}"
        )
    return limits.pop()


def _words(text: str) -> list[str]:
    """Names between commas, or in a list."""
    words = (word.strip(" \n\"'") for word in text.strip("[] \n").split(","))
    return [word for word in words if word]


def _parsed(text: str) -> Any:
    for read in (json.loads, ast.literal_eval):
        with suppress(TypeError, ValueError, SyntaxError, MemoryError, RecursionError):
            value = read(text)
            return list(value) if isinstance(value, tuple) else value
    return text.split(",")
