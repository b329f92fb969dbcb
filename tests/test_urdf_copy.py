"""UrdfCopy: what Drake cannot read is taken out, written down, and nothing else is."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from drake_safety.control.urdf_copy import read_urdf

LINK = '<link name="{}"><inertial><mass value="1"/>{}</inertial>{}</link>'
GOOD = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'


def written(folder, *parts, name="r.urdf"):
    path = folder / name
    path.write_text(f'<robot name="r">{"".join(parts)}</robot>')
    return path


def stl(path, corners):
    facets = np.zeros(1, [("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")])
    facets["c"] = corners
    path.write_bytes(bytes(80) + (1).to_bytes(4, "little") + facets.tobytes())


def mesh(kind, url):
    return f'<{kind}><geometry><mesh filename="{url}"/></geometry></{kind}>'


def test_a_mesh_that_drake_reads_goes_along_and_others_do_not(tmp_path):
    source = tmp_path / "bot_description" / "urdf"
    source.mkdir(parents=True)
    (source.parent / "hull.obj").write_text("v 0 0 0\n")
    shapes = mesh("visual", "package://bot_description/hull.obj") + mesh("visual", "skin.dae")
    copy = read_urdf(written(source, LINK.format("a", GOOD, shapes)))
    copy.write(tmp_path / "copy.urdf")
    (left,) = ET.parse(tmp_path / "copy.urdf").getroot().iter("mesh")
    assert left.get("filename") == "meshes/hull.obj"
    assert (tmp_path / "meshes" / "hull.obj").read_text() == "v 0 0 0\n"
    assert copy.notes == [
        "1 visual meshes that Drake cannot read, or that do not exist, are left out"
    ]


def test_a_lost_collision_mesh_leaves_its_box_behind_turned_as_it_was(tmp_path):
    stl(tmp_path / "foot.stl", [[0, 0, 0], [2, 0, 0], [0, 1, 4]])
    shape = mesh("collision", "foot.stl").replace(
        "<geometry>", '<origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/><geometry>'
    )
    copy = read_urdf(written(tmp_path, LINK.format("foot", GOOD, shape)))
    (box,) = copy.lost_shapes["foot"]
    # A quarter turn about z: x becomes y, and y becomes -x.
    np.testing.assert_allclose(box, [[-1, 0, 1], [0, 2, 5]], atol=1e-12)
    assert list(copy.root.iter("collision")) == []


def test_friction_and_impossible_inertias_are_mended_and_told(tmp_path):
    odd = GOOD.replace('ixy="0"', 'ixy="3"')
    joint = (
        '<joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
        '<limit effort="5" velocity="2" lower="-1" upper="1"/>'
        '<dynamics damping="0.1" friction="0.2"/></joint>'
    )
    copy = read_urdf(
        written(tmp_path, LINK.format("a", GOOD, ""), LINK.format("b", odd, ""), joint)
    )
    assert copy.joint_friction == {"j": 0.2}
    assert [element.get("ixy") for element in copy.root.iter("inertia")] == ["0", "0"]
    assert copy.joint_limits()["j"].effort == 5.0
    (dynamics,) = copy.root.iter("dynamics")
    assert dynamics.attrib == {"damping": "0.1"}
    assert len(copy.notes) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "is not XML"),
        ("<sdf/>", "its outermost element is <sdf>"),
        ("<robot name='r'/>", "has no links"),
        (
            "<robot xmlns:xacro='http://www.ros.org/wiki/xacro'><xacro:include filename='a'/>"
            "<link name='a'/></robot>",
            "run `xacro",
        ),
    ],
)
def test_what_is_no_urdf_is_refused_with_a_reason(tmp_path, text, message):
    path = tmp_path / "odd.urdf"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_urdf(path)


def test_a_file_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"nowhere.urdf' does not exist"):
        read_urdf(tmp_path / "nowhere.urdf")
