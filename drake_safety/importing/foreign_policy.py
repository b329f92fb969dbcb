"""Converts the ``deploy.yaml`` of unitree_rl_lab and the ``config.yaml`` of rl_sar, for `new`."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import Field, FiniteFloat

from drake_safety.files.reading import YamlLoader, parse_yaml, reading
from drake_safety.files.schema import Pair, load_typed
from drake_safety.policies.policy import PolicyParameters, registered_terms
from drake_safety.policies.policy_network import TERM_NAMES, limit, load_network
from drake_safety.robots.robot_model import by_pattern

_EXPORTED = ("policy.onnx", "../exported/policy.onnx", "policy.pt", "../exported/policy.pt")
_DEPLOY_KEYS = """joint_ids_map joint_names step_dt stiffness damping default_joint_pos commands
actions observations"""
_TERM_KEYS = "params clip scale history_length scale_first"
_GROUP_SWITCHES = ("use_gym_history", "scale_first")
_RL_SAR_TERMS = {
    "lin_vel": ("base_lin_vel", "lin_vel_scale"),
    "ang_vel": ("base_ang_vel", "ang_vel_scale"),
    "ang_vel_body": ("base_ang_vel", "ang_vel_scale"),
    "ang_vel_world": ("base_ang_vel", "ang_vel_scale"),
    "gravity_vec": ("projected_gravity", ""),
    "commands": ("velocity_commands", "commands_scale"),
    "dof_pos": ("joint_pos_rel", "dof_pos_scale"),
    "dof_vel": ("joint_vel_rel", "dof_vel_scale"),
    "actions": ("last_action", ""),
}
# The last lines are of its own controllers and robots, without effect on the policy.
_RL_SAR_KEYS = """model_name num_observations observations observations_history
observations_history_priority clip_obs clip_actions_lower clip_actions_upper rl_kp rl_kd num_of_dofs
action_scale wheel_indices lin_vel_scale ang_vel_scale dof_pos_scale dof_vel_scale commands_scale
default_dof_pos joint_names joint_mapping dt decimation framework hip_scale_reduction
hip_scale_reduction_indices
fixed_kp fixed_kd torque_limits joint_controller_names command_mapping state_mapping"""


def converted_policy(path: Path, motors: Sequence[str] = ()) -> dict[str, Any]:
    """Reads a policy's file of another project as the keys of ``policy.yaml``.

    Args:
        path: A ``deploy.yaml`` of unitree_rl_lab or a ``config.yaml`` of rl_sar.
        motors: Joints in the order of the robot's motors, which a ``deploy.yaml`` numbers.

    Returns:
        The keys. ``network`` is an absolute path, ``gait`` may lack its period.
    """
    with reading(path):
        content = _parsed(path)
        raw = content if isinstance(content, dict) else {}
        if {"joint_ids_map", "observations"} <= raw.keys():
            converted = _from_unitree(_Entries(raw, str(path), _DEPLOY_KEYS), path, motors)
        elif any(isinstance(section, dict) and "rl_kp" in section for section in raw.values()):
            converted = _from_rl_sar(raw, path)
        else:
            raise ValueError(
                f"'{path}' is neither a deploy.yaml of unitree_rl_lab (joint_ids_map, "
                "observations, ...) nor a config.yaml of rl_sar (rl_kp, ...); its keys are "
                f"{list(raw) or content}"
            )
        count, network = len(converted["default_positions"]), Path(converted["network"])
        names = converted["joints"]
        if not names and network.suffix == ".onnx":  # Others have no metadata.
            names = load_network(network).metadata.joints
        if len(names) != count:
            raise ValueError(
                f"'{path}' has {count} joints; got {len(names)} names: {names}. A deploy.yaml "
                "numbers the motors: name their joints in that order by --motors"
            )
        gains = zip(converted.pop("kp"), converted.pop("kd"), strict=True)
        converted["joints"] = list(names)
        converted["gains"] = [{"stiffness": p, "damping": d} for p, d in gains]
        for key in ("default_positions", "action_scale", "gains"):
            converted[key] = dict(zip(map(re.escape, names), converted[key], strict=True))
        load_typed(PolicyParameters, converted, str(path))
    return converted


class _Loader(YamlLoader):
    """Reads Python's slices and tuples, which exporters write, as lists; a slice of all as null."""


