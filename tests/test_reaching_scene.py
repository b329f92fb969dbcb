import numpy as np
import pytest
from pydrake.geometry import Meshcat, Role

from drake_safety.models import load_robot
from drake_safety.simulation.scenario import load_scenario

SCENARIO = "atlas_reaching"
HALF_BOARD_M = 0.025
THINGS = ("blue_box", "red_can")


@pytest.fixture(scope="module")
def loop():
    return load_scenario(SCENARIO).make_loop()


def extent(loop, name):
    """Lowest and highest corner of what is seen of a model in the world, (2, 3) [m]."""
    plant = loop.plant
    context = loop.CreateDefaultContext()
    plant_context = plant.GetMyContextFromRoot(context)
    query = plant.get_geometry_query_input_port().Eval(plant_context)
    inspector = query.inspector()
    (body,) = plant.GetBodyIndices(plant.GetModelInstanceByName(name))
    corners = []
    for geometry in inspector.GetGeometries(plant.GetBodyFrameIdOrThrow(body), Role.kIllustration):
        box = inspector.GetObbInGeometryFrame(geometry)
        X_WB = query.GetPoseInWorld(geometry) @ box.pose()
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1)
        corners.append(X_WB.multiply(signs * np.reshape(box.half_width(), (3, 1))))
    points = np.hstack(corners)
    return np.array([points.min(axis=1), points.max(axis=1)])


@pytest.mark.parametrize("name", THINGS)
def test_it_stands_on_a_board(loop, name):
    low, high = extent(loop, name)
    middle = 0.5 * (low + high)
    below = np.array([*middle[:2], low[2]])
    under, over = loop.safe_set.clearance.of_points(
        np.array([below - [0, 0, HALF_BOARD_M], below + [0, 0, 0.01]])
    )
    # Half a board's height under it is the middle of a board; a centimetre over its foot is air.
    assert under == pytest.approx(-HALF_BOARD_M, abs=1e-6)
    assert over == pytest.approx(0.01, abs=1e-6)


@pytest.mark.parametrize("name", THINGS)
def test_the_target_of_that_name_is_where_the_hand_touches_it_and_no_board(loop, name):
    target = np.array(loop.named_targets[name])
    radius_m = load_robot(loop.scenario.robot).reaching_frame(loop.hand).radius_m
    low, high = extent(loop, name)
    gap_m = np.linalg.norm(target - np.clip(target, low, high)) - radius_m
    assert abs(gap_m) < 0.01
    assert loop.safe_set.clearance.of_points(target[None], radius_m)[0] > 0.01
    assert np.all((target >= loop.target_box[0]) & (target <= loop.target_box[1]))


def test_named_targets_are_those_that_are_seen(loop):
    assert set(THINGS) == set(loop.named_targets)


def test_the_view_of_the_other_hand_is_from_the_other_side(loop):
    other = loop.scenario.make_loop(hand="right")
    assert loop.view.azimuth_rad == -other.view.azimuth_rad != 0
    assert other.view.mirrored() == loop.view


def test_the_first_instant_from_the_standing_posture_is_without_noise(loop):
    goal = np.mean(loop.target_box, axis=0)
    context = loop.CreateDefaultContext()
    seen = []
    for rng in (None, np.random.default_rng(1)):
        loop.reset_standing(context, goal, rng)
        seen.append([loop.GetOutputPort(name).Eval(context) for name in ("state", "features")])
    for one, other in zip(*seen, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(seen[0][0], loop.GetOutputPort("true_state").Eval(context))


@pytest.mark.parametrize("is_watched", [False, True])
def test_visual_shapes_are_simulated_only_where_somebody_watches(loop, is_watched):
    if is_watched:
        loop = load_scenario(SCENARIO).make_loop(meshcat=Meshcat())
    context = loop.CreateDefaultContext()
    loop.prepare(context)
    scene_graph = loop.scene_graph
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    model, simulated = scene_graph.model_inspector(), query.inspector()
    assert simulated.GetCollisionCandidates() == model.GetCollisionCandidates()
    num_visual = model.NumGeometriesWithRole(Role.kIllustration)
    assert num_visual > 100
    assert simulated.NumGeometriesWithRole(Role.kIllustration) == is_watched * num_visual


def test_what_is_seen_or_asked_for_does_not_decide_what_episodes_are():
    scenario = load_scenario(SCENARIO)
    before = scenario.simulation_hash()
    scenario.parameters.named_targets = {}
    scenario.parameters.pushes = {}
    scenario.parameters.decorations = []
    scenario.parameters.assessment_period_s = 0.5
    scenario.parameters.view.room = 3.0
    assert scenario.simulation_hash() == before
