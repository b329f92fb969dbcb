"""The ``deploy.yaml`` of unitree_rl_lab, by Isaac Lab."""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path
from typing import Any

from drake_safety.control.policy_entries import (
    Entries,
    check_term,
    file_beside,
    shortest,
    term_width,
)

_EXPORTED = ("policy.onnx", "../exported/policy.onnx", "policy.pt", "../exported/policy.pt")
_ISAAC_KEYS = (
    "joint_ids_map",
    "joint_names",
    "step_dt",
    "stiffness",
    "damping",
    "default_joint_pos",
    "commands",
    "actions",
    "observations",
)
_TERM_KEYS = ("params", "clip", "scale", "history_length", "scale_first")
_GROUP_SWITCHES = ("use_gym_history", "scale_first")
_ISAAC_NAMES = {"keyboard_velocity_commands": "velocity_commands"}


def is_isaac_lab(raw: Any) -> bool:
    """Whether parsed YAML has the form of a ``deploy.yaml`` of unitree_rl_lab."""
    return isinstance(raw, dict) and {"joint_ids_map", "observations"} <= raw.keys()


def from_isaac_lab(raw: Any, path: Path, stated: Collection[str], motors: list[str]) -> dict:
    """Reads the ``deploy.yaml`` of unitree_rl_lab.

    Its gains are in the order of the robot's motors, everything else in that of the network;
    ``joint_ids_map`` has the motor of each of the network's joints.

    Args:
        raw: The parsed file.
        path: The file, for messages and the network beside it.
        stated: Keys of ``policy.yaml`` whose values are not read here.
        motors: Names of the motors in their order; empty if unknown.

    Returns:
        Values for the keys of ``policy.yaml``, those of joints as lists in the network's order, and
        ``num_joints``.

    Raises:
        ValueError: An entry has another form or width, or cannot be supported.
    """
    file = Entries(raw, str(path))
    file.only(_ISAAC_KEYS)
    motor_of = file.indices("joint_ids_map")
    count = len(motor_of)
    found: dict[str, Any] = {"num_joints": count}
    if not motors and "joint_names" in file:
        motors = file.texts("joint_names")
    if motors and "joints" not in stated:
        if max(motor_of, default=0) >= len(motors):
            raise ValueError(
                f"{path}: joint_ids_map goes up to motor {max(motor_of)}; got names of "
                f"{len(motors)} motors: {motors}"
            )
        found["joints"] = [motors[i] for i in motor_of]
    if "network" not in stated:
        found["network"] = file_beside(path, _EXPORTED)
    if "action_clip" not in stated:
        found["action_clip"] = math.inf
    if "period_s" not in stated:
        found["period_s"] = file.number("step_dt")
    if "gains" not in stated:
        for key in ("stiffness", "damping"):
            values = file.get(key)
            if not isinstance(values, list) or max(motor_of, default=0) >= len(values):
                raise ValueError(
                    f"{path}: '{key}' must have an entry for each motor, up to "
                    f"{max(motor_of, default=0)} of joint_ids_map; got {values}. State gains in "
                    "policy.yaml instead"
                )
            found[key] = [file.numbers(key, len(values))[i] for i in motor_of]
    if "default_positions" not in stated:
        found["default_positions"] = file.numbers("default_joint_pos", count)
    actions = file.inner("actions")
    actions.only(["JointPositionAction"])
    action = actions.inner("JointPositionAction")
    action.only(["clip", "joint_names", "scale", "offset", "joint_ids"])
    _all_joints(action, count)
    if "action_scale" not in stated:
        found["action_scale"] = action.numbers("scale", count)
        _check_offset(action, found, stated, count)
        _check_target_clip(action, count)
    if "observation" not in stated:
        found |= _isaac_observation(file, count)
    ranges = file.raw.get("commands") or {}
    if "base_velocity" in ranges:
        bounds = file.inner("commands").inner("base_velocity").inner("ranges")
        pairs = [bounds.numbers(key, 2) for key in ("lin_vel_x", "lin_vel_y", "ang_vel_z")]
        lowest, highest = zip(*pairs, strict=True)
        found["command"] = {"lowest": list(lowest), "highest": list(highest)}
    return found


