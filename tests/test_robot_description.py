"""A model file enters a plant with what robot.yaml says instead of it."""

import re

import numpy as np
import pytest
import yaml
from pydrake.geometry import Box, Capsule, Sphere
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from drake_safety.robots.model_files import model_file
from drake_safety.robots.robot import add_robot
from drake_safety.robots.robot_model import load_robot_file

URDF = """<robot name="stool">
<link name="seat"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
 iyz="0"/></inertial>
 <collision><geometry><mesh filename="package://nowhere/seat.stl"/></geometry></collision></link>
<link name="leg"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
 iyz="0"/></inertial></link>
<link name="tip"/>
<joint name="hip" type="revolute"><parent link="seat"/><child link="leg"/><axis xyz="0 1 0"/>
 <limit lower="-1" upper="1" effort="5" velocity="1000"/></joint>
<joint name="ankle" type="fixed"><parent link="leg"/><child link="tip"/>
 <origin xyz="0 0 -0.5"/></joint>
</robot>"""
ROBOT = {
    "name": "stool",
    "urdf": "stool.urdf",
    "base": "seat",
    "posture": {},
    "feet": {
        "tip": {"body": "tip", "contact_points": [[0, 0, 0.1]], "radius_m": 0.1, "joints": ["hip"]}
    },
    "effort_limits": {"hip": 5.0},
    "velocity_limits": {"hip": 7.0},
    "collision": "stated",
    "shapes": {
        "seat": [{"box_m": [0.4, 0.4, 0.1]}],
        "leg": [{"radius_m": 0.05, "position_m": [0, 0, -0.1], "to_m": [0, 0.3, -0.5]}],
    },
}


def write(folder, **changes):
    (folder / "stool.urdf").write_text(URDF)
    (folder / "robot.yaml").write_text(yaml.safe_dump(ROBOT | changes))
    return load_robot_file(folder / "robot.yaml")


def built(robot):
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    add_robot(plant, robot, scene_graph=scene_graph)
    plant.Finalize()
    return plant, scene_graph, builder.Build()


def test_a_fixed_joint_that_mimics_another_is_no_reason_to_refuse_a_robot(tmp_path):
    robot = write(tmp_path)
    mimic = '<origin xyz="0 0 -0.5"/><mimic joint="hip"/>'
    file = tmp_path / "stool.urdf"
    text = file.read_text()
    file.write_text(re.sub('<origin xyz="0 0 -0.5" ?/>', mimic, text))
    assert file.read_text() != text
    plant, _, _ = built(robot)
    assert plant.num_velocities(plant.GetModelInstanceByName("stool")) == 7


def test_stated_shapes_and_contact_points_are_all_that_collides(tmp_path):
    plant, scene_graph, _ = built(write(tmp_path))
    inspector = scene_graph.model_inspector()
    shapes = {}
    for name in ("seat", "leg", "tip"):
        (geometry,) = plant.GetCollisionGeometriesForBody(plant.GetBodyByName(name))
        shapes[name] = (inspector.GetShape(geometry), inspector.GetPoseInFrame(geometry))
    seat, leg, tip = (shapes[name] for name in ("seat", "leg", "tip"))
    assert isinstance(seat[0], Box) and seat[0].size().tolist() == [0.4, 0.4, 0.1]
    assert isinstance(tip[0], Sphere) and tip[1].translation()[2] == 0.1
    # From (0, 0, -0.1) to (0, 0.3, -0.5): half a metre, its middle between them.
    assert isinstance(leg[0], Capsule) and leg[0].length() == pytest.approx(0.5)
    np.testing.assert_allclose(leg[1].translation(), [0.0, 0.15, -0.3])
    np.testing.assert_allclose(leg[1].rotation().col(2), [0.0, 0.6, -0.8], atol=1e-12)


def test_a_stated_speed_limit_holds_and_what_is_welded_to_a_neighbour_does_not_touch_it(tmp_path):
    # The tip is welded to the leg, so Drake alone would let it push the seat.
    plant, scene_graph, _ = built(write(tmp_path))
    bodies = map(plant.GetBodyByName, ("seat", "tip"))
    seat, tip = (plant.GetCollisionGeometriesForBody(body)[0] for body in bodies)
    assert scene_graph.model_inspector().CollisionFiltered(seat, tip)
    assert plant.GetJointByName("hip").velocity_upper_limit() == 7.0
    assert plant.GetJointByName("hip").velocity_lower_limit() == -7.0


def test_a_package_of_pips_is_found_by_its_share_folder_or_as_a_python_package():
    robots = model_file("package://example-robot-data/robots")
    assert robots.is_dir() and robots.parent.name == "example-robot-data"
    import jinja2

    assert str(model_file("package://jinja2/loaders.py")) == jinja2.loaders.__file__
