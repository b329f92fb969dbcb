"""MJCF as the model file of `new`: the same mechanics as in MuJoCo, and its gains and postures."""

import xml.etree.ElementTree as ElementTree

import mujoco
import numpy as np
import pytest
import yaml
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from command_line import invoked
from drake_safety.extras import MissingExtraError
from drake_safety.robots.mjcf import is_mjcf, mjcf_to_urdf
from drake_safety.robots.robot_template import write_robot
from drake_safety.simulation.scenario_check import check_scenario

SHELL = """v 250 0 0\nv 0 80 0\nv 0 0 50\nv -250 -80 -50
f 1 2 3\nf 1 4 2\nf 2 4 3\nf 3 4 1\n"""
BALL = '<geom size="0.05" mass="1"/>'
LEG = """
<body name="{0}_hip" pos="{1} {2} 0"><joint name="{0}_roll" axis="1 0 0" range="-45 45"/>
  <geom type="sphere" size="0.03" mass="0.4" class="collision"/>
  <body name="{0}_thigh"><joint name="{0}_pitch" axis="0 1 0" range="-90 90"/>
    <geom fromto="0 0 0 0 0 -0.2" size="0.015" mass="0.5" class="collision"/>
    <body name="{0}_calf" pos="0 0 -0.2"><joint name="{0}_knee" axis="0 1 0" range="-150 -10"/>
      <geom fromto="0 0 0 0 0 -0.18" size="0.01" mass="0.2" class="collision"/>
      <geom pos="0 0 -0.2" class="foot"/>
    </body>
  </body>
</body>"""
PLACES = {"FL": (0.2, 0.1), "FR": (0.2, -0.1), "RL": (-0.2, 0.1), "RR": (-0.2, -0.1)}
STANCE = 4 * "0 0.8 -1.6 "
DOG = """<mujoco model="dog">
  <compiler meshdir="assets"/>
  <default>
    <default class="dog">
      <joint damping="0.5" armature="0.02" frictionloss="0.1"/>
      <position kp="150" kv="3" forcerange="-30 30"/>
      <default class="visual">
        <geom type="mesh" contype="0" conaffinity="0" group="2" rgba="1 0 0 1"/>
      </default>
      <default class="collision"><geom type="capsule" group="3"/></default>
      <default class="foot"><geom size="0.02" mass="0.1" group="3" friction="0.7"/></default>
    </default>
  </default>
  <asset><mesh file="shell.obj" scale="0.001 0.001 0.001"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body name="trunk" pos="0 0 0.4" childclass="dog">
      <freejoint/>
      <geom mesh="shell" class="visual"/>
      <geom type="box" size="0.25 0.08 0.05" mass="8" group="3"/>
      {legs}
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
  <keyframe>{keys}</keyframe>
</mujoco>"""
HOME = f'<key name="down" qpos="0 0 0.1 1 0 0 0 {4 * "0 1.2 -2.6 "}"/>'
HOME = f'<key qpos="0 0 0.4 1 0 0 0 {4 * "0 0.3 -0.2 "}"/>{HOME}'
HOME += f'<key name="home" qpos="0 0 0.3 1 0 0 0 {STANCE}"/>'


def write_dog(folder, keys=HOME, actuator="position", change=lambda text: text):
    """A quadruped in the layout of MuJoCo's menagerie."""
    (folder / "assets").mkdir(exist_ok=True)
    (folder / "assets" / "shell.obj").write_text(SHELL)
    names = (f"{leg}_{joint}" for leg in PLACES for joint in ("roll", "pitch", "knee"))
    text = DOG.format(
        legs="".join(LEG.format(leg, *place) for leg, place in PLACES.items()),
        actuators="".join(f'<{actuator} name="{n}" joint="{n}" class="dog"/>' for n in names),
        keys=keys,
    )
    (folder / "dog.xml").write_text(change(text))
    return folder / "dog.xml"


