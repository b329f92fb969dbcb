"""What a URDF says of the drives of its joints: couplings, motors and springs."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from drake_safety.robots.urdf_copy import MOVABLE, as_number, number


@dataclass(frozen=True, kw_only=True)
class JointDrives:
    """Drives of the joints of a URDF.

    Attributes:
        mimics: Coupled joints: the joint that each follows, multiplier and offset [rad, m].
        listed: Joints with a transmission (ROS 1) or a command interface (``<ros2_control>``).
        springs: Stiffness of joints with a spring [N·m/rad].
        efforts: Effort limits [N·m]; NaN without one.
    """

    mimics: dict[str, tuple[str, float, float]] = field(default_factory=dict)
    listed: set[str] = field(default_factory=set)
    springs: dict[str, float] = field(default_factory=dict)
    efforts: dict[str, float] = field(default_factory=dict)

    def passive(self, names: Collection[str]) -> dict[str, str]:
        """Returns those of some joints that have no motor, and the evidence."""
        listed = self.listed.intersection(names)
        has_efforts = any(self.efforts[name] > 0 for name in names)
        found = {}
        for name in names:
            evidence = []
            if listed and name not in listed:
                evidence.append("no transmission, as others have")
            if not listed and has_efforts and self.efforts[name] == 0:
                evidence.append('effort="0"')
            if name in self.springs and name not in listed and len(self.springs) < len(names):
                evidence.append(f"a spring of {self.springs[name]:g} N·m/rad")
            if evidence:
                found[name] = ", ".join(evidence)
        return found

    def coupled(self, positions: Mapping[str, float]) -> dict[str, float]:
        """Returns joint positions in which coupled joints follow the others [rad, m]."""
        found = dict(positions)
        for _ in self.mimics:  # They may follow each other.
            for name, (leader, multiplier, offset) in self.mimics.items():
                if name in found and leader in found:
                    found[name] = multiplier * found[leader] + offset
        return found


def read_drives(root: ET.Element) -> JointDrives:
    """Reads the drives of a URDF, also those that only Gazebo and ROS know."""
    movable = [joint for joint in root.findall("joint") if joint.get("type") in MOVABLE]
    joints = {joint.get("name", ""): joint for joint in movable}
    listed = {one.get("name", "") for one in root.findall("transmission//joint")}
    listed |= {one.get("name", "") for one in root.findall("ros2_control/joint[command_interface]")}
    stated: dict[str, Mapping[str, str | None]] = {}  # Couplings; <mimic> comes last.
    for plugin in root.findall("gazebo/plugin[mimicJoint]"):
        one = {part.tag: part.text for part in plugin}
        stated[(one.get("joint") or "").strip()] = one | {"joint": one["mimicJoint"]}
    for joint in root.findall("ros2_control/joint"):
        one = {part.get("name", ""): part.text for part in joint.findall("param")}
        if "mimic" in one:
            stated[joint.get("name", "")] = one | {"joint": one["mimic"]}
    for name, joint in joints.items():
        for mimic in joint.findall("mimic"):
            stated[name] = mimic.attrib
    springs = {name: _stiffness(joint) for name, joint in joints.items()}
    for gazebo in root.findall("gazebo"):
        name = gazebo.get("reference", "")
        springs[name] = max(springs.get(name, 0.0), _stiffness(gazebo))
    return JointDrives(
        mimics={
            name: (
                (one.get("joint") or "").strip(),
                as_number(one.get("multiplier"), 1.0),
                as_number(one.get("offset"), 0.0),
            )
            for name, one in stated.items()
            if name in joints
        },
        listed=listed,
        springs={name: springs[name] for name in joints if springs[name] > 0},
        efforts={name: number(one.find("limit"), "effort") for name, one in joints.items()},
    )


def _stiffness(element: ET.Element) -> float:
    """The largest, whatever they are called: springStiffness, spring_stiffness, stiffness."""
    return max(
        (
            as_number(value, 0.0)
            for part in element.iter()
            for key, value in {**part.attrib, part.tag: part.text}.items()
            if "stiffness" in key.lower()
        ),
        default=0.0,
    )
