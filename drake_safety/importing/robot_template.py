"""Writes a robot's folder and its first scenario from a URDF, xacro or an MJCF."""

import math
import re
import shutil
import tempfile
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from drake_safety.files.reading import yaml_text
from drake_safety.importing import urdf_survey
from drake_safety.importing.mjcf import ModelFacts, is_mjcf, mjcf_to_urdf
from drake_safety.importing.model_source import expanded, is_xacro
from drake_safety.importing.scenario_template import TASKS, Sizes, scenario_yaml
from drake_safety.importing.simulatable_urdf import simulatable_copy
from drake_safety.importing.standing_posture import standing_posture
from drake_safety.importing.urdf_copy import UrdfCopy
from drake_safety.importing.urdf_survey import WITHOUT_STOPS_RAD, Limb, Survey
from drake_safety.robots.meshes import above
from drake_safety.robots.plausibility import effort_unit, listed, odd_inertias, odd_limits
from drake_safety.robots.robot_model import as_pattern, load_robot_file
from drake_safety.robots.urdf import joint_elements

# Servo gains in proportion to mass times height, from `BALANCING_REFERENCE`.
_STIFFNESS = 28.0  # [1/s² · N·m/(rad kg m)]
_DAMPING_S = 0.027
# Efforts that the file lacks, in proportion to mass times height, and of sliders to mass.
_TORQUE, _FORCE = 4.0, 20.0  # [m/s²]
_LEAST_HEIGHT_M, _GREATEST_HEIGHT_M = 0.02, 20.0
_LEAST_STANCE = 0.02  # Half the stance's width, by the height.


@dataclass(kw_only=True)
class NewRobot:
    """A robot found in a model file, and the folder that `write_robot` has written."""

    name: str
    task: str
    folder: Path
    copy: UrdfCopy
    facts: ModelFacts
    survey: Survey = field(init=False)
    legs: list[Limb] = field(default_factory=list)
    arms: list[Limb] = field(default_factory=list)
    posture: dict[str, float] = field(default_factory=dict)  # While it stands [rad].
    posture_source: str = ""
    fixed: list[str] = field(default_factory=list)  # Joints that move no foot or hand.
    odd: set[str] = field(default_factory=set)  # Joints with efforts that no such motor has.
    asked: list[str] = field(default_factory=list)  # Values that the user must supply.

    def renew_survey(self) -> None:
        """Writes the URDF, and surveys what is written."""
        self.copy.write(self.files[0])
        self.survey = Survey(self.files[0], self.copy.source, self.copy.drives)

    @property
    def files(self) -> list[Path]:
        """URDF, robot.yaml, README and scenario."""
        names = (f"{self.name}.urdf", "robot.yaml", "README.md", f"{self.task}.yaml")
        return [self.folder / name for name in names]

    @property
    def decided(self) -> list[str]:
        """Decisions and reasons, as in the scenario."""
        text = self.files[-1].read_text(encoding="utf-8")
        lines = [line.strip() for line in text.splitlines() if "# DECIDED" in line]
        if self.fixed:
            reason = "they move neither a foot nor a hand, which --hands would name"
            lines.insert(0, f"joints {', '.join(self.fixed)} are fixed: {reason}")
        return [line.replace("# DECIDED ", "") for line in lines]

    @property
    def joints(self) -> list[str]:
        """Names of the joints, in the order of the positions."""
        return [joint.name() for joint in self.survey.joints]

    @property
    def num_hulls(self) -> int:
        """Number of convex hulls that replace collision meshes."""
        return sum(map(len, self.copy.hulls.values()))

    @cached_property
    def sizes(self) -> Sizes:
        """Sizes of the robot as it stands."""
        survey, friction = self.survey, list(self.copy.joint_friction.values())
        points = [survey.positions(limb) for limb in self.legs]
        centroid = np.concatenate(points).mean(axis=0)
        half = np.abs(np.concatenate(points) - centroid).max(axis=0)
        feet = np.array([of_foot.mean(axis=0) for of_foot in points])
        radii = [limb.radius_m for limb in self.legs]
        lowest = min(float(p[:, 2].min()) - r for p, r in zip(points, radii, strict=True))
        reach, shoulder = 0.0, np.zeros(3)
        for arm in self.arms[:1]:
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
            arm_joints=[arm.joints[0] for arm in self.arms],
            joint_friction_nm=float(np.median(friction)) if friction else None,
        )


