"""Reads ``policy.yaml``, and the files of other projects that it names."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from drake_safety.control.isaac_lab_policy import from_isaac_lab, is_isaac_lab
from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.policy import (
    Policy,
    PolicyParameters,
    network_file,
    registered_terms,
)
from drake_safety.control.policy_network import load_network
from drake_safety.control.rl_sar_policy import from_rl_sar, is_rl_sar
from drake_safety.robots.model_files import model_file
from drake_safety.robots.reading import parse_yaml, reading
from drake_safety.robots.robot_model import RobotModel, by_pattern, load_typed


class _Loader(yaml.SafeLoader):
    """Reads Python's slices and tuples, which exporters write, as lists; a slice of all as null."""


def _slice(loader: _Loader, node: yaml.SequenceNode) -> list[Any] | None:
    ends = loader.construct_sequence(node)
    return None if set(ends) == {None} else ends


_Loader.add_constructor("tag:yaml.org,2002:python/object/apply:builtins.slice", _slice)
_Loader.add_constructor("tag:yaml.org,2002:python/tuple", _Loader.construct_sequence)

_MERGED = ("gait", "command")
"""Keys of which single entries may be stated."""


@dataclass(kw_only=True)
class PolicyFile:
    """A policy file with what it reads.

    Attributes:
        parameters: Contents of ``policy.yaml``, with values of the files that it reads.
        files: The files that determine the policy, without the network.
        folder: Folder of the policy file.
    """

    parameters: PolicyParameters
    files: list[Path]
    folder: str

    @property
    def network(self) -> Path:
        """The network's file; see :func:`network_file` for errors."""
        return network_file(self.parameters, self.folder)


def read_policy_file(path: Path, joint_names: list[str] | None = None) -> PolicyFile:
    """Reads a ``policy.yaml``, a ``deploy.yaml`` of unitree_rl_lab or a ``config.yaml`` of rl_sar.

    A ``policy.yaml`` may name one of the others by ``read``; what it states itself wins.

    Args:
        path: The file.
        joint_names: Joints of the robot, for messages.

    Raises:
        MissingExtraError: A package that has a file is not installed.
        ValueError: A file does not exist, is not YAML, does not fit the schema or its form, or does
            not say which joints the network moves.
    """
    path = Path(path)
    raw = _parsed(path, f"policy file '{path}'")
    files, folder, who = [path], str(path.parent), f"policy file '{path}'"
    source = path if is_isaac_lab(raw) or is_rl_sar(raw) else None
    stated: Any = {} if source else raw
    if isinstance(stated, dict) and stated.get("read"):
        source = model_file(str(stated["read"]), folder, str(stated.get("requires", "")))
        files.append(source)
    if source is not None:
        # Unknown keys and values of wrong types are told before anything is read.
        own = load_typed(PolicyParameters, stated, who)
        with reading(source):
            found, more = read_foreign(source, set(stated) - set(_MERGED), own.motors)
            files += more
            stated = _merged(stated, found, source, folder, joint_names)
    return PolicyFile(
        parameters=load_typed(PolicyParameters, stated, who), files=files, folder=folder
    )


def load_policy(path: Path, kinematics: RobotKinematics) -> Policy:
    """Loads a policy for a robot.

    Args:
        path: A file for :func:`read_policy_file`.
        kinematics: The robot.

    Raises:
        ValueError: The file does not fit the schema, the robot or the network.
    """
    found = read_policy_file(path, kinematics.joint_names)
    return Policy(
        found.parameters,
        kinematics.joint_names,
        robot=kinematics.robot.name,
        folder=found.folder,
    )


def with_policy(robot: RobotModel, policy: Policy, joint_names: list[str]) -> RobotModel:
    """A robot with the gains, rotor inertias and posture of a policy.

    Args:
        robot: The robot.
        policy: The policy.
        joint_names: The robot's joints, in the order of the policy's default positions.
    """
    posture = dict(zip(joint_names, policy.default_positions.tolist(), strict=True))
    inertia = policy.parameters.rotor_inertia
    return replace(
        robot,
        posture=posture,
        joint_gains={**policy.gains},
        rotor_inertia=inertia or robot.rotor_inertia,
    )


