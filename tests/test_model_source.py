"""`new` from xacro, and from a robot of robot_descriptions."""

import subprocess

import pytest

from command_line import call
from drake_safety.importing.model_source import expanded, model_file
from drake_safety.robots.urdf import read_urdf
from legged_robots import write_hexapod

HEADER = '<robot name="spider" xmlns:xacro="http://www.ros.org/wiki/xacro">'


@pytest.fixture
def xacro(tmp_path):
    """A robot of six legs as a ROS package: an argument without default, two includes."""
    pytest.importorskip("xacrodoc")
    folder = tmp_path / "spider_description" / "urdf"
    folder.mkdir(parents=True)
    write_hexapod(folder)
    (folder.parent / "package.xml").write_text("<package><name>spider_description</name></package>")
    urdf = folder / "hexapod.urdf"
    body = urdf.read_text().partition("<robot")[2].partition(">")[2].rpartition("</robot>")[0]
    urdf.unlink()
    (folder / "legs.xacro").write_text(f"{HEADER}{body}</robot>")
    (folder / "bag.xacro").write_text(
        f'{HEADER}<xacro:macro name="bag" params="mass"><link name="bag"><inertial>'
        '<mass value="${mass / 2}"/><inertia ixx="0.01" iyy="0.01" izz="0.01"/></inertial></link>'
        '<joint name="bag_joint" type="fixed"><parent link="body"/><child link="bag"/></joint>'
        "</xacro:macro></robot>"
    )
    path = folder / "spider.urdf.xacro"
    path.write_text(
        f'{HEADER}<xacro:arg name="bag" default=""/><xacro:include filename="legs.xacro"/>'
        '<xacro:include filename="$(find spider_description)/urdf/bag.xacro"/>'
        '<xacro:bag mass="$(arg mass)"/></robot>'
    )
    return path


def test_new_expands_xacro_with_its_arguments(xacro, monkeypatch, tmp_path, capsys):
    command = ("new", "spider", "--urdf", xacro, "--out", tmp_path / "spider")
    assert call(monkeypatch, *command, "--xacro-arg", "mass=3") == 0
    root = read_urdf(tmp_path / "spider" / "spider.urdf")
    (bag,) = (link for link in root.findall("link") if link.get("name") == "bag")
    assert float(bag.find("inertial/mass").get("value")) == 1.5
    assert "It is converted from 'spider.urdf.xacro'" in (tmp_path / "spider/README.md").read_text()
    assert "xacro" not in (tmp_path / "spider" / "spider.urdf").read_text()


def test_what_xacro_lacks_is_named_with_its_remedy(xacro, monkeypatch, tmp_path, capsys):
    command = ("new", "spider", "--urdf", xacro, "--out", tmp_path / "spider")
    assert call(monkeypatch, *command) == 2
    printed = capsys.readouterr().out
    assert "Undefined substitution argument mass; pass --xacro-arg mass=VALUE" in printed
    assert call(monkeypatch, *command, "--xacro-arg", "mass") == 2
    assert "--xacro-arg is KEY=VALUE" in capsys.readouterr().out
    xacro.write_text(xacro.read_text().replace("find spider_", "find absent_"))
    with pytest.raises(ValueError, match="Package not found: absent_description"):
        expanded(xacro, {"mass": "1"})
    assert not (tmp_path / "spider").exists()


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """A cache of robot_descriptions; git reaches nothing."""
    pytest.importorskip("robot_descriptions")
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("GIT_CONFIG_COUNT", "1")
    monkeypatch.setenv("GIT_CONFIG_KEY_0", f"url.{tmp_path}/nowhere/.insteadOf")
    monkeypatch.setenv("GIT_CONFIG_VALUE_0", "https://github.com/")
    return tmp_path / "cache"


def test_new_takes_a_robot_of_robot_descriptions(cache, monkeypatch, tmp_path):
    repository = cache / "unitree_ros-kept" / "unitree_ros"
    folder = repository / "robots" / "go2_description" / "urdf"
    folder.mkdir(parents=True)
    write_hexapod(folder)
    (folder / "hexapod.urdf").rename(folder / "go2_description.urdf")
    git = ("git", "-C", str(repository), "-c", "user.name=a", "-c", "user.email=a@b")
    for words in (("init", "-q"), ("add", "."), ("commit", "-qm", "a"), ("tag", "kept")):
        subprocess.run([*git, *words], check=True)
    monkeypatch.setenv("ROBOT_DESCRIPTION_COMMIT", "kept")
    command = ("new", "go", "--robot-description", "go2_description", "--out", tmp_path / "go")
    assert call(monkeypatch, *command) == 0
    assert len(read_urdf(tmp_path / "go" / "go.urdf").findall("link")) > 6


def test_an_unknown_description_and_a_download_that_fails_are_told(cache):
    with pytest.raises(ValueError, match=r"none of \d+ .*; near are .*'go2_description'"):
        model_file("go2")
    with pytest.raises(ValueError, match=r"git cannot download 'a1_description': .*nowhere"):
        model_file("a1_description")
