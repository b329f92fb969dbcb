"""Legged robots for the tests: those of the package, and three made up on the spot."""

import functools
import math
import tempfile
from pathlib import Path

import numpy as np
import yaml

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.models import load_robot
from drake_safety.robots.robot_model import RobotModel, load_robot_file
from drake_safety.systems.trajectory_planner import to_world


def _link(name, mass, size, centre, collisions=()):
    """A box of a link; collisions are (centre, radius) spheres."""
    a, b, c = size
    x, y, z = centre
    spheres = "".join(
        f'<collision><origin xyz="{p[0]} {p[1]} {p[2]}"/><geometry><sphere radius="{r}"/>'
        "</geometry></collision>"
        for p, r in collisions
    )
    return (
        f'<link name="{name}"><inertial><origin xyz="{x} {y} {z}"/><mass value="{mass}"/>'
        f'<inertia ixx="{mass * (b * b + c * c) / 12}" iyy="{mass * (a * a + c * c) / 12}" '
        f'izz="{mass * (a * a + b * b) / 12}" ixy="0" ixz="0" iyz="0"/></inertial>{spheres}</link>'
    )


def _joint(name, parent, child, origin, axis, limits=(-2.5, 2.5), yaw=0.0):
    """A hinge; without limits it turns without stops."""
    x, y, z = origin
    kind = "continuous" if limits is None else "revolute"
    stops = "" if limits is None else f'lower="{limits[0]}" upper="{limits[1]}"'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{x} {y} {z}" rpy="0 0 {yaw}"/><axis xyz="{axis}"/>'
        f'<limit {stops} effort="40" velocity="20"/></joint>'
    )


def _write(folder, name, parts, robot):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.urdf").write_text(f'<robot name="{name}">{"".join(parts)}</robot>')
    path = folder / "robot.yaml"
    path.write_text(yaml.safe_dump({"name": name, "urdf": f"{name}.urdf", **robot}))
    return path


def _frame(body, joints, radius_m, **points):
    return {"body": body, "joints": joints, "radius_m": radius_m} | points


def write_hexapod(folder: Path) -> Path:
    """Writes a spider of six three-joint legs without transmissions; returns its robot.yaml."""
    parts = [_link("body", 6.0, (0.4, 0.4, 0.08), (0, 0, 0), [((0, 0, 0), 0.05)])]
    feet = {}
    for i in range(6):
        angle = math.pi / 6 + i * math.pi / 3
        hip = (0.2 * math.cos(angle), 0.2 * math.sin(angle), 0.0)
        coxa, femur, tibia = (f"{part}_{i}" for part in ("coxa", "femur", "tibia"))
        parts += [
            _link(coxa, 0.2, (0.05, 0.05, 0.05), (0.02, 0, 0)),
            _link(femur, 0.3, (0.15, 0.03, 0.03), (0.075, 0, 0)),
            _link(tibia, 0.2, (0.2, 0.02, 0.02), (0.1, 0, 0), [((0.2, 0, 0), 0.02)]),
            _joint(f"swing_{i}", "body", coxa, hip, "0 0 1", (-1, 1), angle),
            _joint(f"lift_{i}", coxa, femur, (0.05, 0, 0), "0 1 0"),
            _joint(f"knee_{i}", femur, tibia, (0.15, 0, 0), "0 1 0"),
        ]
        joints = [f"swing_{i}", f"lift_{i}", f"knee_{i}"]
        feet[f"foot_{i}"] = _frame(tibia, joints, 0.02, contact_points=[[0.2, 0.0, 0.0]])
    robot = {
        "base": "body",
        "posture": {"lift_.*": -0.4, "knee_.*": 1.6},
        "feet": feet,
        "joint_gains": {".*": {"stiffness": 200.0, "damping": 4.0}},
        "effort_limits": {".*": 40.0},
        "foot_friction": 0.9,
        "whole_body": {"orientation": {"body": {"weight": 20.0}}},
    }
    return _write(folder, "hexapod", parts, robot)


