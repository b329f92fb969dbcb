"""URDFs as exporters write them: handled with a note, or refused with names, values, a remedy."""

import math
import re
from itertools import product

import numpy as np
import pytest
import yaml
from scipy.spatial import ConvexHull

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.importing.robot_check import check_urdf
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


def findings_of(written, *, is_imported=True):
    """Returns the warnings and problems of a check."""
    options = {"is_imported": is_imported, "check_robot": check_urdf}
    findings = check_scenario(written.files[-1], num_episodes=0, **options)
    return {f.item: f for f in findings if f.remedy}


def obj(path, points):
    """Writes the hull of points."""
    rows = [("v", *point) for point in points]
    rows += [("f", *face) for face in ConvexHull(points).simplices + 1]
    path.write_text("\n".join(" ".join(map(str, row)) for row in rows))


MOTOR = """<transmission name="{0}_t"><type>transmission_interface/SimpleTransmission</type>
<joint name="{0}"/><actuator name="{0}_m"/></transmission>"""
MIMIC = '<mimic joint="{}_joint" multiplier="{}" offset="{}"/>'
KNEE, STOPS = '<joint name="FL_calf_joint" type="revolute">', 'lower="-0.9" upper="0.9"'
LOST = shaped('mesh filename="shank.obj"')
ARM = LIMIT.format(-1, 1)


def arm(*limits):
    """Elements of an arm on the trunk, of hinges with these limits."""
    hinges = (("0 0 0.1", "0 1 0", limit) for limit in limits)
    return chain("trunk", *((f"arm{k}", 0.1, "", *hinge) for k, hinge in enumerate(hinges)))


MASSLESS = arm(*4 * [ARM]).replace('mass value="0.1"', 'mass value="0"')
MILLIMETRES = re.sub(
    '<origin xyz="([^"]*)"',
    lambda match: '<origin xyz="{} {} {}"'.format(*(1000 * float(x) for x in match[1].split())),
    quadruped(),
)
REFUSED = {
    "by <mimic>: 'FL_calf_joint' (FL_thigh_joint). Remedy: remove": quadruped(
        {KNEE: KNEE + MIMIC.format("FL_thigh", -1, -0.2)}
    ),
    "'FR_calf_joint' (no transmission, as others": quadruped(
        above="".join(map(MOTOR.format, DRIVEN))
    ),
    "'FL_calf_joint' (effort=\"0\")": quadruped({CALF: CALF.replace("23.7", "0")}),
    "have equal limits: 'FL_hip_joint' (0)": quadruped({STOPS: 'lower="0" upper="0"'}),
    "'FL_foot' (shank.obj); 'FR_foot' (shank.obj)": quadruped({FOOT: LOST}),
    "'FL_hip_joint' has lower=\"0.9\"": quadruped({STOPS: 'lower="0.9" upper="-0.9"'}),
    "joint 'FL_calf_joint' has xyz=\"0 0 -0,2\" in <origin>": quadruped({"0 0 -0.2": "0 0 -0,2"}),
    "link 'FR_foot' is the child of joints ['FR_foot_joint', 'rod']": quadruped(
        above=joint("rod", "FL_foot", "FR_foot")
    ),
    "'arm0_joint' moves link 'arm0', which has no mass": quadruped(above=MASSLESS),
    "'trunk' has a negative moment of inertia": quadruped({'ixx="0.06"': 'ixx="-0.02"'}),
    "'trunk' would stand 320 m high. Are the <origin>s in millimetres?": MILLIMETRES,
}


@pytest.mark.parametrize(("words", "text"), REFUSED.items())
def test_what_cannot_stand_is_refused_by_name_value_and_file(words, text, tmp_path):
    with pytest.raises(ValueError, match=r"q\.urdf'") as error:
        robot_of(text, tmp_path)
    assert words in str(error.value)
    assert "/tmp" not in str(error.value).replace(str(tmp_path), "")
    assert not (tmp_path / "balancing").exists()


def framed(kind, form):
    """The quadruped with a link of one shape."""
    frame = link("frame", shapes=shaped(form, kind)) + joint("j", "trunk", "frame")
    return quadruped(above=frame)