def written(folder, bodies="", more="", name="r.xml"):
    """An MJCF of a free base and some bodies on it."""
    path = folder / name
    base = f'<body name="base"><freejoint/>{BALL}{bodies}</body>'
    path.write_text(f"<mujoco><worldbody>{base}</worldbody>{more}</mujoco>")
    return path


def one_joint(joint="", more=""):
    """A base with an arm by a joint called j."""
    return f'<body name="arm" pos="0 0 1"><joint name="j" {joint}/>{BALL}{more}</body>'


SHAPES = """<geom type="box" size="0.1 0.2 0.3" pos="0.1 0 0" euler="10 20 30"/>
  <geom type="cylinder" size="0.1 0.2" fromto="0 0 0 0.1 0.1 0.1"/>
  <geom type="ellipsoid" size="0.1 0.2 0.3"/>"""


@pytest.mark.parametrize(
    "bodies",
    [
        one_joint(),
        one_joint('axis="1 2 3" range="-30 60"'),
        one_joint('pos="0.1 0.2 0.3" axis="1 1 0"', '<body name="tip" pos="1 0 0"/>'),
        one_joint('ref="45" range="0 90" axis="0 1 0"'),
        one_joint('type="slide" axis="1 0 0" ref="0.2" pos="0.3 0 0"'),
        one_joint('axis="1 0 0"', '<joint name="k" axis="0 1 0" pos="0 0 -0.1" ref="20"/>'),
        one_joint("", f'<body euler="0 90 0"><joint axis="1 0 0"/>{BALL}</body>'),
        f'<body pos="1 0 0" euler="0 0 90"><joint axis="0 1 0"/>{SHAPES}<body>{BALL}</body></body>',
        '<body><inertial pos="0.1 0 0" mass="2" fullinertia="3 2 2 0.1 0.2 0.3"/><joint/></body>',
    ],
)
def test_a_urdf_moves_as_the_mjcf_does(tmp_path, bodies):
    rng = np.random.default_rng(0)
    path = written(tmp_path, bodies)
    mjcf_to_urdf(path, tmp_path / "r.urdf")
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    Parser(plant).AddModels(str(tmp_path / "r.urdf"))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    model = mujoco.MjModel.from_xml_path(str(path))
    state = mujoco.MjData(model)
    joints = [model.joint(j) for j in range(1, model.njnt)]
    names = [joint.name or f"joint_{joint.id}" for joint in joints]
    q = rng.normal(size=len(joints))
    state.qpos[7:] = q
    mujoco.mj_forward(model, state)
    places = [plant.GetJointByName(name).velocity_start() for name in names]
    positions = plant.GetPositions(context)
    positions[:7], positions[np.array(places) + 1] = [1, 0, 0, 0, 0, 0, 0], q
    plant.SetPositions(context, positions)
    for i in range(1, model.nbody):
        body = plant.GetBodyByName(model.body(i).name or f"body_{i}")
        X_WB = RigidTransform(RotationMatrix(state.xmat[i].reshape(3, 3)), state.xpos[i])
        assert X_WB.IsNearlyEqualTo(body.EvalPoseInWorld(context), 1e-8)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, state, M)
    np.testing.assert_allclose(
        plant.CalcMassMatrix(context)[np.ix_(places, places)], M[6:, 6:], rtol=1e-7, atol=1e-9
    )
    mass = plant.CalcTotalMass(context)
    assert mass == pytest.approx(model.body_subtreemass[1])


GEARED = '<position joint="j" kp="9" kv="2" forcerange="-4 4" gear="3"/>'


