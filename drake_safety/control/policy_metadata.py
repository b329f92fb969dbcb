"""What the metadata of ONNX files say of their policies."""

from __future__ import annotations

import ast
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
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
_OF_JOINTS = {
    "stiffness": ("kp", "joint_stiffness"),
    "damping": ("kd", "joint_damping"),
    "default_positions": ("default_joint_pos",),
    "action_scale": ("action_scale",),
}
_OF_TERMS = {
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
    joints = _words(raw.get("dof_names", raw.get("joint_names", "")))
    names = _words(raw.get("observation_names", ""))
    terms: list[dict[str, Any]] = [{"name": TERM_NAMES.get(name, name)} for name in names]
    found = PolicyMetadata(joints=joints, observation=terms)

    def read(name: str, keys: Iterable[str], convert: Callable[[Any], Any], expected: str) -> Any:
        text = next((raw[key] for key in keys if raw.get(key)), "")
        value = _parsed(text)
        try:
            return convert(value) if text else {}
        except (KeyError, TypeError, ValueError, re.error):
            found.unread.append(f"its metadata '{name}' must be {expected}; got {value}")
            return {}

    expected = f"a number for each of the joints {joints}, one for all or by regular expression"
    for name, keys in _OF_JOINTS.items():
        setattr(found, name, read(name, keys, partial(_by_joint, joints), expected))
    command = _parsed(raw.get("command_ranges", ""))
    found.command = command if isinstance(command, dict) else {}
    for name, keys in _OF_TERMS.items() if names else ():
        of_terms = partial(_by_term, names, terms, name)
        values = read(name, keys, of_terms, f"a value for each of the terms {names}")
        for term, value in zip(terms, values, strict=False):
            term[name] = value
    return found


def _by_joint(joints: list[str], value: Any) -> dict[str, float]:
    if isinstance(value, list):
        value = dict(zip(map(re.escape, joints), value, strict=True))
    elif not isinstance(value, dict):
        value = {".*": value}
    numbers = {re.compile(pattern).pattern: float(number) for pattern, number in value.items()}
    if not all(map(math.isfinite, numbers.values())):
        raise ValueError(value)
    return numbers


def _by_term(names: list[str], terms: list[dict[str, Any]], key: str, value: Any) -> list[Any]:
    """Values of a key of ``policy.yaml``; several numbers of a term are between semicolons."""
    if isinstance(value, dict):
        value = [value[name] for name in names]
    values = []
    for term, one in zip(terms, value if isinstance(value, list) else [value], strict=True):
        numbers = [float(x) for x in str(one).split(";")]
        if key == "history":
            values.append(max(1, int(numbers[0])))
        elif key == "clip":  # It is before the scale there.
            limits = {abs(x * factor) for x in numbers for factor in term.get("scale", [1.0])}
            if numbers[0] != -numbers[-1] or len(limits) != 1:
                raise ValueError("only one symmetric limit of a term is supported")
            values.append(limits.pop())
        else:
            values.append(numbers)
    return values


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
