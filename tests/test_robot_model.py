"""robot.yaml: what it says is read by name, and what it misspells is answered with what exists."""

import pytest

from drake_safety.models import load_robot, robot_names
from drake_safety.robots.robot_model import (
    Foot,
    ReachingFrame,
    RobotModel,
    TaskGains,
    WholeBody,
    by_pattern,
    load_robot_file,
)
from legged_robots import edited, write_biped, write_hexapod


def test_every_robot_of_the_package_loads():
    for name in robot_names():
        assert load_robot(name).name == name


def test_an_unknown_robot_is_answered_with_those_that_exist():
    with pytest.raises(ValueError, match=r"robot 'nobody' does not exist.*laikago"):
        load_robot("nobody")


def test_a_missing_robot_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"gone\.yaml' does not exist"):
        load_robot(str(tmp_path / "gone.yaml"))


def test_a_misspelt_key_is_answered_with_the_keys_that_exist(tmp_path):
    path = edited(write_hexapod(tmp_path), foot_frictoin=0.5)
    with pytest.raises(ValueError, match=r"unknown key 'foot_frictoin'.*foot_friction"):
        load_robot_file(path)


def test_a_misspelt_nested_key_is_named_with_its_path(tmp_path):
    path = edited(write_hexapod(tmp_path), joint_gains={".*": {"stiffnes": 3.0}})
    with pytest.raises(ValueError, match=r"joint_gains\.\.\*\.stiffnes.*'stiffness'"):
        load_robot_file(path)


def test_values_of_a_file_are_validated_like_those_of_a_constructor(tmp_path):
    with pytest.raises(ValueError, match="foot_friction must be positive; got -1"):
        RobotModel(name="mine", foot_friction=-1.0)
    with pytest.raises(ValueError, match="foot_friction must be positive; got -1"):
        load_robot_file(edited(write_hexapod(tmp_path), foot_friction=-1.0))


def test_contact_points_are_triples():
    with pytest.raises(ValueError, match=r"foot 'left': contact_points must be a list of \[x, y"):
        RobotModel(name="mine", feet={"left": Foot(contact_points=[[0.0, 0.1]])})


def test_a_file_that_is_not_yaml_is_refused(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text("name: [")
    with pytest.raises(ValueError, match="is not YAML"):
        load_robot_file(path)


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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"whole_body": {"com": {}}}, r"unknown key 'whole_body\.com'.*'center_of_mass'"),
        (
            {"whole_body": {"reaching": {"wieght": 1}}},
            r"unknown key 'whole_body\.reaching\.wieght'.*'weight'",
        ),
        (
            {"whole_body": {"orientation": {"pelvis": {"gain": 1}}}},
            r"unknown key 'whole_body\.orientation\.pelvis\.gain'.*'stiffness'",
        ),
        (
            {"reaching_frames": {"left": {"bodie": "left_shin"}}},
            r"unknown key 'reaching_frames\.left\.bodie'.*'body'",
        ),
        (
            {"whole_body": {"orientation": {"pelvis": {"weight": -1}}}},
            r"whole_body\.orientation\.pelvis\.weight must be finite and not negative; got -1",
        ),
        (
            {"whole_body": {"friction": 0.0}},
            r"whole_body\.friction must be finite and positive; got 0",
        ),
        (
            {"reaching_frames": {"left": {"body": "left_shin", "point": [0, 1]}}},
            r"reaching frame 'left': point must be \[x, y, z\]; got \[0.0, 1.0\]",
        ),
        ({"mirror": {"(": "x"}}, r"mirror pattern '\(' is not a regular expression"),
    ],
)
def test_whole_body_names_and_values_that_do_not_fit_are_answered_with_what_does(
    tmp_path, change, message
):
    with pytest.raises(ValueError, match=message):
        load_robot_file(edited(write_biped(tmp_path), **change))


def test_gains_of_a_constructor_are_validated_like_those_of_a_file():
    with pytest.raises(ValueError, match=r"whole_body\.posture\.damping"):
        WholeBody(posture=TaskGains(damping=float("nan")))
    with pytest.raises(ValueError, match="reaching frame 'left': radius_m must be finite"):
        RobotModel(name="mine", reaching_frames={"left": ReachingFrame(radius_m=-1.0)})


def test_an_unknown_hand_is_answered_with_those_that_exist():
    robot = RobotModel(name="mine", reaching_frames={"left": ReachingFrame()})
    with pytest.raises(ValueError, match=r"robot 'mine' has no reaching frame 'tail'.*'left'"):
        robot.reaching_frame("tail")


def test_mirroring_pairs_joints_both_ways_and_leaves_the_others_to_themselves():
    robot = RobotModel(name="mine", mirror={"l_(.*)": r"r_\1"})
    partners = robot.mirror_partners(["back", "l_arm", "r_arm"])
    assert partners == {"back": "back", "l_arm": "r_arm", "r_arm": "l_arm"}


def test_a_pattern_matches_whole_names_only():
    assert by_pattern({"knee": 1.0}, "left_knee", "gains", "mine") is None
    assert by_pattern({".*knee": 1.0}, "left_knee", "gains", "mine") == 1.0
