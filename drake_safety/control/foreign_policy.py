"""Converts the ``deploy.yaml`` of unitree_rl_lab and the ``config.yaml`` of rl_sar, for `new`."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

from drake_safety.control.policy import PolicyParameters
from drake_safety.control.policy_metadata import TERM_NAMES, limit
from drake_safety.control.policy_network import load_network
from drake_safety.control.policy_terms import registered_terms
from drake_safety.files.reading import YamlLoader, parse_yaml, reading
from drake_safety.files.schema import load_typed
from drake_safety.robots.robot_model import by_pattern

_THREE = ("base_lin_vel", "base_ang_vel", "projected_gravity", "velocity_commands")
_PER_JOINT = ("joint_pos_rel", "joint_vel_rel", "last_action")

_EXPORTED = ("policy.onnx", "../exported/policy.onnx", "policy.pt", "../exported/policy.pt")
_DEPLOY_KEYS = (
    *("joint_ids_map", "joint_names", "step_dt", "stiffness", "damping", "default_joint_pos"),
    *("commands", "actions", "observations"),
)
_TERM_KEYS = ("params", "clip", "scale", "history_length", "scale_first")
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
_RL_SAR_KEYS = (
    *("model_name", "num_observations", "observations", "observations_history"),
    *("observations_history_priority", "clip_obs", "clip_actions_lower", "clip_actions_upper"),
    *("rl_kp", "rl_kd", "num_of_dofs", "action_scale", "wheel_indices", "lin_vel_scale"),
    *("ang_vel_scale", "dof_pos_scale", "dof_vel_scale", "commands_scale", "default_dof_pos"),
    *("joint_names", "joint_mapping", "dt", "decimation", "framework"),
    *("hip_scale_reduction", "hip_scale_reduction_indices"),
    # Of its own controllers and robots, without effect on the policy.
    *("fixed_kp", "fixed_kd", "torque_limits", "joint_controller_names"),
    *("command_mapping", "state_mapping", "rows", "cols"),
)
_PHASE = re.compile(r"\w+_phase")


def converted_policy(path: Path, motors: Sequence[str] = ()) -> dict[str, Any]:
    """Reads a policy's file of another project as the keys of ``policy.yaml``.

    Args:
        path: A ``deploy.yaml`` of unitree_rl_lab or a ``config.yaml`` of rl_sar.
        motors: Joints in the order of the robot's motors, which a ``deploy.yaml`` numbers.

    Returns:
        The keys. ``network`` is an absolute path, ``gait`` may lack its period.
    """
    with reading(path):
        raw = _parsed(path)
        if isinstance(raw, dict) and {"joint_ids_map", "observations"} <= raw.keys():
            found = _from_unitree(_Entries(raw, str(path)), path, motors)
        elif isinstance(raw, dict) and any(
            isinstance(section, dict) and {"rl_kp", "num_observations"} & section.keys()
            for section in raw.values()
        ):
            found = _from_rl_sar(raw, path)
        else:
            raise ValueError(
                f"'{path}' is neither a deploy.yaml of unitree_rl_lab (joint_ids_map, "
                "observations, ...) nor a config.yaml of rl_sar (rl_kp, num_observations, ...); "
                f"its keys are {list(raw) if isinstance(raw, dict) else raw}"
            )
        count = len(found["default_positions"])
        names = found["joints"] or load_network(Path(found["network"])).metadata.joints
        if len(names) != count:
            raise ValueError(
                f"'{path}' has {count} joints; got {len(names)} names: {names}. A deploy.yaml "
                "numbers the motors: name their joints in that order by --motors"
            )
        keys = [re.escape(name) for name in names]
        found["joints"] = list(names)
        found["gains"] = [
            {"stiffness": stiffness, "damping": damping}
            for stiffness, damping in zip(found.pop("kp"), found.pop("kd"), strict=True)
        ]
        for key in ("default_positions", "action_scale", "gains"):
            found[key] = dict(zip(keys, found[key], strict=True))
        load_typed(PolicyParameters, found, str(path))
    return found


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

    def __init__(self, raw: Any, who: str):
        if not isinstance(raw, dict):
            raise ValueError(f"{who} must be a mapping; got {raw}")
        self.raw, self.who = raw, who

    def __contains__(self, key: str) -> bool:
        return self.raw.get(key) is not None

    def only(self, known: Iterable[str]) -> None:
        unknown = [key for key in self.raw if key not in known]
        if unknown:
            raise ValueError(
                f"{self.who} has unknown keys {unknown}; known are {sorted(known)}. Delete them "
                "if the policy does not depend on them"
            )

    def get(self, key: str) -> Any:
        if key not in self:
            raise ValueError(f"{self.who} has no '{key}'; it has {list(self.raw)}")
        return self.raw[key]

    def inner(self, key: str) -> _Entries:
        return _Entries(self.get(key), f"{self.who}, {key},")

    def numbers(self, key: str, count: int | None = None, names: Sequence[str] = ()) -> list[float]:
        """``count`` numbers, one for all, or by regular expression over names.

        Without ``count`` any number of them.
        """
        stated = self.get(key)
        if isinstance(stated, dict) and names:
            stated = [by_pattern(stated, name, key, self.who) for name in names]
        values = stated if isinstance(stated, list) else [stated] * (count or 1)
        if not all(type(value) in (int, float) and math.isfinite(value) for value in values):
            raise ValueError(f"{self.who}: '{key}' must be finite numbers; got {stated}")
        if count is not None and len(values) != count:
            raise ValueError(f"{self.who}: '{key}' must have {count} entries; got {len(values)}")
        return [float(value) for value in values]

    def number(self, key: str) -> float:
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
        values = self.get(key)
        if not isinstance(values, list) or not all(isinstance(x, str) for x in values):
            raise ValueError(f"{self.who}: '{key}' must be a list of names; got {values}")
        return values


def _shortest(scale: list[float]) -> list[float]:
    """One factor if all are the same."""
    return scale[:1] if len(set(scale)) == 1 else scale


def _width(term: str, count: int) -> int:
    """Entries of a term of a policy with ``count`` joints; 0 for terms of users."""
    sizes = {**dict.fromkeys(_THREE, 3), **dict.fromkeys(_PER_JOINT, count), "gait_phase": 2}
    return sizes.get(term, 0)


def _network(path: Path, names: Iterable[str]) -> str:
    for name in names:
        if (path.parent / name).is_file():
            return str((path.parent / name).resolve())
    raise ValueError(f"{path}: no network beside it, expected one of {list(names)}")


def _from_unitree(file: _Entries, path: Path, motors: Sequence[str]) -> dict[str, Any]:
    """Gains are in the order of the motors, everything else in that of the network."""
    file.only(_DEPLOY_KEYS)
    motor_of = file.indices("joint_ids_map")
    count, last = len(motor_of), max(motor_of, default=0)
    names = motors or (file.texts("joint_names") if "joint_names" in file else [])
    joints = [names[i] for i in motor_of] if len(names) > last else []
    gains = {
        key: file.numbers(key, None if isinstance(file.get(key), list) else last + 1, names)
        for key in ("stiffness", "damping")
    }
    for what, values in {"names of motors": names, **gains}.items():
        if values and len(values) <= last:
            raise ValueError(
                f"{path}: '{what}' must have an entry for each motor, up to {last} of "
                f"joint_ids_map; got {values}"
            )
    positions = file.numbers("default_joint_pos", count, joints)
    file.inner("actions").only(["JointPositionAction"])
    action = file.inner("actions").inner("JointPositionAction")
    action.only(["clip", "joint_names", "scale", "offset", "joint_ids"])
    _check_all_joints(action, count)
    offset = action.numbers("offset", count, joints) if "offset" in action else positions
    if any(abs(one - other) > 1e-6 for one, other in zip(offset, positions, strict=True)):
        raise ValueError(
            f"{action.who}: offset must equal default_joint_pos, from which joints are observed; "
            f"got {offset} and {positions}"
        )
    limits = action.raw.get("clip")
    if limits is not None and not (
        isinstance(limits, list)
        and len(limits) == count
        and all(isinstance(pair, list) and len(pair) == 2 for pair in limits)
        and all(low <= -2 * math.pi and high >= 2 * math.pi for low, high in limits)
    ):
        raise ValueError(
            f"{action.who}: clip of joint positions must be null or beyond ±2π for {count} joints, "
            f"as this limit is not supported; got {limits}"
        )
    found = {
        "network": _network(path, _EXPORTED),
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
        found["command"] = {"lowest": list(lowest), "highest": list(highest)}
    return found


def _check_all_joints(entries: _Entries, count: int) -> None:
    if "joint_ids" in entries and entries.raw["joint_ids"] != list(range(count)):
        raise ValueError(
            f"{entries.who}: joint_ids must be all {count} joints in the network's order, as a "
            f"policy observes the joints that it moves; got {entries.raw['joint_ids']}"
        )


def _unitree_observation(terms: _Entries, count: int) -> dict[str, Any]:
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
    observation: list[dict[str, Any]] = []
    found: dict[str, Any] = {"observation": observation}
    for name in terms.raw:
        if name in _GROUP_SWITCHES:
            continue
        spec = terms.inner(name)
        spec.only(_TERM_KEYS)
        entry: dict[str, Any] = {"name": TERM_NAMES.get(name, str(name))}
        if "scale" in spec:
            scale = spec.raw["scale"]
            size = _width(entry["name"], count) or (len(scale) if isinstance(scale, list) else 1)
            entry["scale"] = _shortest(spec.numbers("scale", size))
        entry["clip"] = math.inf
        if "clip" in spec:
            is_scaled = spec.raw.get("scale_first", terms.raw.get("scale_first", False))
            factors = [1.0] if is_scaled else entry.get("scale", [1.0])
            lowest, highest = spec.numbers("clip", 2)
            entry["clip"] = limit(lowest, highest, factors, spec.who)
        length = int(spec.number("history_length")) if "history_length" in spec else 1
        entry["history"] = max(length, 1)
        if entry["name"] == "gait_phase":
            period_s = spec.inner("params").number("period")
            found["gait"] = {"period_s": period_s, "offsets": [0.0], "standing_below": 0.0}
        elif "asset_cfg" in (spec.raw.get("params") or {}):
            _check_all_joints(spec.inner("params").inner("asset_cfg"), count)
        observation.append(entry)
    if terms.raw.get("use_gym_history", False):
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


def _from_rl_sar(raw: dict[str, Any], path: Path) -> dict[str, Any]:
    """What is not in the file is in the ``base.yaml`` of its robot, up to two folders above."""
    if len(raw) != 1:
        raise ValueError(f"{path}: one policy in a file is expected; got {list(raw)}")
    ((section, own),) = raw.items()
    folders = [path.parent, *path.resolve().parents[1:3]]
    base = next((f / "base.yaml" for f in folders if (f / "base.yaml").is_file()), None)
    of_robot = None
    if base is not None:
        with reading(base):
            of_robot = _Entries(_parsed(base), str(base)).raw.get(str(section).partition("/")[0])
    file = _Entries({**(of_robot or {}), **own}, str(path))
    file.only(_RL_SAR_KEYS)
    if "rows" in file and file.raw.get("framework") == "isaacsim":
        raise ValueError(
            f"{path}: the reordering by rows and cols of old files with framework isaacsim is not "
            "supported; put the lists in the network's order, and delete rows and cols"
        )
    if file.raw.get("wheel_indices"):
        raise ValueError(
            f"{path}: wheels are not supported; got wheel_indices {file.raw['wheel_indices']}"
        )
    count = int(file.number("num_of_dofs"))
    names = file.texts("joint_names") if "joint_names" in file else []
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
        if set(high) != {-x for x in low} or len(set(high)) != 1:
            raise ValueError(
                f"{path}: limits of actions that differ between joints or signs are not supported; "
                f"got {low} and {high}. Write one for all"
            )
        action_clip = high[0]
    return {
        "network": _network(path, [str(file.get("model_name"))]),
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
    found: dict[str, Any] = {"observation": observation}
    widths = []
    for name in file.texts("observations"):
        term, key = _RL_SAR_TERMS.get(name, (name, ""))
        if name not in registered_terms() and _PHASE.fullmatch(name) and "mimic" not in name:
            # Its period is in the project's code.
            term = "gait_phase"
            found["gait"] = {"offsets": [0.0], "standing_below": 0.0}
        widths.append(_width(term, count))
        entry: dict[str, Any] = {"name": term, "clip": clip}
        if key:
            entry["scale"] = _shortest(file.numbers(key, widths[-1]))
        observation.append(entry)
    is_wrong = "num_observations" in file and sum(widths) != file.number("num_observations")
    if is_wrong and all(widths):
        raise ValueError(
            f"{file.who}: num_observations is {file.raw['num_observations']}, but its observations "
            f"{file.raw['observations']} have {sum(widths)} entries with {count} joints"
        )
    if file.raw.get("observations_history"):
        found["history"] = {
            "ages": file.indices("observations_history"),
            "by": file.raw.get("observations_history_priority", "time"),
        }
    return found
