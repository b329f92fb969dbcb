"""`new` replaces collision meshes that Drake does not read by hulls; the robot stands with them."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import yaml

import urdf_files
from command_line import problems
from drake_safety.evaluation.stills import StillCamera
from drake_safety.importing.robot_template import write_robot
from drake_safety.importing.urdf_survey import Survey
from drake_safety.simulation.scenario import load_scenario
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
    shin = (
        f'<link name="shin">{urdf_files.mesh("collision", "shin.stl")}</link><joint name="weld" '
        'type="fixed"><parent link="tibia_4"/><child link="shin"/></joint></robot>'
    )
    urdf.write_text(urdf.read_text().replace("</robot>", shin))
    bar(x=0.14, length=0.12, radius=0.015).export(folder / "shin.stl")
    return write_robot("spider", urdf, "balancing", folder / "spider")


def collisions(written, link):
    root = ElementTree.parse(written.files[0]).getroot()
    return root.findall(f"link[@name='{link}']/collision")


def hull_of(written, link):
    """Vertices of the only hull of a link, in its frame, (n, 3)."""
    (shape,) = collisions(written, link)
    mesh = shape.find("geometry/mesh")
    assert [part.tag.rpartition("}")[2] for part in mesh] == ["declare_convex"]
    return trimesh.load_mesh(written.folder / mesh.get("filename")).vertices


def assert_nothing_overlaps(written):
    survey = Survey(written.files[0])
    survey.set_joints(written.posture)
    assert survey.overlaps() == set()


def test_collision_meshes_become_hulls_which_readme_lists(spider):
    hull = hull_of(spider, "femur_0")
    np.testing.assert_allclose(np.ptp(hull, axis=0), np.ptp(bar().vertices, axis=0), rtol=1e-3)
    assert (spider.copy.bare_links, spider.num_hulls) == ([], 3)
    readme = (spider.folder / "README.md").read_text()
    assert "replaced by convex hulls: femur_0.stl, femur_1.stl, tibia_2.stl, shin.stl" in readme
    assert "Foot 'tibia_2' has no hull" in readme
    assert "without_collision" not in yaml.safe_load((spider.folder / "robot.yaml").read_text())


def test_a_hull_that_is_welded_to_a_foot_ends_at_its_contact_points(spider):
    survey = Survey(spider.files[0])
    survey.set_joints(spider.posture)
    (leg,) = (leg for leg in spider.legs if leg.body == "tibia_4")
    heights = (survey.pose("shin") @ hull_of(spider, "shin").T)[2]
    assert heights.min() == pytest.approx(survey.positions(leg)[0, 2], abs=1e-3)
    assert np.ptp(heights) > 0.1


def test_the_robot_stands_with_them(spider):
    assert problems(spider.folder / "balancing.yaml") == {}
    assert_nothing_overlaps(spider)


def test_collisions_of_a_hull_that_overlaps_another_link_are_off(tmp_path):
    # One longer than its link, across the whole robot.
    urdf = shaped(tmp_path, femur_0=bar(length=2.0, radius=0.1))
    written = write_robot("spider", urdf, "balancing", tmp_path / "spider")
    assert written.num_hulls == 1
    assert "<member" not in (tmp_path / "hexapod.urdf").read_text()
    assert_nothing_overlaps(written)
    readme = (written.folder / "README.md").read_text().lower()
    assert "which overlap or are excluded, never collide" in readme


def test_new_gives_normals_to_meshes_of_visuals_and_of_links_without_one(tmp_path, caplog):
    urdf = shaped(tmp_path)
    text = urdf.read_text()
    for link, kind in (("femur_0", "visual"), ("femur_1", "collision")):
        bar(length=0.1).export(tmp_path / f"{link}.obj", include_normals=False)
        text = urdf_files.with_shape(text, link, urdf_files.mesh(kind, f"{link}.obj"))
    urdf.write_text(text)
    folder = write_robot("spider", urdf, "balancing", tmp_path / "new").folder
    loop = load_scenario(folder / "balancing.yaml").make_loop()
    StillCamera(loop, loop.plant.GetPositions(loop.plant.CreateDefaultContext()))
    assert not caplog.records
    assert {one.name for one in (folder / "meshes").iterdir()} >= {"femur_0.gltf", "femur_1.gltf"}
