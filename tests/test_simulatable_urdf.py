"""A URDF made fit for Drake: what can be seen stays, and what cannot is told with its reason."""

import json
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from drake_safety.importing.simulatable_urdf import simulatable_copy
from drake_safety.importing.urdf_copy import read_drives
from drake_safety.robots.meshes import mesh_points
from drake_safety.robots.robot import add_robot
from drake_safety.robots.robot_model import RobotModel
from urdf_files import GOOD, LINK, TETRAHEDRON, mesh, stl, written

VTK = (
    "# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 double\n"
    "0 0 0 1 0 0 0 1 0 0 0 1\nCELLS 1 5\n4 0 1 2 3\nCELL_TYPES 1\n10\n"
)
ACCESSOR = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
GLTF = {"bufferViews": [{"buffer": 0, "byteLength": 36}], "buffers": [{"byteLength": 36}]}
GLTF = json.dumps({"accessors": [ACCESSOR]} | GLTF)
TRIANGLE = [[0, 0, 0], [2, 0, 0], [0, 1, 4]]


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DRAKE_SAFETY_CACHE", str(tmp_path / "cache"))


def meshes_of(folder):
    return [mesh.get("filename") for mesh in ET.parse(folder / "copy.urdf").getroot().iter("mesh")]


def copy_of(folder, shapes="", inertia=GOOD):
    """The copy of a URDF of one link, and where it is written."""
    copy = simulatable_copy(written(folder, LINK.format("a", inertia, shapes)))
    (folder / "written").mkdir()
    copy.write(folder / "written" / "copy.urdf")
    return copy, folder / "written"


def loaded_quietly(copy, folder, caplog):
    """The plant of the written copy, of which Drake does not warn."""
    copy.write(folder / "copy.urdf")
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    Parser(plant).AddModels(str(folder / "copy.urdf"))
    assert [record.getMessage() for record in caplog.records] == []
    return plant


@pytest.mark.parametrize("url", ["package://bot_description/hull.obj", "..\\hull.obj"])
def test_a_mesh_that_drake_shows_goes_along_as_it_is(url, tmp_path):
    source = tmp_path / "bot_description" / "urdf"
    source.mkdir(parents=True)
    (source.parent / "hull.obj").write_text(TETRAHEDRON)
    copy, folder = copy_of(source, mesh("visual", url))
    assert meshes_of(folder) == ["meshes/hull.obj"]
    assert (folder / "meshes" / "hull.obj").read_text() == TETRAHEDRON
    assert copy.notes == []


def test_another_visual_is_converted_and_drake_can_load_what_was_written(tmp_path):
    pytest.importorskip("trimesh")
    stl(tmp_path / "skin.stl", TRIANGLE)
    copy, folder = copy_of(tmp_path, mesh("visual", "skin.stl"))
    assert copy.notes == ["visual meshes are converted to glTF: skin.stl"]
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    Parser(plant).AddModels(str(folder / "copy.urdf"))
    (visual,) = plant.GetVisualGeometriesForBody(plant.GetBodyByName("a"))
    shape = scene_graph.model_inspector().GetShape(visual)
    assert shape.source().path() == folder / "meshes" / "skin.gltf"