def _slice(loader: _Loader, node: yaml.SequenceNode) -> list[Any] | None:
    ends = loader.construct_sequence(node)
    return None if set(ends) == {None} else ends


_Loader.add_constructor("tag:yaml.org,2002:python/object/apply:builtins.slice", _slice)
_Loader.add_constructor("tag:yaml.org,2002:python/tuple", _Loader.construct_sequence)


def _parsed(path: Path) -> Any:
    if not path.is_file():
        raise ValueError(f"'{path}' does not exist")
    return parse_yaml(path.read_text(encoding="utf-8"), f"'{path}'", _Loader)


class _Entries:
    """A mapping of a file, with errors that name the file and the entry."""

    def __init__(self, raw: Any, who: str, known: str = ""):
        if not isinstance(raw, dict):
            raise ValueError(f"{who} must be a mapping; got {raw}")
        self.raw, self.who = raw, who
        unknown = [key for key in raw if known and key not in known.split()]
        self.refuse(bool(unknown), f"it has unknown keys {unknown}; known are {known.split()}")

    def refuse(self, is_wrong: bool, what: str) -> None:
        if is_wrong:
            raise ValueError(f"{self.who}: {what}")

    def __contains__(self, key: str) -> bool:
        return self.raw.get(key) is not None

    def get(self, key: str, kind: Any = Any) -> Any:
        """A value, of a type that pydantic checks."""
        self.refuse(key not in self, f"it has no '{key}'; it has {list(self.raw)}")
        return load_typed(kind, self.raw[key], f"{self.who}: '{key}'")

    def inner(self, key: str, known: str = "") -> _Entries:
        return _Entries(self.get(key), f"{self.who}, {key},", known)

    def number(self, key: str) -> float:
        return float(self.get(key, FiniteFloat))

    def numbers(self, key: str, count: int | None = None, names: Sequence[str] = ()) -> list[float]:
        """``count`` numbers, one for all, or by regular expression over names.

        Without ``count`` any number of them.
        """
        values = self.get(key)
        if isinstance(values, dict) and names:
            values = [by_pattern(values, name, key, self.who) for name in names]
        elif not isinstance(values, list):
            values = [values] * (count or 1)
        is_wrong = count is not None and len(values) != count
        self.refuse(is_wrong, f"'{key}' must have {count} entries; got {len(values)}")
        return load_typed(list[FiniteFloat], values, f"{self.who}: '{key}'")

    def indices(self, key: str, below: int | None = None) -> list[int]:
        """Different integers from 0 on."""
        values = self.get(key, list[Annotated[int, Field(ge=0, lt=below)]])
        is_wrong = len(set(values)) != len(values)
        self.refuse(is_wrong, f"'{key}' must be different integers; got {values}")
        return values


def _scale(entries: _Entries, key: str, size: int) -> list[float]:
    """One factor if all are the same."""
    scale = entries.numbers(key, size)
    return scale[:1] if len(set(scale)) == 1 else scale


def _width(term: str, count: int) -> int:
    """Entries of a term of a policy with ``count`` joints; 0 for terms of users."""
    three = ("base_lin_vel", "base_ang_vel", "projected_gravity", "velocity_commands")
    per_joint = ("joint_pos_rel", "joint_vel_rel", "last_action")
    return 3 * (term in three) + count * (term in per_joint) + 2 * (term == "gait_phase")


def _network(path: Path, *names: str) -> str:
    for name in names:
        if (path.parent / name).is_file():
            return str((path.parent / name).resolve())
    raise ValueError(f"{path}: no network beside it, expected one of {list(names)}")