def write_robot(
    name: str,
    model: Path,
    task: str,
    folder: Path,
    *,
    feet: list[str] | None = None,
    hands: list[str] | None = None,
    moved: Collection[str] | None = (),
    xacro_arguments: Mapping[str, str] | None = None,
) -> NewRobot:
    """Writes a robot's folder: a URDF that Drake can simulate, robot.yaml, README and a scenario.

    Args:
        feet: Links that touch the ground; by default the lowest.
        hands: Links that arms end in; by default ends of limbs of four joints or more.
        moved: Joints that a policy moves, which are not fixed; None for all.
        xacro_arguments: Arguments of a xacro model without a default.
    """
    if not re.fullmatch(r"[A-Za-z]\w*", name):
        raise ValueError(f"new: a robot's name is letters, digits and _; got '{name}'")
    if task not in TASKS:
        raise ValueError(f"new: task must be one of {list(TASKS)}; got '{task}'")
    if folder.exists():
        raise ValueError(f"new: '{folder}' exists already; choose another name, or another --out")
    with tempfile.TemporaryDirectory() as scratch:
        urdf, facts, source = model, ModelFacts(), None
        if is_xacro(model):
            urdf, source = Path(scratch) / f"{name}-expanded.urdf", model
            urdf.write_text(expanded(model, xacro_arguments or {}), encoding="utf-8")
        elif is_mjcf(model):
            urdf = Path(scratch) / "mjcf" / f"{name}.urdf"
            urdf.parent.mkdir()
            facts = mjcf_to_urdf(model, urdf)
        copy = simulatable_copy(urdf, source)
        copy.source = model
        copy.left_out = facts.left_out + copy.left_out
        copy.notes += [f"it is converted from '{model.name}'", *facts.left_out][urdf == model :]
        new = NewRobot(name=name, task=task, folder=Path(scratch), copy=copy, facts=facts)
        new.renew_survey()
        _find_limbs(new, feet, hands, moved or ())
        _fix_joints(new, moved)
        _stand(new)
        # Copied to the target only when complete.
        new.folder = Path(scratch) / "robot"
        new.folder.mkdir()
        description, robot, readme, scenario = new.files
        copy.write(description)
        robot.write_text(_robot_yaml(new), encoding="utf-8")
        load_robot_file(robot)
        scenario.write_text(scenario_yaml(task, new.sizes), encoding="utf-8")
        readme.write_text(_readme(new), encoding="utf-8")
        folder.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(new.folder, folder)
    new.folder = folder
    return new


def _find_limbs(
    new: NewRobot, feet: list[str] | None, hands: list[str] | None, moved: Collection[str]
) -> None:
    copy = new.copy
    if feet is None:
        urdf_survey.require_feet(new.survey, copy)
    root = new.survey.base
    pose = urdf_survey.base_at_hips(new.survey, new.survey.legs(feet))
    if pose is not None:
        base = copy.add_root("hips", root, pose)
        copy.warn(f"the root link '{root}' is far from the hips; the base is a new link '{base}'")
        new.renew_survey()
    new.legs = new.survey.legs(feet)
    urdf_survey.require_motors(new.survey, new.legs, moved)
    new.arms = new.survey.arms(new.legs, hands)
    if new.task == "reaching" and not new.arms:
        what = "no arm (a limb of four joints or more that is not a leg): name its end by --hands"
        raise ValueError(f"new: '{copy.source}' has {what}")


def _fix_joints(new: NewRobot, moved: Collection[str] | None) -> None:
    """Fixes what moves no foot or hand, and notes couplings, motors and wheels."""
    survey, copy, stated = new.survey, new.copy, set(moved or ())
    legged = {joint for limb in new.legs for joint in survey.chain(limb.body)}
    armed = {joint for limb in new.arms for joint in survey.chain(limb.body)}
    used = legged | armed | (set(survey.limits) if moved is None else stated)
    coupled = used & set(copy.drives.mimics)
    passive = copy.drives.passive(sorted(used - legged - coupled - stated))
    used -= coupled | set(passive)
    spans = {name: np.ptp(survey.limits[name]) for name in legged}
    turns = [name for name, span in spans.items() if 8 * math.pi < span <= WITHOUT_STOPS_RAD]
    ends = [limb.joints[-1] for limb in new.legs]
    wheels = [name for name in ends if spans[name] > WITHOUT_STOPS_RAD]
    for names, note in (
        (coupled, "follow others by <mimic> and are fixed"),
        (passive, f"have no motor and are fixed: {listed(passive)}"),
        (turns, "of legs turn more than four times: are their limits in degrees?"),
        (wheels, "have no stops: if they turn wheels, servos hold these, so that none rolls"),
    ):
        if names:
            copy.warn(f"joints {sorted(names)} {note}")
    for limb in new.legs:
        if not limb.is_own_shape:
            copy.replace_collisions(limb.body, limb.points, limb.radius_m)
        elif limb.body in copy.hulls:
            copy.set_hulls(limb.body, [])
            copy.notes.append(f"foot '{limb.body}' has no hull: its spheres alone touch")
    idle = survey.limits.keys() - used
    copy.fix_joints(idle)
    new.fixed = sorted(idle - coupled - set(passive))
    for limb in (*new.legs, *new.arms):
        limb.joints = [name for name in limb.joints if name in used]
    new.renew_survey()


