"""Writes a robot's folder and its first scenario from a URDF or an MJCF."""

from __future__ import annotations

import math
import re
import shutil
import tempfile
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drake_safety.files.reading import yaml_text
from drake_safety.robots.joint_drives import read_drives
from drake_safety.robots.meshes import above
from drake_safety.robots.mjcf import ModelFacts, is_mjcf, mjcf_to_urdf
from drake_safety.robots.robot_model import as_pattern, load_robot_file
from drake_safety.robots.scenario_template import TASKS, Sizes, scenario_yaml
from drake_safety.robots.simulatable_urdf import simulatable_copy
from drake_safety.robots.standing_posture import standing_posture
from drake_safety.robots.urdf_copy import UrdfCopy, read_urdf
from drake_safety.robots.urdf_requirements import (
    mirrored,
    require_masses,
    require_motors,
    require_shapes,
    upright_base,
)
from drake_safety.robots.urdf_survey import Limb, Survey, odd_inertias

# Servo gains in proportion to mass times height, from `BALANCING_REFERENCE`.
_STIFFNESS = 28.0  # [1/s² · N·m/(rad kg m)]
_DAMPING_S = 0.027
_LEAST_HEIGHT_M, _GREATEST_HEIGHT_M = 0.02, 20.0
_LEAST_STANCE = 0.02  # Half the stance's width, by the height.
_ESCAPE = "\\"  # Of templates of mirrored names.


