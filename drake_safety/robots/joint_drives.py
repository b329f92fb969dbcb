"""What a URDF says of the drives of its joints: couplings, motors and springs."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

from drake_safety.robots.urdf_copy import number


@dataclass(frozen=True, kw_only=True)
class JointDrives:
    """Drives of the joints of a URDF.

    Attributes:
        mimics: Coupled joints: the joint that each follows, multiplier and offset [rad, m].
        listed: Joints with a transmission (ROS 1) or a command interface (``<ros2_control>``).
        springs: Stiffness of joints with a spring [N·m/rad].
        efforts: Effort limits [N·m]; NaN without one.
    """

    mimics: dict[str, tuple[str, float, float]]
    listed: set[str]
    springs: dict[str, float]
    efforts: dict[str, float]

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
    joints = {
        joint.get("name", ""): joint
        for joint in root.findall("joint")
        if joint.get("type") in ("revolute", "continuous", "prismatic")
    }
    listed = {one.get("name", "") for one in root.findall("transmission//joint")}
    listed |= {one.get("name", "") for one in root.findall("ros2_control/joint[command_interface]")}
    springs = {}
    for name, joint in joints.items():
        gazebo = [one for one in root.findall("gazebo") if one.get("reference") == name]
        springs[name] = max((k for one in (joint, *gazebo) for k in _stiffness(one)), default=0.0)
    return JointDrives(
        mimics={
            name: (
                str(stated["joint"]).strip(),
                _number(stated.get("multiplier"), 1.0),
                _number(stated.get("offset"), 0.0),
            )
            for name, stated in _couplings(root, joints)
            if name in joints
        },
        listed=listed,
        springs={name: stiffness for name, stiffness in springs.items() if stiffness > 0},
        efforts={name: number(one.find("limit"), "effort") for name, one in joints.items()},
    )


def _couplings(
    root: ET.Element, joints: Mapping[str, ET.Element]
) -> Iterator[tuple[str, Mapping[str, str | None]]]:
    """Couplings by Gazebo's plugins, ``<ros2_control>`` and ``<mimic>``, which comes last."""
    for plugin in root.findall("gazebo/plugin[mimicJoint]"):
        stated = {one.tag: one.text for one in plugin}
        yield (plugin.findtext("joint") or "").strip(), stated | {"joint": stated["mimicJoint"]}
    for joint in root.findall("ros2_control/joint"):
        stated = {one.get("name", ""): one.text for one in joint.findall("param")}
        if "mimic" in stated:
            yield joint.get("name", ""), stated | {"joint": stated["mimic"]}
    for name, joint in joints.items():
        mimic = joint.find("mimic")
        if mimic is not None:
            yield name, {"joint": "", **mimic.attrib}


def _stiffness(element: ET.Element) -> Iterator[float]:
    """Stiffnesses, whatever they are called: springStiffness, spring_stiffness, stiffness."""
    for part in element.iter():
        for key, value in {**part.attrib, part.tag: part.text}.items():
            if "stiffness" in key.lower():
                yield _number(value, 0.0)


def _number(text: str | None, default: float) -> float:
    try:
        return float(text or default)
    except ValueError:
        return default  # Drake refuses it where it is an attribute.
