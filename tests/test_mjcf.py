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

from command_line import problems
from drake_safety.importing.mjcf import mjcf_to_urdf
from drake_safety.importing.robot_template import write_robot

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
NAMES = [f"{leg}_{joint}" for leg in PLACES for joint in ("roll", "pitch", "knee")]


KEY = '<key {} qpos="0 0 0.3 1 0 0 0 {}"/>'
HOME = KEY.format("", 4 * "0 0.3 -0.2 ") + KEY.format("name='down'", 4 * "0 1.2 -2.6 ")
HOME += KEY.format("name='home'", STANCE)


def write_dog(folder, keys=HOME, actuator="position"):
    """A quadruped in the layout of MuJoCo's menagerie."""
    (folder / "assets").mkdir(exist_ok=True)
    (folder / "assets" / "shell.obj").write_text(SHELL)
    legs = "".join(LEG.format(leg, *place) for leg, place in PLACES.items())
    servos = "".join(f'<{actuator} name="{n}" joint="{n}" class="dog"/>' for n in NAMES)
    (folder / "dog.xml").write_text(DOG.format(legs=legs, actuators=servos, keys=keys))
    return folder / "dog.xml"


def robot(bodies="", more="", free="<freejoint/>"):
    """An MJCF of a free base and some bodies on it."""
    base = f'<body name="base">{free}{BALL}{bodies}</body>'
    return f"<mujoco><worldbody>{base}</worldbody>{more}</mujoco>"


def arm(joint="", more="", name="j"):
    """A body by a joint."""
    return f'<body name="arm_{name}" pos="0 0 1"><joint name="{name}" {joint}/>{BALL}{more}</body>'


def converted(text, folder):
    """What an MJCF says beyond a URDF, and the URDF's root."""
    (folder / "r.xml").write_text(text)
    facts = mjcf_to_urdf(folder / "r.xml", folder / "r.urdf")
    return facts, ElementTree.parse(folder / "r.urdf").getroot()


SHAPES = """<geom type="box" size="0.1 0.2 0.3" pos="0.1 0 0" euler="10 20 30"/>
  <geom type="cylinder" size="0.1 0.2" fromto="0 0 0 0.1 0.1 0.1"/>
  <geom type="ellipsoid" size="0.1 0.2 0.3"/>"""


@pytest.mark.parametrize(
    "bodies",
    [
        arm('axis="1 2 3" range="-30 60"'),
        arm('pos="0.1 0.2 0.3" axis="1 1 0"', '<body name="tip" pos="1 0 0"/>'),
        arm('type="slide" axis="1 0 0" ref="0.2" pos="0.3 0 0"'),
        arm('axis="1 0 0"', '<joint name="k" axis="0 1 0" pos="0 0 -0.1" ref="20"/>'),
        f'<body pos="1 0 0" euler="0 0 90"><joint axis="0 1 0"/>{SHAPES}<body>{BALL}</body></body>',
        '<body><inertial pos="0.1 0 0" mass="2" fullinertia="3 2 2 0.1 0.2 0.3"/><joint/></body>',
    ],
)
def test_a_urdf_moves_as_the_mjcf_does(tmp_path, bodies):
    converted(robot(bodies), tmp_path)
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    Parser(plant).AddModels(str(tmp_path / "r.urdf"))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "r.xml"))
    state = mujoco.MjData(model)
    state.qpos[7:] = np.random.default_rng(0).normal(size=model.njnt - 1)
    mujoco.mj_forward(model, state)
    positions, places = np.eye(plant.num_positions())[0], []
    for j in range(1, model.njnt):
        joint = plant.GetJointByName(model.joint(j).name or f"joint_{j}")
        positions[joint.position_start()] = state.qpos[6 + j]
        places.append(joint.velocity_start())
    plant.SetPositions(context, positions)
    for i in range(1, model.nbody):
        body = plant.GetBodyByName(model.body(i).name or f"body_{i}")
        X_WB = RigidTransform(RotationMatrix(state.xmat[i].reshape(3, 3)), state.xpos[i])
        assert X_WB.IsNearlyEqualTo(body.EvalPoseInWorld(context), 1e-8)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, state, M)
    found = plant.CalcMassMatrix(context)[np.ix_(places, places)]
    np.testing.assert_allclose(found, M[6:, 6:], rtol=1e-7, atol=1e-9)
    assert plant.CalcTotalMass(context) == pytest.approx(model.body_subtreemass[1])