@dataclass(kw_only=True)
class NewRobot:
    """A robot found in a model file, and the folder that `write_robot` has written.

    Attributes:
        posture: Its standing joint positions [rad].
        posture_source: Where they come from.
        wheels: Joints that turn wheels at the ends of legs.
        asked: Values that the file lacks and the user must supply.
    """

    name: str
    task: str
    folder: Path
    copy: UrdfCopy
    survey: Survey
    legs: list[Limb]
    arms: list[Limb]
    posture: dict[str, float]
    posture_source: str
    sizes: Sizes
    facts: ModelFacts
    wheels: list[str] = field(default_factory=list)
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
    model: Path,
    task: str,
    folder: Path,
    *,
    feet: list[str] | None = None,
    moved: Collection[str] | None = (),
) -> NewRobot:
    """Writes a robot's folder: a URDF that Drake can simulate, robot.yaml, README and a scenario.

    Args:
        model: Its URDF or MJCF.
        task: ``balancing``, ``reaching`` or ``walking``.
        feet: Links that touch the ground; found by their height by default.
        moved: Joints that a policy moves: they are not fixed, though they may move neither a foot
            nor a hand; None for all.

    Raises:
        ValueError: Invalid name, unknown task, existing folder, or a file without a legged robot.
    """
    if not re.fullmatch(r"[A-Za-z]\w*", name):
        raise ValueError(f"new: a robot's name is letters, digits and _; got '{name}'")
    if task not in TASKS:
        raise ValueError(f"new: task must be one of {list(TASKS)}; got '{task}'")
    if folder.exists():
        raise ValueError(f"new: '{folder}' exists already; choose another name, or another --out")
    with tempfile.TemporaryDirectory() as scratch:
        found = _survey(name, model, task, Path(scratch) / f"{name}.urdf", feet, moved)
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
    model: Path,
    task: str,
    scratch: Path,
    feet: list[str] | None,
    moved: Collection[str] | None,
) -> NewRobot:
    urdf, facts = model, ModelFacts()
    if is_mjcf(model):
        urdf = scratch.parent / "mjcf" / scratch.name
        urdf.parent.mkdir()
        facts = mjcf_to_urdf(model, urdf)
    copy = simulatable_copy(urdf)
    copy.source = model
    copy.left_out = facts.left_out + copy.left_out
    copy.notes += [f"it is converted from '{model.name}'", *facts.left_out][urdf == model :]
    drives = read_drives(read_urdf(urdf).root)
    copy.write(scratch)
    survey = Survey(scratch, model, drives)

    def with_base(limbs: list[Limb], *, is_up: bool) -> Survey:
        pose, why = upright_base(survey, limbs, is_up=is_up)
        if why and pose is None:
            copy.warn(f"the robot {why} of '{survey.base}'")
        if pose is None:
            return survey
        base = copy.add_root("hips", survey.base, pose)
        copy.warn(f"the root link '{survey.base}' {why}; the base is a new link '{base}'")
        copy.write(scratch)
        return Survey(scratch, model, drives)

    survey = with_base(survey.limbs(), is_up=False)
    require_shapes(survey, copy, urdf, are_feet_named=feet is not None)
    survey = with_base(survey.legs(feet), is_up=True)
    legs = survey.legs(feet)
    require_motors(survey, legs, drives, moved or (), model)
    arms = survey.arms(legs)
    if task == "reaching" and not arms:
        raise ValueError(
            f"new: '{model}' has no arm (a limb of four joints or more that is not a leg) to reach "
            "with; use --task balancing"
        )
    used = {joint for limb in (*legs, *arms) for joint in survey.chain(limb.body)}
    used |= {joint.name() for joint in survey.joints} if moved is None else set(moved)
    legged = {joint for limb in legs for joint in survey.chain(limb.body)}
    used -= {name for name, (leader, *_) in drives.mimics.items() if leader in legged}
    coupled = used & set(drives.mimics)
    leaders = {drives.mimics[name][0] for name in coupled}
    if coupled and task != "balancing":
        raise ValueError(
            f"new: '{model}': joints {sorted(coupled)} follow others by <mimic>, for which --task "
            f"{task} has no controller; use --task balancing, or remove <mimic>"
        )
    others = used - legged - coupled - leaders - set(moved or ())
    passive = drives.passive(sorted(others))
    used = used - set(passive) | leaders
    listed = ", ".join(f"'{name}' ({why})" for name, why in passive.items())
    wheels = survey.wheels(legs)
    loose = {name for name, (leader, *_) in drives.mimics.items() if leader in used} - used
    for names, note in (
        (coupled, "follow others by <mimic>, in the posture too"),
        (loose, "follow joints that move, by <mimic>, but move no foot or hand and are fixed"),
        (passive, f"have no motor and are fixed: {listed}"),
        (used & set(drives.springs), "have springs beside their motors, which are left out"),
        (wheels, "turn wheels: position servos hold them, so that they neither roll nor drive"),
    ):
        if names:
            copy.warn(f"joints {sorted(names)} {note}")
    idle = [joint for joint in survey.joints if joint.name() not in used]
    for limb in legs:
        if not limb.is_own_shape:
            copy.replace_collisions(limb.body, limb.points, limb.radius_m)
        elif limb.body in copy.hulls:
            copy.set_hulls(limb.body, [])
            copy.notes.append(f"foot '{limb.body}' has no hull: its spheres alone touch")
    copy.fix_joints(
        {
            joint.name(): survey.joint_pose(joint) if joint.name() in drives.mimics else None
            for joint in idle
        }
    )
    copy.write(scratch)
    survey = Survey(scratch, model, drives)
    require_masses(survey, model)
    try:
        posture, posture_source = standing_posture(survey, legs, facts.postures)
    except ValueError as error:
        raise ValueError(". ".join([f"{error}", *copy.warnings, *copy.left_out])) from error
    _lift_hulls(copy, survey, legs)
    copy.write(scratch)
    survey = Survey(scratch, model)
    survey.set_joints(posture)
    if odd := odd_inertias(survey.plant, survey.context, survey.instance):
        copy.warn(odd)
    # Balls are thrown at the base.
    is_base_bare = not survey.collides(survey.base)
    copy.ignore_collisions({*survey.overlaps(), *facts.apart})
    found = NewRobot(
        name=name,
        task=task,
        folder=scratch.parent,
        copy=copy,
        survey=survey,
        legs=legs,
        arms=arms,
        posture=posture,
        posture_source=posture_source,
        sizes=_sizes(survey, legs, arms, copy),
        facts=facts,
        wheels=wheels,
    )
    found.asked += [
        f"where foot '{limb.body}' touches: the file has no shape there [m]"
        for limb in legs
        if limb.is_guess
    ]
    if not _LEAST_HEIGHT_M < found.sizes.height_m < _GREATEST_HEIGHT_M:
        raise ValueError(
            f"new: '{model}': base '{survey.base}' would stand {found.sizes.height_m:.3g} m high. "
            "Are the <origin>s in millimetres?"
        )
    half = min(found.sizes.half_length_m, found.sizes.half_width_m)
    if half < _LEAST_STANCE * found.sizes.height_m:
        copy.warn(
            "the contact points of the feet lie on a line: on them, no posture stands by servos"
        )
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
    base, keys = yaml_text(survey.base), {name: yaml_text(as_pattern(name)) for name in names}
    unit = sizes.mass_kg * sizes.height_m
    lines = [
        f"# {found.name}: written from {found.copy.source.name}. Lines marked ASK have values that",
        "# it lacks: look them up, and state their sources in README.md.",
        f"name: {found.name}",
        f"urdf: {found.name}.urdf",
        f"base: {base}  # {sizes.mass_kg:.2f} kg in all, {sizes.height_m:.3f} m high [m]",
        f"posture:  # standing, {found.posture_source} [rad]",
        *(f"  {keys[name]}: {found.posture[name]:g}" for name in names if found.posture.get(name)),
        "feet:  # contact_points are centres of spheres, in the body's frame [m]",
    ]
    for limb in found.legs:
        points = [[round(float(value), 5) for value in point] for point in limb.points]
        ask = "  # ASK its contact points [m]" if limb.is_guess else ""
        lines += [
            f"  {yaml_text(limb.body)}:{ask}",
            f"    body: {yaml_text(limb.body)}",
            f"    contact_points: {points}",
            f"    radius_m: {float(f'{limb.radius_m:.5g}')}",
            f"    joints: [{', '.join(map(yaml_text, limb.joints))}]"
            + "  # the last turns a wheel, which its servo holds"
            * (limb.joints[-1] in found.wheels),
        ]
    if found.arms:
        lines.append("reaching_frames:")
    for limb in found.arms:
        lines += [
            f"  {yaml_text(limb.body)}:",
            f"    body: {yaml_text(limb.body)}",
            "    point: [0.0, 0.0, 0.0]  # ASK the point that reaches, in the body's frame [m]",
            "    radius_m: 0.05  # ASK the radius of the hand's collision sphere [m]",
            f"    joints: [{', '.join(map(yaml_text, limb.joints))}]",
        ]
        found.asked.append(f"the point of hand '{limb.body}' that reaches, and its size [m]")
    lines += _gain_lines(found, keys, unit)
    source, facts = found.copy.source.name, found.facts
    rotors = {keys[name]: facts.rotor_inertia.get(name) for name in names}
    if any(rotors.values()):
        lines.append(f"rotor_inertia:  # of {source} [kg·m²]")
        lines += [f"  {key}: {inertia:.4g}" for key, inertia in rotors.items() if inertia]
    lines += _effort_lines(found, keys, unit)
    # Of the shape nearest to a foot's contact points.
    stated = [
        min(shapes, key=lambda one: float(np.linalg.norm(one[0] - limb.points.mean(axis=0))))[1]
        for limb in found.legs
        if (shapes := facts.friction.get(limb.body))
    ]
    friction = min(filter(None, stated), default=0.6)
    origin = f"that of {source}" if stated else "assumed"
    lines.append(
        f"foot_friction: {friction:g}  # ASK Coulomb's coefficient of feet on your ground [1]"
    )
    found.asked.append(f"the friction of feet on your ground [1]; {friction:g} is {origin}")
    mirror = mirrored(names)
    if mirror:
        lines.append("mirror:")
        for one, other in mirror.items():
            lines.append(f"  {keys[one]}: {yaml_text(other.replace(_ESCAPE, 2 * _ESCAPE))}")
    bare = found.bare
    if bare:
        lines += [
            "without_collision:  # ASK shapes in place of these links' lost meshes [m]",
            *(f"  - {yaml_text(link)}" for link in bare),
        ]
        found.asked.append(
            f"collision shapes of the {len(bare)} links under 'without_collision' in robot.yaml [m]"
        )
    lines += ["whole_body:", f"  orientation: {{{base}: {{weight: 20.0}}}}"]
    if found.task == "balancing" and len(found.legs) > 2:
        lines.append("  posture: {weight: 0.001}")
    return "\n".join(lines) + "\n"


