"""URDFs as exporters write them: handled and told, or refused with names, values and a remedy."""

import math
import re

import numpy as np
import pytest
import yaml

from command_line import invoked
from drake_safety.control.kinematics import RobotKinematics
from drake_safety.robots.robot_model import by_pattern, load_robot_file
from drake_safety.robots.robot_template import write_robot
from drake_safety.robots.simulatable_urdf import simulatable_copy
from drake_safety.robots.urdf_survey import Survey
from drake_safety.simulation.scenario_check import check_scenario
from exported_robots import (
    CORNERS,
    FOOT,
    LIMIT,
    STOPS,
    biped,
    box,
    joint,
    link,
    quadruped,
    transmissions,
)

HEIGHT_M = 0.32
DRIVEN = [f"{corner}_{part}_joint" for corner in CORNERS for part in ("hip", "thigh")]
KNEES = [f"{corner}_calf_joint" for corner in CORNERS]
KNEE_STOPS = LIMIT.format(*STOPS["calf"])


def robot_of(text, tmp_path, task="balancing"):
    urdf = tmp_path / "q.urdf"
    urdf.write_text(text)
    return write_robot("q", urdf, task, tmp_path / "q")


def with_knees(inside, kind="revolute"):
    """The quadruped with something else inside its knees; NAME is the corner."""
    text = quadruped()
    for corner in CORNERS:
        head, tail = text.split(f'<joint name="{corner}_calf_joint" type="revolute">')
        tail = tail.replace(KNEE_STOPS, inside.replace("NAME", corner), 1)
        text = f'{head}<joint name="{corner}_calf_joint" type="{kind}">{tail}'
    return text


MIMIC = '<mimic joint="NAME_thigh_joint" multiplier="-1" offset="-0.2"/>'
FREE_KNEES = with_knees(KNEE_STOPS.replace("23.7", "0"))
ROS2 = "".join(
    f'<joint name="{name}"><{kind}_interface name="position"/></joint>'
    for names, kind in ((DRIVEN, "command"), (KNEES, "state"))
    for name in names
)
GAZEBO_MIMIC = (
    "<gazebo><plugin name='m' filename='libmimic.so'><joint>FL_calf_joint</joint>"
    "<mimicJoint>FL_thigh_joint</mimicJoint></plugin></gazebo>"
)
SPRING = '<gazebo reference="FL_calf_joint"><springStiffness>900</springStiffness></gazebo>'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            with_knees(KNEE_STOPS + MIMIC),
            ["follow others by <mimic>", "-1 · 'FL_thigh_joint' + -0.2"],
        ),
        (
            quadruped(above=GAZEBO_MIMIC),
            ["by <mimic>: 'FL_calf_joint' (= 1 · 'FL_thigh_joint' + 0)"],
        ),
        (
            quadruped(
                above='<ros2_control><joint name="RR_calf_joint"><param name="mimic">'
                "RL_calf_joint</param></joint></ros2_control>"
            ),
            ["'RR_calf_joint' (= 1 · 'RL_calf_joint' + 0)"],
        ),
        (quadruped(above=transmissions(*DRIVEN)), ["have no motor", "no transmission, as others"]),
        (
            quadruped(above=f"<ros2_control>{ROS2}</ros2_control>"),
            ["have no motor", "RL_calf_joint"],
        ),
        (FREE_KNEES, ["have no motor", "'FL_calf_joint' (effort=\"0\")"]),
        (quadruped(above=SPRING), ["'FL_calf_joint' (a spring of 900 N·m/rad)"]),
        (
            quadruped(above=transmissions(*DRIVEN) + SPRING),
            ["'FL_calf_joint' (no transmission, as others have, a spring of 900 N·m/rad)"],
        ),
        (
            with_knees(KNEE_STOPS + '<dynamics spring_stiffness="30"/>').replace(
                '30"/>', '0"/>', 3
            ),
            ["a spring of 30 N·m/rad"],
        ),
    ],
    ids=range(9),
)
def test_joints_of_legs_that_no_motor_turns_are_refused_by_name(text, words, tmp_path):
    with pytest.raises(ValueError, match="a motor on every joint of its legs") as error:
        robot_of(text, tmp_path)
    assert all(word in str(error.value) for word in [*words, "q.urdf", "Remedy: "])
    assert not (tmp_path / "q").exists()