def _from_unitree(file: _Entries, path: Path, motors: Sequence[str]) -> dict[str, Any]:
    """Gains are in the order of the motors, everything else in that of the network."""
    motor_of = file.indices("joint_ids_map")
    count, last = len(motor_of), max(motor_of, default=0)
    names = motors or (file.get("joint_names", list[str]) if "joint_names" in file else [])
    joints = [names[i] for i in motor_of] if len(names) > last else []
    gains = {
        key: file.numbers(key, None if isinstance(file.get(key), list) else last + 1, names)
        for key in ("stiffness", "damping")
    }
    for what, values in {"names of motors": names, **gains}.items():
        file.refuse(
            0 < len(values) <= last,
            f"'{what}' must have an entry for each motor, up to {last} of joint_ids_map; got "
            f"{values}",
        )
    positions = file.numbers("default_joint_pos", count, joints)
    actions = file.inner("actions", "JointPositionAction")
    action = actions.inner("JointPositionAction", "clip joint_names scale offset joint_ids")
    _check_all_joints(action, count)
    offset = action.numbers("offset", count, joints) if "offset" in action else positions
    action.refuse(
        not np.allclose(offset, positions, rtol=0.0, atol=1e-6),
        "offset must equal default_joint_pos, from which joints are observed; got "
        f"{offset} and {positions}",
    )
    limits = action.get("clip", list[Pair[float]]) if "clip" in action else []
    action.refuse(
        any(low > -2 * math.pi or high < 2 * math.pi for low, high in limits),
        f"clip of joint positions must be null or beyond ±2π for {count} joints, as this limit is "
        f"not supported; got {limits}",
    )
    converted = {
        "network": _network(path, *_EXPORTED),
        "joints": joints,
        "default_positions": positions,
        "action_scale": action.numbers("scale", count, joints),
        "action_clip": math.inf,
        "kp": [gains["stiffness"][i] for i in motor_of],
        "kd": [gains["damping"][i] for i in motor_of],
        "period_s": file.number("step_dt"),
        **_unitree_observation(file.inner("observations"), count),
    }
    if "base_velocity" in (file.raw.get("commands") or {}):
        bounds = file.inner("commands").inner("base_velocity").inner("ranges")
        pairs = [bounds.numbers(key, 2) for key in ("lin_vel_x", "lin_vel_y", "ang_vel_z")]
        lowest, highest = zip(*pairs, strict=True)
        converted["command"] = {"lowest": list(lowest), "highest": list(highest)}
    return converted


def _check_all_joints(entries: _Entries, count: int) -> None:
    joint_ids = entries.raw.get("joint_ids")
    entries.refuse(
        joint_ids not in (None, list(range(count))),
        f"joint_ids must be all {count} joints in the network's order, as a policy observes the "
        f"joints that it moves; got {joint_ids}",
    )


def _unitree_observation(terms: _Entries, count: int) -> dict[str, Any]:
    groups = [
        key
        for key, value in terms.raw.items()
        if isinstance(value, dict)
        and not set(_TERM_KEYS.split()) - {"scale_first"} & value.keys()
        and any(isinstance(inner, dict) for inner in value.values())
    ]
    terms.refuse(len(groups) > 1, f"a policy has one input; got the groups {groups}")
    if groups:
        terms = terms.inner(groups[0])
    observation: list[dict[str, Any]] = []
    converted: dict[str, Any] = {"observation": observation}
    for key in (key for key in terms.raw if key not in _GROUP_SWITCHES):
        spec = terms.inner(key, _TERM_KEYS)
        name = TERM_NAMES.get(key, str(key))
        entry: dict[str, Any] = {"name": name}
        if "scale" in spec:
            scale = spec.raw["scale"]
            size = _width(name, count) or (len(scale) if isinstance(scale, list) else 1)
            entry["scale"] = _scale(spec, "scale", size)
        entry["clip"] = math.inf
        if "clip" in spec:
            is_scaled = spec.raw.get("scale_first", terms.raw.get("scale_first", False))
            factors = [1.0] if is_scaled else entry.get("scale", [1.0])
            lowest, highest = spec.numbers("clip", 2)
            entry["clip"] = limit(lowest, highest, factors, spec.who)
        entry["history"] = max(int(spec.raw.get("history_length") or 1), 1)
        if name == "gait_phase":
            period_s = spec.inner("params").number("period")
            converted["gait"] = {"period_s": period_s, "offsets": [0.0], "standing_below": 0.0}
        elif "asset_cfg" in (spec.raw.get("params") or {}):
            _check_all_joints(spec.inner("params").inner("asset_cfg"), count)
        observation.append(entry)
    if terms.raw.get("use_gym_history", False):
        lengths = {entry.pop("history") for entry in observation}
        what = f"use_gym_history needs one history_length; got {sorted(lengths)}"
        terms.refuse(len(lengths) != 1, what)
        if (length := lengths.pop()) > 1:
            converted["history"] = {"ages": list(range(length))[::-1], "by": "time"}
    return converted