def _gain_lines(found: NewRobot, keys: dict[str, str], unit: float) -> list[str]:
    known, source = found.facts.gains, found.copy.source.name
    num_guessed = len(keys.keys() - known.keys())
    ask = "ASK the maker's; these grow with mass times height " if num_guessed else ""
    lines = [f"joint_gains:  # {ask}[N·m/rad, N·m·s/rad]"]
    if num_guessed:
        which = f" of {num_guessed} joints" if num_guessed < len(keys) else ""
        found.asked.append(
            f"the maker's servo gains{which} [N·m/rad, N·m·s/rad]; estimated from the mass"
        )
    legs = {name for limb in found.legs for name in limb.joints}
    for name, key in keys.items():
        stiffness = _STIFFNESS * unit * (1.0 if name in legs else 0.5)
        stiffness, damping = known.get(name, (stiffness, _DAMPING_S * stiffness))
        origin = f"  # of {source}" if name in known else ""
        lines.append(f"  {key}: {{stiffness: {stiffness:.4g}, damping: {damping:.4g}}}{origin}")
    return lines


def _effort_lines(found: NewRobot, keys: dict[str, str], unit: float) -> list[str]:
    plant = found.survey.plant
    motors = {
        plant.get_joint_actuator(index).joint().name()
        for index in plant.GetJointActuatorIndices(found.survey.instance)
        if math.isfinite(plant.get_joint_actuator(index).effort_limit())
    }
    limits = found.copy.effort_limits()
    lines = []
    for name, key in keys.items():
        if name in motors:
            continue
        effort = limits[name]
        if effort > 0 and math.isfinite(effort):
            lines.append(f"  {key}: {effort:g}")
        else:
            lines.append(f"  {key}: {4 * unit:.3g}  # ASK the motor's largest torque [N·m]")
            found.asked.append(f"the largest torque of joint '{name}' [N·m]")
    if not lines:
        return []
    return ["effort_limits:  # where the file has no motor, or none with a limit [N·m]", *lines]


def _readme(found: NewRobot) -> str:
    sizes = found.sizes
    notes = (
        "\n".join(f"- {note[0].upper()}{note[1:]}." for note in found.copy.notes) or "- Nothing."
    )
    asked = "\n".join(f"- [ ] {what}" for what in found.asked)
    stated = f"`{found.copy.source.name}`"
    has_gains = set(found.joints) <= found.facts.gains.keys()
    gains = stated if has_gains else "estimated from mass and height; replace them by ..."
    friction = stated if found.facts.friction else "assumed; replace it by ..."
    return f"""# {found.name}

{sizes.mass_kg:.2f} kg; its base, `{sizes.base}`, stands {sizes.height_m:.3f} m high on
{len(found.legs)} feet.

## Where the figures come from
Fill in the sources, so that every figure can be looked up.

| figure | source |
|---|---|
| masses, inertias, joints, limits | `{found.copy.source.name}`, from ... (address, version) |
| standing posture | {found.posture_source} |
| servo gains | {gains} |
| friction of the feet | {friction} |

## Values that the file lacks
{asked}

## Changes of the URDF
{notes}

## Licence of the file
...
"""
