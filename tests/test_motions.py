import numpy as np
import pytest

from cart_episodes import assert_identical
from drake_safety import load_scenario, run_episode, run_episodes, run_motions
from drake_safety.learning.seeds import MOTION
from drake_safety.simulation.capabilities import MovesUndisturbed
from drake_safety.simulation.dataset import load_episodes
from drake_safety.simulation.rollouts import MOTION_PIECE_S, run_motion
from toy_tasks import evaluated, gliding


@pytest.mark.parametrize("name", ["laikago_balancing", "atlas_reaching", "go2_walking"])
def test_a_robot_moves_on_in_its_safe_set_by_plans_that_follow_each_other(name):
    scenario = load_scenario(name)
    loop = scenario.make_loop()
    assert isinstance(loop, MovesUndisturbed)
    one = run_motion(loop, 1, until_s=3.0)
    np.testing.assert_allclose(one.time_s, scenario.monitor_step_s * np.arange(151))
    assert one.is_safe and one.margins.min() > 0.0
    assert np.ptp(one.output, axis=0).max() > 0.01
    context, seen = loop.CreateDefaultContext(), []
    loop.reset_undisturbed(context, np.random.default_rng(0), MOTION_PIECE_S)
    for time_s in np.arange(0.6, 1.0, 0.02) * MOTION_PIECE_S:
        context.SetTime(time_s)
        seen.append(evaluated(loop, context, "desired_output").copy())
    assert np.ptp(seen, axis=0).max() > 0.01
    # It depends on its seed and number alone.
    other = run_motion(loop, 2, until_s=0.2)
    assert not np.array_equal(other.state, one.state[:11])
    anew = run_motion(scenario.make_loop(), 1, until_s=0.2, with_features=True)
    np.testing.assert_array_equal(anew.state, one.state[:11])
    np.testing.assert_array_equal(anew.desired_preview, one.desired_preview[:11])
    # Features that no monitor reads are not evaluated.
    assert anew.features.shape == (11, len(loop.feature_names)) and anew.features.any()
    is_read = loop.monitored.get("features") != []
    np.testing.assert_array_equal(one.features[:11], is_read * anew.features)


@pytest.mark.train
def test_motions_are_the_same_for_any_number_of_workers_and_go_on_where_they_stopped(tmp_path):
    def interrupt(done, wanted):
        if done == 1:
            raise KeyboardInterrupt

    drifting = gliding("Drifting")
    alone = run_motions(drifting, 150.0, num_workers=1)
    assert [one.time_s[-1] for one in alone] == pytest.approx([MOTION_PIECE_S] * 3)
    assert (alone.info.step_s, alone.info.seed) == (drifting.monitor_step_s, MOTION.first)
    assert alone.info.num_steps == alone[0].num_steps
    options = {"path": tmp_path, "num_workers": 1}
    with pytest.raises(KeyboardInterrupt):
        run_motions(drifting, 150.0, progress=interrupt, **options)
    assert len(load_episodes(tmp_path)) == 1
    assert_identical(run_motions(drifting, 150.0, path=tmp_path, num_workers=2), alone)
    assert_identical(load_episodes(tmp_path), alone)
    with pytest.raises(ValueError, match="episodes of another set"):
        run_motions(drifting, 150.0, seed=5, **options)
    with pytest.raises(ValueError, match="episodes of another set"):
        run_episodes(drifting, 3, seed=MOTION.first, **options)


@pytest.mark.parametrize(("task", "are_episodes"), [("Drifting", True), ("Gliding", False)])
def test_motions_of_other_tasks_are_episodes_with_the_monitors_rows(task, are_episodes):
    scenario = gliding(task)
    motions = run_motions(scenario, 4.0, num_workers=1, seed=3, are_episodes=are_episodes)
    assert len(motions) == 5
    loop = scenario.make_loop()
    for motion in motions:
        episode = run_episode(loop, motion.index, seed=3)
        assert (motion.is_safe, motion.first_step) == (episode.is_safe, 2 * episode.first_step)
        rows = len(episode.state) - 1  # It may leave between two rows.
        np.testing.assert_array_equal(motion.state[::2][:rows], episode.state[:rows])
        np.testing.assert_array_equal(motion.features[::2][:rows], episode.features[:rows])
    assert len({motion.first_step for motion in motions}) == 2
