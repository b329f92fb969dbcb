"""URDFs as exporters write them: handled and told, or refused with names, values and a remedy."""

import math
import re
from itertools import product

import numpy as np
import pytest
import yaml
from scipy.spatial import ConvexHull

import legged_robots
from drake_safety.control.kinematics import RobotKinematics
from drake_safety.importing.robot_template import write_robot
from drake_safety.importing.simulatable_urdf import simulatable_copy
from drake_safety.importing.urdf_survey import Survey
from drake_safety.robots.robot_model import load_robot_file
from drake_safety.simulation.scenario_check import check_scenario
from exported_robots import CALF, FOOT, LIMIT, biped, chain, edited, joint, link, quadruped, renamed
from exported_robots import shape as shaped

LEGS = ("FL", "FR", "RL", "RR")
DRIVEN = [f"{leg}_{part}_joint" for leg in LEGS for part in ("hip", "thigh")]
KNEES = [f"{leg}_calf_joint" for leg in LEGS]
BOX = np.array([*product((-0.5, 0.5), repeat=3)])


def robot_of(text, folder, task="balancing", **options):
    (folder / "q.urdf").write_text(text)
    return write_robot("q", folder / "q.urdf", task, folder / task, **options)


def problems(written):
    return [f for f in check_scenario(written.files[-1], num_episodes=0) if not f.is_ok]


def findings_of(written):
    """What a check that imports nothing warns of or refuses."""
    findings = check_scenario(written.files[-1], num_episodes=0, is_imported=False)
    return {f.item: f for f in findings if f.remedy}


def obj(path, points):
    """Writes the hull of points."""
    rows = [("v", *point) for point in points]
    rows += [("f", *face) for face in ConvexHull(points).simplices + 1]
    path.write_text("\n".join(" ".join(map(str, row)) for row in rows))


def each(text, names):
    return "".join(map(text.format, names))


ROS1 = """<transmission name="{0}_t"><type>transmission_interface/SimpleTransmission</type>
<joint name="{0}"/><actuator name="{0}_m"/></transmission>"""
ROS2 = '<ros2_control><joint name="{}">%s</joint></ros2_control>'
COMMAND, STATE = (ROS2 % f'<{kind}_interface name="position"/>' for kind in ("command", "state"))
ROS2_MIMIC = (ROS2 % '<param name="mimic">RL_calf_joint</param>').format("RR_calf_joint")
GAZEBO_MIMIC = """<gazebo><plugin name='m' filename='libmimic.so'><joint>FL_calf_joint</joint>
<mimicJoint>FL_thigh_joint</mimicJoint></plugin></gazebo>"""
MIMIC = '<mimic joint="{}_joint" multiplier="{}" offset="{}"/>'
SPRING = '<gazebo reference="FL_calf_joint"><springStiffness>900</springStiffness></gazebo>'
KNEE, STOPS = '<joint name="FL_calf_joint" type="revolute">', 'lower="-0.9" upper="0.9"'
TRUNK, LOST = 'box size="0.4 0.2 0.1"', shaped('mesh filename="shank.obj"')
MILLIMETRES = re.sub(
    '<origin xyz="([^"]*)"',
    lambda found: '<origin xyz="{} {} {}"'.format(*(1000 * float(x) for x in found[1].split())),
    quadruped(),
)
ARM = LIMIT.format(-1, 1)


def arm(*limits):
    """Elements of an arm on the trunk, of hinges with these limits."""
    hinges = (("0 0 0.1", "0 1 0", limit) for limit in limits)
    return chain("trunk", *((f"arm{k}", 0.1, "", *hinge) for k, hinge in enumerate(hinges)))


MOTORS, MASSLESS = each(ROS1, DRIVEN), arm(*4 * [ARM]).replace('mass value="0.1"', 'mass value="0"')
FL_FOOT = link("FL_foot", 0.04, FOOT)

