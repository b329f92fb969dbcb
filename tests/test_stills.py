import numpy as np
import pytest

from drake_safety.evaluation.stills import StillCamera, render_stills, stack_positions, still_times
from drake_safety.simulation.scenario import load_scenario
from studies.moving_pictures import SceneCamera

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


@pytest.fixture(scope="module")
def camera(loop, standing):
    return StillCamera(loop, standing, **SIZE)


def moved(loop, positions, body, offset):
    """`positions` with a floating body displaced by `offset` (3,)."""
    changed = positions.copy()
    start = loop.plant.GetBodyByName(body).floating_positions_start()
    changed[start + 4 : start + 7] += offset
    return changed


def share_of_orange(image):
    red, green, blue = np.moveaxis(image.astype(int), -1, 0)
    return ((red > 150) & (red > 1.5 * green) & (green > 1.5 * blue)).mean()


def test_a_still_is_an_rgb_image_with_the_dark_robot_in_the_middle_of_a_light_scene(
    camera, standing
):
    image = camera.render(standing)
    assert image.shape == (72, 96, 3)
    assert image.dtype == np.uint8
    is_dark = image.max(axis=-1) < 90
    rows, columns = np.nonzero(is_dark)
    assert 0.02 < is_dark.mean() < 0.5
    assert abs(columns.mean() - 48) < 12
    assert abs(rows.mean() - 36) < 14
    # All of it is in the picture.
    assert not is_dark[[0, -1]].any() and not is_dark[:, [0, -1]].any()


def test_a_robot_that_fell_is_in_the_picture(loop, standing):
    fallen = standing.copy()
    start = loop.plant.GetBodyByName(loop.robot.base).floating_positions_start()
    fallen[start : start + 4] = [np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]
    fallen[start + 4 : start + 7] = [1.0, 2.0, 0.12]
    log, time_s = np.array([standing, fallen]), np.arange(2.0)
    for _, image in render_stills(loop, time_s, log, time_s, **SIZE):
        is_dark = image.max(axis=-1) < 90
        assert 0.01 < is_dark.mean()
        assert not is_dark[[0, -1]].any() and not is_dark[:, [0, -1]].any()


def test_the_camera_follows_the_base_over_the_ground_but_not_up(loop, camera, standing):
    reference = camera.render(standing).astype(int)
    base = loop.robot.base
    along = camera.render(moved(loop, standing, base, [0.3, -0.2, 0.0])).astype(int)
    up = camera.render(moved(loop, standing, base, [0.0, 0.0, 0.15])).astype(int)
    assert np.abs(along - reference).mean() < 6.0
    lowered = np.nonzero(up.max(axis=-1) < 90)[0].mean()
    assert lowered < np.nonzero(reference.max(axis=-1) < 90)[0].mean() - 5


def test_stills_are_spread_evenly_and_give_way_to_events():
    time_s = 0.02 * np.arange(201)
    np.testing.assert_allclose(still_times(time_s, num_stills=5), [0, 1, 2, 3, 4])
    times = still_times(time_s, [1.215, 1.3, 3.9], num_stills=5)
    np.testing.assert_allclose(times, [0.0, 1.22, 1.3, 2.0, 3.0, 3.9], atol=0.011)
    assert set(times) <= set(time_s)
    assert still_times(time_s) == [0.0, 4.0]


def test_points_of_the_world_are_found_in_the_still(loop, standing):
    camera = SceneCamera(loop, standing, **SIZE)
    start = loop.plant.GetBodyByName("ball").floating_positions_start() + 4
    found, places = [], np.array([[0.1, -0.5, 0.4], [0.3, -0.4, 0.2]])
    for place in places:
        ball = standing.copy()
        ball[start : start + 3] = place
        red, green, blue = np.moveaxis(camera.render(ball).astype(int), -1, 0)
        rows, columns = np.nonzero((red > 150) & (red > 1.5 * green) & (green > 1.5 * blue))
        found.append([columns.mean(), rows.mean()])
    seen = camera.project(places)
    # The dark side of a ball does not count.
    np.testing.assert_allclose(seen, found, atol=5.0)
    np.testing.assert_allclose(np.diff(seen, axis=0), np.diff(found, axis=0), atol=2.0)
    base = camera.position(loop.robot.base)
    np.testing.assert_allclose(base[:2], [0.0, 0.0], atol=0.1)
    assert base[2] == pytest.approx(loop.kinematics.standing_height, abs=0.1)


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