IN_CLASSES = """<motor joint="j" class="geared"/></actuator><default><default class="geared">
  <motor ctrlrange="-2 2" gear="25"/><joint armature="0.1"/></default></default><actuator>"""
GEARED = '<position joint="j" kp="9" kv="2" forcerange="-4 4" gear="3"/>'


@pytest.mark.parametrize(
    ("actuators", "joint", "gains", "effort"),
    [
        ('<position joint="j" kp="50"/><velocity joint="j" kv="3"/>', "", (50, 3), None),
        (GEARED, 'actuatorfrcrange="-8 8"', (81, 18), 8),
        ('<general joint="j" biastype="affine" gainprm="5" biasprm="0 -5 -1"/>', "", (5, 1), None),
        ('<motor joint="j" ctrlrange="-3 6" gear="10"/>', "", None, 60),
        (IN_CLASSES, 'class="geared" actuatorfrcrange="-9 9"', None, 9),
    ],
)
def test_gains_and_effort_limits_are_the_actuators(tmp_path, actuators, joint, gains, effort):
    facts, root = converted(robot(arm(joint), f"<actuator>{actuators}</actuator>"), tmp_path)
    assert facts.gains.get("j") == (gains and pytest.approx(gains))
    assert (root.find("transmission/joint[@name='j']") is not None) == bool(actuators)
    limit = root.find("joint[@name='j']/limit")
    assert (effort is None) == (limit is None or limit.get("effort") is None)
    assert effort is None or float(limit.get("effort")) == pytest.approx(effort)


def test_what_a_joint_resists_is_taken(tmp_path):
    motor = '<actuator><motor joint="j" gear="3" armature="0.01" damping="0.1"/></actuator>'
    joint = arm('damping="0.5" armature="0.02" frictionloss="0.3" stiffness="5"')
    facts, root = converted(robot(joint, motor), tmp_path)
    assert facts.rotor_inertia == {"j": pytest.approx(0.02 + 9 * 0.01)}
    found = root.find("joint[@name='j']/dynamics")
    stated = {key: float(value) for key, value in found.items()}
    assert stated == pytest.approx({"damping": 0.5 + 9 * 0.1, "friction": 0.3})
    assert facts.left_out == ["springs are left out: j"]


def test_a_joint_that_an_equality_couples_is_a_mimic(tmp_path):
    equality = '<equality><joint joint1="k" joint2="j" polycoef="0.1 2 0 0 0"/></equality>'
    _, root = converted(robot(arm() + arm(name="k"), equality), tmp_path)
    assert root.find("joint[@name='k']/mimic").get("joint") == "j"


def test_three_slides_and_a_ball_are_a_free_joint(tmp_path):
    slides = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    facts, root = converted(robot(arm(), free=slides + '<joint type="ball"/>'), tmp_path)
    expected, free = converted(robot(arm()), tmp_path)
    assert facts == expected
    assert ElementTree.tostring(root) == ElementTree.tostring(free)


ROPE = '<tendon><fixed name="rope"><joint joint="j" coef="1"/></fixed></tendon>'
CRATE = f'<worldbody><body name="box" pos="9 0 0"><freejoint/>{BALL}</body></worldbody>'
OTHER = "actuators that are neither motors nor position servos of a joint have no gains: v"