def test_a_collision_mesh_becomes_its_hull_turned_and_scaled(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box(bounds=[[0, 0, 0], [2, 1, 4]]).export(tmp_path / "foot.stl")
    shape = (
        mesh("collision", "foot.stl")
        .replace("<geometry>", '<origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/><geometry>')
        .replace("/></geo", ' scale="1 1 2"/></geo')
    )
    copy, folder = copy_of(tmp_path, shape)
    (hull,) = copy.hulls["a"]
    # A quarter turn about z: x becomes y, and y becomes -x.
    np.testing.assert_allclose(hull.bounds, [[-1, 0, 1], [0, 2, 9]], atol=1e-6)
    (name,) = meshes_of(folder)
    np.testing.assert_allclose(mesh_points(folder / name).max(axis=0), [0, 2, 9], atol=1e-6)
    assert copy.bare_links == [] and len(copy.notes) == 1


def test_friction_and_impossible_inertias_are_corrected_and_told(tmp_path):
    odd = GOOD.replace('ixy="0"', 'ixy="3"')
    joint = (
        '<joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
        '<limit effort="5" velocity="2" lower="-1" upper="1"/>'
        '<dynamics damping="0.1" friction="0.2"/></joint>'
    )
    links = [LINK.format("a", GOOD, ""), LINK.format("b", odd, "")]
    copy = simulatable_copy(written(tmp_path, *links, joint))
    assert copy.joint_friction == {"j": 0.2}
    assert [element.get("ixy") for element in copy.root.iter("inertia")] == ["0", "0"]
    assert read_drives(copy.root).efforts["j"] == 5.0
    (dynamics,) = copy.root.iter("dynamics")
    assert dynamics.attrib == {"damping": "0.1"}
    assert len(copy.notes) == 2


def test_inertias_beyond_the_triangle_inequality_are_corrected(tmp_path, caplog):
    inertia = '<inertia ixx="0.001" iyy="0.001" izz="0.007" ixy="0.0005" ixz="0" iyz="0"/>'
    copy, folder = copy_of(tmp_path, inertia=inertia)
    assert "its largest moment is at most the sum of the others" in copy.notes[0]
    loaded_quietly(copy, folder, caplog)


def test_what_drake_ignores_or_warns_of_is_left_out_and_other_motors_stay(tmp_path, caplog):
    motor = (
        "<transmission><type>{}</type>"
        '<joint name="{}"><hardwareInterface>EffortJointInterface</hardwareInterface></joint>'
        '<actuator name="m_{}"><mechanicalReduction>160</mechanicalReduction></actuator>'
        "</transmission>"
    )
    joint = '<joint name="{}" type="{}"><parent link="a"/><child link="{}"/>{}</joint>'
    limit = '<limit effort="5" velocity="2" lower="-1" upper="1"/>'
    parts = [LINK.format(name, GOOD, "") for name in "abc"]
    parts.append(joint.format("j", "revolute", "b", limit))
    odd = '<mimic joint="j"/><safety_controller k_velocity="1"/>'
    parts.append(joint.format("k", "fixed", "c", odd))
    for kind, name, driver in (("Simple", "j", "j"), ("Simple", "k", "k"), ("Other", "j", "d")):
        parts.append(motor.format(f"transmission_interface/{kind}Transmission", name, driver))
    copy = simulatable_copy(written(tmp_path, *parts))
    assert [one.get("name") for one in copy.root.iter("actuator")] == ["m_j"]
    assert loaded_quietly(copy, tmp_path, caplog).num_actuators() == 1


def test_a_material_of_two_colours_becomes_two(tmp_path, caplog):
    black = '<material name="black"><color rgba="0 0 0 {}"/></material>'
    box = '<visual><geometry><box size="1 1 1"/></geometry>{}</visual>'
    parts = [
        black.format("1"),
        LINK.format("a", GOOD, box.format(black.format("1.0"))),
        LINK.format("b", GOOD, box.format(black.format("0.9"))),
        '<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint>',
    ]
    copy = simulatable_copy(written(tmp_path, *parts))
    assert [one.get("name") for one in copy.root.iter("material")] == ["black_0", "black_1"]
    loaded_quietly(copy, tmp_path, caplog)


@pytest.mark.parametrize(
    ("url", "is_copied"),
    [
        ("a.obj", True),
        ("package://bot/meshes/a.obj", True),
        ("package://other/meshes/a.obj", True),  # Beside it in the workspace.
        ("file://{inside}/meshes/a.obj", True),
        ("../../../outside/a.obj", False),
        ("package://bot/../../outside/a.obj", False),
        ("file://{outside}/a.obj", False),
        ("linked.obj", False),
    ],
)
def test_no_mesh_from_outside_the_description_is_copied(tmp_path, url, is_copied):
    inside, outside = tmp_path / "ws" / "bot", tmp_path / "outside"
    places = [inside / "urdf", inside / "meshes", inside.parent / "other" / "meshes", outside]
    for place in (*places, inside.parent):
        place.mkdir(parents=True, exist_ok=True)
        (place / "a.obj").write_text(TETRAHEDRON)
    (inside / "urdf" / "linked.obj").symlink_to(outside / "a.obj")
    url = url.format(inside=inside, outside=outside)
    copy, folder = copy_of(inside / "urdf", mesh("visual", url))
    assert [path.name for path in folder.glob("meshes/*")] == ["a.obj"] * is_copied
    if not is_copied:
        (note,) = copy.left_out
        assert "it lies outside the folders of the URDF and of its package" in note


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.obj", TETRAHEDRON.replace("3//1", "99//1", 1), "4 vertices and a face of vertex 99"),
        ("a.obj", TETRAHEDRON.replace("f 1", "f a", 1), "is damaged"),
        ("a.vtk", VTK.replace("0 1 2 3", "0 1 2 9"), "has 4 points and a cell of point 9"),
        ("a.gltf", GLTF.replace('[{"byteLength": 36', '[{"byteLength": 9'), "a view beyond its"),
    ],
)
def test_a_damaged_mesh_is_refused_by_name_before_drake_sees_it(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    urdf = written(tmp_path, LINK.format("a", GOOD, mesh("visual", name)))
    problem = rf"mesh '{tmp_path / name}' .*{message}"
    assert re.search(problem, simulatable_copy(urdf).left_out[0])
    with pytest.raises(ValueError, match=problem):
        add_robot(MultibodyPlant(0.001), RobotModel(name="r", urdf=str(urdf), base="a"))