def _from_rl_sar(raw: dict[str, Any], path: Path) -> dict[str, Any]:
    """What is not in the file is in the ``base.yaml`` of its robot, up to two folders above."""
    if len(raw) != 1:
        raise ValueError(f"{path}: one policy in a file is expected; got {list(raw)}")
    ((section, own),) = raw.items()
    bases = [folder / "base.yaml" for folder in (path.parent, *path.resolve().parents[1:3])]
    of_robot: Any = {}
    if base := next(filter(Path.is_file, bases), None):
        with reading(base):
            of_robot = _Entries(_parsed(base), str(base)).raw.get(str(section).partition("/")[0])
    file = _Entries({**(of_robot or {}), **own}, str(path), _RL_SAR_KEYS)
    wheels = file.raw.get("wheel_indices")
    file.refuse(bool(wheels), f"wheels are not supported; got wheel_indices {wheels}")
    count = int(file.number("num_of_dofs"))
    names = file.get("joint_names", list[str]) if "joint_names" in file else []
    if names and "joint_mapping" in file:
        names = [names[i] for i in file.indices("joint_mapping", len(names))]
    scale = file.numbers("action_scale", count)
    if "hip_scale_reduction" in file:
        for i in file.indices("hip_scale_reduction_indices", count):
            scale[i] *= file.number("hip_scale_reduction")
    action_clip = math.inf
    clips = ("clip_actions_lower", "clip_actions_upper")
    if any(file.raw.get(key) for key in clips):
        low, high = (file.numbers(key, count) for key in clips)
        file.refuse(
            set(high) != {-x for x in low} or len(set(high)) != 1,
            "limits of actions that differ between joints or signs are not supported; got "
            f"{low} and {high}. Write one for all",
        )
        action_clip = high[0]
    return {
        "network": _network(path, str(file.get("model_name"))),
        "joints": names,
        "default_positions": file.numbers("default_dof_pos", count),
        "action_scale": scale,
        "action_clip": action_clip,
        "kp": file.numbers("rl_kp", count),
        "kd": file.numbers("rl_kd", count),
        "period_s": file.number("dt") * file.number("decimation"),
        **_rl_sar_observation(file, count),
    }


def _rl_sar_observation(file: _Entries, count: int) -> dict[str, Any]:
    clip = file.number("clip_obs") if "clip_obs" in file else math.inf
    observation: list[dict[str, Any]] = []
    converted: dict[str, Any] = {"observation": observation}
    widths = []
    for name in file.get("observations", list[str]):
        term, key = _RL_SAR_TERMS.get(name, (name, ""))
        if name not in registered_terms() and re.fullmatch(r"(?!.*mimic)\w+_phase", name):
            # Its period is in the project's code.
            term = "gait_phase"
            converted["gait"] = {"offsets": [0.0], "standing_below": 0.0}
        widths.append(_width(term, count))
        scale = {"scale": _scale(file, key, widths[-1])} if key else {}
        observation.append({"name": term, "clip": clip, **scale})
    num = file.number("num_observations") if "num_observations" in file else sum(widths)
    file.refuse(
        num != sum(widths) and all(widths),
        f"num_observations is {num:g}, but its observations {file.raw['observations']} have "
        f"{sum(widths)} entries with {count} joints",
    )
    if file.raw.get("observations_history"):
        converted["history"] = {
            "ages": file.indices("observations_history"),
            "by": file.raw.get("observations_history_priority", "time"),
        }
    return converted