WITHOUT_MOTOR = {
    "follow others by <mimic>: 'FL_calf_joint' (= -1 · 'FL_thigh_joint' + -0.2). Remedy: remove": (
        quadruped({KNEE: KNEE + MIMIC.format("FL_thigh", -1, -0.2)})
    ),
    "by <mimic>: 'FL_calf_joint' (= 1 · 'FL_thigh_joint' + 0)": quadruped(above=GAZEBO_MIMIC),
    "'RR_calf_joint' (= 1 · 'RL_calf_joint' + 0)": quadruped(above=ROS2_MIMIC),
    "have no motor: 'FR_calf_joint' (no transmission, as others": quadruped(above=MOTORS),
    "'RL_calf_joint' (no transmission": quadruped(above=each(COMMAND, DRIVEN) + each(STATE, KNEES)),
    "'FL_calf_joint' (effort=\"0\")": quadruped({CALF: CALF.replace("23.7", "0")}),
    "'FL_calf_joint' (a spring of 900 N·m/rad)": quadruped(above=SPRING),
    "(no transmission, as others have, a spring of 900": quadruped(above=MOTORS + SPRING),
    "a spring of 30 N·m/rad": quadruped({KNEE: KNEE + '<dynamics spring_stiffness="30"/>'}),
    "['x'] carry all legs: the base floats without them": quadruped(
        root=link("odom") + joint("x", "odom", "trunk", "0 0 0", "1 0 0", LIMIT.format(-9, 9)),
        above=each(ROS1, DRIVEN + KNEES),
    ),
    "have equal limits: 'FL_hip_joint' (0)": quadruped({STOPS: 'lower="0" upper="0"'}),
}
WITHOUT_FEET = {
    "'FL_foot' (shank.obj); 'FR_foot' (shank.obj)": quadruped({FOOT: LOST}),
    "(package://no/shank.stl)": quadruped({FOOT: shaped('mesh filename="package://no/shank.stl"')}),
    "'FL_foot' (shank.obj). Put": quadruped({FL_FOOT: FL_FOOT.replace(FOOT, LOST)}),
}
WRONG = {
    "'FL_hip_joint' has lower=\"0.9\"": quadruped({STOPS: 'lower="0.9" upper="-0.9"'}),
    "'FL_hip_joint' has velocity=\"-3\"": quadruped({'velocity="30"': 'velocity="-3"'}),
    "'FL_hip_joint' has effort=\"-1\"": quadruped({'effort="23.7"': 'effort="-1"'}),
    "joint 'FL_calf_joint' has xyz=\"0 0 -0,2\" in <origin>": quadruped({"0 0 -0.2": "0 0 -0,2"}),
    "'FL_hip_joint' has xyz=\"${x} 0 0\" in <axis>": quadruped({'"1 0 0"': '"${x} 0 0"'}),
    "link 'FR_foot' is the child of joints ['FR_foot_joint', 'rod']": quadruped(
        above=joint("rod", "FL_foot", "FR_foot")
    ),
    "size got 0.4 0.2": quadruped({TRUNK: 'box size="0.4 0.2"'}),
    "'arm0_joint' moves link 'arm0', which has no mass": quadruped(above=MASSLESS),
    "'trunk' would stand 320 m high. Are the <origin>s in millimetres?": MILLIMETRES,
    "400 m large, in a robot of 0.67 m; in milli": quadruped({TRUNK: 'box size="400 200 100"'}),
    "link 'trunk' ['trunk.obj'] is 400 m large": quadruped({TRUNK: 'mesh filename="trunk.obj"'}),
}


@pytest.mark.parametrize(
    ("law", "words", "text"),
    [
        *(("a motor on every joint of its legs.*Remedy: ", *row) for row in WITHOUT_MOTOR.items()),
        *(("at the ends of limbs were not.* --feet", *row) for row in WITHOUT_FEET.items()),
        *(("", *row) for row in WRONG.items()),
    ],
)
def test_what_cannot_stand_is_refused_by_name_value_and_file(law, words, text, tmp_path):
    obj(tmp_path / "trunk.obj", BOX * [400, 200, 100])
    with pytest.raises(ValueError, match=rf"q\.urdf'.*{law}") as error:
        robot_of(text, tmp_path)
    assert words in str(error.value)
    assert "condition" not in str(error.value)
    assert "/tmp" not in str(error.value).replace(str(tmp_path), "")
    assert not (tmp_path / "balancing").exists()


