"""Writes the robot of an MJCF, MuJoCo's format, as a URDF, and keeps what a URDF cannot hold."""

import math
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis, Quaternion
from pydrake.math import RigidTransform, RollPitchYaw

from drake_safety.extras import require_extra
from drake_safety.importing.urdf_copy import as_text
from drake_safety.robots.urdf import DRAKE, as_number

_SIZES = ("count", "nrow", "ncol", "width", "height")
_MOST_CELLS, _MOST_COPIES = 1e8, 1e4  # Cells of a height field or picture; copies of replicates.
_GREY = [0.5, 0.5, 0.5, 1.0]  # MuJoCo's colour of a geom that states none.
_STL = [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]


@dataclass(kw_only=True)
class ModelFacts:
    """Facts in a model file that a URDF lacks, by the names of joints and bodies."""

    # Stiffness and damping of position servos [N·m/rad, N·m·s/rad].
    gains: dict[str, tuple[float, float]] = field(default_factory=dict)
    rotor_inertia: dict[str, float] = field(default_factory=dict)  # As the joints feel it [kg·m²].
    postures: dict[str, dict[str, float]] = field(default_factory=dict)  # By keyframe [rad].
    # Pairs of bodies that do not collide, each in alphabetical order.
    apart: set[tuple[str, str]] = field(default_factory=set)
    left_out: list[str] = field(default_factory=list)  # A note each.


def is_mjcf(path: Path) -> bool:
    """Whether the root element of a file is ``<mujoco>``."""
    try:
        return ET.parse(path).getroot().tag == "mujoco"
    except (ET.ParseError, OSError):
        return False


def mjcf_to_urdf(path: Path, target: Path) -> ModelFacts:
    """Writes the robot of an MJCF as a URDF, with its meshes as STL in folders beside it.

    The robot is the tree of bodies with the most joints, of the same names, frames and zeros.
    """
    require_extra("mujoco", f"'{path}' is MJCF")
    import mujoco

    _check_sizes(path)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compiler.fusestatic = False  # Keeps the names of welded bodies.
        robot = _Robot(mujoco, spec.compile(), target.parent)
    except ValueError as error:
        raise ValueError(f"MJCF '{path}': {error}") from error
    urdf = _tag("robot", *robot.parts, name=target.stem, **{"xmlns:drake": DRAKE})
    target.write_text(urdf, encoding="utf-8")
    return robot.facts


def _check_sizes(path: Path) -> None:
    """Checks what a file asks MuJoCo to allocate, such as height fields and copies of bodies."""
    try:
        elements = [*ET.parse(path).iter()]
    except (OSError, ET.ParseError):
        return  # MuJoCo says why.
    copies = 1.0
    for element in elements:
        stated = {key: element.get(key, "") for key in _SIZES if key in element.attrib}
        sizes = [as_number(text, 0.0) for text in " ".join(stated.values()).split()]
        size = math.prod(max(value, 1.0) for value in sizes)
        copies *= size if element.tag == "replicate" else 1.0
        if not (size <= _MOST_CELLS and copies <= _MOST_COPIES):
            raise ValueError(f"MJCF '{path}': <{element.tag}> with {stated} takes too much memory")


