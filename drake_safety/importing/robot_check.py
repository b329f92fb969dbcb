"""The part of a check that reads a robot's URDF as its exporter meant it."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.importing.urdf_copy import read_drives
from drake_safety.importing.urdf_survey import WITHOUT_STOPS_RAD
from drake_safety.robots.model_files import model_file
from drake_safety.robots.robot_model import by_pattern
from drake_safety.robots.urdf import read_urdf
from drake_safety.simulation.contract import Finding, failed, passed


def check_urdf(kinematics: RobotKinematics) -> Iterator[Finding]:
    """Checks couplings, wheels and lost collision shapes; yields problems only."""
    robot = kinematics.robot
    path = model_file(robot.urdf, robot.source_dir, robot.requires)
    if path.suffix != ".urdf":
        return
    root = read_urdf(path)
    mimics = read_drives(root).mimics
    if coupled := [name for foot in robot.feet.values() for name in foot.joints if name in mimics]:
        yield failed(
            "joints of legs",
            f"{coupled} follow others by <mimic>, but servos move every joint by itself",
            f"remove <mimic> from {path.name} if each has a motor of its own",
        )
    free = np.ptp(kinematics.position_limits, axis=1) > WITHOUT_STOPS_RAD
    endless = {name for name, is_free in zip(kinematics.joint_names, free, strict=True) if is_free}
    last = [name for foot in robot.feet.values() for name in foot.joints[-1:]]
    if wheels := [name for name in last if name in endless]:
        what = f"joints {wheels} have no stops; if they turn wheels, position servos hold these"
        yield passed("wheels", what, "judge by this scenario only a robot with braked wheels")
    shaped = {link.get("name") for link in root.iter("link") if link.find("collision") is not None}
    names = [name for name in robot.without_collision if name not in shaped]
    if bare := [n for n in names if by_pattern(robot.shapes, n, "shapes", robot.name) is None]:
        yield passed(
            "collision shapes",
            f"{len(bare)} links have none, as their meshes were left out; everything passes "
            f"through {', '.join(bare)}",
            "add a <collision> with a box, sphere or capsule [m] to links that touch something, in "
            f"{Path(robot.urdf).name}, or delete them from 'without_collision' in robot.yaml",
        )
