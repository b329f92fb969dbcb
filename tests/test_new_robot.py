"""`new` and `check`: from a URDF alone to a robot that stands, and mistakes told one by one."""

import re
import shutil

import numpy as np
import pytest
import yaml

from command_line import invoked, problems
from drake_safety.importing.robot_template import write_robot
from drake_safety.simulation.scenario import load_scenario
from legged_robots import edited, write_hexapod, write_porter
from system_doubles import begun
from urdf_files import mesh, stl, with_shape


@pytest.fixture(scope="module")
def spider(tmp_path_factory):
    """The robot that `new` writes for a URDF of six legs."""
    folder = tmp_path_factory.mktemp("urdf")
    write_hexapod(folder)
    return write_robot("spider", folder / "hexapod.urdf", "balancing", folder / "spider")


@pytest.fixture
def own(spider, tmp_path):
    """A copy of it that a test may spoil."""
    return shutil.copytree(spider.folder, tmp_path / "own")


def test_what_new_writes_passes_its_check_as_it_is(spider):
    assert problems(spider.folder / "balancing.yaml", num_episodes=4) == {}


def test_what_a_urdf_does_not_tell_is_asked_for_with_its_unit(spider):
    text = (spider.folder / "robot.yaml").read_text()
    asks = [line for line in text.splitlines() if "# ASK" in line]
    assert len(asks) >= 2
    assert all(line.rstrip().endswith("]") for line in asks)
    assert any("gains [N·m/rad" in what for what in spider.asked)
    readme = (spider.folder / "README.md").read_text()
    assert all(what in readme for what in spider.asked)


def test_a_reaching_robot_gets_its_arms_and_a_box_of_targets(tmp_path):
    write_porter(tmp_path)
    written = write_robot("carrier", tmp_path / "porter.urdf", "reaching", tmp_path / "carrier")
    robot = yaml.safe_load((written.folder / "robot.yaml").read_text())
    hands = {frame["body"] for frame in robot["reaching_frames"].values()}
    assert hands == {"left_palm", "right_palm"}
    assert robot["mirror"]["left_elbow"] == "right_elbow"
    assert problems(written.folder / "reaching.yaml") == {}


def test_a_balancing_robot_has_a_plant_whose_arms_turn_while_it_stands(tmp_path):
    write_porter(tmp_path)
    written = write_robot("carrier", tmp_path / "porter.urdf", "balancing", tmp_path / "carrier")
    scenario = load_scenario(written.folder / "balancing.yaml")
    turned = {}
    for variation in ("actual", "arms"):
        loop = scenario.make_loop(variation, ball=False)
        simulator, context = begun(loop, loop.reset_calm, np.random.default_rng(0))
        simulator.AdvanceTo(1.0)
        q = loop.GetOutputPort("state").Eval(context)
        turned[variation] = dict(zip(loop.state_names, q, strict=True))
    assert written.arms
    for arm in written.arms:
        joint = arm.joints[0]
        assert turned["arms"][joint] - turned["actual"][joint] == pytest.approx(0.5, abs=0.1)


WEAK = {".*": {"stiffness": 0.05, "damping": 0.05}}
POSTURE = "'posture' in robot.yaml [rad]"


@pytest.mark.parametrize(
    ("change", "item", "message", "remedy"),
    [
        ({"base": "trunk"}, "scenario", "has no body 'trunk'", "the message"),
        ({"posture": {"knee_0": 9.0}}, "joint stops", "knee_0 at 9, between -2.5 and 2.5", POSTURE),
        ({"posture": {"lift_0": 0.9}}, "feet level", "hang up to", POSTURE),
        ({"joint_gains": WEAK}, "stands for 1 s", "it has sunk", "raise 'joint_gains' in robot"),
        ({"effort_limits": {}}, "motors", "have none", "'effort_limits' in robot.yaml [N·m]"),
    ],
)
def test_each_mistake_in_robot_yaml_comes_with_a_remedy(own, change, item, message, remedy):
    edited(own / "robot.yaml", **change)
    finding = problems(own / "balancing.yaml")[item]
    assert message in finding.message and remedy in finding.remedy


def test_feet_that_do_not_fit_are_a_problem(own):
    file = own / "robot.yaml"
    feet = yaml.safe_load(file.read_text())["feet"]
    edited(file, feet=feet | {"tibia_0": feet["tibia_0"] | {"radius_m": 0.03}})
    message = problems(own / "balancing.yaml")["contact spheres"].message
    assert "the model file has no such sphere" in message
    edited(file, feet={name: feet[name] for name in list(feet)[:3]})
    finding = problems(own / "balancing.yaml")["centre of mass over the feet"]
    assert "outside their polygon, at (" in finding.message


CALM = {"base_offset_m": [0.0, 0.0], "velocity_std_m_s": [0.01, 0.01, 0.01], "tilt_rad": 0.0}
CALM |= {"target_offset_m": [0.0, 0.0], "angular_velocity_std_rad_s": 0.0}