def missing_entries(path: Path, joint_names: list[str]) -> Iterator[tuple[str, str]]:
    """What a policy file lacks for a robot, each with its remedy.

    Args:
        path: A file for :func:`read_policy_file`.
        joint_names: Joints of the robot.

    Raises:
        ValueError: A file that it needs is missing or wrong.
    """
    found = read_policy_file(path, joint_names)
    parameters, network = found.parameters, load_network(found.network)
    metadata = network.metadata
    names = parameters.joints or metadata.joints
    if not names:
        yield (
            "the network does not name its joints",
            f"state 'joints' in its order in {path.name}; the robot has {joint_names}",
        )
    for key, of_network, what in (
        ("action_scale", metadata.action_scale, "joint positions per unit of action [rad]"),
        ("gains", metadata.stiffness, "stiffness and damping [N·m/rad, N·m·s/rad]"),
    ):
        patterns = getattr(parameters, key)
        without = [
            name
            for name in names or joint_names
            if by_pattern(patterns, name, key, "") is None
            and not (of_network and name in metadata.joints)
        ]
        if without:
            yield (
                f"no {key} for joints {without}",
                f"state '{key}' in {path.name} by regular expression: {what}",
            )
    if not parameters.default_positions and not metadata.default_positions:
        yield (
            "no default_positions",
            f"state the joint positions at zero action [rad] in {path.name}; {{.*: 0.0}} if they "
            "are zero",
        )
    if not parameters.observation:
        width, _ = network.widths
        expected = "" if width is None else f", {width} entries in all"
        yield (
            "no observation",
            f"list the terms of the network's input under 'observation' in {path.name}, in its "
            f"order{expected}; registered are {registered_terms()}",
        )


def _parsed(path: Path, who: str) -> Any:
    if not path.is_file():
        raise ValueError(f"{who} does not exist")
    with reading(path):
        return parse_yaml(path.read_text(encoding="utf-8"), who, _Loader)


def read_foreign(
    path: Path, stated: Collection[str] = (), motors: list[str] | None = None
) -> tuple[dict[str, Any], list[Path]]:
    """Reads a policy's file of another project.

    Args:
        path: A ``deploy.yaml`` of unitree_rl_lab or a ``config.yaml`` of rl_sar.
        stated: Keys of ``policy.yaml`` whose values are not read here.
        motors: Names of the robot's motors in their order.

    Returns:
        Values for the keys of ``policy.yaml``, as those of :func:`from_isaac_lab`, and the further
        files that were read.

    Raises:
        ValueError: The file does not exist, is neither of both, or has entries of another form or
            width, or ones that cannot be supported.
    """
    raw = _parsed(path, f"'{path}', which the policy reads,")
    if is_isaac_lab(raw):
        return from_isaac_lab(raw, path, stated, motors or []), []
    if is_rl_sar(raw):
        folders = [path.parent, *path.resolve().parents[1:3]]
        bases = (folder / "base.yaml" for folder in folders)
        base = next((one for one in bases if one.is_file()), None)
        if base is None:
            return from_rl_sar(raw, path, stated), []
        return from_rl_sar(raw, path, stated, _parsed(base, f"'{base}'")), [base]
    keys = list(raw) if isinstance(raw, dict) else raw
    raise ValueError(
        f"'{path}' is neither a deploy.yaml of unitree_rl_lab (joint_ids_map, observations, ...) "
        f"nor a config.yaml of rl_sar (rl_kp, num_observations, ...); its keys are {keys}"
    )


def _merged(
    stated: dict[str, Any],
    found: dict[str, Any],
    source: Path,
    folder: str,
    joint_names: list[str] | None,
) -> dict[str, Any]:
    """The keys of ``policy.yaml``: as stated, else as found."""
    found = dict(found)
    count = found.pop("num_joints")
    network = stated.get("network") or found.get("network", "")
    names = stated.get("joints") or found.pop("joints", [])
    if not names:
        of_network = PolicyParameters(network=network, requires=stated.get("requires", ""))
        names = load_network(network_file(of_network, folder)).metadata.joints
    if not names:
        exists = f"; the robot has {joint_names}" if joint_names else ""
        raise ValueError(
            f"'{source}' does not name its joints, nor does the network. State in policy.yaml "
            "'motors', the joints in the order of the robot's motors, or 'joints', those in the "
            f"network's order{exists}"
        )
    if len(names) != count:
        raise ValueError(f"'{source}' has {count} joints; got {len(names)} names: {names}")
    keys = [re.escape(name) for name in names]
    values: dict[str, Any] = {"joints": list(names)}
    for key, value in found.items():
        if key in ("default_positions", "action_scale"):
            value = dict(zip(keys, value, strict=True))
        elif key in _MERGED:
            value = {**value, **(stated.get(key) or {})}
        if key not in ("stiffness", "damping"):
            values[key] = value
    if "stiffness" in found:
        values["gains"] = {
            key: {"stiffness": stiffness, "damping": damping}
            for key, stiffness, damping in zip(
                keys, found["stiffness"], found["damping"], strict=True
            )
        }
    merged = {**values, **{key: value for key, value in stated.items() if key not in _MERGED}}
    merged |= {key: stated[key] for key in _MERGED if key in stated and key not in values}
    uses_clock = any(term.get("name") == "gait_phase" for term in merged.get("observation", ()))
    if uses_clock and not (merged.get("gait") or {}).get("period_s"):
        raise ValueError(
            f"'{source}' has a gait clock without a period; state it in policy.yaml: "
            "gait: {period_s: ...} [s]"
        )
    return merged
