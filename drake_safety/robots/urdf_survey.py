"""Identifies a robot's base, legs, arms and contact points from its URDF."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.geometry import Box, Capsule, Cylinder, GeometryId, Obb, Shape, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import Joint, ModelInstanceIndex, RevoluteJoint
from pydrake.systems.framework import Context, DiagramBuilder

from drake_safety.robots.joint_drives import JointDrives
from drake_safety.robots.model_files import package_parser

WITHOUT_STOPS_RAD = 4 * math.pi
"""Range of a joint from which it may turn a wheel."""
_CORNER_RADIUS_M = 0.005  # Radius of spheres at the corners of a flat foot.
_GUESSED_RADIUS_M = 0.02
_STOP_RAD = 0.05  # Distance from a stop of a joint that cannot be at zero.
_ROUND = 0.15  # Of a wheel's radius, by which it may be out of round.
_MATTERS = 1e-4  # Moment of inertia that matters, by the robot's mass times extent squared.
_POINT = 0.005  # Least radius of gyration, by the robot's extent.
_FLAT_M = 1e-3  # Height over a sole's lowest part within which other parts touch as well.
_LEVEL_M = 0.005  # Height over the lowest sphere within which others count as contacts.


@dataclass(kw_only=True)
class Limb:
    """A leg or an arm.

    Attributes:
        body: The body at its end, which touches the ground or reaches.
        joints: Its own joints, starting at the base.
        points: Centres of contact spheres in the body's frame, (n, 3) [m].
        is_own_shape: Whether the URDF has these spheres.
        is_guess: Whether the URDF has no collision shape at the end.
    """

    body: str
    joints: list[str]
    points: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))
    radius_m: float = _GUESSED_RADIUS_M
    is_own_shape: bool = False
    is_guess: bool = True


@dataclass(frozen=True)
class _Shape:
    """A collision shape as spheres: their centres in the base's frame, (n, 3) [m]."""

    body: str
    centers: np.ndarray
    radius_m: float
    is_sphere: bool = False

    @property
    def lowest_m(self) -> float:
        return float(self.centers[:, 2].min()) - self.radius_m


