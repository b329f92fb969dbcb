"""Reads ``policy.yaml`` for a robot, and says what it lacks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.policy import Policy, PolicyParameters, network_file, registered_terms
from drake_safety.control.policy_network import load_network
from drake_safety.robots.robot_model import RobotModel, by_pattern, load_typed_file


def read_policy_file(path: Path) -> PolicyParameters:
    """Reads a ``policy.yaml``.

    Raises:
        ValueError: The file does not exist, is not YAML, or does not fit the schema.
    """
    return load_typed_file(PolicyParameters, path, f"policy file '{path}'")


def load_policy(path: Path, kinematics: RobotKinematics) -> Policy:
    """Loads a policy for a robot.

    Args:
        path: The ``policy.yaml``.
        kinematics: The robot.

    Raises:
        MissingExtraError: The package that has the network is not installed.
        ValueError: The file does not fit the schema, the robot or the network.
    """
    return Policy(
        read_policy_file(path),
        kinematics.joint_names,
        robot=kinematics.robot.name,
        folder=str(path.parent),
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
        path: The ``policy.yaml``.
        joint_names: Joints of the robot.

    Raises:
        ValueError: A file that it needs is missing or wrong.
    """
    parameters = read_policy_file(path)
    network = load_network(network_file(parameters, str(path.parent)))
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
