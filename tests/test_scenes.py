"""The scenes: ground, ball, bookshelf and what stands on it."""

import numpy as np
import pytest
from pydrake.geometry import Box, Role
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import UnitInertia
from pydrake.systems.framework import DiagramBuilder

from package_models import MODELS, Scene, package_parser

SCENES = "package://drake_safety_models/scenes"
TARGETS = ("blue_box", "red_can")
# Source: junhyeokahn/PyPnC, robot_model/bookcase/bookshelf.urdf.
BOARD_SIZE = (0.3, 2.0, 0.05)
BOARD_HEIGHTS = (0.025, 0.325, 0.625, 0.925, 1.225, 1.475)


def scene_of(name, is_welded=False):
    """A plant and scene graph with one model, at will welded to the origin, and its bodies."""
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.001)
    (instance,) = package_parser(plant).AddModelsFromUrl(f"{SCENES}/{name}")
    bodies = [plant.get_body(index) for index in plant.GetBodyIndices(instance)]
    if is_welded:
        plant.WeldFrames(plant.world_frame(), bodies[0].body_frame())
    plant.Finalize()
    return plant, scene_graph, bodies


def test_the_ball_is_a_solid_sphere_of_two_kilograms():
    _, _, (ball,) = scene_of("ball.sdf")
    inertia = ball.default_spatial_inertia()
    assert inertia.get_mass() == 2.0
    np.testing.assert_array_equal(inertia.get_com(), np.zeros(3))
    expected = 2.0 / 5.0 * 2.0 * 0.08**2 * np.eye(3)
    found = inertia.CalcRotationalInertia().CopyToFullMatrix3()
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("scene", ["ground.urdf", "blue_box.sdf", "red_can.sdf"])
def test_ground_and_targets_are_only_to_be_seen_and_the_ground_does_not_move(scene):
    plant, scene_graph, _ = scene_of(scene)
    inspector = scene_graph.model_inspector()
    assert inspector.NumGeometriesWithRole(Role.kProximity) == 0
    assert inspector.NumGeometriesWithRole(Role.kIllustration) > 0
    assert (plant.num_velocities() == 0) == (scene == "ground.urdf")


def test_the_bookshelf_can_be_touched_at_its_boards_where_they_are_seen_and_nowhere_else():
    plant, scene_graph, (shelf,) = scene_of("bookshelf.urdf", is_welded=True)
    inspector = scene_graph.model_inspector()
    visuals = plant.GetVisualGeometriesForBody(shelf)
    seen = [(inspector.GetPoseInFrame(g), inspector.GetShape(g).size()) for g in visuals]
    heights = []
    for board in plant.GetCollisionGeometriesForBody(shelf):
        shape, X_BG = inspector.GetShape(board), inspector.GetPoseInFrame(board)
        assert isinstance(shape, Box)
        np.testing.assert_array_equal(shape.size(), BOARD_SIZE)
        assert X_BG.rotation().IsNearlyIdentity(0.0)
        np.testing.assert_array_equal(X_BG.translation()[:2], np.zeros(2))
        heights.append(X_BG.translation()[2])
        assert any(X.IsExactlyEqualTo(X_BG) and tuple(size) == BOARD_SIZE for X, size in seen)
    assert sorted(heights) == list(BOARD_HEIGHTS)
    assert plant.num_velocities() == 0


@pytest.mark.parametrize("target", TARGETS)
def test_a_target_whose_centre_is_six_centimetres_above_a_board_stands_on_it(target):
    plant, scene_graph, (body,) = scene_of(f"{target}.sdf")
    inspector = scene_graph.model_inspector()
    halves = []
    for geometry in plant.GetVisualGeometriesForBody(body):
        box = inspector.GetObbInGeometryFrame(geometry)
        p_BG = inspector.GetPoseInFrame(geometry).translation() + box.pose().translation()
        halves.append(np.abs(p_BG) + box.half_width())
    half = np.max(halves, axis=0)
    assert half[2] == pytest.approx(0.06, abs=2e-3)
    # It fits on a board and under the next one.
    assert 2 * half[2] < np.diff(BOARD_HEIGHTS).min() - BOARD_SIZE[2]
    assert (2 * half[:2] < BOARD_SIZE[:2]).all()


@pytest.mark.parametrize("target", TARGETS)
def test_a_target_has_the_inertia_of_a_solid_of_its_size(target):
    plant, scene_graph, (body,) = scene_of(f"{target}.sdf")
    inspector = scene_graph.model_inspector()
    shape = inspector.GetShape(plant.GetVisualGeometriesForBody(body)[0])
    if isinstance(shape, Box):
        unit = UnitInertia.SolidBox(0.1, 0.1, 0.12)
    else:
        unit = UnitInertia.SolidCylinder(shape.radius(), 0.12, [0.0, 0.0, 1.0])
    found = body.default_spatial_inertia().get_unit_inertia().CopyToFullMatrix3()
    np.testing.assert_allclose(found, unit.CopyToFullMatrix3(), rtol=0.01)


@pytest.mark.parametrize("name", ["laikago", "atlas"])
def test_no_body_of_a_robot_shares_its_name_with_a_scene(name):
    files = [path.name for path in (MODELS / "scenes").iterdir() if path.suffix != ".md"]
    scene = Scene(name, *(file for file in files if file != "ground.urdf"))
    for body in scene.bodies:
        # By name alone, which fails where two models have one of that name.
        assert scene.plant.GetBodyByName(body).model_instance() == scene.instance