def _stand(new: NewRobot) -> None:
    """Finds the posture, and what touches what in it."""
    copy = new.copy
    urdf_survey.require_masses(new.survey)
    try:
        new.posture, new.posture_source = standing_posture(new.survey, new.legs, new.facts.postures)
    except ValueError as error:
        raise ValueError(". ".join([f"{error}", *copy.warnings, *copy.left_out])) from error
    for limb in new.legs:
        # Hulls welded to a foot end at the height of its contact points, which alone touch.
        lowest = float(new.survey.positions(limb)[:, 2].min())
        for link in set(new.survey.welded(limb.body)) & set(copy.hulls):
            X_LW = new.survey.pose(link).inverse()
            up = X_LW.rotation().col(2)
            height = lowest + float(X_LW.translation() @ up)
            parts = [above(hull, up, height) for hull in copy.hulls[link]]
            copy.set_hulls(link, [part for part in parts if part is not None])
    new.renew_survey()
    survey = new.survey
    survey.set_joints(new.posture)
    model = survey.plant, survey.context, survey.instance
    new.odd, limits = odd_limits(*model, copy.drives.efforts)
    for joint in joint_elements(copy.root):
        for limit in joint.findall("limit") if joint.get("name") in new.odd else []:
            limit.attrib.pop("effort", None)  # robot.yaml has an estimate of it.
    for odd in filter(None, (odd_inertias(*model), limits)):
        copy.warn(odd)
    copy.ignore_collisions(survey.overlaps() | new.facts.apart)
    sizes = new.sizes
    if not _LEAST_HEIGHT_M < sizes.height_m < _GREATEST_HEIGHT_M:
        what = f"base '{survey.base}' would stand {sizes.height_m:.3g} m high"
        raise ValueError(f"new: '{copy.source}': {what}. Are the <origin>s in millimetres?")
    if min(sizes.half_length_m, sizes.half_width_m) < _LEAST_STANCE * sizes.height_m:
        copy.warn("the contact points of the feet lie on a line, on which no posture stands")
    what = "touches: the file has no shape there [m]"
    new.asked += [f"where foot '{limb.body}' {what}" for limb in new.legs if limb.is_guess]
    if not any(survey.geometries(survey.welded(survey.base))):  # Balls are thrown at it.
        new.asked.append(f"a <collision> shape of the base '{survey.base}', in {new.name}.urdf [m]")


