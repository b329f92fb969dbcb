import numpy as np
import pytest

from drake_safety.evaluation.stills import render_stills, stack_positions
from drake_safety.simulation.scenario import load_scenario

SIZE = {"width": 96, "height": 72}


@pytest.fixture(scope="module")
def loop():
    return load_scenario("laikago_balancing").make_loop(ball=True)


@pytest.fixture(scope="module")
def standing(loop):
    plant = loop.plant
    positions = plant.GetPositions(plant.CreateDefaultContext())
    start = plant.GetBodyByName(loop.robot.base).floating_positions_start()
    positions[start + 4 : start + 7] = [0.0, 0.0, loop.kinematics.standing_height]
    return moved(loop, positions, "ball", [50.0, 50.0, 0.0])


def moved(loop, positions, body, offset):
    """`positions` with a floating body displaced by `offset` (3,)."""
    changed = positions.copy()
    start = loop.plant.GetBodyByName(body).floating_positions_start()
    changed[start + 4 : start + 7] += offset
    return changed


def test_a_still_shows_all_of_the_dark_robot_in_a_light_scene_where_it_stands_or_fell(
    loop, standing
):
    fallen = standing.copy()
    start = loop.plant.GetBodyByName(loop.robot.base).floating_positions_start()
    fallen[start : start + 4] = [np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]
    fallen[start + 4 : start + 7] = [1.0, 2.0, 0.12]
    log, time_s = np.array([standing, fallen]), np.arange(2.0)
    for _, image in render_stills(loop, time_s, log, time_s, **SIZE):
        assert (image.shape, image.dtype) == ((72, 96, 3), np.uint8)
        is_dark = image.max(axis=-1) < 90
        assert 0.01 < is_dark.mean() < 0.5
        assert not is_dark[[0, -1]].any() and not is_dark[:, [0, -1]].any()


def test_logged_states_of_robot_and_ball_make_up_the_plants_positions(loop):
    plant, name = loop.plant, loop.robot.name
    q = np.random.default_rng(0).normal(size=(4, plant.num_positions()))
    robot, ball = (plant.GetModelInstanceByName(n) for n in (name, "ball"))
    states = {
        name: np.array([plant.GetPositionsFromArray(robot, row) for row in q]),
        "ball": np.array(
            [np.append(plant.GetPositionsFromArray(ball, row), 6 * [9.0]) for row in q]
        ),
    }
    np.testing.assert_array_equal(stack_positions(loop, states), q)
