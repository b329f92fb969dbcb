import dataclasses

import numpy as np
import pytest

from drake_safety.learning.segments import Episodes, split, unsafety_score
from lip_episodes import HORIZON, NUM_STEPS, make_episodes


@pytest.fixture(scope="module")
def episodes():
    return make_episodes(40)


def test_score_is_discounted_by_the_steps_left_and_zero_when_safe():
    score = unsafety_score(np.array([0, 1, 2, 2]), np.array([True, True, True, False]), 0.9)
    np.testing.assert_allclose(score, [1.0, 0.9, 0.81, 0.0])


def test_segments_hold_errors_margins_and_causes_until_the_episodes_end(episodes):
    segments = split(episodes, stride=3, discount=0.99)
    names = ["", *episodes.info.constraint_names]
    assert np.any(segments.length < HORIZON)
    for i in range(len(segments)):
        episode, row = episodes[int(segments.episode[i])], segments.start_row[i]
        error = (episode.desired_output - episode.output)[row:][:HORIZON]
        assert segments.length[i] == len(error)
        # When cut short, the last error is repeated.
        filled = np.concatenate([error, error[-1:].repeat(HORIZON - len(error), axis=0)])
        np.testing.assert_array_equal(segments.error[i], filled)
        least = episode.margins[row:].min(axis=0)
        np.testing.assert_array_equal(segments.future_margins[i], least)
        assert segments.is_unsafe[i] == (not episode.is_safe)
        assert episode.cause == names[segments.cause[i] + 1]


def test_rows_before_the_first_step_are_left_out(episodes):
    late = [dataclasses.replace(episode, first_step=2) for episode in episodes]
    segments = split(Episodes(episodes.info, late), stride=4, discount=0.99)
    assert segments.start_row.min() == 2
    np.testing.assert_array_equal(segments.is_first, segments.start_row == 2)


def test_diverged_episodes_are_counted_and_give_no_segments(episodes):
    failed = dataclasses.replace(episodes[0], is_safe=False, cause="diverged")
    mixed = Episodes(episodes.info, [failed, *episodes[1:]])
    assert mixed.num_diverged == 1
    assert mixed.num_safe + mixed.num_unsafe + mixed.num_diverged == len(mixed)
    assert 0 not in split(mixed, stride=1, discount=0.99).episode


@pytest.mark.parametrize("asked", [1, 4, None])
def test_segment_begins_where_enough_of_a_whole_episode_is_left(episodes, asked):
    segments = split(episodes, stride=1, discount=0.99, shortest=asked)
    shortest = asked or HORIZON
    for position, episode in enumerate(episodes):
        rows = segments.start_row[segments.episode == position]
        num_starts = min(NUM_STEPS - shortest + 1, episode.num_steps)
        np.testing.assert_array_equal(rows, np.arange(max(num_starts, 0)))
    assert segments.remaining_steps[~segments.is_unsafe].min() == shortest
    expected = np.minimum(HORIZON, segments.remaining_steps + 1)
    np.testing.assert_array_equal(segments.length, expected)


def test_episode_that_never_fills_the_horizon_gives_no_segment_whatever_its_label(episodes):
    late = NUM_STEPS - HORIZON + 1  # Where a safe one has less than the horizon left.
    pushed = [dataclasses.replace(e, first_step=late) for e in episodes if e.num_steps > late]
    assert len({episode.is_safe for episode in pushed}) == 2
    mixed = Episodes(episodes.info, [*pushed, episodes[0]])
    assert set(split(mixed, stride=1, discount=0.99).episode) == {len(pushed)}


def test_longest_episode_stands_in_for_a_length_that_is_not_known(episodes):
    info = dataclasses.replace(episodes.info, num_steps=0)
    unknown = split(Episodes(info, episodes), stride=1, discount=0.99)
    known = split(episodes, stride=1, discount=0.99)
    np.testing.assert_array_equal(unknown.start_row, known.start_row)


def test_samples_and_steps_of_the_score_are_a_preview_stride_apart():
    episodes, stride, horizon = make_episodes(20), 2, HORIZON // 2
    info = dataclasses.replace(episodes.info, horizon=horizon, preview_stride=stride)
    wide = []
    for episode in episodes:
        preview = episode.desired_preview.reshape(len(episode.time_s), -1, 3)[:, ::stride]
        preview = preview[:, :horizon].reshape(len(episode.time_s), -1)
        wide.append(dataclasses.replace(episode, desired_preview=preview))
    assert info.preview_step_s == 2 * episodes.info.step_s
    segments = split(Episodes(info, wide), stride=1, discount=0.9)
    for i in range(len(segments)):
        episode = episodes[segments.episode[i]]
        row, count = segments.start_row[i], segments.length[i]
        rows = row + stride * np.arange(count)
        assert rows[-1] <= episode.num_steps < rows[-1] + stride or count == horizon
        error = (episode.desired_output - episode.output)[rows]
        np.testing.assert_array_equal(segments.error[i, :count], error)
        assert row <= episodes.info.num_steps - stride * horizon
        if not episode.is_safe:
            expected = 0.9 ** ((episode.num_steps - row) / stride)
            assert segments.score[i] == pytest.approx(expected)


def changed(episodes, **changes):
    return Episodes(episodes.info, [dataclasses.replace(episodes[7], **changes)])


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda e: changed(e, state=e[7].state[:, :-1]), "episode 7 of 'lip': state has shape"),
        (lambda e: split(e[:0], stride=1, discount=0.99), "none of the 0 episodes .* of 10 samp"),
        (lambda e: split(e, stride=1, discount=0.99, shortest=11), "shortest is 11.* 1..10"),
        (lambda e: dataclasses.replace(e.info, preview_stride=0), "preview_stride 0 and step_s"),
    ],
)
def test_what_gives_no_segments_is_refused(episodes, ask, message):
    with pytest.raises(ValueError, match=message):
        ask(episodes)


def test_masked_entries_of_an_episode_are_not_numbers():
    (episode,) = make_episodes(1)
    masked = np.ma.array(episode.margins)
    masked[-1, 0] = np.ma.masked
    margins = dataclasses.replace(episode, margins=masked).margins
    assert type(margins) is np.ndarray and np.isnan(margins[-1, 0])
    np.testing.assert_array_equal(margins[:-1], episode.margins[:-1])