def framed(kind, form):
    """The quadruped with a link of one shape."""
    frame = link("frame", shapes=shaped(form, kind)) + joint("j", "trunk", "frame")
    return quadruped(above=frame)


GRIPPER = chain("trunk", ("finger", 0.1, "", "0 0 0.1", "0 1 0", ARM)) + ROS1.format("finger_joint")


def with_moments(change, names="ixx|iyy|izz"):
    moment = re.compile(f'({names})="([^"]*)"')
    return moment.sub(lambda found: f'{found[1]}="{change(float(found[2]))}"', quadruped())


TURN = '<child link="FL_foot"/><origin xyz="0 0 -0.2" rpy="0 0 0"/>'
BOX_JOINT = joint("box_joint", "trunk", "box")
MASSES, THIGH_MASS = "mass value|ixx|iyy|izz", '<mass value="0.24"/>'


@pytest.mark.parametrize(
    ("text", "note"),
    [
        # All joints of its legs are alike.
        (quadruped(above=each(ROS1, DRIVEN + KNEES)), ""),
        (quadruped(above=each(COMMAND, DRIVEN + KNEES)), ""),
        (quadruped({'effort="23.7"': 'effort="0"'}), ""),
        (quadruped(above=GRIPPER), ""),
        (biped(FOOT), "the contact points of the feet lie on a line"),
        (quadruped({'ixx="0.06"': 'ixx="-0.02"'}), "link 'trunk' has an impossible inertia; -0.02"),
        (with_moments(lambda moment: 1.0), "links have inertias that no body"),
        (with_moments(lambda moment: 1e6 * moment), "17 links have inertias"),
        (with_moments(lambda moment: 1e-6), "at 4.8 kg, a radius of gyration of 0.00046 m"),
        (with_moments(lambda mass: 1e3 * mass, MASSES), "has 8.16e+03 kg (grams or tonnes?)"),
        (
            with_moments(lambda value: 1e-3 * value, f"{MASSES}|effort"),
            "has 0.00816 kg (grams or tonnes?)",
        ),
        (
            quadruped({THIGH_MASS: f'<origin xyz="0 0 -100"/>{THIGH_MASS}'}),
            "the centre of mass of link 'FL_thigh' is 100 m from it; the centre of mass",
        ),
        (quadruped({STOPS: 'lower="-45" upper="45"'}), "limits in degrees instead of radians?"),
        (quadruped({'velocity="30"': 'velocity="1000"'}), "(1000 rad/s, at most 97.3 expected)"),
        (
            quadruped({TURN: TURN.replace('rpy="0 0 0', 'rpy="0 0 180')}),
            "rpy of ['FL_foot_jo",
        ),
        (
            quadruped(above=link("box", 1.0).replace('<mass value="1.0"/>', "") + BOX_JOINT),
            "link 'box' has an inertia but no mass",
        ),
        *(
            (framed(kind, form), f"the {kind} of link 'frame' is a {words}: it is left out")
            for kind in ("collision", "visual")
            for form, words in (
                ('box size="0 0 0"', "box of size 0 0 0"),
                ('box size="0.1 0.1 0.0"', "box of size 0.1 0.1 0.0"),
                ('sphere radius="0"', "sphere of radius 0"),
                ('sphere radius="-0.1"', "sphere of radius -0.1"),
                ('cylinder radius="0.1" length="0"', "cylinder of radius 0.1, length 0"),
                ('mesh filename="part.obj" scale="0 1 1"', "mesh of scale 0 1 1"),
            )
        ),
    ],
)
def test_what_is_changed_or_odd_is_told_at_once_and_nothing_else(text, note, tmp_path):
    obj(tmp_path / "part.obj", BOX)
    written = robot_of(text, tmp_path)
    warnings, found = written.copy.warnings, findings_of(written)
    remedy = found["inertias"].remedy if "inertias" in found else ""
    assert len(warnings) == bool(note) and all(note in one for one in warnings)
    of_masses = re.search("inertias|centre of mass|grams", "".join(warnings))
    assert ("correct <inertia>" in remedy) == bool(of_masses)