def with_moments(change, names="ixx|iyy|izz"):
    moment = re.compile(f'({names})="([^"]*)"')
    return moment.sub(lambda match: f'{match[1]}="{change(float(match[2]))}"', quadruped())


@pytest.mark.parametrize(
    ("text", "note"),
    [
        (biped(FOOT), "the contact points of the feet lie on a line"),
        (with_moments(lambda moment: 1e6 * moment), "17 links have inertias"),
        (with_moments(lambda x: 1e3 * x, "mass value|ixx|iyy|izz"), "has 8.16e+03 kg (grams or"),
        (quadruped({STOPS: 'lower="-45" upper="45"'}), "their limits in degrees?"),
        (framed("collision", 'box size="0.1 0.1 0.0"'), "is a box of size 0.1 0.1 0.0: it is left"),
    ],
)
def test_what_is_odd_is_noted_at_once_and_nothing_else(text, note, tmp_path):
    written = robot_of(text, tmp_path)
    warnings, findings = written.copy.warnings, findings_of(written, is_imported=False)
    assert len(warnings) == bool(note) and all(note in warning for warning in warnings)
    of_masses = re.search("links have inertias|grams", "".join(warnings))
    assert ("inertias" in findings) == bool(of_masses)


SLIDING = quadruped({'"0 1 0"/>' + CALF: f'"0 0 1"/>{LIMIT.format(-0.12, 0.1)}'})
for name in KNEES:
    SLIDING = SLIDING.replace(f'"{name}" type="revolute"', f'"{name}" type="prismatic"')


@pytest.mark.parametrize(
    ("text", "asked"),
    [
        (quadruped(), "'FL_calf_joint' (q.urdf says 1000) [N·m]"),
        (SLIDING, "force of joint 'FL_calf_joint' (q.urdf says 1000) [N]"),
    ],
)
def test_efforts_that_no_motor_has_are_estimated_asked_for_and_warned_of(text, asked, tmp_path):
    written = robot_of(text.replace('effort="23.7"', 'effort="1000"'), tmp_path)
    (note,) = written.copy.warnings
    assert "12 joints have limits that no motor of a robot of 8" in note
    assert asked in " ".join(written.asked)
    findings = findings_of(written, is_imported=False)
    assert "the limits of 12 joints are estimates" in findings["effort limits"].message
    assert "motor limits" not in findings
    # robot.yaml replaces the limits of the file, which come back without it.
    file = written.folder / "robot.yaml"
    stated = yaml.safe_load(file.read_text())
    plant = RobotKinematics(load_robot_file(file)).plant
    motors = map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
    assert {m.joint().name(): m.effort_limit() for m in motors} == stated["effort_limits"]
    limits = {name: 1e3 for name in stated["effort_limits"]}
    file.write_text(yaml.safe_dump(stated | {"effort_limits": limits}))
    assert "(1000 N·m, at most" in findings_of(written, is_imported=False)["motor limits"].message


@pytest.mark.parametrize(
    ("limit", "note"),
    [
        (ARM + MIMIC.format("FL_hip", 1, 0), "] follow others by <mimic> and are fixed"),
        (ARM.replace("23.7", "0"), "] have no motor and are fixed: 'arm2_joint' (effort=\"0\")"),
    ],
)
def test_a_joint_of_an_arm_that_cannot_be_held_is_fixed_with_a_note(limit, note, tmp_path):
    written = robot_of(quadruped(above=arm(ARM, ARM, limit, ARM)), tmp_path)
    assert "arm2_joint" not in written.joints and "arm3_joint" in written.joints
    (hand,) = load_robot_file(written.files[1]).reaching_frames.values()
    assert hand.joints == ["arm0_joint", "arm1_joint", "arm3_joint"]
    (warning,) = written.copy.warnings
    assert f"joints ['arm2_joint'{note}" in warning


