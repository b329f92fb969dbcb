"""The ``config.yaml`` of rl_sar."""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

from drake_safety.control.policy_entries import Entries, file_beside, shortest, term_width
from drake_safety.control.policy_terms import registered_terms

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


def is_rl_sar(raw: Any) -> bool:
    """Whether parsed YAML has the form of a ``config.yaml`` of rl_sar."""
    return isinstance(raw, dict) and any(
        isinstance(section, dict) and {"rl_kp", "num_observations"} & section.keys()
        for section in raw.values()
    )


def from_rl_sar(raw: Any, path: Path, stated: Collection[str], base: Any = None) -> dict[str, Any]:
    """Reads the ``config.yaml`` of rl_sar.

    Args:
        raw: The parsed file.
        path: The file, for messages and the network beside it.
        stated: Keys of ``policy.yaml`` whose values are not read here.
        base: The parsed ``base.yaml`` of the robot, whose values those of the file replace.

    Returns:
        As :func:`from_isaac_lab`.

    Raises:
        ValueError: An entry has another form or width, or cannot be supported.
    """
    if len(raw) != 1:
        raise ValueError(f"{path}: one policy in a file is expected; got {list(raw)}")
    ((section, own),) = raw.items()
    robot = str(section).partition("/")[0]
    of_robot = base.get(robot) if isinstance(base, dict) else None
    file = Entries({**(of_robot if isinstance(of_robot, dict) else {}), **own}, str(path))
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
    found: dict[str, Any] = {"num_joints": count}
    if "network" not in stated:
        found["network"] = file_beside(path, [str(file.get("model_name"))])
    if "joints" not in stated and "joint_names" in file:
        names = file.texts("joint_names")
        order = list(range(count))
        if "joint_mapping" in file:
            order = file.indices("joint_mapping", len(names))
        if len(order) != count or len(names) < count:
            raise ValueError(
                f"{path}: joint_names and joint_mapping must be of {count} joints, num_of_dofs; "
                f"got {len(names)} names and the mapping {order}"
            )
        found["joints"] = [names[i] for i in order]
    if "period_s" not in stated:
        found["period_s"] = file.number("dt") * file.number("decimation")
    if "gains" not in stated:
        found["stiffness"] = file.numbers("rl_kp", count)
        found["damping"] = file.numbers("rl_kd", count)
    if "default_positions" not in stated:
        found["default_positions"] = file.numbers("default_dof_pos", count)
    if "action_scale" not in stated:
        scale = file.numbers("action_scale", count)
        if "hip_scale_reduction" in file:
            for i in file.indices("hip_scale_reduction_indices", count):
                scale[i] *= file.number("hip_scale_reduction")
        found["action_scale"] = scale
    if "action_clip" not in stated:
        found["action_clip"] = _action_clip(file, count)
    if "observation" not in stated:
        found |= _rl_sar_observation(file, count)
    return found


def _action_clip(file: Entries, count: int) -> float:
    keys = ("clip_actions_lower", "clip_actions_upper")
    if not any(file.raw.get(key) for key in keys):
        return math.inf
    low, high = (file.numbers(key, count) for key in keys)
    if set(high) != {-x for x in low} or len(set(high)) != 1:
        raise ValueError(
            f"{file.who}: limits of actions that differ between joints or signs are not supported; "
            f"got {low} and {high}. State action_clip in policy.yaml instead"
        )
    return high[0]


def _rl_sar_observation(file: Entries, count: int) -> dict[str, Any]:
    clip = file.number("clip_obs") if "clip_obs" in file else math.inf
    observation: list[dict[str, Any]] = []
    found: dict[str, Any] = {"observation": observation}
    known = [*_RL_SAR_TERMS, "*_phase", *registered_terms()]
    total = 0
    for name in file.texts("observations"):
        if name in _RL_SAR_TERMS:
            term, key = _RL_SAR_TERMS[name]
        elif _PHASE.fullmatch(name) and "mimic" not in name:
            # Its period is in the project's code.
            term, key = "gait_phase", ""
            found["gait"] = {"offsets": [0.0], "standing_below": 0.0}
        elif name in registered_terms():
            term, key = name, ""
        else:
            raise ValueError(f"{file.who}: unknown observation '{name}'; known are {known}")
        width = term_width(term, count)
        total += width or 1
        entry: dict[str, Any] = {"name": term, "clip": clip}
        if key:
            entry["scale"] = shortest(file.numbers(key, width))
        observation.append(entry)
    is_known = all(term_width(entry["name"], count) for entry in observation)
    if is_known and "num_observations" in file and total != file.number("num_observations"):
        raise ValueError(
            f"{file.who}: num_observations is {file.raw['num_observations']}, but its observations "
            f"{file.raw['observations']} have {total} entries with {count} joints"
        )
    if file.raw.get("observations_history"):
        ages = file.indices("observations_history")
        priority = file.raw.get("observations_history_priority", "time")
        if priority not in ("time", "term"):
            raise ValueError(
                f"{file.who}: observations_history_priority must be 'time' or 'term'; got "
                f"'{priority}'"
            )
        found["history"] = {"ages": ages, "by": priority}
    return found