GRIPPER = (
    link("finger", 0.1)
    + joint("grip", "trunk", "finger", "0 0 0.1", "0 1 0", KNEE_STOPS)
    + transmissions("grip")
)


@pytest.mark.parametrize(
    "text",
    [
        quadruped(above=transmissions(*DRIVEN, *KNEES)),
        quadruped(above=GRIPPER),
        quadruped().replace('effort="23.7"', 'effort="0"'),
        quadruped(above=f"<ros2_control>{ROS2.replace('state', 'command')}</ros2_control>"),
    ],
)
def test_joints_that_are_all_alike_have_motors(text, tmp_path):
    assert robot_of(text, tmp_path).copy.warnings == []


def wheel(shape, kind="continuous"):
    """The quadruped with a wheel in place of its feet."""
    text = quadruped(
        foot=f'<collision><origin rpy="1.5708 0 0"/><geometry>{shape}</geometry></collision>'
    )
    for corner in CORNERS:
        text = text.replace(
            f'<joint name="{corner}_foot_joint" type="fixed">',
            f'<joint name="{corner}_foot_joint" type="{kind}"><axis xyz="0 1 0"/>',
        )
    return text


CYLINDER = '<cylinder radius="0.08" length="0.04"/>'


@pytest.mark.parametrize(
    ("text", "is_wheel"),
    [
        (wheel(CYLINDER), True),
        (wheel('<sphere radius="0.05"/>'), True),
        (wheel('<mesh filename="tyre.obj"/>'), True),
        (wheel(CYLINDER, "revolute"), True),
        (wheel('<box size="0.08 0.08 0.04"/>'), False),
        (with_knees('<limit effort="23.7" velocity="30"/>', "continuous"), False),
    ],
    ids=["cylinder", "ball", "mesh", "no limits", "box", "knees without stops"],
)
def test_wheels_are_told_in_the_terminal_and_in_the_files(text, is_wheel, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.cylinder(0.08, 0.04).export(tmp_path / "tyre.obj")
    written = robot_of(text, tmp_path)
    if is_wheel:
        radius_m = 0.05 if "sphere" in text else 0.08
        assert [limb.radius_m for limb in written.legs] == pytest.approx(4 * [radius_m], abs=1e-6)
        np.testing.assert_allclose([limb.points for limb in written.legs], 0.0, atol=1e-6)
    told = "joints ['FL_foot_joint', 'FR_foot_joint', 'RL_foot_joint', 'RR_foot_joint'] turn wheels"
    assert any(told in note for note in written.copy.warnings) == is_wheel
    robot = (written.folder / "robot.yaml").read_text()
    assert ("turns a wheel, which its servo holds" in robot) == is_wheel
    assert ("turn wheels" in (written.folder / "README.md").read_text()) == is_wheel
    findings = check_scenario(written.folder / "balancing.yaml", num_episodes=0, is_imported=False)
    assert any(f.item == "wheels" and f.is_warning for f in findings) == is_wheel


def arm(*inside):
    """Elements of an arm of four joints on the trunk; its last joint moves a finger."""
    above, parts = "trunk", []
    for k, limit in enumerate(inside):
        name = f"arm{k}"
        parts += [
            link(name, 0.1),
            joint(f"{name}_joint", above, name, "0 0 0.1", "0 1 0", limit),
        ]
        above = name
    return "".join(parts)


ARM = LIMIT.format(-1, 1)
FOLLOWS = '<mimic joint="arm1_joint" multiplier="2" offset="0.3"/>'


def test_coupled_joints_of_an_arm_stay_coupled_in_the_posture(tmp_path):
    written = robot_of(quadruped(above=arm(ARM, ARM, ARM + FOLLOWS, ARM)), tmp_path)
    assert written.posture["arm2_joint"] == pytest.approx(0.3 + 2 * written.posture["arm1_joint"])
    assert any("['arm2_joint'] follow others by <mimic>" in one for one in written.copy.warnings)
    assert {
        f.item
        for f in check_scenario(written.folder / "balancing.yaml", num_episodes=0)
        if not f.is_ok
    } == set()
    with pytest.raises(
        ValueError, match=r"\['arm2_joint'\] follow others .* --task reaching has no"
    ):
        write_robot("r", tmp_path / "q.urdf", "reaching", tmp_path / "r")


def test_a_joint_that_follows_a_leg_is_fixed_and_told(tmp_path):
    follows = '<mimic joint="FL_hip_joint"/>'
    written = robot_of(quadruped(above=arm(ARM, ARM, ARM + follows, ARM)), tmp_path)
    assert "arm2_joint" not in written.joints
    (note,) = written.copy.warnings
    assert note.startswith("joints ['arm2_joint'] follow joints that move, by <mimic>, but")


def test_a_robot_in_millimetres_is_refused(tmp_path):
    text = re.sub(
        r'<origin xyz="(\S+) (\S+) (\S+)"',
        lambda found: '<origin xyz="{} {} {}"'.format(*(1000 * float(x) for x in found.groups())),
        quadruped(),
    )
    with pytest.raises(ValueError, match=r"'trunk' would stand 3\d\d m high. Are the <origin>s"):
        robot_of(text, tmp_path)


def test_coupled_joints_that_are_fixed_keep_their_coupling(tmp_path):
    gripper = arm(ARM, ARM + FOLLOWS.replace("arm1", "arm0"))
    written = robot_of(quadruped(above=gripper), tmp_path)
    text = (written.folder / "q.urdf").read_text()
    assert "mimic" not in text
    pose = written.survey.pose("arm1").rotation().ToRollPitchYaw().vector()
    np.testing.assert_allclose(pose, [0, 0.3, 0], atol=1e-6)


def test_passive_joints_beside_the_legs_are_fixed_and_told(tmp_path):
    limbs = arm(ARM, ARM, ARM.replace("23.7", "0"), ARM)
    written = robot_of(quadruped(above=limbs), tmp_path)
    assert "arm2_joint" not in written.joints and "arm3_joint" in written.joints
    assert any(
        "['arm2_joint'] have no motor and are fixed: 'arm2_joint' (effort=\"0\")" in one
        for one in written.copy.warnings
    )


def legs_of(text, tmp_path):
    urdf = tmp_path / "b.urdf"
    urdf.write_text(text)
    copy = simulatable_copy(urdf)
    (tmp_path / "copy").mkdir()
    copy.write(tmp_path / "copy" / "b.urdf")
    survey = Survey(tmp_path / "copy" / "b.urdf")
    return survey, survey.legs()


def test_a_heel_that_is_higher_than_the_toe_does_not_touch(tmp_path):
    heel, toe = (
        box("0.08 0.1 0.02").replace("0 0 0.0", at) for at in ("-0.06 0 0.003", "0.06 0 0")
    )
    assert heel != toe
    _, legs = legs_of(biped(heel + toe), tmp_path)
    assert [leg.points[:, 0].min() for leg in legs] == pytest.approx([0.025, 0.025])


HEAD = "<collision><geometry>"


@pytest.mark.parametrize("thickness_mm", [1, 2, 6, 10, 12, 15, 19.5, 21, 30])
@pytest.mark.parametrize("form", ["box", "mesh", "two boxes", "plate"])
def test_a_sole_of_any_thickness_touches_at_its_lower_corners(form, thickness_mm, tmp_path):
    t = thickness_mm / 1000
    shapes = {
        "box": box(f"0.2 0.1 {t}"),
        "mesh": f'{HEAD}<mesh filename="sole.obj"/></geometry></collision>',
        "two boxes": "".join(
            f'<collision><origin xyz="{x} 0 0"/><geometry><box size="0.08 0.1 {t}"/></geometry>'
            "</collision>"
            for x in (-0.06, 0.06)
        ),
        "plate": f'{HEAD}<cylinder radius="0.1" length="{t}"/></geometry></collision>',
    }
    if form == "mesh":
        trimesh = pytest.importorskip("trimesh")
        trimesh.creation.box([0.2, 0.1, t]).export(tmp_path / "sole.obj")
    survey, legs = legs_of(biped(shapes[form]), tmp_path)
    half = 0.1 / math.sqrt(2) if form == "plate" else 0.1
    for leg in legs:
        assert len(leg.points) == (8 if form == "two boxes" else 4)
        low, high = leg.points.min(axis=0), leg.points.max(axis=0)
        np.testing.assert_allclose(leg.points[:, 2], leg.radius_m - t / 2, atol=1e-9)
        assert high[0] == pytest.approx(half - leg.radius_m) == -low[0]
    assert survey.positions(legs[0])[:, 2].min() - legs[0].radius_m == pytest.approx(-0.6 - t / 2)


def test_feet_on_a_line_are_told(tmp_path):
    sphere = '<collision><geometry><sphere radius="0.03"/></geometry></collision>'
    written = robot_of(biped(sphere), tmp_path)
    assert any("lie on a line" in note for note in written.copy.warnings)


def turned(rpy, xyz="0 0 0", name="odd", mass=0.0):
    """A root link at a pose, to which the trunk is fixed."""
    return link(name, mass) + joint(f"{name}_joint", name, "trunk", xyz, rpy=rpy)


UP = "0 0 0"
QUARTER = math.pi / 2


@pytest.mark.parametrize(
    ("root", "base", "note"),
    [
        ("", "trunk", ""),
        (turned(UP), "odd", ""),
        (turned(UP, "0.02 0 0.03"), "odd", ""),
        (turned(UP, "0 0 0.1"), "hips", "'odd' lies 0.10 m below the hips"),
        (turned(UP, "0 0 0.33"), "hips", "lies 0.33 m below the hips"),
        (turned(UP, "0 0 0.33", mass=2.0), "hips", "lies 0.33 m below the hips"),
        (turned(UP, "0.1 0 -0.6", name="imu"), "hips", "'imu' lies -0.60 m below"),
        (turned(UP, "-0.3 0 0", name="hips"), "hips_", "0.30 m aside"),
        (turned(f"0 0 {QUARTER}"), "hips", "has its left along -x"),
        (turned(f"0 0 {-QUARTER}"), "hips", "has its left along +x"),
        (turned(f"{-QUARTER} 0 0"), "hips", "has its legs along -y"),
        (turned(f"{math.pi} 0 0"), "hips", "has its legs along +z"),
        (turned(f"0 {QUARTER} 0"), "hips", "has its legs along -x"),
        (turned(f"0 0 {math.pi}"), "odd", "faces backwards, as its left is along -y of 'odd'"),
        (turned(UP, name="world"), "trunk", "the root link 'world' is left out"),
        (turned(UP, name="odom").replace("fixed", "floating"), "trunk", "'odom' is left out"),
        (turned(UP, name="odom").replace("fixed", "planar"), "trunk", "'odom' is left out"),
    ],
)
def test_the_base_lies_between_the_hips_x_forwards_and_z_up(root, base, note, tmp_path):
    written = robot_of(quadruped(root=root), tmp_path)
    assert written.survey.base == base
    assert any(note in one for one in written.copy.warnings) == bool(note)
    assert written.sizes.height_m == pytest.approx(HEIGHT_M, abs=0.04)
    assert written.sizes.half_length_m == pytest.approx(0.19, abs=0.03)
    assert written.sizes.half_width_m == pytest.approx(0.13, abs=0.03)
    if base.startswith("hips"):
        assert written.sizes.height_m == pytest.approx(HEIGHT_M, abs=1e-3)
        front = written.survey.joint_origin("FL_hip_joint")
        np.testing.assert_allclose(front, [0.19, 0.05, 0.0], atol=1e-6)


def test_without_names_of_sides_the_axes_of_the_knees_tell_left(tmp_path):
    names = dict(zip(CORNERS, "abcd", strict=True))
    text = quadruped(
        root=turned(f"0 0 {QUARTER}"),
        spelled=lambda name: re.sub("^(..)_", lambda match: names[match[1]] + "_", name),
    )
    written = robot_of(text, tmp_path)
    assert any("has its left along -x" in note for note in written.copy.warnings)
    assert written.sizes.half_length_m == pytest.approx(0.19, abs=0.03)


LOST = '<collision><geometry><mesh filename="shank.obj"/></geometry></collision>'


@pytest.mark.parametrize(
    "text",
    [
        quadruped(foot=LOST),
        quadruped(foot=LOST).replace("shank.obj", "package://nobody/shank.stl"),
        quadruped().replace(FOOT, LOST, 1),
    ],
    ids=["all", "package", "one of four"],
)
def test_a_foot_whose_mesh_was_not_found_is_named_before_anything_is_guessed(text, tmp_path):
    with pytest.raises(ValueError, match="collision meshes at the ends of limbs were not") as error:
        robot_of(text, tmp_path)
    assert all(
        word in str(error.value)
        for word in ("'FL_foot' (", "/shank." if "nobody" in text else "shank.obj", "--feet")
    )


NAMES = [
    "{}1",
    "on{}",
    "null {}",
    "1e{}",
    "{}[0]",
    "{}(a|b)*",
    "a:{}",
    "{}, x",
    "#{}",
    "'{}\"",
    "{}\\d",
    "ß/{}",
    "{}.",
    "- {}",
    "{{{}}}",
]


@pytest.mark.parametrize("pattern", NAMES)
def test_names_are_data(pattern, tmp_path):
    numbers = {}
    text = quadruped(spelled=lambda name: pattern.format(numbers.setdefault(name, len(numbers))))
    written = robot_of(text, tmp_path)
    robot = load_robot_file(written.folder / "robot.yaml")
    kinematics = RobotKinematics(robot)
    assert kinematics.joint_names == written.joints
    assert kinematics.standing_height == pytest.approx(written.sizes.height_m, abs=1e-4)
    for name, position in zip(written.joints, kinematics.posture, strict=True):
        assert position == written.posture[name]
        assert by_pattern(robot.joint_gains, name, "gains", "q") is not None


@pytest.mark.parametrize(
    "name",
    [
        "on",
        "off",
        "null",
        "~",
        "1e3",
        "0x1",
        "1_0",
        "12:30:00",
        "2001-01-01",
        ".inf",
        "yes",
        "a: b",
        "-",
    ],
)
def test_a_base_named_like_another_value_of_yaml_is_its_text(name, tmp_path):
    written = robot_of(quadruped(spelled=lambda one: name if one == "trunk" else one), tmp_path)
    assert yaml.safe_load((written.folder / "robot.yaml").read_text())["base"] == name


def test_a_robot_with_names_of_every_kind_passes_its_check(tmp_path):
    text = quadruped(spelled=lambda name: f"[{name}: 1]*")
    written = robot_of(text, tmp_path)
    partner = load_robot_file(written.folder / "robot.yaml").mirror_partners(written.joints)
    assert partner["[FL_calf_joint: 1]*"] == "[FR_calf_joint: 1]*"
    file = written.folder / "balancing.yaml"
    assert [f for f in check_scenario(file, num_episodes=0) if not f.is_ok] == []


def test_hulls_of_links_with_like_names_are_separate_files(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box([0.1, 0.1, 0.1]).export(tmp_path / "part.stl")
    shape = '<collision><geometry><mesh filename="part.stl"/></geometry></collision>'
    names = ["a/b", "a b", "a_b", "../a"]
    parts = [
        link(name, 0.1, shape) + joint(f"{name} j", "trunk", name, "0 0 0.1") for name in names
    ]
    written = robot_of(quadruped(above="".join(parts)), tmp_path)
    meshes = list((written.folder / "meshes").rglob("*.obj"))
    assert len(meshes) == 4 and {path.parent.name for path in meshes} == {"meshes"}


def changed(old, new):
    text = quadruped()
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ('<box size="0 0 0"/>', "is a box of size 0 0 0"),
        ('<box size="0.1 0.1 0.0"/>', "is a box of size 0.1 0.1 0.0"),
        ('<sphere radius="0"/>', "is a sphere of radius 0"),
        ('<sphere radius="-0.1"/>', "is a sphere of radius -0.1"),
        ('<cylinder radius="0.1" length="0"/>', "is a cylinder of radius 0.1, length 0"),
        ('<mesh filename="part.obj" scale="0 1 1"/>', "is a mesh of scale 0 1 1"),
    ],
)
@pytest.mark.parametrize("kind", ["collision", "visual"])
def test_shapes_without_extent_are_left_out_with_a_note(kind, shape, words, tmp_path):
    (tmp_path / "part.obj").write_text("v 0 0 0\n")
    frame = link("frame", shape=f"<{kind}><geometry>{shape}</geometry></{kind}>")
    written = robot_of(quadruped(above=frame + joint("j", "trunk", "frame", "0 0 0")), tmp_path)
    assert f"the {kind} of link 'frame' {words}: it is left out" in written.copy.warnings


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            changed('lower="-0.9" upper="0.9"', 'lower="0.9" upper="-0.9"'),
            ["FL_hip_joint", 'lower="0.9" upper="-0.9"'],
        ),
        (changed('velocity="30"', 'velocity="-3"'), ["FL_hip_joint", 'velocity="-3"']),
        (changed('effort="23.7"', 'effort="-1"'), ["FL_hip_joint", 'effort="-1"']),
        (
            changed('lower="-0.9" upper="0.9"', 'lower="0" upper="0"'),
            ["'FL_hip_joint' (0)", "equal limits"],
        ),
        (changed('"0.4 0.2 0.1"', '"400 200 100"'), ["link 'trunk'", "400 m", "in millimetres?"]),
        (changed('"0.4 0.2 0.1"', '"0.4 0.2"'), ["size got 0.4 0.2"]),
        (changed('<mass value="4.8"/>', '<mass value="-1"/>'), ["link 'trunk' has a mass of -1"]),
        (
            quadruped(
                above=arm(ARM, ARM, ARM, ARM).replace('<mass value="0.1"/>', '<mass value="0"/>')
            ),
            ["joint 'arm0_joint' moves link 'arm0', which has no mass"],
        ),
    ],
    ids=[
        "exchanged",
        "velocity",
        "effort",
        "equal",
        "millimetres",
        "two numbers",
        "mass",
        "massless",
    ],
)
def test_what_cannot_be_simulated_is_refused_by_name_value_and_file(text, words, tmp_path):
    with pytest.raises(ValueError, match=r"q\.urdf'") as error:
        robot_of(text, tmp_path)
    message = str(error.value)
    assert all(word in message for word in words)
    assert "condition" not in message and "/tmp" not in message.replace(str(tmp_path), "")


