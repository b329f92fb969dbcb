"""Writes the first ``policy.yaml`` of a new robot, as far as the files of a policy tell."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from drake_safety.files.atomic import write_file
from drake_safety.files.reading import yaml_text
from drake_safety.importing.foreign_policy import converted_policy
from drake_safety.policies import policy_network
from drake_safety.policies.policy import TERMS
from drake_safety.robots.robot_model import as_pattern


@dataclass(kw_only=True)
class PolicyTemplate:
    """The statements of a policy's files."""

    network: policy_network.PolicyNetwork
    stated: dict[str, Any] = field(default_factory=dict)  # By key of ``policy.yaml``.
    source: str = ""

    @property
    def joints(self) -> list[str]:
        """The joints that the policy moves, in its order; empty if no file names them."""
        return self.stated.get("joints") or self.network.metadata.joints

    def write(
        self, folder: Path, robot_joints: list[str], posture: dict[str, float]
    ) -> tuple[list[Path], list[str]]:
        """Writes ``policy.yaml`` into a robot's folder, and copies the network's files there."""
        text, asked = self.yaml(robot_joints, posture)
        written = []
        for source in policy_network.network_files(self.network.path):
            written.append(folder / source.relative_to(self.network.path.parent))
            write_file(written[-1], source.read_bytes())
        path = folder / "policy.yaml"
        write_file(path, text)
        return [*written, path], asked

    def yaml(self, robot_joints: list[str], posture: dict[str, float]) -> tuple[str, list[str]]:
        """Returns the text of ``policy.yaml``, and what the user must supply."""
        metadata, known = self.network.metadata, dict(self.stated)
        lines, asked = list[str](), list[str]()

        def ask(line: str, what: str) -> None:
            lines.append(f"# {line}  # ASK {what}")
            asked.append(what)

        missing = [name for name in self.joints if name not in robot_joints]
        width, num_moved = self.network.widths
        observed, what = list[str](), ""
        if missing:
            what = f"the robot's joints in the network's order; {missing} are none of them"
        elif not self.joints:
            what = "the joints that the network moves, in its order"
        elif num_moved not in (None, len(self.joints)):
            observed = self.joints
            what = f"the {num_moved} joints that it moves, in its order, of the {len(observed)} "
            what += "that it names, which joint_pos_rel and joint_vel_rel observe"
        if what:
            known.pop("joints", None)
            ask(f"joints: [{', '.join(map(yaml_text, observed or robot_joints))}]", what)
        angles = [f"{yaml_text(as_pattern(name))}: {q:g}" for name, q in posture.items() if q]
        said = vars(metadata) | {"gains": metadata.stiffness and metadata.damping} | known
        servo, units = "{.*: {stiffness: 20.0, damping: 0.5}}", "[N·m/rad, N·m·s/rad]"
        zero = f"{{{', '.join(angles)}}}"
        for key, example, what in (
            ("default_positions", zero, "joint positions at zero action [rad]"),
            ("action_scale", "{.*: 0.25}", "joint positions per unit of action [rad]"),
            ("gains", servo, f"the servos' gains of training {units}"),
        ):
            if not said[key]:
                ask(f"{key}: {example}", what)
        lines.append("# rotor_inertia: {.*: 0.01}  # that of training, if it had any [kg·m²]")
        if "action_clip" not in known:
            ask("action_clip: 1.0", "the limit of actions in training, if any")
        if len(self.network.outputs) > 1:
            asked.append(f"its outputs are {self.network.outputs}: the first is the action")
        if "period_s" not in known:
            lines.append("period_s: 0.02  # ASK the time between two actions [s]")
            asked.append("the time between two actions [s]; 0.02 is assumed")
        if metadata.observation and "observation" not in known:
            without = {"name": "", "clip": math.inf}
            known["observation"] = [without | term for term in metadata.observation]
            for term in known["observation"] if observed else []:
                if term["name"] in ("joint_pos_rel", "joint_vel_rel"):
                    term["joints"] = [*observed]
            unstated = [k for k in ("scale", "history") if k not in metadata.observation[0]]
            if unstated:
                what = f"{' and '.join(unstated)} of the terms of the observation"
                asked.append(f"{what}; 1 is assumed")
        if "observation" not in known:
            entries = "" if width is None else f", {width} entries"
            ask("observation:", f"the terms of the network's input in its order{entries}")
            lines += [
                "#   - {name: base_ang_vel, scale: [0.25]}",
                "#   - {name: projected_gravity}",
                "#   - {name: velocity_commands}",
                f"# registered terms: {', '.join(sorted(TERMS))}",
            ]
        terms = {term["name"] for term in known.get("observation", [])}
        if unknown := sorted(terms - set(TERMS)):
            asked.append(f"functions of the terms {unknown}, by @observation_term")
        if "gait" in known and "period_s" not in known["gait"]:
            gait = {"period_s": 0.8, **known.pop("gait")}
            ask(f"gait: {gait}".replace("'", ""), "the period of the gait's clock [s]")
        if "command" not in known:
            what = "the ranges of commands in training [m/s, m/s, rad/s]"
            lines += [f"command:  # ASK {what}", "  lowest: [-1.0, -1.0, -1.0]"]
            lines.append("  highest: [1.0, 1.0, 1.0]")
            asked.append(f"{what}; ±1 is assumed")
        head = [
            f"# Written from {self.source}. Commented lines marked ASK have values that it lacks:",
            "# correct them, and delete the sign. docs/walking.md has all keys.",
            f"network: {self.network.path.name}",
        ]
        if known:
            text = yaml.safe_dump(known, default_flow_style=None, sort_keys=False, width=100)
            head.append(text.rstrip())
        asked = [f"policy.yaml: {what}" for what in (*asked, *metadata.unread)]
        return "\n".join([*head, *lines]) + "\n", asked


def survey_policy(
    path: Path, motors: Sequence[str] = (), announce: Callable[[str], object] = lambda text: None
) -> PolicyTemplate:
    """Reads a network or another project's file; announces what a network is before it is run."""
    is_described = path.suffix in (".yaml", ".yml")
    converted = converted_policy(path, motors) if is_described else {}
    file = Path(converted.pop("network", path))
    for text in policy_network.network_kinds([file]):
        announce(text)
    network = policy_network.load_network(file)
    return PolicyTemplate(network=network, stated=converted, source=path.name)
