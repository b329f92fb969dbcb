"""A URDF is changed where Drake needs it, and nowhere else; what is no URDF is refused."""

import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from drake_safety.importing.urdf_copy import UrdfCopy
from drake_safety.robots.urdf import drake_urdf, read_urdf
from urdf_files import GOOD, LINK, mesh, stl, written


def test_a_mesh_in_the_cache_has_its_colour_and_hides_no_other_beside_the_urdf(
    tmp_path, monkeypatch
):
    pytest.importorskip("trimesh")
    monkeypatch.setenv("DRAKE_SAFETY_CACHE", str(tmp_path / "cache"))
    stl(tmp_path / "seat.stl", [[0, 0, 0], [2, 0, 0], [0, 1, 4]])
    corners = ["0 0 0", "1 0 0", "0 1 0", "0 0 1"]
    faces = ["1 3 2", "1 2 4", "1 4 3", "2 3 4"]
    lines = [f"v {corner}" for corner in corners] + [f"f {face}" for face in faces]
    (tmp_path / "hull.obj").write_text("\n".join(lines))
    seat = mesh("visual", "seat.stl").replace("</visual>", '<material name="red"/></visual>')
    red = '<material name="red"><color rgba="1 0 0 1"/></material>'
    path = written(tmp_path, red, LINK.format("a", GOOD, seat + mesh("collision", "hull.obj")))
    text = drake_urdf(path, with_collisions=True, with_visuals=True)
    assert (tmp_path / "hull.obj").as_uri() in text
    # A second colour beside that of the mesh would be a warning of Drake's.
    assert text.count("<material") == 1
    (converted,) = (tmp_path / "cache").rglob("*.gltf")
    assert converted.as_uri() in text
    assert '"baseColorFactor":[1.0,0.0,0.0,1.0]' in converted.read_text().replace(" ", "")
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.0)
    Parser(plant).AddModelsFromString(text, "urdf")
    assert len(plant.GetCollisionGeometriesForBody(plant.GetBodyByName("a"))) == 1


def test_what_drake_knows_by_its_prefix_keeps_it_whatever_address_the_file_gives(tmp_path):
    path = written(tmp_path, LINK.format("a", GOOD, ""), LINK.format("b", GOOD, ""))
    joint = (
        '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>'
        '<transmission><type>SimpleTransmission</type><joint name="j"/><actuator name="j">'
        '<drake:controller_gains p="3" d="1"/></actuator></transmission>'
    )
    text = path.read_text().replace('name="r"', 'name="r" xmlns:drake="drake.mit.edu"')
    path.write_text(text.replace("</robot>", f"{joint}</robot>"))
    copy = UrdfCopy(source=path, root=read_urdf(path))
    copy.ignore_collisions([("a", "b")])
    copy.write(tmp_path / "copy.urdf")
    assert "<drake:collision_filter_group" in (tmp_path / "copy.urdf").read_text()
    plant = MultibodyPlant(0.001)
    Parser(plant).AddModels(str(tmp_path / "copy.urdf"))
    assert plant.GetJointActuatorByName("j").get_controller_gains().p == 3.0


XACRO = "xmlns:xacro='http://www.ros.org/wiki/xacro'"
HEAVY = '<robot name="r"><link name="a"><inertial><mass value="nan"/></inertial></link></robot>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "is not XML"),
        ("<sdf/>", "its root element is <sdf>"),
        (f"<robot {XACRO}><xacro:include filename='a'/><link name='a'/></robot>", "run `xacro"),
        (HEAVY, r"odd.urdf': link 'a' has a mass of nan kg"),
    ],
)
def test_what_is_no_urdf_is_refused_with_a_reason(tmp_path, text, message):
    path = tmp_path / "odd.urdf"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_urdf(path)
