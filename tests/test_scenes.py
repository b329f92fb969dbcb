"""The scenes: ground, ball, bookshelf and decorations on it."""

import numpy as np
import pytest
from pydrake.geometry import Box
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from drake_safety.plants.physics import add_ground
from package_models import package_parser

# Source: junhyeokahn/PyPnC, robot_model/bookcase/bookshelf.urdf.
BOARD_SIZE = (0.3, 2.0, 0.05)
BOARD_HEIGHTS = (0.025, 0.325, 0.625, 0.925, 1.225, 1.475)


def scene_of(name, is_welded=False):
    """A plant and scene graph with one model, at will welded to the origin, and its bodies."""
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.001)
    url = f"package://drake_safety_models/scenes/{name}"
    (instance,) = package_parser(plant).AddModelsFromUrl(url)
    bodies = [plant.get_body(index) for index in plant.GetBodyIndices(instance)]
    if is_welded:
        plant.WeldFrames(plant.world_frame(), bodies[0].body_frame())
    plant.Finalize()
    return plant, scene_graph, bodies


def test_the_bookshelf_can_be_touched_at_its_visible_boards():
    plant, scene_graph, (shelf,) = scene_of("bookshelf.urdf", is_welded=True)
    inspector = scene_graph.model_inspector()
    visuals = plant.GetVisualGeometriesForBody(shelf)
    visible = [(inspector.GetPoseInFrame(g), inspector.GetShape(g).size()) for g in visuals]
    heights = []
    for board in plant.GetCollisionGeometriesForBody(shelf):
        shape, X_BG = inspector.GetShape(board), inspector.GetPoseInFrame(board)
        assert isinstance(shape, Box)
        np.testing.assert_array_equal(shape.size(), BOARD_SIZE)
        np.testing.assert_array_equal(X_BG.translation()[:2], np.zeros(2))
        heights.append(X_BG.translation()[2])
        assert any(X.IsExactlyEqualTo(X_BG) and tuple(size) == BOARD_SIZE for X, size in visible)
    assert sorted(heights) == list(BOARD_HEIGHTS)


def test_the_ground_is_a_level_half_space_with_the_given_friction():
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    add_ground(plant, 0.7)
    plant.Finalize()
    diagram = builder.Build()
    context = plant.GetMyContextFromRoot(diagram.CreateDefaultContext())
    query = plant.get_geometry_query_input_port().Eval(context)
    for point in ([0.0, 0.0, 0.25], [500.0, -300.0, 0.25], [3.0, 0.0, -0.1]):
        (nearest,) = query.ComputeSignedDistanceToPoint(point)
        assert nearest.distance == pytest.approx(point[2])
    (collision,) = plant.GetCollisionGeometriesForBody(plant.world_body())
    properties = scene_graph.model_inspector().GetProximityProperties(collision)
    friction = properties.GetProperty("material", "coulomb_friction")
    assert (friction.static_friction(), friction.dynamic_friction()) == (0.7, 0.7)