SLIDING = quadruped({'"0 1 0"/>' + CALF: f'"0 0 1"/>{LIMIT.format(-0.12, 0.1)}'})
for name in KNEES:
    SLIDING = SLIDING.replace(f'"{name}" type="revolute"', f'"{name}" type="prismatic"')


def limited(text, effort):
    return text.replace('effort="23.7"', effort)


@pytest.mark.parametrize(
    ("text", "effort", "asked"),
    [
        (quadruped(), 'effort="1000"', "'FL_calf_joint' (q.urdf says 1000) [N·m]"),
        (quadruped(above=each(ROS1, DRIVEN + KNEES)), 'effort="50000"', "says 50000) [N·m]"),
        (quadruped(), 'effort="100"', "(q.urdf says 100) [N·m]"),
        (quadruped(), 'effort="1e12"', "(q.urdf says 1e+12) [N·m]"),
        (
            SLIDING,
            'effort="1000"',
            "the largest force of joint 'FL_calf_joint' (q.urdf says 1000) [N]",
        ),
        (SLIDING, "", "the largest force of joint 'FL_calf_joint' [N]"),
    ],
)
def test_efforts_that_no_motor_has_are_estimated_asked_for_and_warned_of(
    text, effort, asked, tmp_path
):
    written = robot_of(limited(text, effort), tmp_path)
    (note,) = written.copy.warnings or [""]
    assert ("12 joints have limits that no motor of a robot of 8" in note) == bool(effort)
    assert asked in " ".join(written.asked)
    assert "those of 12 joints are estimates" in findings_of(written)["effort limits"].message
    assert "motor limits" not in findings_of(written)
    # robot.yaml replaces the limits of the file, which come back without it.
    file = written.folder / "robot.yaml"
    stated = yaml.safe_load(file.read_text())
    plant = RobotKinematics(load_robot_file(file)).plant
    motors = map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
    assert {m.joint().name(): m.effort_limit() for m in motors} == stated["effort_limits"]
    limits = {name: 1e3 for name in stated["effort_limits"]}
    file.write_text(yaml.safe_dump(stated | {"effort_limits": limits}))
    unit = "N" if "prismatic" in text and not effort else "N·m"
    assert f"(1000 {unit}, at most" in findings_of(written)["motor limits"].message


@pytest.mark.parametrize("text", [quadruped(), SLIDING, limited(SLIDING, 'effort="60"')])
def test_efforts_that_a_motor_may_have_are_neither_noted_nor_asked_for(text, tmp_path):
    written = robot_of(text, tmp_path)
    assert not written.copy.warnings and "largest" not in " ".join(written.asked)
    assert {"motor limits", "effort limits"}.isdisjoint(findings_of(written))


def test_a_slider_is_as_stiff_at_the_foot_as_a_hinge(tmp_path):
    gains = load_robot_file(robot_of(SLIDING, tmp_path).folder / "robot.yaml").joint_gains
    slider, hinge = (gains[f"FL_{part}_joint"].stiffness for part in ("calf", "hip"))
    assert slider == pytest.approx(hinge / 0.36**2, rel=0.1)


def test_efforts_too_small_to_stand_are_a_problem(tmp_path):
    found = findings_of(robot_of(limited(quadruped(), 'effort="0.5"'), tmp_path))
    assert "of 0.5 N·m" in found["effort against gravity"].message