@pytest.mark.parametrize(
    ("text", "note"),
    [
        (robot(arm(), ROPE), "tendons are left out: rope"),
        (robot(arm(), '<actuator><velocity name="v" joint="j"/></actuator>'), OTHER),
        (robot(arm(), CRATE), "moving bodies beside the robot are left out: box"),
        (robot(arm(), free=""), "the base is fixed to the world there, and floats here: base"),
    ],
)
def test_what_a_urdf_cannot_hold_is_noted(tmp_path, text, note):
    assert converted(text, tmp_path)[0].left_out == [note]


LOOP = '<equality><connect body1="arm_j" body2="base" anchor="0 0 0"/></equality>'
MANY = '<replicate count="3000" offset="1 0 0">{}</replicate>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (robot(arm('type="ball"')), "body 'arm_j' has a ball joint; replace it by three hinges"),
        (robot(arm(), free='<joint type="ball"/>'), "moves in 3 of 6 .* by <freejoint/>"),
        (robot(arm(), LOOP), "connects 'arm_j' and 'base' to a loop"),
        (robot(arm("", MANY.format(MANY.format(BALL)))), "<replicate> with .* takes"),
        (robot(more='<asset><texture width="1e6" height="1e6"/></asset>'), "<texture> with"),
    ],
)
def test_what_cannot_be_converted_is_refused_with_its_name(tmp_path, text, message):
    with pytest.raises(ValueError, match=f"{tmp_path / 'r.xml'}.*{message}"):
        converted(text, tmp_path)


EXCLUDE = '<contact><exclude body1="FL_calf" body2="FR_calf"/></contact>'


@pytest.fixture(scope="module")
def dog(tmp_path_factory):
    """The robot that `new` writes for the quadruped's scene, which includes its file."""
    folder = tmp_path_factory.mktemp("mjcf")
    write_dog(folder)
    (folder / "scene.xml").write_text(f'<mujoco><include file="dog.xml"/>{EXCLUDE}</mujoco>')
    return write_robot("dog", folder / "scene.xml", "balancing", folder / "dog")


def test_a_robot_from_mjcf_passes_its_check_as_it_is(dog):
    assert problems(dog.folder / "balancing.yaml") == {}


def test_robot_yaml_has_what_the_mjcf_states(dog):
    stated = yaml.safe_load((dog.folder / "robot.yaml").read_text())
    assert stated["joint_gains"] == {n: {"stiffness": 150, "damping": 3} for n in NAMES}
    assert stated["rotor_inertia"] == dict.fromkeys(NAMES, 0.02)
    bent = {"pitch": 0.8, "knee": -1.6}
    assert stated["posture"] == {f"{leg}_{part}": q for leg in PLACES for part, q in bent.items()}
    assert dog.posture_source == "keyframe 'home'"
    assert not any("gains" in what for what in dog.asked)
    assert "joint_friction_nm: 0.1 " in (dog.folder / "balancing.yaml").read_text()
    assert "converted from 'scene.xml'" in (dog.folder / "README.md").read_text()


def test_geoms_are_seen_or_collide_by_their_groups_masks_and_exclusions(dog):
    root = ElementTree.parse(dog.files[0]).getroot()
    (seen,) = root.findall("link[@name='trunk']/visual/geometry/mesh")
    assert seen.get("filename") == "meshes/shell.gltf"
    (shape,) = root.findall("link[@name='trunk']/collision/geometry/box")
    assert [*map(float, shape.get("size").split())] == pytest.approx([0.5, 0.16, 0.1])
    groups = [{part.get("link") for part in group} for group in root]
    assert {"FL_calf", "FR_calf", None} in groups


@pytest.mark.parametrize(
    ("name", "joints", "source"),
    [
        ("", STANCE, "keyframe '0'"),
        # Feet that are not level.
        ("name='home'", 2 * "0 0.8 -1.6 " + 2 * "0 0.7 -1.4 ", "solved: feet under the hips"),
    ],
)
def test_a_posture_is_a_keyframe_in_which_the_robot_stands(tmp_path, name, joints, source):
    path = write_dog(tmp_path, KEY.format(name, joints))
    assert write_robot("dog", path, "balancing", tmp_path / "dog").posture_source.startswith(source)
