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
from drake_safety.policies.policy import TERMS, PolicyParameters
from drake_safety.policies.policy_network import TERM_NAMES, limit, load_network
from drake_safety.robots.robot_model import by_pattern

_EXPORTED = ("policy.onnx", "../exported/policy.onnx", "policy.pt", "../exported/policy.pt")
_DEPLOY_KEYS = """joint_ids_map joint_names step_dt stiffness damping default_joint_pos commands
actions observations"""
_TERM_KEYS = "params clip scale history_length scale_first"
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
    """Reads a file of another project as keys of ``policy.yaml``; ``gait`` may lack its period.

    Args:
        path: A ``deploy.yaml`` of unitree_rl_lab or a ``config.yaml`` of rl_sar.
        motors: Joints in the order of the robot's motors, which a ``deploy.yaml`` numbers.
    """
    with reading(path):
        raw = _parsed(path)
        if isinstance(raw, dict) and {"joint_ids_map", "observations"} <= raw.keys():
            converted = _from_unitree(_Entries(raw, str(path), _DEPLOY_KEYS), path, motors)
        else:
            converted = _from_rl_sar(_rl_sar_entries(raw, path), path)
        for key in ("default_positions", "action_scale", "gains"):
            patterns = map(re.escape, converted["joints"])
            converted[key] = dict(zip(patterns, converted[key], strict=True))
        load_typed(PolicyParameters, converted, str(path))
    return converted


class _Loader(YamlLoader):
    """Reads Python's slices and tuples, which exporters write, as lists; a slice of all as null."""

    def slice(self, node: yaml.SequenceNode) -> list[Any] | None:
        ends = self.construct_sequence(node)
        return None if set(ends) == {None} else ends


_Loader.add_constructor("tag:yaml.org,2002:python/object/apply:builtins.slice", _Loader.slice)
_Loader.add_constructor("tag:yaml.org,2002:python/tuple", _Loader.construct_sequence)


def _parsed(path: Path) -> Any:
    return parse_yaml(path.read_text(encoding="utf-8"), f"'{path}'", _Loader)


class _Entries:
    """A mapping of a file, with errors that name the file and the entry."""

    def __init__(self, raw: dict[str, Any], who: str, known: str = ""):
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
        return _Entries(self.get(key, dict[str, Any]), f"{self.who}, {key},", known)

    def number(self, key: str) -> float:
        return float(self.get(key, FiniteFloat))

    def numbers(self, key: str, count: int, names: Sequence[str] = ()) -> list[float]:
        """``count`` numbers, one for all, or by regular expression over names."""
        values = self.get(key)
        if isinstance(values, dict) and names:
            values = [by_pattern(values, name, key, self.who) for name in names]
        elif not isinstance(values, list):
            values = [values] * count
        self.refuse(len(values) != count, f"'{key}' must have {count} entries; got {len(values)}")
        return load_typed(list[FiniteFloat], values, f"{self.who}: '{key}'")

    def indices(self, key: str, below: int | None = None) -> list[int]:
        """Different integers from 0 on."""
        values = self.get(key, list[Annotated[int, Field(ge=0, lt=below)]])
        is_wrong = len(set(values)) != len(values)
        self.refuse(is_wrong, f"'{key}' must be different integers; got {values}")
        return values

    def check_all_joints(self, count: int) -> None:
        is_wrong = self.raw.get("joint_ids") not in (None, list(range(count)))
        self.refuse(is_wrong, f"joint_ids must be all {count} joints in the network's order")


def _network(path: Path, *names: str) -> str:
    if files := [path.parent / name for name in names if (path.parent / name).is_file()]:
        return str(files[0].resolve())
    raise ValueError(f"{path}: expected a network beside it, one of {list(names)}")


def _joined(factors: list[float]) -> list[float]:
    """One factor if all are the same."""
    return factors[:1] if len(set(factors)) == 1 else factors


def _gains(file: _Entries, keys: tuple[str, str], *shape: Any) -> list[dict[str, float]]:
    stiffness, damping = (file.numbers(key, *shape) for key in keys)
    return [{"stiffness": p, "damping": d} for p, d in zip(stiffness, damping, strict=True)]