def test_a_speed_limit_of_zero_is_none(tmp_path):
    written = robot_of(quadruped({'velocity="30"': 'velocity="0"'}), tmp_path)
    (note,) = written.copy.warnings
    assert "is read as no limit" in note
    kinematics = RobotKinematics(load_robot_file(written.files[1]))
    assert np.isinf(kinematics.velocity_limits).all()


@pytest.mark.parametrize(
    ("limit", "note"),
    [
        (ARM + MIMIC.format("FL_hip", 1, 0), "] follow joints that move, by <mimic>, but"),
        (ARM.replace("23.7", "0"), "] have no motor and are fixed: 'arm2_joint' (effort=\"0\")"),
    ],
)
def test_a_joint_of_an_arm_that_cannot_be_held_is_fixed_and_told(limit, note, tmp_path):
    written = robot_of(quadruped(above=arm(ARM, ARM, limit, ARM)), tmp_path)
    assert "arm2_joint" not in written.joints and "arm3_joint" in written.joints
    (hand,) = load_robot_file(written.files[1]).reaching_frames.values()
    assert hand.joints == ["arm0_joint", "arm1_joint", "arm3_joint"]
    (found,) = written.copy.warnings
    assert f"joints ['arm2_joint'{note}" in found


def test_an_arm_whose_stops_are_at_zero_stands_off_them_and_is_safe(tmp_path):
    stops = [LIMIT.format(*one) for one in ((0, 2), (-2, 0), (-0.2, 0), (-1, 1))]
    written = robot_of(quadruped(above=arm(*stops)), tmp_path, "reaching")
    angles = [written.posture[f"arm{k}_joint"] for k in range(4)]
    assert angles == pytest.approx([0.05, -0.05, -0.05, 0.0])
    legged_robots.edited(written.files[1], posture=written.posture | {"arm3_joint": 0.99})
    assert [finding.item for finding in problems(written)] == ["safe while it stands"]
    (finding,) = problems(written)
    assert (
        "violates joint_limits, -1.1°; arm3_joint is at 0.99 rad, its stop at 1" in finding.message
    )
    assert finding.remedy == "change 'posture' in robot.yaml [rad]"


def test_what_ends_in_a_joint_that_is_fixed_still_reaches(tmp_path):
    passive = arm(ARM, ARM, ARM, ARM, ARM.replace("23.7", "0"))
    written = robot_of(quadruped(above=passive), tmp_path, "reaching")
    (limb,) = written.arms
    assert (limb.body, limb.joints) == ("arm4", [f"arm{k}_joint" for k in range(4)])
    assert problems(written) == []


def test_a_short_arm_is_one_if_its_hand_is_named_and_fixed_and_told_if_not(tmp_path):
    text = quadruped(above=arm(ARM, ARM))
    written = robot_of(text, tmp_path)
    assert written.decided[0].startswith("joints arm0_joint, arm1_joint are fixed: they move nei")
    assert "arm1_joint" not in written.joints
    written = robot_of(text, tmp_path, "reaching", hands=["arm1"])
    assert written.joints[-2:] == ["arm0_joint", "arm1_joint"]
    assert not any("fixed" in one for one in written.decided)
    with pytest.raises(ValueError, match=r"no arm ends in links \['arm0'\]; limbs end in .*'arm1'"):
        robot_of(text, tmp_path, "walking", hands=["arm0"])


def test_coupled_joints_of_an_arm_stay_coupled_in_the_posture(tmp_path):
    text = quadruped(above=arm(ARM, ARM, ARM + MIMIC.format("arm1", 2, 0.3), ARM))
    written = robot_of(text, tmp_path)
    assert written.posture["arm2_joint"] == pytest.approx(0.3 + 2 * written.posture["arm1_joint"])
    assert any("['arm2_joint'] follow others by <mimic>" in one for one in written.copy.warnings)
    assert problems(written) == []
    with pytest.raises(ValueError, match=r"\['arm2_joint'\] follow others .* --task reaching has"):
        robot_of(text, tmp_path, "reaching")


