"""What `new` refuses of a URDF, and the base that it adds where the root link is none."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from drake_safety.robots.urdf_copy import UrdfCopy
from drake_safety.robots.urdf_survey import Limb, Survey, extent

_LEAST_INERTIA = 1e-10  # Of what a joint moves [kg·m², kg].
_SIDES = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("L", "R"), ("l", "r"))
_Y = np.array([0.0, 1.0, 0.0])
_Z = np.array([0.0, 0.0, 1.0])


def require_shapes(survey: Survey, copy: UrdfCopy, *, are_feet_named: bool) -> None:
    """Refuses shapes of another order of magnitude, and to guess feet whose meshes were not found.

    Raises:
        ValueError: It names the links and the files of their meshes.
    """
    robot_m = extent(survey.plant, survey.context, survey.instance)
    for link, size in survey.oversized(10 * robot_m).items():
        raise ValueError(
            f"new: '{survey.source}': a collision shape of link '{link}' "
            f"{copy.mesh_urls.get(link, '')} is {size:.3g} m large, in a robot of "
            f"{robot_m:.2g} m; in millimetres? State sizes in metres, or "
            'scale="0.001 0.001 0.001"'
        )
    groups = [group for group in survey.leaves() if len(survey.chain(group[0])) >= 2]
    floor = min(map(survey.lowest, groups), default=0.0)
    lost = [
        f"'{name}' ({', '.join(copy.mesh_urls[name])})"
        for group, z in zip(groups, map(survey.lowest, groups), strict=True)
        for name in group
        if name in copy.bare_links
        and z < 0.4 * floor
        # What is left reaches lower than the link that was lost, such as a foot's cover.
        and (survey.pose(name).translation()[2] < z - 0.25 * floor or not survey.collides(name))
    ]
    if lost and not are_feet_named:
        raise ValueError(
            f"new: '{survey.source}': collision meshes at the ends of limbs were not found or not "
            f"read, so that the feet cannot be told: {'; '.join(lost)}. Put them where the URDF "
            "says, give these links a box or sphere, or name the feet by --feet. "
            f"{'. '.join(copy.left_out)}"
        )


def require_motors(survey: Survey, legs: list[Limb], moved: Collection[str]) -> None:
    """Refuses legs with joints that no motor moves by itself, unless a policy ``moved`` them.

    Raises:
        ValueError: It names the joints and what the file says of them.
    """
    drives = survey.drives
    chains = [survey.chain(limb.body) for limb in legs]
    joints = list(dict.fromkeys(joint for one in chains for joint in one))
    mimics = {name: drives.mimics[name] for name in joints if name in drives.mimics}
    coupled = {name: "= {1:g} · '{0}' + {2:g}".format(*one) for name, one in mimics.items()}
    passive = {name: why for name, why in drives.passive(joints).items() if name not in moved}
    limits = ((name, *survey.limits[name]) for name in survey.limits if name in joints)
    stuck = {name: f"{low:g}" for name, low, high in limits if low == high}
    fix = 'or fix them (type="fixed")'
    shared = [name for name in passive if all(name in one for one in chains)]
    if shared:
        fix += f"; {shared} carry all legs: the base floats without them and the links above"
    for found, what, remedy in (
        (coupled, "follow others by <mimic>", "remove <mimic> if each has a motor of its own"),
        (passive, "have no motor", f"add a <transmission> if they have one, {fix}"),
        (stuck, "have equal limits", f"correct <limit>, {fix}"),
    ):
        if found:
            raise ValueError(
                f"new: '{survey.source}': a robot that stands by servos needs a motor on every "
                f"joint of its legs, but some {what}: {listed(found)}. Remedy: {remedy}"
            )


def listed(reasons: Mapping[str, str]) -> str:
    """Returns names with their reasons in a sentence."""
    return ", ".join(f"'{name}' ({why})" for name, why in reasons.items())


def require_masses(survey: Survey) -> None:
    """Refuses joints that move nothing with mass or inertia, whose acceleration is infinite.

    Raises:
        ValueError: It names the joint and its link.
    """
    M = survey.plant.CalcMassMatrix(survey.context)
    for joint in survey.joints:
        if M[joint.velocity_start(), joint.velocity_start()] < _LEAST_INERTIA:
            raise ValueError(
                f"new: '{survey.source}': joint '{joint.name()}' moves link "
                f"'{joint.child_body().name()}', which has no mass or inertia about its axis, and "
                'carries none. Correct its <inertial>, or fix the joint (type="fixed")'
            )


def upright_base(
    survey: Survey, limbs: list[Limb], *, is_up: bool
) -> tuple[RigidTransform | None, str]:
    """A pose between the hips, x forwards and z up, if the root link is far from that; and why.

    Legs point down: unless z ``is_up``, it is against their direction where they agree and the hips
    lie in a plane. Left is where joints with names of the left are, else along the axes of hips and
    knees. A robot that faces backwards is only told of.
    """
    hips = np.array([survey.joint_origin(limb.joints[0]) for limb in limbs]).reshape(-1, 3)
    if not len(hips):
        return None, ""
    across = np.array([survey.positions(limb).mean(axis=0) for limb in limbs]) - hips
    lengths = np.maximum(np.linalg.norm(across, axis=1), 1e-9)
    length, middle = lengths.mean(), 0.5 * (hips.min(axis=0) + hips.max(axis=0))
    down = (across / lengths[:, None]).mean(axis=0)
    up, left, why = (_Z if is_up else -_nearest_axis(down)), _Y, ""
    if not is_up:
        if up[2] > 0.5 or np.linalg.norm(down) < 0.8 or np.ptp(hips @ up) > 0.2 * length:
            return None, ""
        why = f"has its legs along {_in_words(-up)}"
    if np.linalg.norm(down) > 0.5:  # Not a spider's.
        left = _left(survey, limbs, up)
    if abs(left[1]) < 0.5 and not why:
        why = f"has its left along {_in_words(left)}"
    height, offset = -middle @ up, float(np.linalg.norm(np.cross(middle, up)))
    if not why and not (-0.2 * length < height < 1.2 * length and offset < 0.5 * length):
        why = f"lies {-height:.2f} m below the hips and {offset:.2f} m aside"
    if not why:
        return None, "faces backwards, as its left is along -y" if left[1] < 0 else ""
    R_BH = RotationMatrix(np.column_stack([np.cross(left, up), left, up]))
    return RigidTransform(R_BH, middle), why


def _left(survey: Survey, limbs: list[Limb], up: np.ndarray) -> np.ndarray:
    level = 1 - np.abs(up)
    origins = {name: survey.joint_origin(name) for limb in limbs for name in limb.joints}
    pairs = [origins[one] - origins[other] for one, other in mirrored(list(origins)).items()]
    if pairs and np.linalg.norm(np.mean(pairs, axis=0) * level) > 0.01:
        return _nearest_axis(np.mean(pairs, axis=0) * level)
    axes = ([survey.joint_axis(joint) for joint in limb.joints] for limb in limbs)
    turns = np.array([(np.abs(one) > 0.9).sum(axis=0) for one in axes]) * level
    # Legs that do not agree decide nothing.
    others = np.flatnonzero(np.all(turns > turns[:, [1]], axis=0))
    left = np.eye(3)[others[0]] if len(others) else _nearest_axis(_Y * level + 0.1 * level)
    return left if np.cross(left, up).sum() > 0 else -left


def _nearest_axis(direction: np.ndarray) -> np.ndarray:
    k = int(np.argmax(np.abs(direction)))
    return np.sign(direction[k]) * np.eye(3)[k]


def _in_words(axis: np.ndarray) -> str:
    return f"{'-' if axis.sum() < 0 else '+'}{'xyz'[int(np.argmax(np.abs(axis)))]}"


def mirrored(names: list[str]) -> dict[str, str]:
    """Returns joints of one side and their partners, by common names for left and right."""
    pairs: dict[str, str] = {}
    for name in names:
        for left, right in _SIDES:
            # As a word, or as the letter that begins or ends one: FL_hip, hip_left, l_arm.
            for match in re.finditer(left, name):
                partner = f"{name[: match.start()]}{right}{name[match.end() :]}"
                if partner in names:
                    pairs.setdefault(name, partner)
    return pairs