def test_a_mesh_in_millimetres_is_refused_with_its_file(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box([400.0, 200.0, 100.0]).export(tmp_path / "trunk.stl")
    text = changed('<box size="0.4 0.2 0.1"/>', '<mesh filename="trunk.stl"/>')
    with pytest.raises(ValueError, match=r"link 'trunk' \['trunk.stl'\] is 400 m large") as error:
        robot_of(text, tmp_path)
    assert 'scale="0.001 0.001 0.001"' in str(error.value)


def test_a_speed_limit_of_zero_is_none(tmp_path):
    written = robot_of(quadruped().replace('velocity="30"', 'velocity="0"'), tmp_path)
    assert sum("is read as no limit" in note for note in written.copy.warnings) == 1
    kinematics = RobotKinematics(load_robot_file(written.folder / "robot.yaml"))
    assert np.isinf(kinematics.velocity_limits).all()


def with_inertia(scale, name="ixx"):
    """The quadruped with one moment of its trunk scaled, or all of them."""
    text, value = quadruped(), 'ixx="0.06" iyy="0.06" izz="0.06"'
    assert value in text
    if name == "all":
        return re.sub(
            r'(i(?:xx|yy|zz))="([^"]*)"', lambda m: f'{m[1]}="{scale(float(m[2]))}"', text
        )
    return text.replace(value, value.replace(f'{name}="0.06"', f'{name}="{scale(0.06)}"'))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            with_inertia(lambda i: -0.02),
            "link 'trunk' has an impossible inertia; -0.02",
        ),
        (with_inertia(lambda i: 1.0, "all"), "links have inertias that no body"),
        (with_inertia(lambda i: 1e6 * i, "all"), "17 links have inertias"),
        (with_inertia(lambda i: 1e-6, "all"), "kg·m² at 4.8 kg, a radius of gyration of 0.00046 m"),
    ],
    ids=["negative", "ones", "kg mm2", "point"],
)
def test_inertias_that_no_body_has_are_told_by_new_and_check(text, words, tmp_path):
    written = robot_of(text, tmp_path)
    assert any(words in note for note in written.copy.warnings)
    findings = check_scenario(written.folder / "balancing.yaml", num_episodes=0, is_imported=False)
    told = [f for f in findings if f.item == "inertias"]
    assert bool(told) == ("impossible" not in words)
    assert all(f.is_warning and "correct <inertia>" in f.remedy for f in told)