def test_coupled_joints_that_are_fixed_keep_their_coupling(tmp_path):
    gripper = arm(ARM, ARM + MIMIC.format("arm0", 2, 0.3))
    written = robot_of(quadruped(above=gripper), tmp_path)
    assert "mimic" not in written.files[0].read_text()
    pose = written.survey.pose("arm1").rotation().ToRollPitchYaw().vector()
    np.testing.assert_allclose(pose, [0, 0.3, 0], atol=1e-6)


def test_feet_on_a_line_are_no_matter_of_gains(tmp_path):
    (finding,) = problems(robot_of(biped(FOOT), tmp_path))
    assert "q: a biped on 2 points along a line cannot balance with this c" in finding.message
    assert "along a line" in finding.remedy
    assert "joint_gains" not in finding.remedy


PITCH = '<drake:screw_thread_pitch value="0.1"/>'


def test_a_joint_that_only_drake_knows_is_fixed_if_it_moves_no_limb(tmp_path):
    lift = joint("lift", "trunk", "nut", "0 0 0", "0 0 1", LIMIT.format(0, 1) + PITCH)
    screw = re.sub("(</?)joint", r"\1drake:joint", lift).replace("revolute", "screw")
    text = quadruped(above=link("nut", 0.1) + screw)
    text = text.replace("<robot", '<robot xmlns:drake="http://drake.mit.edu"')
    assert "lift" not in robot_of(text, tmp_path).joints


CYLINDER = 'cylinder radius="0.08" length="0.04"'
FREE_KNEES = {CALF: '<limit effort="23.7" velocity="30"/>'}
FREE_KNEES |= {'_calf_joint" type="revolute"': '_calf_joint" type="continuous"'}


def wheeled(form, kind="continuous"):
    """The quadruped with a wheel in place of its feet."""
    hinge = f'_foot_joint" type="{kind}"><axis xyz="0 1 0"/>'
    return quadruped({FOOT: shaped(form, rpy="1.5708 0 0"), '_foot_joint" type="fixed">': hinge})


@pytest.mark.parametrize(
    ("text", "radius_m"),
    [
        (wheeled(CYLINDER), 0.08),
        (wheeled('sphere radius="0.05"'), 0.05),
        (wheeled('mesh filename="tyre.obj"'), 0.08),
        (wheeled(CYLINDER, "revolute"), 0.08),
        (wheeled('box size="0.08 0.08 0.04"'), None),
        (quadruped(FREE_KNEES), None),
    ],
    ids=["cylinder", "ball", "mesh", "no limits", "box", "knees without stops"],
)
def test_wheels_are_told_in_the_terminal_and_in_the_files(text, radius_m, tmp_path):
    rim = np.exp(2j * math.pi * np.arange(32) / 32) * 0.08
    obj(tmp_path / "tyre.obj", [(p.real, p.imag, z) for p in rim for z in (-0.02, 0.02)])
    written = robot_of(text, tmp_path)
    if radius_m:
        assert [limb.radius_m for limb in written.legs] == pytest.approx(4 * [radius_m], abs=1e-6)
        np.testing.assert_allclose([limb.points for limb in written.legs], 0.0, atol=1e-6)
    told = f"joints {[f'{leg}_foot_joint' for leg in LEGS]} turn wheels"
    assert [
        any(told in note for note in written.copy.warnings),
        "turns a wheel, which its servo holds" in written.files[1].read_text(),
        "turn wheels" in written.files[2].read_text(),
        "wheels" in findings_of(written),
    ] == 4 * [radius_m is not None]


def standing(text, folder):
    """The survey of a robot, and its legs, before any posture is solved."""
    (folder / "b.urdf").write_text(text)
    simulatable_copy(folder / "b.urdf").write(folder / "copy.urdf")
    survey = Survey(folder / "copy.urdf")
    return survey, survey.legs()