class Survey:
    """A URDF in a plant, with the base at the world's origin and all joints at or near zero."""

    def __init__(self, path: Path, source: Path | None = None, drives: JointDrives | None = None):
        self.source, self.drives = source or path, drives or JointDrives()
        builder = DiagramBuilder()
        plant: MultibodyPlant
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
        try:
            (self.instance,) = package_parser(plant).AddModels(str(path))
            plant.Finalize()
        # Where a condition of Drake's C++ fails, pydrake raises SystemExit.
        except (RuntimeError, ValueError, SystemExit) as error:
            reason = re.sub(rf"{re.escape(str(path))}:\d+: ", "", str(error))
            raise ValueError(f"Drake cannot read '{self.source}': {reason}") from error
        self.plant, self._scene_graph = plant, scene_graph
        self._diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self.context = plant.GetMyMutableContextFromRoot(self._root)
        bodies = [*map(plant.get_body, plant.GetBodyIndices(self.instance))]
        self.bodies = [body.name() for body in bodies]
        floating = [body.name() for body in bodies if body.is_floating_base_body()]
        if len(floating) != 1:
            raise ValueError(
                f"'{self.source}' must have exactly one floating body, its base; got "
                f"{floating or 'none'}. Remove a link 'world' and its joint"
            )
        (self.base,) = floating
        joints = [plant.get_joint(i) for i in plant.GetJointIndices(self.instance)]
        odd = [j.name() for j in joints if 1 < j.num_velocities() < 6]
        if odd:
            raise ValueError(f"'{self.source}': joints {odd} have more than one degree of freedom")
        single = (joint for joint in joints if joint.num_velocities() == 1)
        self.joints: list[Joint] = sorted(single, key=lambda joint: joint.position_start())
        self.limits = {
            joint.name(): (joint.position_lower_limit(), joint.position_upper_limit())
            for joint in self.joints
        }
        self._index = {joint.name(): joint.position_start() for joint in self.joints}
        neutral = {name: _near_zero(*limits) for name, limits in self.limits.items()}
        self._neutral = self.drives.coupled(neutral)
        self._above = {joint.child_body().name(): joint for joint in joints}
        self.set_joints({})
        self.total_mass = plant.CalcTotalMass(self.context, [self.instance])

    def set_joints(self, values: dict[str, float]) -> None:
        """Sets joint positions [rad]; other joints are as close to zero as their limits allow."""
        q = self.plant.GetPositions(self.context)
        for name, value in {**self._neutral, **values}.items():
            q[self._index[name]] = value
        self.plant.SetPositions(self.context, q)

    def rest_joints(self, values: dict[str, float]) -> None:
        """Sets the positions [rad] of joints that are not set otherwise, within their limits."""
        for name in self._index.keys() & values.keys():
            self._neutral[name] = np.clip(values[name], *self.limits[name])

    def posture(self) -> dict[str, float]:
        """Returns the present joint positions by name [rad]."""
        q = self.plant.GetPositions(self.context)
        return {name: float(q[index]) for name, index in self._index.items()}

    def center_of_mass(self) -> np.ndarray:
        """Returns the centre of mass in the base's frame, (3,) [m]."""
        return self.plant.CalcCenterOfMassPositionInWorld(self.context, [self.instance])

    def chain(self, body: str) -> list[str]:
        """Returns the joints that move a body, starting at the base."""
        found: list[str] = []
        while body in self._above:
            joint = self._above[body]
            if joint.num_velocities() == 1:
                found.append(joint.name())
            body = joint.parent_body().name()
        return found[::-1]

    def pose(self, body: str) -> RigidTransform:
        """Returns the pose of a body in the base's frame."""
        return self.plant.GetBodyByName(body, self.instance).EvalPoseInWorld(self.context)

    def joint_origin(self, joint: str) -> np.ndarray:
        """Returns the position of a joint in the base's frame, (3,) [m]."""
        frame = self.plant.GetJointByName(joint, self.instance).frame_on_child()
        return frame.CalcPoseInWorld(self.context).translation()

    def joint_pose(self, joint: Joint) -> RigidTransform:
        """Returns the present pose of a joint's child in its parent."""
        X_BP, X_BC = map(self.pose, (joint.parent_body().name(), joint.child_body().name()))
        return X_BP.inverse() @ X_BC

    def joint_axis(self, joint: str) -> np.ndarray:
        """Returns the direction of a joint's axis in the base's frame, (3,)."""
        one = self.plant.GetJointByName(joint, self.instance)
        axis = one.revolute_axis() if isinstance(one, RevoluteJoint) else one.translation_axis()
        R_BJ = one.frame_on_parent().CalcPoseInWorld(self.context).rotation()
        return R_BJ.matrix() @ axis

    def extent(self) -> float:
        """Returns the diagonal of the box around the origins of all bodies [m]."""
        return extent(self.plant, self.context, self.instance)

    def positions(self, limb: Limb) -> np.ndarray:
        """Returns a limb's contact points in the base's frame, (n, 3) [m]."""
        return (self.pose(limb.body) @ limb.points.T).T

    def leaves(self) -> list[list[str]]:
        """Returns groups of welded bodies at the ends of the kinematic tree."""
        carriers = {joint.parent_body().name() for joint in self.joints}
        groups = [self.welded(joint.child_body().name()) for joint in self.joints]
        return [group for group in groups if not carriers & set(group)]

    def welded(self, body: str) -> list[str]:
        """Returns the bodies welded to a body, including itself."""
        one = self.plant.GetBodyByName(body, self.instance)
        return [b.name() for b in self.plant.GetBodiesWeldedTo(one)]

    def collides(self, body: str) -> bool:
        """Whether a body or one welded to it has collision geometry."""
        return any(True for _ in self._geometries(self.welded(body)))

    def limbs(self) -> list[Limb]:
        """Returns the limbs of two joints or more."""
        return [self._leg(group) for group in self.leaves() if len(self.chain(group[0])) >= 2]

    def legs(self, feet: list[str] | None = None) -> list[Limb]:
        """Returns the limbs that reach lowest, or those that end in the given links."""
        groups = self.leaves()
        ends = [name for group in groups for name in group]
        for name in feet or ():
            if name not in ends:
                raise ValueError(f"no limb ends in link '{name}'; limbs end in {ends}")
        if feet is None:
            floor = min(map(self.lowest, groups), default=0.0)
            # Hanging arms end well above the ground.
            highest = floor + max(-0.25 * floor, 0.02)
            groups = [
                group
                for group in groups
                if self.lowest(group) <= highest and len(self.chain(group[0])) >= 2
            ]
        else:
            groups = [group for group in groups if set(group) & set(feet)]
        if len(groups) < 2:
            raise ValueError(
                f"found {len(groups)} feet, expected at least 2: name the links that touch the "
                f"ground by --feet; limbs end in {ends}"
            )
        limbs = [self._leg(group) for group in groups]
        shared = set.intersection(*(set(limb.joints) for limb in limbs))
        for limb in limbs:
            limb.joints = [name for name in limb.joints if name not in shared]
        # Front to back, then right to left, for readability.
        places = [np.round(self.positions(limb).mean(axis=0), 1) for limb in limbs]
        return [limbs[i] for i in np.lexsort([[y for _, y, _ in places], [-p[0] for p in places]])]

    def arms(self, legs: list[Limb]) -> list[Limb]:
        """Returns other limbs of four joints or more; a hand's fingers are no limbs."""
        feet = {limb.body for limb in legs}
        arms: dict[tuple[str, ...], list[tuple[list[str], str]]] = {}
        for group in self.leaves():
            chain = self.chain(group[0])
            if len(chain) >= 4 and not feet & set(group):
                arms.setdefault(tuple(chain[:4]), []).append((chain, group[-1]))
        found = []
        for start, members in arms.items():
            shared, body = members[0]
            if len(members) > 1:
                steps = zip(*(chain for chain, _ in members), strict=False)
                shared = [names[0] for names in steps if len(set(names)) == 1]
                joint = self.plant.GetJointByName(shared[-1], self.instance)
                body = joint.child_body().name()
            # Joints of the torso are shared between arms.
            others = {name for other in arms if other != start for name in arms[other][0][0]}
            found.append(Limb(body=body, joints=[name for name in shared if name not in others]))
        return found

    def wheels(self, legs: list[Limb]) -> list[str]:
        """Returns joints without stops that turn a round body at a leg's end.

        Such legs touch by a sphere as large as the wheel, unless they have one of their own.
        """
        found = []
        for limb in legs:
            low, high = self.limits[limb.joints[-1]]
            wheel = self._wheel(limb) if high - low > WITHOUT_STOPS_RAD else None
            if wheel is not None:
                found.append(limb.joints[-1])
                if not limb.is_own_shape:
                    limb.points, limb.radius_m = wheel
        return found

    def _wheel(self, limb: Limb) -> tuple[np.ndarray, float] | None:
        """Centre (1, 3) and radius of what touches the ground, if round about the last joint."""
        axis, origin = self.joint_axis(limb.joints[-1]), self.joint_origin(limb.joints[-1])
        group = self.welded(limb.body)
        lowest = self.lowest(group)
        for _, _, shape, X_WG, box in self._geometries(group):
            if box is None or isinstance(shape, Box):
                continue
            X_WO = X_WG @ box.pose()
            along = np.abs(X_WO.rotation().matrix().T @ axis)
            across = np.delete(box.half_width(), np.argmax(along))
            radius, center = float(across.max()), X_WO.translation()
            is_low = center[2] - 1.5 * radius < lowest
            is_turned = along.max() > 0.95 or isinstance(shape, Sphere)
            offset = max(np.ptp(across), np.linalg.norm(np.cross(axis, center - origin)))
            if is_low and is_turned and offset < _ROUND * radius:
                return (self.pose(limb.body).inverse() @ center)[None], radius
        return None

    def oversized(self) -> dict[str, float]:
        """Returns links with a collision shape beyond ten times the robot's extent; sizes [m]."""
        boxes = ((name, box) for name, _, _, _, box in self._geometries(self.bodies) if box)
        sizes = {name: 2 * max(box.half_width()) for name, box in boxes}
        return {name: size for name, size in sizes.items() if size > 10 * self.extent()}

    def _geometries(
        self, bodies: list[str]
    ) -> Iterator[tuple[str, GeometryId, Shape, RigidTransform, Obb | None]]:
        """The collision shapes of bodies: body, id, shape, pose, and the box in its frame."""
        inspector = self._scene_graph.model_inspector()
        for name in bodies:
            body = self.plant.GetBodyByName(name, self.instance)
            for one in self.plant.GetCollisionGeometriesForBody(body):
                X_WG = self.pose(name) @ inspector.GetPoseInFrame(one)
                box = inspector.GetObbInGeometryFrame(one)
                yield name, one, inspector.GetShape(one), X_WG, box

    def overlaps(self) -> set[tuple[str, str]]:
        """Returns pairs of links that overlap in the present posture."""
        query = self._scene_graph.get_query_output_port().Eval(
            self._scene_graph.GetMyContextFromRoot(self._root)
        )
        inspector = query.inspector()

        def link(geometry: GeometryId) -> str:
            return self.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)).name()

        pairs = [(link(one.id_A), link(one.id_B)) for one in query.ComputePointPairPenetration()]
        return {(min(pair), max(pair)) for pair in pairs}

    def lowest(self, group: list[str]) -> float:
        """Returns the height of bodies' lowest point over the base [m]."""
        lowest = [shape.lowest_m for shape in self._shapes(group)]
        return min(lowest or [float(self.pose(name).translation()[2]) for name in group])

    def _leg(self, group: list[str]) -> Limb:
        joints = self.chain(group[0])
        shapes = self._shapes(group)
        if not shapes:
            # A body whose name contains "foot", or the last one.
            body = max(group, key=lambda name: ("foot" in name.lower(), group.index(name)))
            return Limb(body=body, joints=joints)
        # A sphere of the URDF's rather than what is hardly lower, such as the shank at its height.
        foot = min(shapes, key=lambda one: one.lowest_m - (_LEVEL_M if one.is_sphere else 0.0))
        lowest_m = min(shape.lowest_m for shape in shapes)
        # A sole may be several shapes.
        level_m = lowest_m + _LEVEL_M if foot.is_sphere else foot.lowest_m + _FLAT_M
        centers = np.concatenate(
            [
                one.centers
                for one in shapes
                if (one.body, one.is_sphere) == (foot.body, foot.is_sphere)
                and abs(one.radius_m - foot.radius_m) < 1e-6
                and one.lowest_m < level_m
            ]
        )
        centers = centers[centers[:, 2] < centers[:, 2].min() + _LEVEL_M + foot.radius_m]
        return Limb(
            body=foot.body,
            joints=joints,
            points=(self.pose(foot.body).inverse() @ centers.T).T,
            radius_m=foot.radius_m,
            is_own_shape=foot.is_sphere,
            is_guess=False,
        )

    def _shapes(self, group: list[str]) -> list[_Shape]:
        found = []
        for name, geometry, shape, X_WG, box in self._geometries(group):
            hull = self._scene_graph.model_inspector().GetConvexHull(geometry)
            if isinstance(shape, Sphere):
                found.append(_Shape(name, X_WG.translation()[None], shape.radius(), True))
            elif isinstance(shape, Cylinder) and _is_plate(X_WG, shape):
                half = np.array([*2 * [math.sqrt(0.5) * shape.radius()], shape.length() / 2])
                found.append(_Shape(name, *_corners(X_WG, half)))
            elif isinstance(shape, Capsule | Cylinder):
                radius = shape.radius()
                half = shape.length() / 2 - (0 if isinstance(shape, Capsule) else radius)
                ends = np.array([[0, 0, -half], [0, 0, half]]) if half > 0 else np.zeros((1, 3))
                found.append(_Shape(name, (X_WG @ ends.T).T, radius))
            elif hull is not None:
                middle, edges = hull.CalcBoundingBox()
                X_WO = X_WG @ RigidTransform(middle)
                found.append(_Shape(name, *_corners(X_WO, np.array(edges) / 2)))
            elif box is not None:
                X_WO = X_WG @ box.pose()
                found.append(_Shape(name, *_corners(X_WO, np.array(box.half_width()))))
        return found


