"""Converts the ``config.yaml`` of an rl_sar policy to the keys of a ``policy.yaml``, for `new`."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, FiniteFloat

from drake_safety.files.reading import parse_yaml, reading
from drake_safety.files.schema import load_typed
from drake_safety.policies.policy import TERMS, PolicyParameters

_TERMS = {
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
_KEYS = """model_name num_observations observations observations_history
observations_history_priority clip_obs clip_actions_lower clip_actions_upper rl_kp rl_kd num_of_dofs
action_scale wheel_indices lin_vel_scale ang_vel_scale dof_pos_scale dof_vel_scale commands_scale
default_dof_pos joint_names joint_mapping dt decimation framework hip_scale_reduction
hip_scale_reduction_indices
fixed_kp fixed_kd torque_limits joint_controller_names command_mapping state_mapping""".split()


def converted_policy(path: Path) -> dict[str, Any]:
    """Reads a ``config.yaml`` of rl_sar; the ``gait`` of its policy may lack a period."""
    with reading(path):
        file = _read(path)
        file.refuse(bool(file.raw.get("wheel_indices")), "wheels are not supported")
        count = int(file.number("num_of_dofs"))
        names = file.get("joint_names", list[str])
        if "joint_mapping" in file:
            names = [names[i] for i in file.indices("joint_mapping", len(names))]
        file.refuse(len(names) != count, f"it has {count} joints; got {len(names)} names: {names}")
        network = path.parent / str(file.get("model_name"))
        file.refuse(not network.is_file(), f"there is no network '{network.name}' beside it")
        scale = file.numbers("action_scale", count)
        if "hip_scale_reduction" in file:
            for i in file.indices("hip_scale_reduction_indices", count):
                scale[i] *= file.number("hip_scale_reduction")
        action_clip = math.inf
        if any(file.raw.get(f"clip_actions_{side}") for side in ("lower", "upper")):
            low, high = (file.numbers(f"clip_actions_{side}", count) for side in ("lower", "upper"))
            action_clip = high[0]
            file.refuse(
                {*high} | {-x for x in low} != {action_clip},
                f"limits of actions must be the same for all joints and signs; got {low}, {high}",
            )
        patterns = [re.escape(name) for name in names]
        positions = file.numbers("default_dof_pos", count)
        gains = zip(file.numbers("rl_kp", count), file.numbers("rl_kd", count), strict=True)
        servos = [{"stiffness": stiffness, "damping": damping} for stiffness, damping in gains]
        converted = {
            "network": str(network.resolve()),
            "joints": names,
            "default_positions": dict(zip(patterns, positions, strict=True)),
            "action_scale": dict(zip(patterns, scale, strict=True)),
            "action_clip": action_clip,
            "gains": dict(zip(patterns, servos, strict=True)),
            "period_s": file.number("dt") * file.number("decimation"),
            **_observation(file, count),
        }
        load_typed(PolicyParameters, converted, str(path))
    return converted


class _Entries:
    """The entries of a policy, with errors that name the file and the entry."""

    def __init__(self, raw: dict[str, Any], path: Path):
        self.raw, self.path = raw, path

    def refuse(self, is_wrong: bool, what: str) -> None:
        if is_wrong:
            raise ValueError(f"{self.path}: {what}")

    def __contains__(self, key: str) -> bool:
        return self.raw.get(key) is not None

    def get(self, key: str, kind: Any = Any) -> Any:
        """A value, of a type that pydantic checks."""
        self.refuse(key not in self, f"it has no '{key}'; it has {list(self.raw)}")
        return load_typed(kind, self.raw[key], f"{self.path}: '{key}'")

    def number(self, key: str) -> float:
        return float(self.get(key, FiniteFloat))

    def numbers(self, key: str, count: int) -> list[float]:
        """``count`` numbers, or one for all."""
        if not isinstance(self.get(key), list):
            return [self.number(key)] * count
        values = self.get(key, list[FiniteFloat])
        is_wrong = len(values) != count
        self.refuse(is_wrong, f"'{key}' must have {count} entries; got {len(values)}")
        return values

    def indices(self, key: str, below: int | None = None) -> list[int]:
        """Different integers from 0 on."""
        values = self.get(key, list[Annotated[int, Field(ge=0, lt=below)]])
        is_wrong = len(set(values)) != len(values)
        self.refuse(is_wrong, f"'{key}' must be different integers; got {values}")
        return values


def _read(path: Path) -> _Entries:
    """The entries of a policy, and those of its robot's ``base.yaml``, up to two folders above."""

    def parsed(file: Path) -> Any:
        return parse_yaml(file.read_text(encoding="utf-8"), f"'{file}'")

    sections = parsed(path)
    section, own = "", None
    if isinstance(sections, dict) and len(sections) == 1:
        ((section, own),) = sections.items()
    if not isinstance(own, dict) or "rl_kp" not in own:
        raise ValueError(f"'{path}' is not a config.yaml of rl_sar, with one policy: {sections}")
    bases = [folder / "base.yaml" for folder in (path.parent, *path.resolve().parents[1:3])]
    base = next(filter(Path.is_file, bases), None)
    robots = load_typed(dict[str, dict[str, Any]], parsed(base) if base else {}, f"'{base}'")
    robot = robots.get(str(section).partition("/")[0], {})
    file = _Entries(load_typed(dict[str, Any], {**robot, **own}, f"'{path}'"), path)
    unknown = [key for key in file.raw if key not in _KEYS]
    file.refuse(bool(unknown), f"it has unknown keys {unknown}")
    return file


def _observation(file: _Entries, count: int) -> dict[str, Any]:
    clip = file.number("clip_obs") if "clip_obs" in file else math.inf
    observation: list[dict[str, Any]] = []
    converted: dict[str, Any] = {"observation": observation}
    widths = []
    for name in file.get("observations", list[str]):
        term, key = _TERMS.get(name, (name, ""))
        if name not in TERMS and re.fullmatch(r"(?!.*mimic)\w+_phase", name):
            # Its period is in the project's code.
            term = "gait_phase"
            converted["gait"] = {"offsets": [0.0], "standing_below": 0.0}
        widths.append(_width(term, count))
        entry = {"name": term, "clip": clip}
        if key:
            scale = file.numbers(key, widths[-1])
            entry["scale"] = scale[:1] if len(set(scale)) == 1 else scale
        observation.append(entry)
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


def _width(term: str, count: int) -> int:
    """Entries of a term of a policy with ``count`` joints; 0 for terms of users."""
    three = ("base_lin_vel", "base_ang_vel", "projected_gravity", "velocity_commands")
    per_joint = ("joint_pos_rel", "joint_vel_rel", "last_action")
    return 3 * (term in three) + count * (term in per_joint) + 2 * (term == "gait_phase")
