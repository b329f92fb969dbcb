"""`new` fits shapes to collision meshes that Drake does not read: the robot stands on its feet."""

import sys
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import yaml

import urdf_files
from command_line import invoked
from drake_safety.robots.robot_template import write_robot
from drake_safety.robots.urdf_survey import Survey
from drake_safety.simulation.rollouts import run_episode
from drake_safety.simulation.scenario import load_scenario
from drake_safety.simulation.scenario_check import check_scenario
from legged_robots import write_hexapod

trimesh = pytest.importorskip("trimesh")


def shaped(folder, **meshes):
    """A spider whose links have collision meshes, in STL."""
    write_hexapod(folder)
    urdf = folder / "hexapod.urdf"
    text = urdf.read_text()
    for link, mesh in meshes.items():
        mesh.export(folder / f"{link}.stl")
        text = urdf_files.with_shape(text, link, urdf_files.mesh("collision", f"{link}.stl"))
    urdf.write_text(text)
    return urdf


def bar(length=0.1, radius=0.02, x=0.06):
    mesh = trimesh.creation.capsule(radius=radius, height=length, count=[16, 16])
    mesh.apply_transform(trimesh.transformations.rotation_matrix(1.5708, [0, 1, 0]))
    mesh.apply_translation([x, 0.0, 0.0])
    return mesh


@pytest.fixture(scope="module")
def spider(tmp_path_factory):
    folder = tmp_path_factory.mktemp("urdf")
    urdf = shaped(folder, femur_0=bar(), femur_1=bar(), tibia_2=bar(x=0.1, length=0.15))
    return write_robot("spider", urdf, "balancing", folder / "spider")


def collisions(written, link):
    root = ElementTree.parse(written.files[0]).getroot()
    return root.findall(f"link[@name='{link}']/collision")


def test_lost_meshes_become_shapes_which_readme_lists(spider):
    (shape,) = collisions(spider, "femur_0")
    (capsule,) = shape.find("geometry")
    assert capsule.tag.endswith("capsule")
    assert float(capsule.get("radius")) == pytest.approx(0.02, rel=0.05)
    assert spider.bare == []
    assert spider.fitted["capsule"] >= 2
    readme = (spider.folder / "README.md").read_text()
    assert "'femur_0' capsule (" in readme
    assert "without_collision" not in yaml.safe_load((spider.folder / "robot.yaml").read_text())


def test_the_robot_stands_with_them(spider):
    findings = list(check_scenario(spider.folder / "balancing.yaml", num_episodes=0))
    assert [f.item for f in findings if not f.is_ok] == []
    assert_nothing_overlaps(spider)


def assert_nothing_overlaps(written):
    survey = Survey(written.files[0])
    survey.set_joints(written.posture)
    assert survey.overlaps() == set()


def test_a_foot_keeps_its_contact_spheres_alone(spider):
    of_mesh, of_sphere = (collisions(spider, name) for name in ("tibia_2", "tibia_3"))
    assert [one.get("name") for one in of_mesh] == [one.get("name") for one in of_sphere]


def test_where_a_primitive_would_touch_the_hull_is_taken_and_what_still_does_is_ignored(tmp_path):
    # One longer than its link, across the whole robot.
    urdf = shaped(tmp_path, femur_0=bar(length=2.0, radius=0.1))
    written = write_robot("spider", urdf, "balancing", tmp_path / "spider")
    assert written.fitted == {"hull": 1}
    assert "<member" not in (tmp_path / "hexapod.urdf").read_text()
    assert_nothing_overlaps(written)
    readme = (written.folder / "README.md").read_text().lower()
    assert "collisions of the overlapping links" in readme


def test_without_the_extra_its_command_is_told_and_the_meshes_are_left_out(tmp_path, monkeypatch):
    urdf = shaped(tmp_path, femur_0=bar())
    monkeypatch.setitem(sys.modules, "trimesh", None)
    out = tmp_path / "spider"
    result = invoked("new", "spider", "--urdf", urdf, "--out", out)
    assert result.exit_code == 0
    assert "WARNING  1 links have lost their collision meshes" in result.output
    assert result.output.count("pip install 'drake_safety[robots]'") == 1
    assert yaml.safe_load((out / "robot.yaml").read_text())["without_collision"] == ["femur_0"]


@pytest.mark.parametrize("is_legged", [True, False])
def test_check_draws_the_standing_robot_beside_its_shapes(spider, tmp_path, is_legged):
    scenario = str(spider.folder / "balancing.yaml") if is_legged else "pendulum"
    picture = tmp_path / "shapes.png"
    result = invoked("check", scenario, "--quick", "--picture", picture)
    assert picture.is_file() == is_legged
    if is_legged:
        assert result.exit_code == 0
        text = picture.with_suffix(".svg").read_text()
        assert "capsules" in text or picture.stat().st_size > 10_000
    else:
        assert "--picture draws a legged robot" in str(result.exception or result.output)


def test_mujoco_takes_the_fitted_hulls_too(tmp_path):
    pytest.importorskip("mujoco")
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.02)
    tip = trimesh.creation.cone(radius=0.02, height=0.1)
    tip.apply_translation([0.02, 0.0, 0.0])
    urdf = shaped(tmp_path, femur_0=trimesh.util.concatenate([ball, tip]))
    written = write_robot("spider", urdf, "balancing", tmp_path / "spider")
    assert written.fitted == {"hull": 1}
    file = written.files[-1]
    text = file.read_text()
    file.write_text(text.replace("  nominal:", "  in_mujoco: {engine: mujoco}\n  nominal:", 1))
    loop = load_scenario(file).make_loop("in_mujoco", ball=False)
    episode = run_episode(loop, 0, seed=0)
    assert np.isfinite(episode.margins).all()
