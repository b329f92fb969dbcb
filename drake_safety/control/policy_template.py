"""Writes the first ``policy.yaml`` of a new robot, as far as the files of a policy tell."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drake_safety.control.policy_files import read_foreign
from drake_safety.control.policy_network import PolicyNetwork, load_network
from drake_safety.control.policy_terms import registered_terms

_NETWORKS = (".onnx", ".pt", ".jit")


@dataclass(kw_only=True)
class PolicyTemplate:
    """What the files of a policy tell.

    Attributes:
        network: The network.
        source: File of another project that describes it; None for a network alone.
        found: What that file says, by key of ``policy.yaml``.
        further: Files that belong to it.
        joints: The joints that the policy moves, in its order; empty if no file names them.
    """

    network: PolicyNetwork
    source: Path | None = None
    found: dict[str, Any] = field(default_factory=dict)
    further: list[Path] = field(default_factory=list)
    joints: list[str] = field(default_factory=list)

    def write(
        self, folder: Path, robot_joints: list[str], posture: dict[str, float]
    ) -> tuple[list[Path], list[str]]:
        """Writes ``policy.yaml`` into a robot's folder, and copies the policy's files there.

        Args:
            folder: The folder.
            robot_joints: The robot's joints.
            posture: Its standing posture [rad].

        Returns:
            The files, and what the user must supply.
        """
        written = []
        for path in (self.network.path, *([self.source] if self.source else []), *self.further):
            written.append(folder / path.name)
            shutil.copyfile(path, written[-1])
        text, asked = self.yaml(robot_joints, posture)
        path = folder / "policy.yaml"
        path.write_text(text, encoding="utf-8")
        return [*written, path], asked

    def yaml(self, robot_joints: list[str], posture: dict[str, float]) -> tuple[str, list[str]]:
        """Returns the text of ``policy.yaml``, and what the user must supply.

        Args:
            robot_joints: The robot's joints.
            posture: Its standing posture [rad].
        """
        lines = [
            "# Written from the policy's files. Commented lines marked ASK have values that these",
            "# lack: correct them, and delete the sign. docs/walking.md has all keys.",
        ]
        if self.source is not None:
            lines.append(f"read: {self.source.name}  # what is stated here wins")
        lines.append(f"network: {self.network.path.name}")
        asked: list[str] = []

        def ask(line: str, what: str) -> None:
            lines.append(f"# {line}  # ASK {what}")
            asked.append(f"policy.yaml: {what}")

        missing = [name for name in self.joints if name not in robot_joints]
        names = f"[{', '.join(robot_joints)}]"
        if missing:
            ask(
                f"joints: {names}",
                f"the robot's joints in the network's order; its own {missing} are none of them",
            )
        elif not self.joints and self.source is not None:
            ask(f"motors: {names}", "the joints in the order of the robot's motors")
        elif not self.joints:
            ask(f"joints: {names}", "the joints that the network moves, in its order")
        self._ask_of_joints(ask, posture)
        lines.append("# rotor_inertia: {.*: 0.01}  # that of training, if it had any [kg·m²]")
        if "period_s" not in self.found:
            lines.append("period_s: 0.02  # ASK the time between two actions [s]")
            asked.append("policy.yaml: the time between two actions [s]; 0.02 is assumed")
        if "observation" not in self.found:
            width, _ = self.network.widths
            entries = "" if width is None else f", {width} entries"
            ask("observation:", f"the terms of the network's input in its order{entries}")
            lines += [
                "#   - {name: base_ang_vel, scale: [0.25]}",
                "#   - {name: projected_gravity}",
                "#   - {name: velocity_commands}",
                f"# registered terms: {', '.join(registered_terms())}",
            ]
        if "command" not in self.found:
            lines += self._command(asked)
        return "\n".join(lines) + "\n", asked

    def _ask_of_joints(self, ask: Any, posture: dict[str, float]) -> None:
        metadata, found = self.network.metadata, self.found
        if not metadata.default_positions and "default_positions" not in found:
            values = ", ".join(f"{name}: {value:g}" for name, value in posture.items() if value)
            ask(f"default_positions: {{{values}}}", "joint positions at zero action [rad]")
        if not metadata.action_scale and "action_scale" not in found:
            ask("action_scale: {.*: 0.25}", "joint positions per unit of action [rad]")
        if not metadata.stiffness and "stiffness" not in found:
            ask(
                "gains: {.*: {stiffness: 20.0, damping: 0.5}}",
                "the servos' gains of training [N·m/rad, N·m·s/rad]",
            )

    def _command(self, asked: list[str]) -> list[str]:
        ranges = self.network.metadata.command
        yaw = "ang_vel_z" if "ang_vel_z" in ranges else "ang_vel_yaw"
        keys = ("lin_vel_x", "lin_vel_y", yaw)
        ask = ""
        pairs: list[list[float]] = [[-1.0, 1.0]] * 3
        if all(key in ranges for key in keys):
            pairs = [ranges[key] for key in keys]
        else:
            what = "the ranges of commands in training [m/s, m/s, rad/s]"
            ask = f"  # ASK {what}"
            asked.append(f"policy.yaml: {what}; ±1 is assumed")
        lowest, highest = ([float(pair[i]) for pair in pairs] for i in (0, 1))
        return [f"command:{ask}", f"  lowest: {lowest}", f"  highest: {highest}"]


def survey_policy(path: Path) -> PolicyTemplate:
    """Reads what the files of a policy tell.

    Args:
        path: A network (``.onnx``, ``.pt``, ``.jit``), a ``deploy.yaml`` of unitree_rl_lab or a
            ``config.yaml`` of rl_sar.

    Raises:
        ValueError: The file is none of these, or one that it names cannot be read.
    """
    path = Path(path)
    if path.suffix in _NETWORKS:
        network = load_network(path)
        return PolicyTemplate(network=network, joints=network.metadata.joints)
    found, further = read_foreign(path)
    network = load_network(Path(found["network"]))
    return PolicyTemplate(
        network=network,
        source=path,
        found=found,
        further=further,
        joints=found.get("joints") or network.metadata.joints,
    )