@pytest.mark.parametrize(
    ("actuators", "joint", "gains", "effort"),
    [
        ('<position joint="j" kp="50" kv="2"/>', "", (50, 2), None),
        ('<position joint="j" kp="50" kv="2" ctrlrange="-1 1"/>', "", (50, 2), None),
        ('<position joint="j" kp="50" forcerange="-7 7"/>', "", (50, 0), 7),
        ('<position joint="j" kp="50"/>', 'actuatorfrcrange="-8 8"', (50, 0), 8),
        ('<position joint="j" kp="50"/><velocity joint="j" kv="3"/>', "", (50, 3), None),
        (GEARED, "", (81, 18), 12),
        (GEARED, 'actuatorfrcrange="-8 8"', (81, 18), 8),
        ('<general joint="j" biastype="affine" gainprm="5" biasprm="0 -5 -1"/>', "", (5, 1), None),
        ('<motor joint="j" ctrlrange="-3 6" gear="10"/>', "", None, 60),
        ('<motor joint="j"/>', "", None, None),
        ("", 'actuatorfrcrange="-8 8"', None, None),
    ],
)
def test_gains_and_effort_limits_are_the_actuators(tmp_path, actuators, joint, gains, effort):
    path = written(tmp_path, one_joint(joint), f"<actuator>{actuators}</actuator>")
    facts = mjcf_to_urdf(path, tmp_path / "r.urdf")
    assert facts.gains.get("j") == (gains and pytest.approx(gains))
    root = ElementTree.parse(tmp_path / "r.urdf").getroot()
    assert (root.find("transmission/joint[@name='j']") is not None) == bool(actuators)
    limit = root.find("joint[@name='j']/limit")
    assert (effort is None) == (limit is None or limit.get("effort") is None)
    assert effort is None or float(limit.get("effort")) == pytest.approx(effort)


def test_what_a_joint_resists_is_taken(tmp_path):
    motor = '<actuator><motor joint="j" gear="3" armature="0.01" damping="0.1"/></actuator>'
    joint = one_joint('damping="0.5" armature="0.02" frictionloss="0.3" stiffness="5"')
    facts = mjcf_to_urdf(written(tmp_path, joint, motor), tmp_path / "r.urdf")
    assert facts.rotor_inertia == {"j": pytest.approx(0.02 + 9 * 0.01)}
    dynamics = ElementTree.parse(tmp_path / "r.urdf").find("joint[@name='j']/dynamics")
    assert float(dynamics.get("damping")) == pytest.approx(0.5 + 9 * 0.1)
    assert float(dynamics.get("friction")) == pytest.approx(0.3)
    assert float(dynamics.get("stiffness")) == pytest.approx(5)


def test_a_joint_that_an_equality_couples_is_a_mimic(tmp_path):
    arms = one_joint('ref="10"') + one_joint('ref="20"').replace('"j"', '"k"').replace("arm", "leg")
    equality = '<equality><joint joint1="k" joint2="j" polycoef="0.1 2 0 0 0"/></equality>'
    mjcf_to_urdf(written(tmp_path, arms, equality), tmp_path / "r.urdf")
    mimic = ElementTree.parse(tmp_path / "r.urdf").find("joint[@name='k']/mimic")
    assert mimic.get("joint") == "j"
    assert float(mimic.get("multiplier")) == pytest.approx(2)
    assert float(mimic.get("offset")) == pytest.approx(np.radians(20) + 0.1 - 2 * np.radians(10))


@pytest.mark.parametrize(
    ("bodies", "more", "note"),
    [
        (
            one_joint(),
            '<tendon><fixed name="rope"><joint joint="j" coef="1"/></fixed></tendon>',
            "tendons are left out: rope",
        ),
        (one_joint(), '<actuator><velocity name="v" joint="j"/></actuator>', "have no gains: v"),
        (
            one_joint('range="-1 1"'),
            '<actuator><muscle name="calf" joint="j"/></actuator>',
            "neither motors nor position servos of a joint have no gains: calf",
        ),
        (
            one_joint(),
            '<equality><joint name="bent" joint1="j" polycoef="0 1 2 0 0"/></equality>',
            "constraints are left out: bent",
        ),
        (
            one_joint(),
            f'<worldbody><body name="box" pos="9 0 0"><freejoint/>{BALL}</body></worldbody>',
            "moving bodies beside the robot are left out: box",
        ),
    ],
)
def test_what_a_urdf_cannot_hold_is_noted(tmp_path, bodies, more, note):
    facts = mjcf_to_urdf(written(tmp_path, bodies, more), tmp_path / "r.urdf")
    assert any(note in what for what in facts.left_out)


