"""Writes a robot's folder and its first scenario from a URDF."""

from __future__ import annotations

import math
import re
import shutil
import tempfile
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drake_safety.robots.meshes import above
from drake_safety.robots.robot_model import load_robot_file
from drake_safety.robots.scenario_template import TASKS, Sizes, scenario_yaml
from drake_safety.robots.simulatable_urdf import simulatable_copy
from drake_safety.robots.standing_posture import solve_standing_posture
from drake_safety.robots.urdf_copy import UrdfCopy
from drake_safety.robots.urdf_survey import Limb, Survey

# Servo gains in proportion to mass times height, from `BALANCING_REFERENCE`.
_STIFFNESS = 28.0  # [1/s² · N·m/(rad kg m)]
_DAMPING_S = 0.027
_SIDES = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("L", "R"), ("l", "r"))


@dataclass(kw_only=True)
class NewRobot:
    """A robot found in a URDF, and the folder that `write_robot` has written.

    Attributes:
        posture: Its standing joint positions [rad].
        asked: Values that the URDF lacks and the user must supply.
    """

    name: str
    task: str
    folder: Path
    copy: UrdfCopy
    survey: Survey
    legs: list[Limb]
    arms: list[Limb]
    posture: dict[str, float]
    sizes: Sizes
    asked: list[str] = field(default_factory=list)

    @property
    def files(self) -> list[Path]:
        """URDF, robot.yaml, README and scenario."""
        names = (f"{self.name}.urdf", "robot.yaml", "README.md", f"{self.task}.yaml")
        return [self.folder / name for name in names]

    @property
    def joints(self) -> list[str]:
        """Its joints, in the order of its positions."""
        return [joint.name() for joint in self.survey.joints]

    @property
    def num_hulls(self) -> int:
        """Number of convex hulls that replace collision meshes."""
        return sum(map(len, self.copy.hulls.values()))

    @property
    def bare(self) -> list[str]:
        """Links whose collision meshes the copy lacks, and that have no other shape."""
        return self.copy.bare_links()


def write_robot(
    name: str,
    urdf: Path,
    task: str,
    folder: Path,
    *,
    feet: list[str] | None = None,
    moved: Collection[str] | None = (),
) -> NewRobot:
    """Writes a robot's folder: a URDF that Drake can simulate, robot.yaml, README and a scenario.

    Args:
        task: ``balancing``, ``reaching`` or ``walking``.
        feet: Links that touch the ground; found by their height by default.
        moved: Joints that a policy moves: they are not fixed, though they may move neither a foot
            nor a hand; None for all.

    Raises:
        ValueError: Invalid name, unknown task, existing folder, or a URDF without a legged robot.
    """
    if not re.fullmatch(r"[A-Za-z]\w*", name):
        raise ValueError(f"new: a robot's name is letters, digits and _; got '{name}'")
    if task not in TASKS:
        raise ValueError(f"new: task must be one of {list(TASKS)}; got '{task}'")
    if folder.exists():
        raise ValueError(f"new: '{folder}' exists already; choose another name, or another --out")
    with tempfile.TemporaryDirectory() as scratch:
        found = _survey(name, urdf, task, Path(scratch) / f"{name}.urdf", feet, moved)
        # Copied to the target only when complete.
        found.folder = Path(scratch) / "robot"
        found.folder.mkdir()
        description, robot, readme, scenario = found.files
        found.copy.write(description)
        robot.write_text(_robot_yaml(found), encoding="utf-8")
        load_robot_file(robot)
        scenario.write_text(scenario_yaml(task, found.sizes), encoding="utf-8")
        readme.write_text(_readme(found), encoding="utf-8")
        folder.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(found.folder, folder)
    found.folder = folder
    return found