def _legs():
    """A pelvis on two six-joint legs, whose feet touch at four points each: parts and robot."""
    parts, feet = [_link("pelvis", 12.0, (0.2, 0.3, 0.3), (0, 0, 0.1))], {}
    corners = [[x, y, -0.05] for x in (-0.06, 0.1) for y in (-0.04, 0.04)]
    for side, y in (("left", 0.1), ("right", -0.1)):
        links = [f"{side}_{n}" for n in ("yaw", "roll", "thigh", "shin", "ankle", "sole")]
        joints = [f"{side}_{n}" for n in ("hip_z", "hip_x", "hip_y", "knee", "ankle_y", "ankle_x")]
        box, long, middle = (0.05, 0.05, 0.05), (0.06, 0.06, 0.3), (0, 0, -0.15)
        for link, mass in zip(links, (0.3, 0.3, 2.0, 1.0, 0.2), strict=False):
            shape = (long, middle) if mass >= 1.0 else (box, (0, 0, 0))
            parts.append(_link(link, mass, *shape))
        sole = [(p, 0.005) for p in corners]
        parts.append(_link(links[5], 0.5, (0.2, 0.1, 0.03), (0, 0, -0.04), sole))
        parents = ["pelvis", *links[:-1]]
        origins = [(0, y, 0), (0, 0, 0), (0, 0, 0), (0, 0, -0.3), (0, 0, -0.3), (0, 0, 0)]
        axes = ["0 0 1", "1 0 0", "0 1 0", "0 1 0", "0 1 0", "1 0 0"]
        parts += map(_joint, joints, parents, links, origins, axes)
        feet[side] = _frame(links[5], joints, 0.005, contact_points=corners)
    robot = {
        "base": "pelvis",
        "posture": {".*_hip_y": -0.4, ".*_knee": 0.8, ".*_ankle_y": -0.4},
        "feet": feet,
        "effort_limits": {".*": 80.0},
        "mirror": {"left_(.*)": r"right_\1"},
        "whole_body": {"orientation": {"pelvis": {"weight": 20.0}}},
    }
    return parts, robot


def write_biped(folder: Path) -> Path:
    """Writes a pelvis on two legs; returns its robot.yaml."""
    parts, robot = _legs()
    robot["joint_gains"] = {".*": {"stiffness": 400.0, "damping": 8.0}}
    # It has no arms, so it reaches with its head.
    robot["reaching_frames"] = {"head": {"body": "pelvis", "point": [0.0, 0.0, 0.25]}}
    return _write(folder, "biped", parts, robot)


HAND_POINT, HAND_RADIUS_M = (0.22, 0.0, 0.0), 0.04


def write_porter(folder: Path) -> Path:
    """Writes two legs with two arms, of which only the hands, spheres, can be touched."""
    parts, robot = _legs()
    robot["whole_body"]["reaching"] = {"weight": 200.0}
    hands = robot["reaching_frames"] = {}
    for side, y in (("left", 1), ("right", -1)):
        links = [f"{side}_{n}" for n in ("shoulder", "upper_arm", "forearm", "palm")]
        joints = [f"{side}_{n}" for n in ("shoulder_y", "shoulder_x", "elbow", "wrist")]
        palm = _link(links[3], 0.2, (0.05, 0.05, 0.05), HAND_POINT, [(HAND_POINT, HAND_RADIUS_M)])
        roll = (-0.3, 2.0) if side == "left" else (-2.0, 0.3)
        parts += [
            _link(links[0], 0.3, (0.05, 0.05, 0.05), (0, 0, 0)),
            _link(links[1], 0.8, (0.06, 0.06, 0.25), (0, 0, -0.12)),
            _link(links[2], 0.4, (0.2, 0.05, 0.05), (0.1, 0, 0)),
            palm,
            _joint(joints[0], "pelvis", links[0], (0, 0.2 * y, 0.25), "0 1 0"),
            _joint(joints[1], links[0], links[1], (0, 0, 0), "1 0 0", roll),
            _joint(joints[2], links[1], links[2], (0, 0, -0.25), "0 1 0", (-1.5, 1.5)),
            _joint(joints[3], links[2], links[3], (0, 0, 0), "1 0 0", None),
        ]
        hands[side] = _frame(links[3], joints, HAND_RADIUS_M, point=list(HAND_POINT))
    return _write(folder, "porter", parts, robot)


def edited(path, **changes):
    """Rewrites keys of a robot.yaml."""
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | changes))
    return path


@functools.cache
def robot_model(name: str) -> RobotModel:
    """A robot of the package by name, or one of the made-up ones."""
    writers = {"hexapod": write_hexapod, "biped": write_biped, "porter": write_porter}
    if name not in writers:
        return load_robot(name)
    return load_robot_file(writers[name](Path(tempfile.mkdtemp(prefix=name))))


@functools.cache
def robot_kinematics(name: str) -> RobotKinematics:
    """Its kinematics; they keep nothing between two calls, so tests may share them."""
    return RobotKinematics(robot_model(name))


def standing_feet(kinematics, stance_pose=(0.0, 0.0, 0.0)):
    feet = np.column_stack([kinematics.nominal_contacts, kinematics.foot_radii])
    return to_world(np.array(stance_pose), feet)


def base_over(kinematics, stance_pose=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0)):
    base = np.append(kinematics.nominal_base_offset, kinematics.standing_height)
    return to_world(np.array(stance_pose), base + shift)
