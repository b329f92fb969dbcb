"""Masses, inertias and limits that no robot of its size has."""

import math
from collections.abc import Mapping

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint, ModelInstanceIndex, PrismaticJoint
from pydrake.systems.framework import Context

from drake_safety.robots.robot_size import GRAVITY_M_S2

_MATTERS = 1e-4  # Moment of inertia that matters, by the robot's mass times extent squared.
_POINT = 0.005  # Least radius of gyration, by the robot's extent.
_MOST_TORQUE, _MOST_FORCE = 1.5, 8.0  # Motors: by weight times extent (known: 0.4); by weight.
_AIR_KG_M3, _LEAD_KG_M3 = 1.2, 11_300.0  # Density of the cube that is as large as the robot.
_NUM_LISTED = 4


def extent(plant: MultibodyPlant, context: Context, instance: ModelInstanceIndex) -> float:
    """Returns the diagonal of the box around the origins of a model's bodies [m]."""
    bodies = map(plant.get_body, plant.GetBodyIndices(instance))
    origins = [body.EvalPoseInWorld(context).translation() for body in bodies]
    return float(np.linalg.norm(np.ptp(origins, axis=0)))


def effort_unit(joint: Joint) -> str:
    """Returns the unit of a joint's effort."""
    return "N" if isinstance(joint, PrismaticJoint) else "N·m"


def listed(reasons: Mapping[str, str]) -> str:
    """Returns names with their reasons in a sentence."""
    return ", ".join(f"'{name}' ({why})" for name, why in reasons.items())


def odd_inertias(plant: MultibodyPlant, context: Context, instance: ModelInstanceIndex) -> str:
    """Names links with masses or inertias that no body of a robot of this size has; "" if none."""
    size, total = extent(plant, context, instance), plant.CalcTotalMass(context, [instance])
    odd, remarks = [], []
    for body in map(plant.get_body, plant.GetBodyIndices(instance)):
        M_BBo = body.default_spatial_inertia()
        mass, away = M_BBo.get_mass(), float(np.linalg.norm(M_BBo.get_com()))
        if not mass > 0:
            continue
        G_BBcm = M_BBo.get_unit_inertia().ShiftToCenterOfMass(M_BBo.get_com())
        radius = math.sqrt(max(*G_BBcm.CalcPrincipalMomentsOfInertia(), 0.0))
        is_large = radius > size and mass * radius**2 > _MATTERS * total * size**2
        if is_large or (radius < _POINT * size and mass > 0.01 * total):
            what = f"{mass * radius**2:.3g} kg·m² at {mass:.3g} kg"
            odd.append(f"'{body.name()}' {what}, a radius of gyration of {radius:.2g} m")
        if away > 2 * size:
            remarks.append(f"the centre of mass of link '{body.name()}' is {away:.3g} m from it")
    if odd:
        few = "; ".join(odd[:_NUM_LISTED]) + " ..." * (len(odd) > _NUM_LISTED)
        what = f"inertias that no body of a robot of {size:.2g} m has (kg·mm² instead of kg·m²?)"
        remarks.insert(0, f"{len(odd)} links have {what}: {few}")
    if not _AIR_KG_M3 < total / size**3 < _LEAD_KG_M3:
        remarks.append(f"no robot of {size:.2g} m has {total:.3g} kg (grams or tonnes?)")
    return "; ".join(remarks)


def odd_limits(
    plant: MultibodyPlant,
    context: Context,
    instance: ModelInstanceIndex,
    efforts: Mapping[str, float],
) -> tuple[set[str], str]:
    """Returns joints with efforts that no motor of such a robot has, and words; "" if none."""
    size, mass = extent(plant, context, instance), plant.CalcTotalMass(context, [instance])
    odd = dict[str, str]()
    for joint in map(plant.get_joint, plant.GetJointIndices(instance)):
        unit, effort = effort_unit(joint), efforts.get(joint.name(), math.inf)
        most = (_MOST_FORCE if unit == "N" else _MOST_TORQUE * size) * GRAVITY_M_S2 * mass
        if joint.num_velocities() == 1 and most < effort < math.inf:
            odd[joint.name()] = f"{effort:g} {unit}, at most {most:.3g} expected"
    few = listed(dict([*odd.items()][:_NUM_LISTED])) + " ..." * (len(odd) > _NUM_LISTED)
    what = f"limits that no motor of a robot of {mass:.3g} kg and {size:.2g} m has (placeholders?)"
    return set(odd), f"{len(odd)} joints have {what}: {few}" if odd else ""