def _from_unitree(file: _Entries, path: Path, motors: Sequence[str]) -> dict[str, Any]:
    """A ``deploy.yaml``: gains are in the order of the motors, all else in the network's."""
    motor_of, network = file.indices("joint_ids_map"), _network(path, *_EXPORTED)
    count, last = len(motor_of), max(motor_of, default=0)
    names = motors or (file.get("joint_names", list[str]) if "joint_names" in file else [])
    for what in ("stiffness", "damping"):
        if isinstance(gains := file.get(what), list):
            file.refuse(len(gains) <= last, f"'{what}' must have an entry for each motor")
            file.raw[what] = [gains[i] for i in motor_of]
    joints = [names[i] for i in motor_of] if len(names) > last else []
    if not names and network.endswith(".onnx"):  # Others have no metadata.
        joints = load_network(Path(network)).metadata.joints
    what = f"it numbers motors, from 0 to {last}: name their joints in this order by --motors"
    file.refuse(len(joints) != count, f"{what}; got {names or joints}")
    positions = file.numbers("default_joint_pos", count, joints)
    actions = file.inner("actions", "JointPositionAction")
    action = actions.inner("JointPositionAction", "clip joint_names scale offset joint_ids")
    action.check_all_joints(count)
    offset = action.numbers("offset", count, joints) if "offset" in action else positions
    is_other = not np.allclose(offset, positions, rtol=0.0, atol=1e-6)
    action.refuse(is_other, f"offset must equal default_joint_pos, {positions}; got {offset}")
    limits = action.get("clip", list[Pair[float]]) if "clip" in action else []
    is_limiting = any(low > -2 * math.pi or high < 2 * math.pi for low, high in limits)
    action.refuse(is_limiting, f"clip of joint positions must be beyond ±2π; got {limits}")
    converted = {
        "network": network,
        "joints": joints,
        "default_positions": positions,
        "action_scale": action.numbers("scale", count, joints),
        "action_clip": math.inf,
        "gains": _gains(file, ("stiffness", "damping"), count, joints),
        "period_s": file.number("step_dt"),
        **_unitree_observation(file.inner("observations"), count),
    }
    if "commands" in file and "base_velocity" in (commands := file.inner("commands")):
        bounds = commands.inner("base_velocity").inner("ranges")
        pairs = [bounds.numbers(key, 2) for key in ("lin_vel_x", "lin_vel_y", "ang_vel_z")]
        lowest, highest = zip(*pairs, strict=True)
        converted["command"] = {"lowest": list(lowest), "highest": list(highest)}
    return converted


def _unitree_observation(terms: _Entries, count: int) -> dict[str, Any]:
    groups = [  # Unlike terms, they have entries of entries.
        key
        for key, value in terms.raw.items()
        if isinstance(value, dict)
        and not {"params", "clip", "scale", "history_length"} & value.keys()
        and any(isinstance(inner, dict) for inner in value.values())
    ]
    terms.refuse(len(groups) > 1, f"a policy has one input; got the groups {groups}")
    terms = terms.inner(groups[0]) if groups else terms
    observation: list[dict[str, Any]] = []
    converted: dict[str, Any] = {"observation": observation}
    for key in (key for key in terms.raw if key not in ("use_gym_history", "scale_first")):
        spec, name = terms.inner(key, _TERM_KEYS), TERM_NAMES.get(key, key)
        params = spec.inner("params") if "params" in spec else _Entries({}, spec.who)
        entry: dict[str, Any] = {"name": name, "clip": math.inf}
        length = spec.number("history_length") if "history_length" in spec else 1
        entry["history"] = max(int(length), 1)
        if "scale" in spec:
            scale = spec.raw["scale"]
            size = _width(name, count) or (len(scale) if isinstance(scale, list) else 1)
            entry["scale"] = _joined(spec.numbers("scale", size))
        if "clip" in spec:
            is_scaled = spec.raw.get("scale_first", terms.raw.get("scale_first", False))
            factors = [1.0] if is_scaled else entry.get("scale", [1.0])
            lowest, highest = spec.numbers("clip", 2)
            entry["clip"] = limit(lowest, highest, factors)
        if name == "gait_phase":
            period_s = params.number("period")
            converted["gait"] = {"period_s": period_s, "offsets": [0.0], "standing_below": 0.0}
        elif "asset_cfg" in params:
            params.inner("asset_cfg").check_all_joints(count)
        observation.append(entry)
    if terms.raw.get("use_gym_history", False):  # Whole observations, the oldest first.
        lengths = {entry.pop("history") for entry in observation}
        terms.refuse(len(lengths) != 1, f"use_gym_history needs one history_length; got {lengths}")
        converted["history"] = {"ages": list(range(lengths.pop()))[::-1], "by": "time"}
    return converted