def _survey(
    name: str,
    urdf: Path,
    task: str,
    scratch: Path,
    feet: list[str] | None,
    moved: Collection[str] | None,
) -> NewRobot:
    copy = simulatable_copy(urdf)
    copy.write(scratch)
    survey = Survey(scratch)
    legs = survey.legs(feet)
    arms = survey.arms(legs)
    if task == "reaching" and not arms:
        raise ValueError(
            f"new: '{urdf}' has no arm (a limb of four joints or more that is not a leg) to reach "
            "with; use --task balancing"
        )
    used = {joint for limb in (*legs, *arms) for joint in survey.chain(limb.body)}
    used |= {joint.name() for joint in survey.joints} if moved is None else set(moved)
    idle = [joint.name() for joint in survey.joints if joint.name() not in used]
    for limb in legs:
        if not limb.is_own_shape:
            copy.replace_collisions(limb.body, limb.points, limb.radius_m)
        elif limb.body in copy.hulls:
            copy.set_hulls(limb.body, [])
            copy.notes.append(f"foot '{limb.body}' has no hull: its spheres alone touch")
    copy.fix_joints(idle)
    copy.write(scratch)
    survey = Survey(scratch)
    posture = solve_standing_posture(survey, legs)
    _lift_hulls(copy, survey, legs)
    copy.write(scratch)
    survey = Survey(scratch)
    survey.set_joints(posture)
    # Balls are thrown at the base.
    is_base_bare = not survey.collides(survey.base)
    copy.ignore_collisions(survey.overlaps())
    found = NewRobot(
        name=name,
        task=task,
        folder=scratch.parent,
        copy=copy,
        survey=survey,
        legs=legs,
        arms=arms,
        posture=posture,
        sizes=_sizes(survey, legs, arms, copy),
    )
    found.asked += [
        f"where foot '{limb.body}' touches: the URDF has no shape there [m]"
        for limb in legs
        if limb.is_guess
    ]
    if is_base_bare:
        found.asked.append(
            f"a <collision> shape of the base '{survey.base}', in {name}.urdf [m]: without one no "
            "ball can hit it"
        )
    return found


def _lift_hulls(copy: UrdfCopy, survey: Survey, legs: list[Limb]) -> None:
    """Cuts hulls welded to a foot at the height of its contact points, which alone touch."""
    for limb in legs:
        lowest = float(survey.positions(limb)[:, 2].min())
        for link in set(survey.welded(limb.body)) & set(copy.hulls):
            X_LW = survey.pose(link).inverse()
            up = X_LW.rotation().col(2)
            height = lowest + float(X_LW.translation() @ up)
            parts = [above(hull, up, height) for hull in copy.hulls[link]]
            copy.set_hulls(link, [part for part in parts if part is not None])


def _sizes(survey: Survey, legs: list[Limb], arms: list[Limb], copy: UrdfCopy) -> Sizes:
    points = [survey.positions(limb) for limb in legs]
    lowest = min(float(p[:, 2].min()) - limb.radius_m for p, limb in zip(points, legs, strict=True))
    everything = np.concatenate(points)
    centroid = everything.mean(axis=0)
    half = np.abs(everything - centroid).max(axis=0)
    feet = np.array([p.mean(axis=0) for p in points])
    reach = 0.0
    shoulder = np.zeros(3)
    if arms:
        arm = arms[0]
        origins = [survey.joint_origin(joint) for joint in arm.joints]
        hand = survey.pose(arm.body).translation()
        reach = float(np.linalg.norm(np.diff([*origins, hand], axis=0), axis=1).sum())
        shoulder = origins[0] - [*centroid[:2], lowest]
    return Sizes(
        mass_kg=survey.total_mass,
        height_m=-lowest,
        half_length_m=float(half[0]),
        half_width_m=float(half[1]),
        lateral_m=float(np.abs(feet[:, 1] - centroid[1]).min()),
        reach_m=reach,
        shoulder_m=shoulder.tolist(),
        base=survey.base,
        joint_friction_nm=float(np.median(list(copy.joint_friction.values())))
        if copy.joint_friction
        else None,
    )