def _all_joints(entries: Entries, count: int) -> None:
    if "joint_ids" in entries and entries.raw["joint_ids"] != list(range(count)):
        raise ValueError(
            f"{entries.who}: joint_ids must be all {count} joints in the network's order, as a "
            f"policy observes the joints that it moves; got {entries.raw['joint_ids']}"
        )


def _check_offset(action: Entries, found: dict, stated: Collection[str], count: int) -> None:
    if "default_positions" in stated or "offset" not in action:
        return
    offset = action.numbers("offset", count)
    if not all(
        math.isclose(one, other, abs_tol=1e-6)
        for one, other in zip(offset, found["default_positions"], strict=True)
    ):
        raise ValueError(
            f"{action.who}: offset must equal default_joint_pos, from which joints are observed; "
            f"got {offset} and {found['default_positions']}"
        )


def _check_target_clip(action: Entries, count: int) -> None:
    """Refuses limits of joint positions that a joint can reach."""
    if "clip" not in action:
        return
    limits = action.get("clip")
    if not (
        isinstance(limits, list)
        and len(limits) == count
        and all(isinstance(pair, list) and len(pair) == 2 for pair in limits)
        and all(low <= -2 * math.pi and high >= 2 * math.pi for low, high in limits)
    ):
        raise ValueError(
            f"{action.who}: clip of joint positions must be null or beyond ±2π for {count} joints, "
            f"as this limit is not supported; got {limits}"
        )


def _isaac_observation(file: Entries, count: int) -> dict[str, Any]:
    terms = file.inner("observations")
    groups = [
        key
        for key, value in terms.raw.items()
        if isinstance(value, dict)
        and not any(name in value for name in _TERM_KEYS if name != "scale_first")
        and any(isinstance(one, dict) for one in value.values())
    ]
    if len(groups) > 1:
        raise ValueError(f"{terms.who} a policy has one input; got the groups {groups}")
    if groups:
        terms = terms.inner(groups[0])
    is_whole = terms.raw.get("use_gym_history", False)
    scale_first = terms.raw.get("scale_first", False)
    observation: list[dict[str, Any]] = []
    found: dict[str, Any] = {"observation": observation}
    for name in terms.raw:
        if name in _GROUP_SWITCHES:
            continue
        spec = terms.inner(name)
        spec.only(_TERM_KEYS)
        term = _ISAAC_NAMES.get(name, str(name))
        check_term(term, terms.who)
        width = term_width(term, count)
        entry: dict[str, Any] = {"name": term}
        if "scale" in spec:
            scale = spec.raw["scale"]
            size = width or (len(scale) if isinstance(scale, list) else 1)
            entry["scale"] = shortest(spec.numbers("scale", size))
        if "clip" in spec:
            entry["clip"] = _clip(
                spec, entry.get("scale", [1.0]), bool(spec.raw.get("scale_first", scale_first))
            )
        else:
            entry["clip"] = math.inf
        length = int(spec.number("history_length")) if "history_length" in spec else 1
        entry["history"] = max(length, 1)
        params = spec.raw.get("params") or {}
        if term == "gait_phase":
            period_s = spec.inner("params").number("period")
            found["gait"] = {"period_s": period_s, "offsets": [0.0], "standing_below": 0.0}
        elif "asset_cfg" in params:
            _all_joints(spec.inner("params").inner("asset_cfg"), count)
        observation.append(entry)
    if is_whole:
        lengths = {entry.pop("history") for entry in observation}
        if len(lengths) != 1:
            raise ValueError(
                f"{terms.who} use_gym_history needs terms of one history_length; got "
                f"{sorted(lengths)}"
            )
        length = lengths.pop()
        if length > 1:
            found["history"] = {"ages": list(range(length))[::-1], "by": "time"}
    return found


def _clip(spec: Entries, scale: list[float], scale_first: bool) -> float:
    """Largest absolute value after scaling."""
    low, high = spec.numbers("clip", 2)
    sizes = {1.0} if scale_first else {abs(factor) for factor in scale}
    if low != -high or len(sizes) != 1:
        raise ValueError(
            f"{spec.who} clip must be symmetric, with one scale; got {[low, high]} and {scale}"
        )
    return high * sizes.pop()
