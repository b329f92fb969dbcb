"""Check of a policy's files before a diagram is built."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.policy_files import load_policy, missing_entries
from drake_safety.simulation.contract import Finding, failed, passed


def policy_findings(path: Path, kinematics: RobotKinematics) -> Iterator[Finding]:
    """Checks that a policy's files say all that a robot needs, and fit it.

    An error in the files is a finding, never an exception.

    Args:
        path: The policy file.
        kinematics: The robot.

    Yields:
        One finding for each entry that is missing, or one for all.
    """
    try:
        missing = list(missing_entries(path, kinematics.joint_names))
        for what, remedy in missing:
            yield failed("policy", what, remedy)
        if not missing:
            policy = load_policy(path, kinematics)
            yield passed(
                "policy",
                f"{len(policy.joint_names)} joints, {sum(policy.sizes)} entries of observation",
            )
    except ValueError as error:
        yield failed("policy", str(error), f"correct what the message names, or {path.name}")
