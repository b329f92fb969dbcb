"""Writes the first ``policy.yaml`` of a new robot, as far as the files of a policy tell."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from drake_safety.files.atomic import write_file
from drake_safety.files.reading import yaml_text
from drake_safety.importing.foreign_policy import converted_policy
from drake_safety.policies.policy import registered_terms
from drake_safety.policies.policy_network import (
    PolicyNetwork,
    load_network,
    network_files,
    network_kinds,
)
from drake_safety.robots.robot_model import as_pattern


@dataclass(kw_only=True)
class PolicyTemplate:
    """What the files of a policy tell.

    Attributes:
        found: What a file of another project says, by key of ``policy.yaml``.
    """

    network: PolicyNetwork
    found: dict[str, Any] = field(default_factory=dict)
    source: str = ""

    @property
    def joints(self) -> list[str]:
        """The joints that the policy moves, in its order; empty if no file names them."""
        return self.found.get("joints") or self.network.metadata.joints

    def write(
        self, folder: Path, robot_joints: list[str], posture: dict[str, float]
    ) -> tuple[list[Path], list[str]]:
        """Writes ``policy.yaml`` into a robot's folder, and copies the network's files there."""
        text, asked = self.yaml(robot_joints, posture)
        written = []
        for source in network_files(self.network.path):
            written.append(folder / source.relative_to(self.network.path.parent))
            write_file(written[-1], source.read_bytes())
        path = folder / "policy.yaml"
        write_file(path, text)
        return [*written, path], asked

    def yaml(self, robot_joints: list[str], posture: dict[str, float]) -> tuple[str, list[str]]:
        """Returns the text of ``policy.yaml``, and what the user must supply."""
        metadata, found = self.network.metadata, dict(self.found)
        lines: list[str] = []
        asked: list[str] = []

        def ask(line: str, what: str) -> None:
            lines.append(f"# {line}  # ASK {what}")
            asked.append(what)

        names = f"joints: [{', '.join(map(yaml_text, robot_joints))}]"
        missing = [name for name in self.joints if name not in robot_joints]
        if missing:
            found.pop("joints", None)
            ask(names, f"the robot's joints in the network's order; {missing} are none of them")
        _, num_moved = self.network.widths
        observed = self.joints if num_moved not in (None, len(self.joints)) else []
        if observed and not missing:
            found.pop("joints", None)
            names = f"joints: [{', '.join(map(yaml_text, observed))}]"
            what = f"the {num_moved} joints that it moves, in its order, of the {len(observed)} "
            ask(names, f"{what}that it names, which joint_pos_rel and joint_vel_rel observe")
        elif not self.joints:
            ask(names, "the joints that the network moves, in its order")
        keys = {yaml_text(as_pattern(name)): value for name, value in posture.items() if value}
        values = ", ".join(f"{key}: {value:g}" for key, value in keys.items())
        said = vars(metadata) | {"gains": metadata.stiffness and metadata.damping} | found
        for line, what in (
            (f"default_positions: {{{values}}}", "joint positions at zero action [rad]"),
            ("action_scale: {.*: 0.25}", "joint positions per unit of action [rad]"),
            (
                "gains: {.*: {stiffness: 20.0, damping: 0.5}}",
                "the servos' gains of training [N·m/rad, N·m·s/rad]",
            ),
        ):
            if not said[line.partition(":")[0]]:
                ask(line, what)
        lines.append("# rotor_inertia: {.*: 0.01}  # that of training, if it had any [kg·m²]")
        if "action_clip" not in found:
            ask("action_clip: 1.0", "the limit of actions in training, if any")
        if len(self.network.outputs) > 1:
            asked.append(f"its outputs are {self.network.outputs}: the first is the action")
        if "period_s" not in found:
            lines.append("period_s: 0.02  # ASK the time between two actions [s]")
            asked.append("the time between two actions [s]; 0.02 is assumed")
        if metadata.observation and "observation" not in found:
            without = {"name": "", "clip": math.inf}
            found["observation"] = [without | term for term in metadata.observation]
            for term in found["observation"] if observed else []:
                if term["name"] in ("joint_pos_rel", "joint_vel_rel"):
                    term["joints"] = [*observed]
            unstated = [k for k in ("scale", "history") if k not in metadata.observation[0]]
            if unstated:
                what = f"{' and '.join(unstated)} of the terms of the observation"
                asked.append(f"{what}; 1 is assumed, as the network only names them")
        if "observation" not in found:
            width, _ = self.network.widths
            entries = "" if width is None else f", {width} entries"
            ask("observation:", f"the terms of the network's input in its order{entries}")
            lines += [
                "#   - {name: base_ang_vel, scale: [0.25]}",
                "#   - {name: projected_gravity}",
                "#   - {name: velocity_commands}",
                f"# registered terms: {', '.join(registered_terms())}",
            ]
        stated = {term["name"] for term in found.get("observation", [])}
        if unknown := sorted(stated - set(registered_terms())):
            asked.append(f"functions of the terms {unknown}, by @observation_term")
        if "gait" in found and "period_s" not in found["gait"]:
            gait = {"period_s": 0.8, **found.pop("gait")}
            ask(f"gait: {gait}".replace("'", ""), "the period of the gait's clock [s]")
        if "command" not in found:
            ranges, words = metadata.command, ""
            yaw = "ang_vel_z" if "ang_vel_z" in ranges else "ang_vel_yaw"
            pairs = [ranges.get(key) for key in ("lin_vel_x", "lin_vel_y", yaw)]
            if None in pairs:
                what = "the ranges of commands in training [m/s, m/s, rad/s]"
                pairs, words = [[-1.0, 1.0]] * 3, f"  # ASK {what}"
                asked.append(f"{what}; ±1 is assumed")
            lowest, highest = ([pair[i] for pair in pairs if pair] for i in (0, 1))
            lines += [f"command:{words}", f"  lowest: {lowest}", f"  highest: {highest}"]
        head = [
            f"# Written from {self.source}. Commented lines marked ASK have values that it lacks:",
            "# correct them, and delete the sign. docs/walking.md has all keys.",
            f"network: {self.network.path.name}",
        ]
        if found:
            text = yaml.safe_dump(found, default_flow_style=None, sort_keys=False, width=100)
            head.append(text.rstrip())
        asked = [f"policy.yaml: {what}" for what in (*asked, *metadata.unread)]
        return "\n".join([*head, *lines]) + "\n", asked


def survey_policy(
    path: Path, motors: Sequence[str] = (), announce: Callable[[str], object] = lambda text: None
) -> PolicyTemplate:
    """Reads what the files of a policy tell.

    Args:
        path: A network (``.onnx``, ``.pt``, ``.jit``), a ``deploy.yaml`` of unitree_rl_lab or a
            ``config.yaml`` of rl_sar.
        motors: Joints in the order of the robot's motors, which a ``deploy.yaml`` numbers.
        announce: Called with what the network is, before it is loaded.
    """
    is_described = path.suffix in (".yaml", ".yml")
    found = converted_policy(path, motors) if is_described else {}
    file = Path(found.pop("network", path))
    for text in network_kinds([file]):
        announce(text)
    return PolicyTemplate(network=load_network(file), found=found, source=path.name)
