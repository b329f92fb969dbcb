"""Identifies a robot's base, legs, arms and contact points from its URDF, or refuses it."""

import math
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.geometry import Capsule, Cylinder, Shape, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import Joint
from pydrake.systems.framework import DiagramBuilder

from drake_safety.importing.urdf_copy import JointDrives, UrdfCopy
from drake_safety.robots.model_files import package_parser
from drake_safety.robots.plausibility import listed

WITHOUT_STOPS_RAD = 720.0
"""Range of a leg's last joint from which it turns a wheel; below, limits may be degrees."""
_CORNER_RADIUS_M = 0.005  # Radius of spheres at the corners of a flat foot.
_GUESSED_RADIUS_M = 0.02
_STOP_RAD = 0.05  # Distance from a stop of a joint that cannot be at zero.
_FLAT_M = 1e-3  # Height over a sole's lowest part within which other parts touch as well.
_LEVEL_M = 0.005  # Height over the lowest sphere within which others count as contacts.
_LEAST_INERTIA = 1e-10  # Inertia or mass that a joint moves [kg·m², kg].
_SIDES = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("L", "R"), ("l", "r"))


@dataclass(kw_only=True)
class Limb:
    """A leg or an arm."""

    body: str  # At its end, which touches the ground or reaches.
    joints: list[str]  # Its own, starting at the base.
    points: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))
    """Centres of contact spheres in the body's frame, (n, 3) [m]."""
    radius_m: float = _GUESSED_RADIUS_M
    is_own_shape: bool = False  # The URDF has these spheres.
    is_guess: bool = True  # The URDF has no collision shape at the end.


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
        plant, self._scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
        try:
            (self.instance,) = package_parser(plant).AddModels(str(path))
            plant.Finalize()
        # Where a condition of Drake's C++ fails, pydrake raises SystemExit.
        except (RuntimeError, ValueError, SystemExit) as error:
            reason = str(error).replace(str(path), "")
            raise ValueError(f"Drake cannot read '{self.source}': {reason}") from error
        self.plant, self._diagram = plant, builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self.context = plant.GetMyMutableContextFromRoot(self._root)
        bodies = [*map(plant.get_body, plant.GetBodyIndices(self.instance))]
        self.bodies = [body.name() for body in bodies]
        floating = [body.name() for body in bodies if body.is_floating_base_body()]
        if len(floating) != 1:
            raise ValueError(f"'{self.source}' must have one floating body; got {floating}")
        (self.base,) = floating
        joints = [plant.get_joint(i) for i in plant.GetJointIndices(self.instance)]
        if odd := [j.name() for j in joints if 1 < j.num_velocities() < 6]:
            raise ValueError(f"'{self.source}': joints {odd} have more than one degree of freedom")
        self._above = {joint.child_body().name(): joint for joint in joints}
        single = (joint for joint in joints if joint.num_velocities() == 1)
        self.joints: list[Joint] = sorted(single, key=lambda joint: joint.position_start())
        self._index = {joint.name(): joint.position_start() for joint in self.joints}
        self.limits, self._neutral = dict[str, tuple[float, float]](), dict[str, float]()
        for joint in self.joints:
            (low,), (high,) = joint.position_lower_limits(), joint.position_upper_limits()
            self.limits[joint.name()] = low, high
            # The position nearest to zero that is not beyond a stop, nor at one unless zero is.
            room = 0.0 if low <= 0.0 <= high else min(_STOP_RAD, 0.1 * (high - low))
            self._neutral[joint.name()] = float(np.clip(0.0, low + room, high - room))
        self.set_joints({})
        self.total_mass = plant.CalcTotalMass(self.context, [self.instance])

    def set_joints(self, values: Mapping[str, float]) -> None:
        """Sets joint positions [rad]; other joints are as close to zero as their limits allow."""
        q = self.plant.GetPositions(self.context)
        for name, value in {**self._neutral, **values}.items():
            q[self._index[name]] = value
        self.plant.SetPositions(self.context, q)

    def rest_joints(self, names: Collection[str]) -> None:
        """Moves joints, where they are not set otherwise, off their stops."""
        for name in names:
            low, high = self.limits[name]
            room = min(_STOP_RAD, 0.25 * (high - low))
            self._neutral[name] = float(np.clip(0.0, low + room, high - room))

    def posture(self) -> dict[str, float]:
        """Returns the present joint positions by name [rad]."""
        return {joint.name(): joint.GetOnePosition(self.context) for joint in self.joints}

    def center_of_mass(self) -> np.ndarray:
        """Returns the centre of mass in the base's frame, (3,) [m]."""
        return self.plant.CalcCenterOfMassPositionInWorld(self.context, [self.instance])

    def chain(self, body: str) -> list[str]:
        """Returns the joints that move a body, starting at the base."""
        names: list[str] = []
        while body in self._above:
            joint = self._above[body]
            if joint.num_velocities() == 1:
                names.insert(0, joint.name())
            body = joint.parent_body().name()
        return names

    def pose(self, body: str) -> RigidTransform:
        """Returns the pose of a body in the base's frame."""
        return self.plant.GetBodyByName(body, self.instance).EvalPoseInWorld(self.context)

    def joint_origin(self, joint: str) -> np.ndarray:
        """Returns the position of a joint in the base's frame, (3,) [m]."""
        frame = self.plant.GetJointByName(joint, self.instance).frame_on_child()
        return frame.CalcPoseInWorld(self.context).translation()

    def positions(self, limb: Limb) -> np.ndarray:
        """Returns a limb's contact points in the base's frame, (n, 3) [m]."""
        return (self.pose(limb.body) @ limb.points.T).T

    def leaves(self) -> list[list[str]]:
        """Returns groups of welded bodies at the ends of the kinematic tree."""
        carriers = {joint.parent_body().name() for joint in self.joints}
        groups = [self.welded(joint.child_body().name()) for joint in self.joints]
        return [group for group in groups if not carriers & set(group)]

    def _groups(self, named: list[str] | None) -> list[list[str]]:
        """The ends of the tree, or the groups with the links that a user named."""
        groups = self.leaves()
        ends = [name for group in groups for name in group]
        if unknown := [name for name in named or () if name not in ends]:
            raise ValueError(f"no limb ends in links {unknown}; limbs end in {ends}")
        return groups if named is None else [one for one in groups if set(one) & set(named)]

    def welded(self, body: str) -> list[str]:
        """Returns the bodies welded to a body, including itself."""
        welded = self.plant.GetBodiesWeldedTo(self.plant.GetBodyByName(body, self.instance))
        return [other.name() for other in welded]

    def legs(self, feet: list[str] | None = None) -> list[Limb]:
        """Returns the limbs that reach lowest, or the limbs that end in the given links."""
        groups = self._groups(feet)
        if feet is None:
            floor = min(map(self.lowest, groups), default=0.0)
            # Hanging arms end well above the ground.
            highest = floor + max(-0.25 * floor, 0.02)
            moved = (group for group in groups if len(self.chain(group[0])) >= 2)
            groups = [group for group in moved if self.lowest(group) <= highest]
        if len(groups) < 2:
            ends = [name for group in self.leaves() for name in group]
            what = f"found {len(groups)} feet, expected at least 2: name them by --feet"
            raise ValueError(f"{what}; limbs end in {ends}")
        limbs = [self._leg(group) for group in groups]
        shared = set.intersection(*(set(limb.joints) for limb in limbs))
        for limb in limbs:
            limb.joints = [name for name in limb.joints if name not in shared]
        # Front to back, then right to left, for readability.
        places = [np.round(self.positions(limb).mean(axis=0), 1) for limb in limbs]
        return [limbs[i] for i in np.lexsort([[y for _, y, _ in places], [-p[0] for p in places]])]

    def arms(self, legs: list[Limb], named: list[str] | None = None) -> list[Limb]:
        """Returns other limbs that end in named links, by default limbs of four joints or more."""
        feet = {limb.body for limb in legs}
        # Ends of limbs by their first four joints: chains and bodies. Fingers are not limbs.
        hands: dict[tuple[str, ...], list[tuple[list[str], str]]] = {}
        for group in self._groups(named):
            chain = self.chain(group[0])
            if (named is not None or len(chain) >= 4) and not feet & set(group):
                hands.setdefault(tuple(chain[:4]), []).append((chain, group[-1]))
        arms = []
        for fingers in hands.values():
            chain, body = fingers[0]
            if len(fingers) > 1:
                steps = zip(*(chain for chain, _ in fingers), strict=False)
                chain = [names[0] for names in steps if len(set(names)) == 1]
                joint = self.plant.GetJointByName(chain[-1], self.instance)
                body = joint.child_body().name()
            arms.append(Limb(body=body, joints=chain))
        # Joints of the torso are shared between arms.
        chains = {arm.body: {*arm.joints} for arm in arms}
        for arm in arms:
            others = set().union(*(chains[body] for body in chains if body != arm.body))
            arm.joints = [name for name in arm.joints if name not in others]
        return arms

    def geometries(
        self, bodies: list[str]
    ) -> Iterator[tuple[str, Shape, RigidTransform, RigidTransform, np.ndarray]]:
        """Yields the collision shapes of bodies: body, shape, pose, its box's pose, half edges."""
        inspector = self._scene_graph.model_inspector()
        for name in bodies:
            body = self.plant.GetBodyByName(name, self.instance)
            for geometry in self.plant.GetCollisionGeometriesForBody(body):
                X_WG = self.pose(name) @ inspector.GetPoseInFrame(geometry)
                hull = inspector.GetConvexHull(geometry)
                box = inspector.GetObbInGeometryFrame(geometry)
                if hull is not None:
                    middle, edges = hull.CalcBoundingBox()
                    X_GO, half = RigidTransform(middle), np.array(edges) / 2
                elif box is not None:
                    X_GO, half = box.pose(), np.array(box.half_width())
                else:  # It is boundless.
                    continue
                yield name, inspector.GetShape(geometry), X_WG, X_WG @ X_GO, half

    def overlaps(self) -> set[tuple[str, str]]:
        """Returns pairs of links that overlap in the present posture, in alphabetical order."""
        context = self._scene_graph.GetMyContextFromRoot(self._root)
        query = self._scene_graph.get_query_output_port().Eval(context)
        pairs = set()
        for contact in query.ComputePointPairPenetration():
            frames = map(query.inspector().GetFrameId, (contact.id_A, contact.id_B))
            low, high = sorted(self.plant.GetBodyFromFrameId(frame).name() for frame in frames)
            pairs.add((low, high))
        return pairs

    def lowest(self, group: list[str]) -> float:
        """Returns the height of bodies' lowest point over the base [m]."""
        lowest = [shape.lowest_m for shape in self._shapes(group)]
        return min(lowest or [float(self.pose(name).translation()[2]) for name in group])

    def _leg(self, group: list[str]) -> Limb:
        joints, shapes = self.chain(group[0]), self._shapes(group)
        if not shapes:
            # A body whose name contains "foot", or the last one.
            body = max(group, key=lambda name: ("foot" in name.lower(), group.index(name)))
            return Limb(body=body, joints=joints)
        # A sphere of the URDF's rather than what is hardly lower, such as the shank at its height.
        foot = min(shapes, key=lambda shape: shape.lowest_m - _LEVEL_M * shape.is_sphere)
        # A sole may be several shapes.
        level_m = foot.lowest_m + _FLAT_M
        if foot.is_sphere:
            level_m = min(shape.lowest_m for shape in shapes) + _LEVEL_M
        low = [shape for shape in shapes if shape.lowest_m < level_m]
        alike = [s for s in low if (s.body, s.is_sphere) == (foot.body, foot.is_sphere)]
        alike = [shape for shape in alike if abs(shape.radius_m - foot.radius_m) < 1e-6]
        centers = np.concatenate([shape.centers for shape in alike])
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
        shapes = []
        for name, shape, X_WG, X_WO, half in self.geometries(group):
            # A flat cylinder that lies on the ground is a sole.
            is_flat = isinstance(shape, Cylinder) and shape.length() < 2 * shape.radius()
            is_plate = is_flat and abs(X_WG.rotation().matrix()[2, 2]) > 0.7
            if isinstance(shape, Sphere):
                spheres = X_WG.translation()[None], shape.radius()
            elif isinstance(shape, Capsule | Cylinder) and not is_plate:
                radius = shape.radius()
                rise = shape.length() / 2 - (0 if isinstance(shape, Capsule) else radius)
                ends = np.array([[0, 0, -rise], [0, 0, rise]]) if rise > 0 else np.zeros((1, 3))
                centers = (X_WG @ ends.T).T
                is_upright = abs(X_WG.rotation().matrix()[2, 2]) > 0.7
                spheres = centers[[np.argmin(centers[:, 2])]] if is_upright else centers, radius
            else:
                # The largest square in a round plate.
                spheres = _corners(X_WO, half * ([*2 * [math.sqrt(0.5)], 1] if is_plate else 1))
            shapes.append(_Shape(name, *spheres, isinstance(shape, Sphere)))
        return shapes