def test_a_base_that_is_fixed_to_the_world_floats_and_is_noted(tmp_path):
    path = written(tmp_path, one_joint())
    path.write_text(path.read_text().replace("<freejoint/>", ""))
    assert "floats here: base" in mjcf_to_urdf(path, tmp_path / "r.urdf").left_out[0]


LOOP = '<equality><connect body1="arm" body2="base" anchor="0 0 0"/></equality>'
GONE = '<asset><mesh name="gone" file="gone.stl"/></asset>'


@pytest.mark.parametrize(
    ("bodies", "more", "message"),
    [
        (one_joint('type="ball"'), "", "joint 'j' is a ball joint or moves the base"),
        (one_joint(), LOOP, "connects bodies 'arm' and 'base' to a loop"),
        (one_joint('stiff="5"'), "", "unrecognized attribute: 'stiff'"),
        (one_joint("", '<geom type="mesh" mesh="gone"/>'), GONE, "gone.stl"),
    ],
)
def test_what_cannot_be_converted_is_refused_with_its_name(tmp_path, bodies, more, message):
    path = written(tmp_path, bodies, more)
    with pytest.raises(ValueError, match=message) as caught:
        mjcf_to_urdf(path, tmp_path / "r.urdf")
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            f"<body><joint name='slide_x' type='slide'/>{BALL}{one_joint()}</body>",
            "'slide_x' .* moves the base",
        ),
        ("<body><geom size='1'/></body>", "has no joint"),
    ],
)
def test_a_base_that_is_none_is_refused(tmp_path, text, message):
    path = tmp_path / "r.xml"
    path.write_text(f"<mujoco><worldbody>{text}</worldbody></mujoco>")
    with pytest.raises(ValueError, match=message):
        mjcf_to_urdf(path, tmp_path / "r.urdf")