def _robot_yaml(found: NewRobot) -> str:
    survey, sizes, names = found.survey, found.sizes, found.joints
    unit = sizes.mass_kg * sizes.height_m
    lines = [
        f"# {found.name}: written from {found.copy.source.name}. Lines marked ASK have values that",
        "# the URDF lacks: look them up, and state their sources in README.md.",
        f"name: {found.name}",
        f"urdf: {found.name}.urdf",
        f"base: {survey.base}  # {sizes.mass_kg:.2f} kg in all, {sizes.height_m:.3f} m high [m]",
        "posture:  # standing, found by putting the feet under the hips [rad]",
        *(f"  {name}: {found.posture[name]:g}" for name in names if found.posture.get(name)),
        "feet:  # contact_points are centres of spheres, in the body's frame [m]",
    ]
    for limb in found.legs:
        points = [[round(float(value), 5) for value in point] for point in limb.points]
        ask = "  # ASK its contact points [m]" if limb.is_guess else ""
        lines += [
            f"  {limb.body}:{ask}",
            f"    body: {limb.body}",
            f"    contact_points: {points}",
            f"    radius_m: {float(f'{limb.radius_m:.5g}')}",
            f"    joints: [{', '.join(limb.joints)}]",
        ]
    if found.arms:
        lines.append("reaching_frames:")
    for limb in found.arms:
        lines += [
            f"  {limb.body}:",
            f"    body: {limb.body}",
            "    point: [0.0, 0.0, 0.0]  # ASK the point that reaches, in the body's frame [m]",
            "    radius_m: 0.05  # ASK the radius of the hand's collision sphere [m]",
            f"    joints: [{', '.join(limb.joints)}]",
        ]
        found.asked.append(f"the point of hand '{limb.body}' that reaches, and its size [m]")
    lines.append(
        "joint_gains:  # ASK the maker's; these grow with mass times height [N·m/rad, N·m·s/rad]"
    )
    found.asked.append("the maker's servo gains [N·m/rad, N·m·s/rad]; estimated from the mass")
    legs = {name for limb in found.legs for name in limb.joints}
    for name in names:
        stiffness = _STIFFNESS * unit * (1.0 if name in legs else 0.5)
        lines.append(
            f"  {name}: {{stiffness: {stiffness:.4g}, damping: {_DAMPING_S * stiffness:.4g}}}"
        )
    lines += _effort_lines(found, names, unit)
    lines.append("foot_friction: 0.6  # ASK Coulomb's coefficient of feet on your ground [1]")
    found.asked.append("the friction of feet on your ground [1]; 0.6 is assumed")
    mirror = _mirror(names)
    if mirror:
        lines += ["mirror:", *(f"  {one}: {other}" for one, other in mirror.items())]
    bare = found.bare
    if bare:
        lines += [
            "without_collision:  # ASK shapes in place of these links' lost meshes [m]",
            *(f"  - {link}" for link in bare),
        ]
        found.asked.append(
            f"collision shapes of the {len(bare)} links under 'without_collision' in robot.yaml [m]"
        )
    lines += ["whole_body:", f"  orientation: {{{survey.base}: {{weight: 20.0}}}}"]
    if found.task == "balancing" and len(found.legs) > 2:
        lines.append("  posture: {weight: 0.001}")
    return "\n".join(lines) + "\n"


def _effort_lines(found: NewRobot, names: list[str], unit: float) -> list[str]:
    plant = found.survey.plant
    motors = {
        plant.get_joint_actuator(index).joint().name()
        for index in plant.GetJointActuatorIndices(found.survey.instance)
        if math.isfinite(plant.get_joint_actuator(index).effort_limit())
    }
    limits = found.copy.effort_limits()
    lines = []
    for name in names:
        if name in motors:
            continue
        effort = limits[name]
        if effort > 0 and math.isfinite(effort):
            lines.append(f"  {name}: {effort:g}")
        else:
            lines.append(f"  {name}: {4 * unit:.3g}  # ASK the motor's largest torque [N·m]")
            found.asked.append(f"the largest torque of joint '{name}' [N·m]")
    if not lines:
        return []
    return ["effort_limits:  # where the URDF has no motor, or none with a limit [N·m]", *lines]


def _mirror(names: list[str]) -> dict[str, str]:
    """Joints of one side and their partners, by common names for left and right."""
    pairs: dict[str, str] = {}
    for name in names:
        for left, right in _SIDES:
            # As a word, or as the letter that begins or ends one: FL_hip, hip_left, l_arm.
            for match in re.finditer(left, name):
                partner = f"{name[: match.start()]}{right}{name[match.end() :]}"
                if partner in names and name not in pairs:
                    pairs[name] = partner
    return pairs


def _readme(found: NewRobot) -> str:
    sizes = found.sizes
    notes = (
        "\n".join(f"- {note[0].upper()}{note[1:]}." for note in found.copy.notes) or "- Nothing."
    )
    asked = "\n".join(f"- [ ] {what}" for what in found.asked)
    return f"""# {found.name}

{sizes.mass_kg:.2f} kg; its base, `{sizes.base}`, stands {sizes.height_m:.3f} m high on
{len(found.legs)} feet.

## Where the figures come from
Fill in the sources, so that every figure can be looked up.

| figure | source |
|---|---|
| masses, inertias, joints, limits | `{found.copy.source.name}`, from ... (address, version) |
| standing posture | solved: feet under the hips |
| servo gains | estimated from mass and height; replace them by ... |
| friction of the feet | assumed; replace it by ... |

## Values that the URDF lacks
{asked}

## Changes of the URDF
{notes}

## Licence of the URDF
...
"""
