import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_safety import load_scenario
from drake_safety.simulation.dataset import completed
from drake_safety.simulation.feedback import (
    AddFeedbackRecorder,
    pair_windows,
    run_pairs,
    window_start,
)
from drake_safety.simulation.rollouts import episode_rng, run_episode
from drake_safety.systems.feedback_recorder import RecordedWindow

pytestmark = pytest.mark.train


def quick():
    scenario = load_scenario("laikago_balancing")
    scenario.episode_duration_s = 0.4
    scenario.assessment.preview_stride = 1
    scenario.parameters.push.share = 0.0
    return scenario


def recorded(loop, episode):
    """A window of the episode with the index 0, and the recorder of another plant."""
    context, builder = loop.CreateDefaultContext(), DiagramBuilder()
    loop.reset(context, episode_rng(7, 0))
    plant_state = loop.GetOutputPort("plant_state").Eval(context)
    window = RecordedWindow(episode=episode, plant_state=plant_state, start_time_s=3.0)
    actual = builder.AddSystem(loop.scenario.make_loop("payload"))
    return window, AddFeedbackRecorder(builder, actual)


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pairs")
    return folder, run_pairs(quick(), 3, variation="payload", seed=7, num_workers=1, path=folder)


def test_the_twin_begins_where_the_actual_robot_does_with_the_same_plan(kept):
    _, pairs = kept
    assert (pairs.actual.info.variation, pairs.nominal.info.variation) == ("payload", "nominal")
    for actual, nominal in zip(pairs.actual, pairs.nominal, strict=True):
        np.testing.assert_array_equal(actual.true_state[0], nominal.true_state[0])
        np.testing.assert_array_equal(actual.desired_preview[0], nominal.desired_preview[0])
        later = min(actual.num_steps, nominal.num_steps)
        assert not np.array_equal(actual.true_state[later], nominal.true_state[later])


def test_pairs_are_kept_and_gone_on_with(kept):
    folder, pairs = kept
    assert completed(folder / "payload") == completed(folder / "nominal") == {0, 1, 2}
    done, options = [], {"variation": "payload", "seed": 7, "num_workers": 1, "path": folder}
    again = run_pairs(quick(), 3, progress=lambda *count: done.append(count), **options)
    assert done == [(3, 6), (6, 6)]
    for one, other in zip(pairs.actual, again.actual, strict=True):
        np.testing.assert_array_equal(one.state, other.state)
    assert len(again.feedback()) == len(again.actual) == 3


def test_a_recorded_window_gives_the_twin_that_the_episode_would_have(kept):
    _, pairs = kept
    scenario = quick()
    loop = scenario.make_loop("nominal")
    window, recorder = recorded(loop, pairs.actual[0])
    assert recorder.info.variation == "payload"
    (feedback,) = pair_windows(scenario, recorder, [window])
    twin = feedback.twin
    expected = run_episode(loop, 0, seed=7)
    rows = min(len(twin.time_s), len(expected.time_s))
    assert rows > 3
    # Not to the bit: the feet stand where q has them, and the plan was seen in samples.
    np.testing.assert_allclose(twin.output[:rows], expected.output[:rows], atol=5e-3)
    assert feedback.info.variation == "payload"
    assert feedback.nominal_hash == pairs.nominal.info.scenario_hash


def test_twins_of_one_simulation_share_a_loop_for_pydrake_frees_none(kept, monkeypatch):
    scenario, made = quick(), []
    _, pairs = kept
    window, recorder = recorded(scenario.make_loop("nominal"), pairs.actual[0])
    pair_windows(scenario, recorder, [window])
    monkeypatch.setattr(type(scenario), "make_loop", lambda *given, **options: made.append(given))
    pair_windows(scenario, recorder, [window])
    pair_windows(scenario, recorder, [window])
    assert not made


def test_the_plan_of_a_window_goes_through_what_was_desired(kept):
    _, pairs = kept
    loop = quick().make_loop()
    episode = pairs.actual[1]
    plant_state = np.concatenate([loop.kinematics.standing_positions(), np.zeros(18)])
    window = RecordedWindow(episode=episode, plant_state=plant_state, start_time_s=0.0)
    start = window_start(loop, window)
    preview = episode.desired_preview.reshape(len(episode.time_s), -1, 3)
    for row, time_s in enumerate(episode.time_s[:-1]):
        np.testing.assert_allclose(start.plan.value(time_s).ravel(), preview[row, 0], atol=1e-12)
    np.testing.assert_array_equal(start.q, plant_state[:19])


def test_pairs_with_an_engine_without_balls_begin_alike_and_are_the_scenarios_own():
    scenario = load_scenario("laikago_balancing")
    scenario.episode_duration_s = 0.48
    pairs = run_pairs(scenario, 3, variation="mujoco", seed=7, num_workers=1)
    # Refuses what begins elsewhere.
    assert {one.nominal_hash for one in pairs.feedback()} == {scenario.simulation_hash()}
    assert pairs.actual.info.scenario_hash != pairs.nominal.info.scenario_hash