def test_a_short_arm_is_one_if_its_hand_is_named_and_fixed_if_not(tmp_path):
    text = quadruped(above=arm(ARM, ARM))
    written = robot_of(text, tmp_path)
    assert written.decided[0].startswith("joints arm0_joint, arm1_joint are fixed: they move nei")
    assert "arm1_joint" not in written.joints
    written = robot_of(text, tmp_path, "reaching", hands=["arm1"])
    assert written.joints[-2:] == ["arm0_joint", "arm1_joint"]


def wheeled(form):
    """The quadruped with a wheel in place of its feet."""
    hinge = '_foot_joint" type="continuous"><axis xyz="0 1 0"/>'
    return quadruped({FOOT: shaped(form, rpy="1.5708 0 0"), '_foot_joint" type="fixed">': hinge})


def test_wheels_are_named_in_the_terminal_and_in_the_files(tmp_path):
    written = robot_of(wheeled('cylinder radius="0.08" length="0.04"'), tmp_path)
    assert [limb.radius_m for limb in written.legs] == pytest.approx(4 * [0.08], abs=1e-6)
    np.testing.assert_allclose([limb.points for limb in written.legs], 0.0, atol=1e-6)
    note = f"joints {[f'{leg}_foot_joint' for leg in LEGS]} have no stops"
    assert any(note in warning for warning in written.copy.warnings)
    assert "turn wheels, servos hold" in written.files[2].read_text()
    assert "wheels" in findings_of(written, is_imported=False)


def standing(text, folder):
    """The survey of a robot, and its legs, before any posture is solved."""
    (folder / "b.urdf").write_text(text)
    simulatable_copy(folder / "b.urdf").write(folder / "copy.urdf")
    survey = Survey(folder / "copy.urdf")
    return survey, survey.legs()


@pytest.mark.parametrize("form", ["box", "mesh", "two boxes", "plate"])
def test_a_thin_sole_touches_at_its_lower_corners(form, tmp_path):
    t = 0.015
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


def below(rpy="0 0 0", xyz="0 0 0", name="odd", kind="fixed"):
    """The quadruped, whose trunk is at a pose in a root link."""
    root = link(name) + joint(f"{name}_joint", name, "trunk", xyz, rpy=rpy)
    return quadruped(root=root.replace("fixed", kind))


@pytest.mark.parametrize(
    ("text", "base", "note"),
    [
        (below(xyz="0.02 0 0.03"), "odd", ""),
        (below(xyz="0 0 0.33"), "hips", "is far from the hips"),
        (below(name="world"), "trunk", "the root link 'world' is left out"),
        (below(name="odom", kind="floating"), "trunk", "'odom' is left out"),
    ],
)
def test_the_base_lies_near_the_hips(text, base, note, tmp_path):
    written = robot_of(text, tmp_path)
    assert written.survey.base == base
    assert any(note in warning for warning in written.copy.warnings) == bool(note)
    is_new, sizes = base.startswith("hips"), written.sizes
    assert sizes.height_m == pytest.approx(0.32, abs=1e-3 if is_new else 0.04)
    assert (sizes.half_length_m, sizes.half_width_m) == pytest.approx((0.19, 0.13), abs=0.03)
    if is_new:
        front = written.survey.joint_origin(written.joints[0])
        np.testing.assert_allclose(front, [0.19, 0.05, 0.0], atol=1e-6)


@pytest.mark.parametrize("pattern", ["1{}", "[{}: 1](a|b)*", "'{}\"\\d"])
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
    for name, position in zip(written.joints, kinematics.posture, strict=True):
        assert position == written.posture[name]
        assert robot.gains_of(name) is not None
    assert not [finding for finding in findings_of(written).values() if not finding.is_ok]


def test_check_names_what_was_spoilt_by_hand(tmp_path):
    written = robot_of(quadruped(), tmp_path)
    text = written.files[0].read_text()

    for edits, message in (
        ({"0.4 0.2 0.1": "0 0.2 0.1"}, "link 'trunk' is a box of size 0 0.2 0.1"),
        ({KNEE: KNEE + '<mimic joint="FL_thigh_joint"/>'}, "['FL_calf_joint'] follow others by"),
    ):
        written.files[0].write_text(edited(text, edits))
        first = next(finding for finding in findings_of(written).values() if not finding.is_ok)
        assert message in first.message