@pytest.mark.parametrize("zero", ["izz", "ixx"])
def test_moments_that_break_the_triangle_inequality_are_reduced(zero, tmp_path):
    text = with_inertia(lambda i: 0.0, zero).replace('iyy="0.06"', 'iyy="0.6"', 1)
    written = robot_of(text, tmp_path)
    assert any("is reduced to the sum of the others" in note for note in written.copy.notes)


def test_notes_are_printed_and_kept(tmp_path):
    urdf = tmp_path / "w.urdf"
    urdf.write_text(wheel(CYLINDER))
    result = invoked("new", "w", "--urdf", urdf, "--out", tmp_path / "w")
    assert result.exit_code == 0
    assert "note  joints ['FL_foot_joint'" in result.output


def test_check_names_what_was_spoilt_by_hand(tmp_path):
    written = robot_of(quadruped(), tmp_path)
    urdf, scenario = written.files[0], written.files[-1]
    text = urdf.read_text()

    def problem():
        return next(f for f in check_scenario(scenario, num_episodes=0) if not f.is_ok)

    urdf.write_text(text.replace("0.4 0.2 0.1", "0 0.2 0.1"))
    assert "link 'trunk' is a box of size 0 0.2 0.1" in problem().message
    knee = '<joint name="FL_calf_joint" type="revolute">'
    assert knee in text
    urdf.write_text(text.replace(knee, knee + '<mimic joint="FL_thigh_joint"/>'))
    assert problem().item == "joints of legs"
    assert "['FL_calf_joint'] follow others by <mimic>" in problem().message
