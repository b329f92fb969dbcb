"""Episodes from a log: what the loop itself would have recorded of the same motion."""

import copy
import dataclasses

import numpy as np
import pytest

from drake_safety import run_episode
from drake_safety.logs.episodes import cut_log, motions_from_log
from log_files import (
    SAFE,
    UNSAFE,
    assert_same,
    balancing_loop,
    balancing_scenario,
    part,
    record,
    recorded,
)
from reaching_loops import EASY, easy_episode, porter

NUM_JOINTS = 12


def test_a_safe_run_of_the_loop_gives_the_episode_that_the_loop_recorded():
    episode = run_episode(balancing_loop(), SAFE)
    assert episode.is_safe
    episodes = cut_log(recorded(SAFE), balancing_loop())[0]
    assert len(episodes) == 1
    assert_same(episodes[0], episode, num_loads=NUM_JOINTS)
    assert episodes.info.variation == "actual"
    assert episodes.info.scenario_hash == balancing_scenario().simulation_hash("actual")


def test_an_unsafe_run_ends_with_the_state_and_the_cause_the_loop_ended_with():
    episode = run_episode(balancing_loop(), UNSAFE)
    assert not episode.is_safe
    (logged,) = cut_log(recorded(UNSAFE), balancing_scenario())[0]
    assert_same(logged, episode, slice(-1), num_loads=NUM_JOINTS)
    assert_same(logged, episode, slice(-1, None), ("true_state", "output", "margins"))
    assert abs(logged.time_s[-1] - episode.time_s[-1]) < 1e-9


def test_a_reaching_log_says_the_same_as_the_loop_for_the_other_hand_too():
    loop = porter("nominal", hand="right")
    (logged,) = cut_log(record(loop, 0, goal=EASY * [1.0, -1.0, 1.0]), loop)[0]
    episode = easy_episode("nominal", "right")
    assert_same(logged, episode, atol=1e-8)


def test_the_twin_begins_as_the_log_does_and_where_nothing_differs_goes_on_so():
    log = recorded(SAFE)
    episodes, starts = cut_log(log, balancing_loop())
    assert len(starts) == len(episodes) == 1
    twin = run_episode(balancing_loop(), start=starts[0])
    np.testing.assert_allclose(twin.state[0], episodes[0].state[0], atol=1e-12)
    # Between two rows of the log the plan is a cubic in place of the quintic.
    assert_same(twin, episodes[0], atol=1e-4, num_loads=NUM_JOINTS)


def test_a_longer_log_gives_an_episode_after_the_other_and_drops_a_short_rest():
    log = recorded(SAFE)
    scenario = copy.deepcopy(balancing_scenario())
    scenario.episode_duration_s = 0.2
    scenario.assessment.horizon = 4
    loop = scenario.make_loop("actual")
    episodes, starts = cut_log(part(log, 0, 221), loop)  # 0.55 s: two, and less than a horizon
    assert [e.num_steps for e in episodes] == [5, 5]
    np.testing.assert_allclose(episodes[0].true_state[-1], episodes[1].true_state[0], atol=1e-9)
    np.testing.assert_allclose(starts[1].q, log.q[80], atol=1e-12)
    # Of the previews the first stays in the second's frame, whose feet have not moved.
    first, second = (episode.desired_preview for episode in episodes)
    np.testing.assert_allclose(first[-1], second[0], atol=1e-9)


def test_motions_of_a_log_go_on_through_its_episodes_at_the_monitors_rows():
    loop = copy.deepcopy(balancing_scenario())
    loop.episode_duration_s = 0.2
    loop = loop.make_loop("actual")
    safe, unsafe = motions_from_log([recorded(SAFE), recorded(UNSAFE)], loop)
    np.testing.assert_allclose(safe.time_s, 0.02 * np.arange(31), atol=1e-9)
    assert (safe.index, safe.is_safe, unsafe.index, unsafe.is_safe) == (0, True, 1, False)
    (episode,) = cut_log(recorded(SAFE), balancing_loop())[0]
    for name in ("state", "desired_preview"):
        rows = getattr(safe, name)[::2]
        np.testing.assert_allclose(rows, getattr(episode, name), atol=1e-9, err_msg=name)
    # What is shorter than three rows is no motion.
    motions = motions_from_log(part(recorded(SAFE), 0, 15), loop)
    assert (len(motions), motions.info.step_s) == (0, 0.02)


def test_after_the_last_row_the_desired_output_stays_as_it_is():
    (episode,) = cut_log(part(recorded(SAFE), 0, 161), balancing_loop())[0]
    preview = episode.desired_preview[-1].reshape(-1, 3)
    np.testing.assert_allclose(preview, np.tile(preview[0], (len(preview), 1)), atol=1e-9)


def test_what_gives_no_episode_is_refused():
    log = recorded(SAFE)
    short = [dataclasses.replace(part(log, 0, 41), piece=i) for i in range(2)]
    low = dataclasses.replace(log, q=log.q - np.eye(log.q.shape[1])[6] * 0.1)
    for odd, message in (
        (dataclasses.replace(log, desired_output=None), "has no desired output"),
        (short, "too short for a segment of 10 steps"),
        (low, "begins outside the safe set.*'height'"),
    ):
        with pytest.raises(ValueError, match=message):
            cut_log(odd, balancing_loop())
    with pytest.raises(ValueError, match="is of robot 'laikago', scenario 'porting' of"):
        cut_log(log, porter())
