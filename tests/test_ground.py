import numpy as np
import pytest
from pydrake.geometry import Role
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from drake_safety.plants.physics import add_ground


@pytest.fixture
def grounded():
    """A plant with ground alone, and the geometry query of its Context."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    add_ground(plant, 0.7)
    plant.Finalize()
    diagram = builder.Build()
    context = plant.GetMyContextFromRoot(diagram.CreateDefaultContext())
    return plant, scene_graph, plant.get_geometry_query_input_port().Eval(context)


def test_the_ground_is_level_at_zero_and_has_no_edge(grounded):
    _, _, query = grounded
    for point in ([0.0, 0.0, 0.25], [500.0, -300.0, 0.25], [3.0, 0.0, -0.1]):
        (found,) = query.ComputeSignedDistanceToPoint(point)
        assert found.distance == pytest.approx(point[2])
        np.testing.assert_allclose(found.grad_W, [0.0, 0.0, 1.0])


def test_the_ground_has_the_friction_that_was_asked_for_and_is_seen(grounded):
    plant, scene_graph, _ = grounded
    inspector = scene_graph.model_inspector()
    (collision,) = plant.GetCollisionGeometriesForBody(plant.world_body())
    properties = inspector.GetProximityProperties(collision)
    friction = properties.GetProperty("material", "coulomb_friction")
    assert (friction.static_friction(), friction.dynamic_friction()) == (0.7, 0.7)
    assert inspector.GetAllGeometryIds(Role.kIllustration)
