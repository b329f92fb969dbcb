import dataclasses
import gc
import weakref

import numpy as np
import pytest

from cart_episodes import ARRAYS
from drake_safety import inputs_at, load_scenario, run_episode
from drake_safety.simulation.rollouts import episode_rng
from reaching_loops import EASY, easy_episode, evaluated, porter
from toy_tasks import gliding


@pytest.fixture(scope="module")
def balancing():
    scenario = load_scenario("laikago_balancing", {"parameters.push.share": 0.0})
    scenario.episode_duration_s = 0.4
    return scenario.make_loop()


def start_at(loop, index, **goal):
    """Returns the start of an episode of the loop."""
    context = loop.CreateDefaultContext()
    loop.reset(context, episode_rng(0, index), **goal)
    return loop.start_of(context)


def test_a_start_gives_the_same_episode_again(balancing):
    episode = run_episode(balancing, 4)
    twin = run_episode(balancing, 7, start=start_at(balancing, 4))
    for name in set(ARRAYS) - {"state", "features"}:  # What noise enters is another's.
        np.testing.assert_array_equal(getattr(twin, name), getattr(episode, name), err_msg=name)
    assert (twin.is_safe, twin.cause) == (episode.is_safe, episode.cause)
    assert not np.array_equal(twin.state, episode.state)


def test_a_reaching_start_gives_the_same_episode_again_whichever_hand_reaches():
    for hand, mirrored in (("left", 1.0), ("right", -1.0)):
        loop = porter("nominal", hand=hand)
        start = start_at(loop, 0, goal=EASY * [1.0, mirrored, 1.0])
        twin = run_episode(loop, 0, start=start)
        for name in ARRAYS:
            expected = getattr(easy_episode("nominal", hand), name)
            np.testing.assert_array_equal(getattr(twin, name), expected, err_msg=name)


def test_without_a_generator_the_first_instant_is_seen_as_it_is(balancing):
    start = start_at(balancing, 0)
    context = balancing.CreateDefaultContext()
    balancing.reset_to(context, None, start)
    true_state = evaluated(balancing, context, "true_state")
    np.testing.assert_array_equal(evaluated(balancing, context, "state"), true_state)
    balancing.reset_to(context, np.random.default_rng(0), start)
    assert not np.array_equal(evaluated(balancing, context, "state"), true_state)


def test_inputs_of_a_hypothetical_start_are_those_of_its_first_row(balancing):
    start = balancing.standing_start()
    # Feet that are not named stand on the ground below where they are.
    moved = dataclasses.replace(start, q=start.q + np.eye(len(start.q))[6] * 0.01)
    feet = start.feet(balancing.kinematics)
    np.testing.assert_allclose(moved.feet(balancing.kinematics), feet, atol=1e-6)
    first = run_episode(balancing, start=start)
    state, preview, features = inputs_at(balancing, start)
    np.testing.assert_allclose(state, first.true_state[0], atol=1e-12)
    np.testing.assert_allclose(preview, first.desired_preview[0], atol=1e-12)
    assert features.shape == first.features[0].shape
    with pytest.raises(ValueError, match="lacks 'CanStartAnywhere'"):
        inputs_at(gliding().make_loop(), start)


def test_a_start_that_does_not_fit_the_robot_is_refused(balancing):
    good = start_at(balancing, 0)
    context = balancing.CreateDefaultContext()
    for changes, message in [
        ({"q": good.q[:-1]}, "q must be 19 finite numbers"),
        ({"q": good.q * 2}, "quaternion must have a norm of 1"),
    ]:
        with pytest.raises(ValueError, match=message):
            balancing.reset_to(context, None, dataclasses.replace(good, **changes))
    with pytest.raises(ValueError, match="leave out the goal"):
        run_episode(porter(), start=good, goal=EASY)


def test_a_start_from_a_quaternion_that_has_drifted_is_that_of_unit_norm(balancing):
    good = start_at(balancing, 0)
    drifted = dataclasses.replace(good, q=np.concatenate([1.03 * good.q[:4], good.q[4:]]))
    states = []
    for start in (good, drifted):
        context = balancing.CreateDefaultContext()
        balancing.reset_to(context, None, start)
        states.append(evaluated(balancing, context, "plant_state").copy())
    np.testing.assert_allclose(states[1], states[0], atol=1e-12)


def test_the_context_of_an_episode_is_freed_so_that_memory_does_not_grow(balancing):
    context = balancing.CreateDefaultContext()
    balancing.reset(context, np.random.default_rng(0))
    assert balancing.start_of(context).q.size
    alive = weakref.ref(context)
    del context
    gc.collect()
    assert alive() is None
