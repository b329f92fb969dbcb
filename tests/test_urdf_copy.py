"""UrdfCopy: a URDF is changed where Drake needs it, and nowhere else."""

import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from drake_safety.importing.urdf_copy import FIXED_MIMIC, read_urdf
from urdf_files import GOOD, LINK, mesh, stl, written

RED = '<material name="red"><color rgba="1 0 0 1"/></material>'


def red_seat(url):
    """A link to be seen, whose material is only mentioned there."""
    shape = mesh("visual", url).replace("</visual>", '<material name="red"/></visual>')
    return RED + LINK.format("seat", GOOD, shape)


def test_a_file_that_needs_no_change_is_said_to_be_the_same(tmp_path):
    copy = read_urdf(written(tmp_path, red_seat("seat.obj")))
    copy.remove(*FIXED_MIMIC)
    copy.remove("link", "collision")
    copy.convert_visual_meshes()
    assert not copy.is_changed


def test_a_mesh_is_replaced_with_its_colour_in_it(tmp_path):
    asked = []

    def shown(url, rgba):
        asked.append((url, rgba))
        return "file:///cache/seat.gltf"

    copy = read_urdf(written(tmp_path, red_seat("seat.stl")))
    copy.replace_visual_meshes(shown)
    assert asked == [("seat.stl", "1 0 0 1")]
    assert copy.is_changed
    (visual,) = copy.root.iter("visual")
    assert visual.find("geometry/mesh").get("filename") == "file:///cache/seat.gltf"
    # Its colour is in the mesh: Drake warns of a second one.
    assert visual.find("material") is None
    copy.replace_visual_meshes(lambda url, rgba: "")  # For which there is no mesh.
    assert list(copy.root.iter("visual")) == []


def test_collisions_go_and_visuals_stay(tmp_path):
    shapes = mesh("collision", "a.obj") + mesh("visual", "b.obj")
    copy = read_urdf(written(tmp_path, LINK.format("a", GOOD, shapes)))
    copy.remove("link", "collision")
    assert [element.get("filename") for element in copy.root.iter("mesh")] == ["b.obj"]


def test_a_mesh_in_the_cache_does_not_hide_another_beside_the_urdf(tmp_path, monkeypatch):
    pytest.importorskip("trimesh")
    monkeypatch.setenv("DRAKE_SAFETY_CACHE", str(tmp_path / "cache"))
    stl(tmp_path / "seat.stl", [[0, 0, 0], [2, 0, 0], [0, 1, 4]])
    corners = ["0 0 0", "1 0 0", "0 1 0", "0 0 1"]
    faces = ["1 3 2", "1 2 4", "1 4 3", "2 3 4"]
    lines = [f"v {corner}" for corner in corners] + [f"f {face}" for face in faces]
    (tmp_path / "hull.obj").write_text("\n".join(lines))
    shapes = mesh("visual", "seat.stl") + mesh("collision", "hull.obj")
    copy = read_urdf(written(tmp_path, LINK.format("a", GOOD, shapes)))
    copy.convert_visual_meshes()
    copy.anchor_meshes()
    seat, hull = (element.get("filename") for element in copy.root.iter("mesh"))
    assert (tmp_path / "cache").as_uri() in seat
    assert hull == (tmp_path / "hull.obj").as_uri()
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    Parser(plant).AddModelsFromString(copy.text(), "urdf")
    assert len(plant.GetCollisionGeometriesForBody(plant.GetBodyByName("a"))) == 1


def test_what_drake_knows_by_its_prefix_keeps_it_whatever_address_the_file_gives(tmp_path):
    path = written(tmp_path, LINK.format("a", GOOD, ""), LINK.format("b", GOOD, ""))
    joint = (
        '<joint name="j" type="continuous"><parent link="a"/><child link="b"/>'
        '<drake:controller_gains p="3" d="1"/></joint>'
        '<transmission><type>SimpleTransmission</type><joint name="j"/><actuator name="j">'
        '<drake:controller_gains p="3" d="1"/></actuator></transmission>'
    )
    text = path.read_text().replace('name="r"', 'name="r" xmlns:drake="drake.mit.edu"')
    path.write_text(text.replace("</robot>", f"{joint}</robot>"))
    copy = read_urdf(path)
    copy.ignore_collisions([("a", "b")])
    assert "<drake:controller_gains" in copy.text()
    assert "<drake:collision_filter_group" in copy.text()
    plant = MultibodyPlant(0.001)
    Parser(plant).AddModelsFromString(copy.text(), "urdf")
    assert plant.GetJointActuatorByName("j").get_controller_gains().p == 3.0


XACRO = "xmlns:xacro='http://www.ros.org/wiki/xacro'"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not XML"),
        ("<robot", "is not XML"),
        ("<sdf/>", "its root element is <sdf>"),
        ("<robot name='r'/>", "has no links"),
        (f"<robot {XACRO}><xacro:include filename='a'/><link name='a'/></robot>", "run `xacro"),
        (None, r"odd.urdf' does not exist"),
    ],
)
def test_what_is_no_urdf_is_refused_with_a_reason(tmp_path, text, message):
    path = tmp_path / "odd.urdf"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_urdf(path)


@pytest.mark.parametrize("mass", ["-1", "nan", "inf", "heavy"])
def test_a_mass_that_no_body_has_is_refused_with_file_and_link(mass, tmp_path):
    path = written(tmp_path, f'<link name="a"><inertial><mass value="{mass}"/></inertial></link>')
    with pytest.raises(ValueError, match=r"r.urdf': link 'a' has a mass of (-1|nan|inf) kg"):
        read_urdf(path)