def test_a_scenario_without_safety_or_without_danger_is_a_problem(own):
    file = own / "balancing.yaml"
    parameters = yaml.safe_load(file.read_text())["parameters"]
    edited(file, parameters=parameters | {"safe_set": {"height_m": [0.8, 0.9]}})
    assert "violates height" in problems(file)["safe while it stands"].message
    edited(file, parameters=parameters | {"start": CALM, "push": {"share": 0.0}})
    finding = problems(file, 2)["share of unsafe episodes"]
    assert "0 % of 2 episodes" in finding.message and "expected 10 to 90 %" in finding.message
    assert "widen the ranges of starts and plans in the scenario" in finding.remedy


def urdf_of_spider(folder, change):
    """The spider's URDF, changed as text."""
    write_hexapod(folder)
    urdf = folder / "hexapod.urdf"
    text = urdf.read_text()
    urdf.write_text(change(text))
    assert urdf.read_text() != text
    return urdf


def test_a_base_whose_shape_is_a_flat_mesh_collides_as_its_box(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    stl(tmp_path / "trunk.stl", [[-0.2, -0.2, -0.04], [0.2, 0.2, 0.04], [0.2, -0.2, 0.04]])
    sphere, trunk = '<sphere radius="0.05"/>', '<mesh filename="trunk.stl"/>'
    urdf = urdf_of_spider(tmp_path, lambda text: text.replace(sphere, trunk, 1))
    written = write_robot("spider", urdf, "balancing", tmp_path / "spider")
    hull = trimesh.load_mesh(written.folder / "meshes" / "body_hull_0.obj")
    assert hull.extents == pytest.approx([0.4, 0.4, 0.08])
    assert not any("shape of the base" in what for what in written.asked)
    assert problems(written.folder / "balancing.yaml") == {}


def without_shapes(text):
    """A URDF two of whose links collide by meshes that do not exist."""
    for link in ("femur_0", "femur_1"):
        text = with_shape(text, link, mesh("collision", "femur.stl"))
    text = text.replace('velocity="20"', 'velocity="0"')
    return with_shape(text, "body", mesh("visual", "gone.stl"))


def test_new_and_check_tell_what_was_lost_and_changed(tmp_path):
    bare = urdf_of_spider(tmp_path, without_shapes)
    out = tmp_path / "spider"
    result = invoked("new", "spider", "--urdf", bare, "--out", out)
    assert result.exit_code == 0
    for text in (
        "WARNING  2 links have lost their collision meshes",
        "decided mass_scale: 0.8  Γ learns from lighter links",
        "note  velocity",
    ):
        assert text in result.output
    assert "left out: gone.stl" in (out / "README.md").read_text()
    # The check warns of them until they have a shape.
    file, urdf = out / "balancing.yaml", out / "spider.urdf"
    result = invoked("check", file, "--quick")
    assert result.exit_code == 0
    assert "warning  collision shapes: 2 links have none" in result.output
    box = '<collision><geometry><box size="0.1 0.02 0.02"/></geometry></collision>'
    urdf.write_text(with_shape(urdf.read_text(), "femur_0", box))
    assert "1 links have none" in invoked("check", file, "--quick").output
    edited(out / "robot.yaml", without_collision=["femur_0"])
    assert "warning  collision shapes" not in invoked("check", file, "--quick").output


TRUNK = "<collision><geometry><box size='0.3 0.2 1'/></geometry></collision></link>"


@pytest.mark.parametrize(
    ("pattern", "new", "item", "message"),
    [
        ("<collision>.*?</collision>", "", "shape of the base", "has no collision geometry"),
        ("</link>", TRUNK, "off the ground", "reach into the ground: 'body' by "),
    ],
)
def test_a_base_without_a_shape_or_that_the_robot_rests_on_is_a_problem(
    tmp_path, pattern, new, item, message
):
    urdf = urdf_of_spider(tmp_path, lambda text: re.sub(pattern, new, text, count=1))
    written = write_robot("spider", urdf, "balancing", tmp_path / "spider")
    assert message in problems(written.folder / "balancing.yaml")[item].message
    asked = any("shape of the base 'body', in spider.urdf" in what for what in written.asked)
    assert asked == (not new)


@pytest.mark.parametrize(
    ("name", "task", "message"),
    [
        ("my robot", "balancing", "a robot's name is letters"),
        ("spider", "reaching", "has no arm"),
    ],
)
def test_new_refuses_what_it_cannot_write(tmp_path, name, task, message):
    write_hexapod(tmp_path)
    with pytest.raises(ValueError, match=message):
        write_robot(name, tmp_path / "hexapod.urdf", task, tmp_path / "a")
    assert not (tmp_path / "a").exists()
    with pytest.raises(ValueError, match="exists already"):
        write_robot("spider", tmp_path / "hexapod.urdf", "balancing", tmp_path)