def _near_zero(low: float, high: float) -> float:
    """The position nearest to zero that is not beyond a stop, nor at one unless zero is."""
    if low <= 0.0 <= high:
        return 0.0
    room = min(_STOP_RAD, 0.1 * (high - low))
    return low + room if low > 0.0 else high - room


def _is_plate(X_WG: RigidTransform, shape: Cylinder) -> bool:
    """Whether a cylinder is flat and lies on the ground, as a sole does."""
    return shape.length() < 2 * shape.radius() and abs(X_WG.rotation().matrix()[2, 2]) > 0.7


def extent(plant: MultibodyPlant, context: Context, instance: ModelInstanceIndex) -> float:
    """Returns the diagonal of the box around the origins of a model's bodies [m]."""
    bodies = map(plant.get_body, plant.GetBodyIndices(instance))
    origins = [body.EvalPoseInWorld(context).translation() for body in bodies]
    return float(np.linalg.norm(np.ptp(origins, axis=0)))


def odd_inertias(plant: MultibodyPlant, context: Context, instance: ModelInstanceIndex) -> str:
    """Names links with an inertia that no body of a robot of this size has; "" if there is none.

    The radius of gyration √(I/m) is beyond the robot's extent, or a heavy link's is below 1/200.
    """
    size, total = extent(plant, context, instance), plant.CalcTotalMass(context, [instance])
    found = []
    for body in map(plant.get_body, plant.GetBodyIndices(instance)):
        M_BBo = body.default_spatial_inertia()
        mass = M_BBo.get_mass()
        if not mass > 0:
            continue
        G_BBcm = M_BBo.get_unit_inertia().ShiftToCenterOfMass(M_BBo.get_com())
        radius = math.sqrt(max(*G_BBcm.CalcPrincipalMomentsOfInertia(), 0.0))
        is_large = radius > size and mass * radius**2 > _MATTERS * total * size**2
        if is_large or (radius < _POINT * size and mass > 0.01 * total):
            found.append(
                f"'{body.name()}' {mass * radius**2:.3g} kg·m² at {mass:.3g} kg, a radius of "
                f"gyration of {radius:.2g} m"
            )
    if not found:
        return ""
    return (
        f"{len(found)} links have inertias that no body of a robot of {size:.2g} m has (kg·mm² or "
        f"g·mm² instead of kg·m²?): {'; '.join(found[:4])}{' ...' * (len(found) > 4)}"
    )


def _corners(X_WG: RigidTransform, half: np.ndarray) -> tuple[np.ndarray, float]:
    """Spheres that replace a box: at its lower corners, or one below a small box."""
    down = X_WG.rotation().matrix().T @ [0.0, 0.0, -1.0]
    axis = int(np.argmax(np.abs(down)))
    # A sole that is longer is flat.
    if np.delete(half, axis).max() < 0.035 and np.linalg.norm(half) < 0.12:
        radius = float(np.sort(half)[0])
        point = np.zeros(3)
        point[axis] = math.copysign(half[axis] - min(radius, half[axis]), down[axis])
        return (X_WG @ point)[None], radius
    inner = np.maximum(half - _CORNER_RADIUS_M, 0.0)
    # A thin sole's spheres rise above it.
    inner[axis] = half[axis] - _CORNER_RADIUS_M
    signs = np.array(np.meshgrid(*3 * [[-1, 1]])).reshape(3, -1).T
    signs = signs[signs[:, axis] * down[axis] > 0]
    return (X_WG @ (signs * inner).T).T, _CORNER_RADIUS_M