class _Robot:
    """The URDF of the robot in a compiled model; its bodies and joints are names by index."""

    def __init__(self, mujoco: Any, model: Any, folder: Path):
        self.mujoco, self.model, self.folder = mujoco, model, folder
        self.facts, self.parts = ModelFacts(), list[str]()
        roots = model.body_rootid[model.jnt_bodyid]
        if not len(roots):
            raise ValueError("it has no joint")
        (base, _), *others = Counter(roots.tolist()).most_common()
        self.bodies = self._names("body", np.flatnonzero(model.body_rootid == base).tolist())
        ids = np.flatnonzero(roots == base)
        is_base, num_ways = model.jnt_bodyid[ids] == base, int(model.body_dofnum[base])
        # A free joint, or as free by three slides and a ball or three hinges.
        if num_ways not in (0, 6):
            what = f"the base '{self.bodies[base]}' moves in {num_ways} of 6 directions"
            raise ValueError(f"{what}; replace its joints by <freejoint/>")
        self.joints = self._names("joint", ids[~is_base].tolist())
        for j in self.joints:
            if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_BALL:
                child = self.bodies[int(model.jnt_bodyid[j])]
                raise ValueError(f"body '{child}' has a ball joint; replace it by three hinges")
        fixed = [] if num_ways else [base]
        self._note("moving bodies beside the robot are left out", "body", [i for i, _ in others])
        self._note("the base is fixed to the world there, and floats here", "body", fixed)
        self._note("tendons are left out", "tendon", range(model.ntendon))
        springs = [j for j in self.joints if model.joint(j).stiffness[0] > 0]
        self._note("springs are left out", "joint", springs)
        self.damping = {j: float(model.joint(j).damping[0]) for j in self.joints}
        self.efforts: dict[int, float] = {}
        self.mimics: dict[int, str] = {}
        self._read_actuators()
        self._read_constraints()
        for body in self.bodies:
            if body != base:
                self._add_joints(body)
            self._add_link(body)
        for pair in (divmod(code, 1 << 16) for code in model.exclude_signature.tolist()):
            if self.bodies.keys() >= set(pair):
                one, other = sorted(self.bodies[i] for i in pair)
                self.facts.apart.add((one, other))
        for key, qpos in enumerate(model.key_qpos):
            q = {name: float(qpos[model.jnt_qposadr[j]]) for j, name in self.joints.items()}
            self.facts.postures[model.key(key).name or str(key)] = q

    def _names(self, kind: str, ids: Iterable[int]) -> dict[int, str]:
        return {i: getattr(self.model, kind)(i).name or f"{kind}_{i}" for i in ids}

    def _note(self, what: str, kind: str, ids: Iterable[int]) -> None:
        if names := self._names(kind, ids).values():
            self.facts.left_out.append(f"{what}: {', '.join(names)}")

    def _read_actuators(self) -> None:
        model, mujoco = self.model, self.mujoco
        gains = {j: np.zeros(2) for j in self.joints}
        armature = {j: float(model.joint(j).armature[0]) for j in self.joints}
        others: dict[int, int] = {}  # Joints of other actuators than motors.
        of_joint = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT
        for i in range(model.nu):
            one, j = model.actuator(i), int(model.actuator_trnid[i, 0])
            if int(one.trntype[0]) not in of_joint:
                others[i] = j = -1
            if j not in self.joints:
                continue
            gear, bias = abs(float(one.gear[0])), one.biastype[0]
            limit = float(np.abs(one.forcerange).max()) if one.forcelimited[0] else math.inf
            is_fixed = one.gaintype[0] == mujoco.mjtGain.mjGAIN_FIXED
            if not (is_fixed and bias == mujoco.mjtBias.mjBIAS_NONE):
                others[i] = j
                is_integrated = one.dyntype[0] == mujoco.mjtDyn.mjDYN_INTEGRATOR
                if bias == mujoco.mjtBias.mjBIAS_AFFINE and not is_integrated:
                    # A servo may be two actuators, of position and of velocity.
                    gains[j] -= gear**2 * one.biasprm[1:3]
            elif one.ctrllimited[0]:
                limit = min(limit, float(np.abs(one.gainprm[0] * one.ctrlrange).max()))
            self.efforts[j] = self.efforts.get(j, 0.0) + gear * limit
            armature[j] += gear**2 * float(model.actuator_armature[i])
            self.damping[j] += gear**2 * float(model.actuator_damping[i])
        odd = [i for i, j in others.items() if j < 0 or gains[j][0] <= 0]
        what = "actuators that are neither motors nor position servos of a joint have no gains"
        self._note(what, "actuator", odd)
        for j in (j for j in self.efforts if model.jnt_actfrclimited[j]):
            most = float(np.abs(model.jnt_actfrcrange[j]).max())
            self.efforts[j] = min(self.efforts[j], most)
        names, facts = self.joints, self.facts
        facts.gains = {names[j]: (float(k), float(d)) for j, (k, d) in gains.items() if k > 0}
        facts.rotor_inertia = {names[j]: inertia for j, inertia in armature.items() if inertia > 0}

    def _read_constraints(self) -> None:
        """Finds joints that others drive; refuses loops."""
        model, kinds, left_out = self.model, self.mujoco.mjtEq, []
        for i in np.flatnonzero(model.eq_active0).tolist():
            kind, pair = int(model.eq_type[i]), [int(model.eq_obj1id[i]), int(model.eq_obj2id[i])]
            if kind in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
                if model.eq_objtype[i] == self.mujoco.mjtObj.mjOBJ_SITE:
                    pair = model.site_bodyid[pair].tolist()
                if self.bodies.keys() >= set(pair):
                    one, other = (self.bodies[i] for i in pair)
                    raise ValueError(f"a constraint connects '{one}' and '{other}' to a loop")
            if kind == kinds.mjEQ_JOINT and self.joints.keys() >= set(pair):
                self.mimics[pair[0]] = _tag("mimic", joint=self.joints[pair[1]])
            else:
                left_out.append(i)
        self._note("constraints are left out", "equality", left_out)

    def _add_link(self, body: int) -> None:
        one, inside = self.model.body(body), []
        if one.mass[0] > 0:
            names = dict(zip(("ixx", "iyy", "izz"), one.inertia, strict=True))
            inertia = _tag("inertia", **names, **dict.fromkeys(("ixy", "ixz", "iyz"), 0.0))
            mass, origin = _tag("mass", value=one.mass), _origin(_pose(one.ipos, one.iquat))
            inside.append(_tag("inertial", origin, mass, inertia))
        for geom in range(one.geomadr[0], one.geomadr[0] + one.geomnum[0]):
            inside += self._shapes(geom)
        self.parts.append(_tag("link", *inside, name=self.bodies[body]))

    def _shapes(self, geom: int) -> list[str]:
        """A geom as visual, as collision shape, or both."""
        model, size = self.model, self.model.geom_size[geom]
        radius, length = size[0], 2.0 * size[1]
        kind = self.mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()
        known = {
            "sphere": lambda: _tag("sphere", radius=radius),
            "box": lambda: _tag("box", size=2.0 * size),
            "cylinder": lambda: _tag("cylinder", radius=radius, length=length),
            "capsule": lambda: _tag("drake:capsule", radius=radius, length=length),
            "ellipsoid": lambda: _tag("drake:ellipsoid", a=size[0], b=size[1], c=size[2]),
            "mesh": lambda: _tag("mesh", filename=self._mesh(int(model.geom_dataid[geom]))),
        }
        if kind not in known:
            self._note(f"shapes of type {kind} are left out", "geom", [geom])
            return []
        origin = _origin(_pose(model.geom_pos[geom], model.geom_quat[geom]))
        shape, shapes = _tag("geometry", known[kind]()), []
        if model.geom_group[geom] < 3:  # MuJoCo shows geoms of the groups 0 to 2.
            rgba, material = model.geom_rgba[geom], int(model.geom_matid[geom])
            if material >= 0 and np.allclose(rgba, _GREY):
                rgba = model.mat_rgba[material]
            colour = _tag("material", _tag("color", rgba=rgba), name=f"rgba {as_text(rgba)}")
            shapes.append(_tag("visual", origin, shape, colour))
        paired = geom in model.pair_geom1 or geom in model.pair_geom2
        if model.geom_contype[geom] or model.geom_conaffinity[geom] or paired:
            shapes.append(_tag("collision", origin, shape))
        return shapes

    def _mesh(self, mesh: int) -> str:
        """Writes a mesh as STL, in the frame that MuJoCo gives it; returns its relative path."""
        model = self.model
        first, start = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        facets = np.zeros(model.mesh_facenum[mesh], _STL)
        facets["corners"] = model.mesh_vert[first + model.mesh_face[start : start + len(facets)]]
        # A folder each, as different names may become the same.
        name = re.sub(r"[^\w.-]", "_", model.mesh(mesh).name) or "mesh"
        file = self.folder / str(mesh) / f"{name}.stl"
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(bytes(80) + len(facets).to_bytes(4, "little") + facets.tobytes())
        return f"{mesh}/{file.name}"

    def _add_joints(self, body: int) -> None:
        """Adds a body's joints, with links between them and to one that is not at its origin."""
        model, name = self.model, self.bodies[body]
        parent = self.bodies[int(model.body_parentid[body])]
        X_PB = _pose(model.body_pos[body], model.body_quat[body])
        joints = [j for j in self.joints if model.jnt_bodyid[j] == body]
        for j in joints:
            one, joint = model.joint(j), self.joints[j]
            child = name if j == joints[-1] and not one.pos.any() else f"{joint}_frame"
            if child != name:
                self.parts.append(_tag("link", name=child))
            limit = dict(zip(("lower", "upper"), one.range, strict=True)) if one.limited[0] else {}
            # Bodies are drawn at the joint's reference, which need not be zero.
            q = float(one.qpos0[0])
            if one.type[0] == self.mujoco.mjtJoint.mjJNT_SLIDE:
                kind, X_AJ = "prismatic", RigidTransform(-q * one.axis)
            else:
                kind = "revolute" if limit else "continuous"
                X_AJ = RigidTransform(AngleAxis(-q, one.axis), np.zeros(3))
            if math.isfinite(self.efforts.get(j, math.inf)):
                limit["effort"] = self.efforts[j]
            dynamics = _tag("dynamics", damping=self.damping[j], friction=one.frictionloss)
            inside = [_tag("axis", xyz=one.axis), dynamics, self.mimics.get(j, "")]
            inside += [_tag("limit", **limit)] if limit else []
            X_PJ = X_PB @ RigidTransform(one.pos) @ X_AJ
            self._add_joint(joint, kind, parent, child, X_PJ, *inside)
            if j in self.efforts:
                kind = _tag("type", "transmission_interface/SimpleTransmission")
                inside = [kind, _tag("joint", name=joint), _tag("actuator", name=f"{joint}_motor")]
                self.parts.append(_tag("transmission", *inside, name=f"{joint}_transmission"))
            parent, X_PB = child, RigidTransform(-one.pos)
        if parent != name:
            self._add_joint(f"{name}_fixed", "fixed", parent, name, X_PB)

    def _add_joint(
        self, name: str, kind: str, parent: str, child: str, X_PJ: RigidTransform, *inside: str
    ) -> None:
        links = _tag("parent", link=parent), _tag("child", link=child)
        self.parts.append(_tag("joint", _origin(X_PJ), *links, *inside, name=name, type=kind))


def _pose(position: np.ndarray, quaternion: np.ndarray) -> RigidTransform:
    return RigidTransform(Quaternion(quaternion / np.linalg.norm(quaternion)), position)


def _origin(X: RigidTransform) -> str:
    return _tag("origin", xyz=X.translation(), rpy=RollPitchYaw(X.rotation()).vector())


def _tag(tag: str, *inside: str, **attributes: Any) -> str:
    """An element of the URDF; attributes are text, a number or several."""
    words = ""
    for key, value in attributes.items():
        text = value if isinstance(value, str) else as_text(np.atleast_1d(value))
        words += f" {key}={quoteattr(text)}"
    return f"<{tag}{words}>{''.join(inside)}</{tag}>"