def _corners(X_WG: RigidTransform, half: np.ndarray) -> tuple[np.ndarray, float]:
    """Spheres that replace a box: at its lower corners, or one below a small box."""
    down = X_WG.rotation().matrix().T @ [0.0, 0.0, -1.0]
    axis = int(np.argmax(np.abs(down)))
    # A sole that is longer is flat.
    if np.delete(half, axis).max() < 0.035 and np.linalg.norm(half) < 0.12:
        radius, point = float(np.sort(half)[0]), np.zeros(3)
        point[axis] = math.copysign(half[axis] - min(radius, half[axis]), down[axis])
        return (X_WG @ point)[None], radius
    # A thin sole's spheres rise above it.
    inner = half - _CORNER_RADIUS_M
    inner = np.where(np.arange(3) == axis, inner, np.maximum(inner, 0.0))
    signs = np.array(np.meshgrid(*3 * [[-1, 1]])).reshape(3, -1).T
    signs = signs[signs[:, axis] * down[axis] > 0]
    return (X_WG @ (signs * inner).T).T, _CORNER_RADIUS_M


def require_feet(survey: Survey, copy: UrdfCopy) -> None:
    """Refuses to guess feet of limbs whose collision meshes were not found or not read."""
    groups = [group for group in survey.leaves() if len(survey.chain(group[0])) >= 2]
    heights = [*map(survey.lowest, groups)]
    floor = min(heights, default=0.0)
    shaped = {name for name, *_ in survey.geometries(survey.bodies)}
    lost = [
        f"'{name}' ({', '.join(copy.mesh_urls[name])})"
        for group, z in zip(groups, heights, strict=True)
        for name in group
        if name in copy.bare_links
        and z < 0.4 * floor
        # The remaining links reach lower than the lost link, such as a foot's cover.
        and (survey.pose(name).translation()[2] < z - 0.25 * floor or not shaped & set(group))
    ]
    if lost:
        what = f"no collision meshes at the ends of limbs: {'; '.join(lost)}"
        remedy = "put them where the URDF says, or name the feet by --feet"
        raise ValueError(f"new: '{survey.source}': {what}; {remedy}. {'. '.join(copy.left_out)}")