def test_mujoco_is_asked_for_where_it_is_not_installed(tmp_path, monkeypatch):
    monkeypatch.setattr("drake_safety.extras.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"pip install 'drake_safety\[mujoco\]'"):
        mjcf_to_urdf(written(tmp_path, one_joint()), tmp_path / "r.urdf")


@pytest.fixture(scope="module")
def dog(tmp_path_factory):
    """What `new` writes for the quadruped's scene, which includes its file."""
    folder = tmp_path_factory.mktemp("mjcf")
    write_dog(folder)
    (folder / "scene.xml").write_text('<mujoco><include file="dog.xml"/></mujoco>')
    return write_robot("dog", folder / "scene.xml", "balancing", folder / "dog")


def test_a_robot_from_mjcf_passes_its_check_as_it_is(dog):
    findings = check_scenario(dog.folder / "balancing.yaml", num_episodes=0)
    assert [f for f in findings if not f.is_ok] == []


def test_robot_yaml_has_what_the_mjcf_states(dog):
    robot = yaml.safe_load((dog.folder / "robot.yaml").read_text())
    names = [f"{leg}_{joint}" for leg in PLACES for joint in ("roll", "pitch", "knee")]
    assert robot["joint_gains"] == {name: {"stiffness": 150, "damping": 3} for name in names}
    assert robot["rotor_inertia"] == dict.fromkeys(names, 0.02)
    assert robot["foot_friction"] == 0.7
    assert "| friction of the feet | `scene.xml` |" in (dog.folder / "README.md").read_text()
    assert robot["posture"] == {
        f"{leg}_{joint}": q for leg in PLACES for joint, q in (("pitch", 0.8), ("knee", -1.6))
    }
    assert dog.posture_source == "keyframe 'home'"
    assert "effort_limits" not in robot
    assert not any("gains" in what for what in dog.asked)
    assert "joint_friction_nm: 0.1 " in (dog.folder / "balancing.yaml").read_text()
    assert "converted from 'scene.xml'" in (dog.folder / "README.md").read_text()


def test_geoms_are_seen_or_collide_by_their_groups_and_masks(dog):
    root = ElementTree.parse(dog.files[0]).getroot()
    trunk = root.find("link[@name='trunk']")
    (seen,) = trunk.findall("visual")
    assert seen.find("geometry/mesh").get("filename") == "meshes/shell.gltf"
    (shape,) = trunk.findall("collision")
    np.testing.assert_allclose(
        np.fromstring(shape.find("geometry/box").get("size"), sep=" "), [0.5, 0.16, 0.1]
    )


UNUSED = (
    "solved: feet under the hips, as it stands in no keyframe; other joints as in keyframe 'home'"
)


@pytest.mark.parametrize(
    ("keys", "source"),
    [
        (f'<key name="stand" qpos="0 0 0 1 0 0 0 {STANCE}"/>', "keyframe 'stand'"),
        (f'<key qpos="0 0 0 1 0 0 0 {STANCE}"/>', "keyframe '0'"),
        ("", "solved: feet under the hips"),
        # Beyond the stops of the knees; feet that are not level.
        (f'<key name="home" qpos="0 0 0 1 0 0 0 {4 * "0 0.8 0.5 "}"/>', UNUSED),
        (
            f'<key name="home" qpos="0 0 0 1 0 0 0 {2 * "0 0.8 -1.6 "}{2 * "0 0.7 -1.4 "}"/>',
            UNUSED,
        ),
    ],
)
def test_a_posture_is_a_keyframe_in_which_the_robot_stands(tmp_path, keys, source):
    found = write_robot("dog", write_dog(tmp_path, keys), "balancing", tmp_path / "dog")
    assert found.posture_source == source


def test_bodies_that_the_mjcf_excludes_do_not_collide(tmp_path):
    exclude = '<contact><exclude body1="FL_calf" body2="FR_calf"/></contact></mujoco>'
    path = write_dog(tmp_path, change=lambda text: text.replace("</mujoco>", exclude))
    found = write_robot("dog", path, "balancing", tmp_path / "dog")
    members = {
        frozenset(one.get("link") for one in group if one.tag.endswith("member"))
        for group in ElementTree.parse(found.files[0]).getroot()
        if group.tag.endswith("collision_filter_group")
    }
    assert {"FL_calf", "FR_calf"} in members


def test_friction_that_is_stated_of_no_foot_is_assumed_everywhere(tmp_path):
    path = write_dog(tmp_path, change=lambda text: text.replace('friction="0.7"', 'friction="0"'))
    found = write_robot("dog", path, "balancing", tmp_path / "dog")
    assert "foot_friction: 0.6" in found.files[1].read_text()
    assert "| friction of the feet | assumed;" in found.files[2].read_text()
    assert "the friction of feet on your ground [1]; 0.6 is assumed" in found.asked


def test_bodies_that_overlap_and_are_excluded_are_told_once(tmp_path):
    def change(text):
        text = text.replace('<geom type="box" size="0.25 0.08', '<geom type="box" size="0.25 0.3')
        return text.replace(
            "</mujoco>",
            '<contact><exclude body1="trunk" body2="FL_thigh"/></contact></mujoco>',
        )

    found = write_robot("dog", write_dog(tmp_path, change=change), "balancing", tmp_path / "dog")
    told = [note for note in found.copy.notes if "'FL_thigh' and 'trunk'" in note]
    assert len(told) == 1
    assert not any("'trunk' and 'FL_thigh'" in note for note in found.copy.notes)


def test_gains_are_asked_for_where_actuators_are_motors(tmp_path):
    path = write_dog(tmp_path, actuator="motor")
    result = invoked("new", "dog", "--mjcf", path, "--out", tmp_path / "dog")
    assert result.exit_code == 0, result.output
    assert "posture keyframe 'home'" in result.output
    assert "the maker's servo gains" in result.output


def test_the_root_element_tells_mjcf_from_urdf(tmp_path):
    assert is_mjcf(written(tmp_path, name="robot.urdf"))
    for text in ("<robot name='r'/>", "no XML"):
        (tmp_path / "r.xml").write_text(text)
        assert not is_mjcf(tmp_path / "r.xml")
    assert not is_mjcf(tmp_path / "gone.xml")
