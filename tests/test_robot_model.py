"""robot.yaml: what it says is read by name, and what it misspells is answered with what exists."""

import pytest

from drake_safety.models import load_robot, robot_names
from drake_safety.robots.robot_model import (
    RobotModel,
    WholeBody,
    by_pattern,
    load_robot_file,
)
from legged_robots import edited, write_biped


def test_every_robot_of_the_package_loads():
    for name in robot_names():
        assert load_robot(name).name == name


def test_an_unknown_robot_is_named():
    with pytest.raises(ValueError, match=r"robot 'nobody' does not exist.*laikago"):
        load_robot("nobody")


def test_whole_body_gains_and_reaching_frames_are_read_by_name(tmp_path):
    path = edited(
        write_biped(tmp_path),
        reaching_frames={"knee": {"body": "left_shin", "point": [0, 0, -0.1], "radius_m": 0.02}},
        whole_body={"orientation": {"pelvis": {"weight": 7}}, "posture": {"damping": 3.0}},
    )
    robot = load_robot_file(path)
    assert robot.reaching_frame("knee").body == "left_shin"
    tasks = robot.whole_body.tasks()
    assert tasks["orientation.pelvis"].weight == 7
    assert tasks["posture"].damping == 3.0
    # What the file leaves out is as by default.
    assert tasks["posture"].weight == WholeBody().posture.weight
    assert tasks["center_of_mass"] == WholeBody().center_of_mass


def test_mirroring_pairs_joints_both_ways_and_leaves_the_others_to_themselves():
    robot = RobotModel(name="mine", mirror={"l_(.*)": r"r_\1"})
    partners = robot.mirror_partners(["back", "l_arm", "r_arm"])
    assert partners == {"back": "back", "l_arm": "r_arm", "r_arm": "l_arm"}


def test_a_pattern_matches_whole_names_only():
    assert by_pattern({"knee": 1.0}, "left_knee", "gains", "mine") is None
    assert by_pattern({".*knee": 1.0}, "left_knee", "gains", "mine") == 1.0