def require_motors(survey: Survey, legs: list[Limb], moved: Collection[str]) -> None:
    """Refuses legs with joints that no motor moves by itself, unless a policy ``moved`` them."""
    drives = survey.drives
    joints = list(dict.fromkeys(joint for limb in legs for joint in survey.chain(limb.body)))
    coupled = {name: drives.mimics[name] for name in joints if name in drives.mimics}
    passive = {name: why for name, why in drives.passive(joints).items() if name not in moved}
    limits = ((name, *survey.limits[name]) for name in survey.limits if name in joints)
    stuck = {name: f"{low:g}" for name, low, high in limits if low == high}
    for names, what, remedy in (
        (coupled, "follow others by <mimic>", "remove <mimic> if each has a motor of its own"),
        (passive, "have no motor", "add a <transmission> if they have one, or fix them"),
        (stuck, "have equal limits", "correct <limit>, or fix them"),
    ):
        if names:
            text = f"every joint of a leg needs a motor, but some {what}: {listed(names)}"
            raise ValueError(f"new: '{survey.source}': {text}. Remedy: {remedy}")


def require_masses(survey: Survey) -> None:
    """Refuses joints that move nothing with mass or inertia, whose acceleration is infinite."""
    M = survey.plant.CalcMassMatrix(survey.context)
    for joint in survey.joints:
        if M[joint.velocity_start(), joint.velocity_start()] < _LEAST_INERTIA:
            what = f"joint '{joint.name()}' moves link '{joint.child_body().name()}'"
            raise ValueError(f"new: '{survey.source}': {what}, which has no mass or inertia")


def base_at_hips(survey: Survey, legs: list[Limb]) -> RigidTransform | None:
    """Returns a pose between the hips if the root link is far from them."""
    hips = np.array([survey.joint_origin(limb.joints[0]) for limb in legs])
    feet = np.array([survey.positions(limb).mean(axis=0) for limb in legs])
    length = np.linalg.norm(feet - hips, axis=1).mean()
    x, y, z = middle = 0.5 * (hips.min(axis=0) + hips.max(axis=0))
    is_near = -0.2 * length < -z < 1.2 * length and math.hypot(x, y) < 0.5 * length
    return None if is_near else RigidTransform(middle)


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