def _robot_yaml(new: NewRobot) -> str:
    sizes, facts, names, source = new.sizes, new.facts, new.joints, new.copy.source.name
    base, keys = yaml_text(sizes.base), {name: yaml_text(as_pattern(name)) for name in names}
    posture = [f"{key}: {new.posture[j]:g}" for j, key in keys.items() if new.posture.get(j)]
    lines = [
        f"# {new.name}: written from {source}. Lines marked ASK have values that",
        "# it lacks: look them up, and state their sources in README.md.",
        f"name: {new.name}",
        f"urdf: {new.name}.urdf",
        f"base: {base}  # {sizes.mass_kg:.2f} kg in all, {sizes.height_m:.3f} m high [m]",
        f"posture:  # standing, {new.posture_source} [rad]",
        *(f"  {entry}" for entry in posture),
        "feet:  # contact_points are centres of spheres, in the body's frame [m]",
    ]

    def add(title: str, entries: list[str]) -> None:
        """Adds a block, unless it is empty."""
        lines.extend([title, *(f"  {entry}" for entry in entries)] if entries else [])

    for limb in new.legs:
        points = [[round(float(value), 5) for value in point] for point in limb.points]
        about = [f"contact_points: {points}", f"radius_m: {float(f'{limb.radius_m:.5g}')}"]
        lines += _limb_lines(limb, about, "  # ASK its contact points [m]" * limb.is_guess)
    lines += ["reaching_frames:"] * bool(new.arms)
    for limb in new.arms:
        about = [
            "point: [0.0, 0.0, 0.0]  # ASK the point that reaches, in the body's frame [m]",
            "radius_m: 0.05  # ASK the radius of the hand's collision sphere [m]",
        ]
        lines += _limb_lines(limb, about)
        new.asked.append(f"the point of hand '{limb.body}' that reaches, and its size [m]")
    gains, guessed = [], [name for name in names if name not in facts.gains]
    legs = {name for limb in new.legs for name in limb.joints}
    for name, key in keys.items():
        stiffness = _STIFFNESS * sizes.load * (1.0 if name in legs else 0.5)
        if effort_unit(new.survey.plant.GetJointByName(name, new.survey.instance)) == "N":
            stiffness /= sizes.height_m**2  # [N/m]
        stiffness, damping = facts.gains.get(name, (stiffness, _DAMPING_S * stiffness))
        origin = f"  # of {source}" if name in facts.gains else ""
        gains.append(f"{key}: {{stiffness: {stiffness:.4g}, damping: {damping:.4g}}}{origin}")
    note = "ASK the maker's; these grow with mass times height " if guessed else ""
    add(f"joint_gains:  # {note}[N·m/rad, N·m·s/rad]", gains)
    if guessed:
        which = f" of {len(guessed)} joints" if len(guessed) < len(keys) else ""
        units = "[N·m/rad, N·m·s/rad]"
        new.asked.append(f"the maker's servo gains{which} {units}; estimated from mass and height")
    rotors = [f"{keys[j]}: {facts.rotor_inertia[j]:.4g}" for j in names if j in facts.rotor_inertia]
    add(f"rotor_inertia:  # of {source} [kg·m²]", rotors)
    survey, efforts = new.survey, []
    indices = survey.plant.GetJointActuatorIndices(survey.instance)
    motors = map(survey.plant.get_joint_actuator, indices)
    driven = {motor.joint().name() for motor in motors if math.isfinite(motor.effort_limit())}
    for name in (name for name in names if name not in driven - new.odd):
        stated = limit = new.copy.drives.efforts[name]
        unit, note = effort_unit(survey.plant.GetJointByName(name, survey.instance)), ""
        if name in new.odd or not 0 < limit < math.inf:
            limit = float(f"{_FORCE * sizes.mass_kg if unit == 'N' else _TORQUE * sizes.load:.3g}")
            said = f" ({source} says {stated:g})" * (name in new.odd)
            note = f"  # ASK the motor's largest torque or force{said} [{unit}]"
            new.asked.append(f"the largest torque or force of joint '{name}'{said} [{unit}]")
        efforts.append(f"{keys[name]}: {limit:g}{note}")
    add("effort_limits:  # where the file has no motor, or no plausible limit [N·m, N]", efforts)
    lines.append("foot_friction: 0.6  # ASK Coulomb's coefficient of feet on your ground [1]")
    new.asked.append("the friction of feet on your ground [1]; 0.6 is assumed")
    pairs = urdf_survey.mirrored(names).items()
    partners = {keys[name]: other.replace("\\", r"\\") for name, other in pairs}
    add("mirror:", [f"{key}: {yaml_text(other)}" for key, other in partners.items()])
    if bare := new.copy.bare_links:
        lines.append("without_collision:  # ASK shapes in place of these links' lost meshes [m]")
        lines += [f"  - {yaml_text(link)}" for link in bare]
        links = f"{len(bare)} links under 'without_collision' in robot.yaml"
        new.asked.append(f"collision shapes of the {links} [m]")
    lines += ["whole_body:", f"  orientation: {{{base}: {{weight: 20.0}}}}"]
    if new.task == "balancing" and len(new.legs) > 2:
        lines.append("  posture: {weight: 0.001}")
    return "\n".join(lines) + "\n"


def _limb_lines(limb: Limb, about: list[str], note: str = "") -> list[str]:
    body, joints = yaml_text(limb.body), ", ".join(map(yaml_text, limb.joints))
    entries = [f"body: {body}", *about, f"joints: [{joints}]"]
    return [f"  {body}:{note}", *(f"    {entry}" for entry in entries)]


def _readme(new: NewRobot) -> str:
    sizes = new.sizes
    notes = "\n".join(f"- {note[0].upper()}{note[1:]}." for note in new.copy.notes)
    asked = "\n".join(f"- [ ] {what}" for what in new.asked)
    return f"""# {new.name}

{sizes.mass_kg:.2f} kg; its base, `{sizes.base}`, stands {sizes.height_m:.3f} m high on
{len(new.legs)} feet.

## Source and licence of `{new.copy.source.name}`
...

## Values that the file lacks
{asked}

## Changes of the URDF
{notes or "- Nothing."}
"""