def test_a_heel_that_is_higher_than_the_toe_does_not_touch(tmp_path):
    heel, toe = (shaped('box size="0.08 0.1 0.02"', xyz=at) for at in ("-0.06 0 0.003", "0.06 0 0"))
    _, legs = standing(biped(heel + toe), tmp_path)
    assert [leg.points[:, 0].min() for leg in legs] == pytest.approx([0.025, 0.025])


def test_an_upright_capsule_touches_at_its_lower_end(tmp_path):
    foot = shaped('drake:capsule radius="0.02" length="0.02"')
    text = biped(foot).replace("<robot", '<robot xmlns:drake="http://drake.mit.edu"')
    _, legs = standing(text, tmp_path)
    for leg in legs:
        np.testing.assert_allclose(leg.points, [[0, 0, -0.01]], atol=1e-9)


@pytest.mark.parametrize("thickness_mm", [1, 2, 6, 10, 12, 15, 19.5, 21, 30])
@pytest.mark.parametrize("form", ["box", "mesh", "two boxes", "plate"])
def test_a_sole_of_any_thickness_touches_at_its_lower_corners(form, thickness_mm, tmp_path):
    t = thickness_mm / 1000
    obj(tmp_path / "sole.obj", BOX * [0.2, 0.1, t])
    heel, toe = (shaped(f'box size="0.08 0.1 {t}"', xyz=f"{x} 0 0") for x in (-0.06, 0.06))
    shapes = {
        "box": shaped(f'box size="0.2 0.1 {t}"'),
        "mesh": shaped('mesh filename="sole.obj"'),
        "two boxes": heel + toe,
        "plate": shaped(f'cylinder radius="0.1" length="{t}"'),
    }
    survey, legs = standing(biped(shapes[form]), tmp_path)
    half = 0.1 / math.sqrt(2) if form == "plate" else 0.1
    for leg in legs:
        assert len(leg.points) == (8 if form == "two boxes" else 4)
        low, high = leg.points.min(axis=0), leg.points.max(axis=0)
        np.testing.assert_allclose(leg.points[:, 2], leg.radius_m - t / 2, atol=1e-9)
        assert high[0] == pytest.approx(half - leg.radius_m) == -low[0]
    assert survey.positions(legs[0])[:, 2].min() - legs[0].radius_m == pytest.approx(-0.6 - t / 2)


def below(rpy="0 0 0", xyz="0 0 0", name="odd", mass=0.0, kind="fixed"):
    """The quadruped, whose trunk is at a pose in a root link."""
    root = link(name, mass) + joint(f"{name}_joint", name, "trunk", xyz, rpy=rpy)
    return quadruped(root=root.replace("fixed", kind))


QUARTER = math.pi / 2
NAMELESS = dict(zip(LEGS, "abcd", strict=True))


@pytest.mark.parametrize(
    ("text", "base", "note"),
    [
        (quadruped(), "trunk", ""),
        (below(), "odd", ""),
        (below(xyz="0.02 0 0.03"), "odd", ""),
        (below(xyz="0 0 0.1"), "hips", "'odd' lies 0.10 m below the hips"),
        (below(xyz="0 0 0.33"), "hips", "lies 0.33 m below the hips"),
        (below(xyz="0 0 0.33", mass=2.0), "hips", "lies 0.33 m below the hips"),
        (below(xyz="0.1 0 -0.6", name="imu"), "hips", "'imu' lies -0.60 m below"),
        (below(xyz="-0.3 0 0", name="hips"), "hips_", "0.30 m aside"),
        (below(f"0 0 {QUARTER}"), "hips", "has its left along -x"),
        (below(f"0 0 {-QUARTER}"), "hips", "has its left along +x"),
        # The axes of the knees tell left.
        (edited(below(f"0 0 {QUARTER}"), NAMELESS), "hips", "has its left along -x"),
        (below(f"{-QUARTER} 0 0"), "hips", "has its legs along -y"),
        (below(f"{math.pi} 0 0"), "hips", "has its legs along +z"),
        (below(f"0 {QUARTER} 0"), "hips", "has its legs along -x"),
        (below(f"0 0 {math.pi}"), "odd", "faces backwards, as its left is along -y of 'odd'"),
        (below(name="world"), "trunk", "the root link 'world' is left out"),
        (below(name="odom", kind="floating"), "trunk", "'odom' is left out"),
        (below(name="odom", kind="planar"), "trunk", "'odom' is left out"),
    ],
)
def test_the_base_lies_between_the_hips_x_forwards_and_z_up(text, base, note, tmp_path):
    written = robot_of(text, tmp_path)
    assert written.survey.base == base
    assert any(note in one for one in written.copy.warnings) == bool(note)
    is_new, sizes = base.startswith("hips"), written.sizes
    assert sizes.height_m == pytest.approx(0.32, abs=1e-3 if is_new else 0.04)
    assert (sizes.half_length_m, sizes.half_width_m) == pytest.approx((0.19, 0.13), abs=0.03)
    if is_new:
        front = written.survey.joint_origin(written.joints[0])
        np.testing.assert_allclose(front, [0.19, 0.05, 0.0], atol=1e-6)