def _rl_sar_entries(sections: Any, path: Path) -> _Entries:
    """The entries of a policy and of its robot's ``base.yaml``, up to two folders above."""
    section, own = "", None
    if isinstance(sections, dict) and len(sections) == 1:
        ((section, own),) = sections.items()
    if not isinstance(own, dict) or "rl_kp" not in own:
        kinds = "neither a deploy.yaml of unitree_rl_lab nor a config.yaml of rl_sar"
        raise ValueError(f"'{path}' is {kinds}, with one policy: {sections}")
    bases = [folder / "base.yaml" for folder in (path.parent, *path.resolve().parents[1:3])]
    base = next(filter(Path.is_file, bases), None)
    robots = load_typed(dict[str, dict[str, Any]], _parsed(base) if base else {}, f"'{base}'")
    robot = robots.get(str(section).partition("/")[0], {})
    raw = load_typed(dict[str, Any], {**robot, **own}, f"'{path}'")
    return _Entries(raw, str(path), _RL_SAR_KEYS)


def _from_rl_sar(file: _Entries, path: Path) -> dict[str, Any]:
    file.refuse(bool(file.raw.get("wheel_indices")), "wheels are not supported")
    count = int(file.number("num_of_dofs"))
    names = file.get("joint_names", list[str])
    if "joint_mapping" in file:
        names = [names[i] for i in file.indices("joint_mapping", len(names))]
    file.refuse(len(names) != count, f"it has {count} joints; got {len(names)} names: {names}")
    scale = file.numbers("action_scale", count)
    if "hip_scale_reduction" in file:
        for i in file.indices("hip_scale_reduction_indices", count):
            scale[i] *= file.number("hip_scale_reduction")
    action_clip = math.inf
    if any(file.raw.get(f"clip_actions_{side}") for side in ("lower", "upper")):
        low, high = (file.numbers(f"clip_actions_{side}", count) for side in ("lower", "upper"))
        action_clip = high[0]
        is_odd = {*high} | {-x for x in low} != {action_clip}
        what = "limits of actions must be the same for all joints and signs"
        file.refuse(is_odd, f"{what}; got {low}, {high}")
    return {
        "network": _network(path, str(file.get("model_name"))),
        "joints": names,
        "default_positions": file.numbers("default_dof_pos", count),
        "action_scale": scale,
        "action_clip": action_clip,
        "gains": _gains(file, ("rl_kp", "rl_kd"), count),
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
        if name not in TERMS and re.fullmatch(r"(?!.*mimic)\w+_phase", name):
            term = "gait_phase"  # Its period is in the project's code.
            converted["gait"] = {"offsets": [0.0], "standing_below": 0.0}
        widths.append(_width(term, count))
        entry = {"name": term, "clip": clip}
        if key:
            entry["scale"] = _joined(file.numbers(key, widths[-1]))
        observation.append(entry)
    num = file.number("num_observations") if "num_observations" in file else sum(widths)
    what = f"its observations have {sum(widths)} entries with {count} joints"
    is_other = num != sum(widths) and all(widths)
    file.refuse(is_other, f"num_observations is {num:g}, but {what}")
    if file.raw.get("observations_history"):
        converted["history"] = {
            "ages": file.indices("observations_history"),
            "by": file.raw.get("observations_history_priority", "time"),
        }
    return converted


def _width(term: str, count: int) -> int:
    """Entries of a term of a policy with ``count`` joints; 0 for terms of users."""
    three = ("base_lin_vel", "base_ang_vel", "projected_gravity", "velocity_commands")
    per_joint = ("joint_pos_rel", "joint_vel_rel", "last_action")
    return 3 * (term in three) + count * (term in per_joint) + 2 * (term == "gait_phase")