NAMES = ["{}1", "on{}", "null {}", "1e{}", "{}[0]", "{}(a|b)*", "a:{}", "{}, x", "#{}", "'{}\""]
NAMES += ["{}\\d", "ß/{}", "{}.", "- {}", "{{{}}}"]
VALUES = "on off null ~ 1e3 0x1 1_0 12:30:00 2001-01-01 .inf yes -".split()  # Of YAML.


@pytest.mark.parametrize("pattern", [*NAMES, *VALUES, "a: b"])
def test_names_are_data(pattern, tmp_path):
    numbers = {}

    def spell(name):
        if "{}" in pattern:
            return pattern.format(numbers.setdefault(name, len(numbers)))
        return pattern if name == "trunk" else name

    written = robot_of(renamed(quadruped(), spell), tmp_path)
    robot = load_robot_file(written.files[1])
    kinematics = RobotKinematics(robot)
    assert robot.base == spell("trunk")
    assert kinematics.joint_names == written.joints
    assert kinematics.standing_height == pytest.approx(written.sizes.height_m, abs=1e-4)
    for name, position in zip(written.joints, kinematics.posture, strict=True):
        assert position == written.posture[name]
        assert robot.gains_of(name) is not None


def test_a_robot_with_names_of_every_kind_passes_its_check(tmp_path):
    written = robot_of(renamed(quadruped(), "[{}: 1]*".format), tmp_path)
    partner = load_robot_file(written.files[1]).mirror_partners(written.joints)
    assert partner["[FL_calf_joint: 1]*"] == "[FR_calf_joint: 1]*"
    assert problems(written) == []


def test_hulls_of_links_with_like_names_are_separate_files(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box([0.1, 0.1, 0.1]).export(tmp_path / "part.stl")
    part = 0.1, shaped('mesh filename="part.stl"'), "0 0 0.1"
    parts = (chain("trunk", (name, *part)) for name in ("a/b", "a b", "a_b", "../a"))
    written = robot_of(quadruped(above="".join(parts)), tmp_path)
    meshes = list((written.folder / "meshes").rglob("*.obj"))
    assert len(meshes) == 4 and {path.parent.name for path in meshes} == {"meshes"}


def test_check_names_what_was_spoilt_by_hand(tmp_path):
    written = robot_of(quadruped(), tmp_path)
    text = written.files[0].read_text()

    def problem(edits):
        written.files[0].write_text(edited(text, edits))
        return problems(written)[0]

    shape = problem({"0.4 0.2 0.1": "0 0.2 0.1"})
    assert "link 'trunk' is a box of size 0 0.2 0.1" in shape.message
    leg = problem({KNEE: KNEE + '<mimic joint="FL_thigh_joint"/>'})
    assert leg.item == "joints of legs"
    assert "['FL_calf_joint'] follow others by <mimic>" in leg.message
