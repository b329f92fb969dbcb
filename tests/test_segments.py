import dataclasses

import numpy as np
import pytest

from drake_safety.learning.segments import Episodes, split, unsafety_score
from lip_episodes import HORIZON, NUM_STEPS, make_episodes


@pytest.fixture(scope="module")
def episodes():
    return make_episodes(40)


def test_the_score_is_discounted_by_the_steps_left_and_zero_when_safe():
    score = unsafety_score(np.array([0, 1, 2, 2]), np.array([True, True, True, False]), 0.9)
    np.testing.assert_allclose(score, [1.0, 0.9, 0.81, 0.0])


def test_a_segment_holds_the_errors_from_its_start_and_its_last_one_when_cut_short(episodes):
    segments = split(episodes, stride=3, discount=0.99)
    assert np.any(segments.length < HORIZON)
    for i in range(len(segments)):
        episode = episodes[int(segments.episode[i])]
        error = (episode.desired_output - episode.output)[segments.start_row[i] :][:HORIZON]
        assert segments.length[i] == len(error)
        np.testing.assert_array_equal(segments.error[i, : len(error)], error)
        np.testing.assert_array_equal(
            segments.error[i, len(error) :], error[-1:].repeat(HORIZON - len(error), axis=0)
        )


def test_the_future_margin_is_the_smallest_until_the_end(episodes):
    segments = split(episodes, stride=7, discount=0.99)
    for i in range(len(segments)):
        margins = episodes[int(segments.episode[i])].margins[segments.start_row[i] :]
        np.testing.assert_array_equal(segments.future_margins[i], margins.min(axis=0))


def test_an_unsafe_segment_names_the_constraint_that_ended_it(episodes):
    segments = split(episodes, stride=5, discount=0.99)
    names = episodes.info.constraint_names
    for position, cause, is_unsafe in zip(
        segments.episode, segments.cause, segments.is_unsafe, strict=True
    ):
        episode = episodes[int(position)]
        assert is_unsafe == (not episode.is_safe)
        assert episode.cause == ("" if cause < 0 else names[cause])


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


@pytest.mark.parametrize("asked", [1, 4, HORIZON, None])
def test_a_segment_begins_where_enough_of_a_whole_episode_is_left(episodes, asked):
    segments = split(episodes, stride=1, discount=0.99, shortest=asked)
    shortest = asked or HORIZON
    for position, episode in enumerate(episodes):
        rows = segments.start_row[segments.episode == position]
        num_starts = min(NUM_STEPS - shortest + 1, episode.num_steps)
        np.testing.assert_array_equal(rows, np.arange(max(num_starts, 0)))
    assert segments.remaining_steps[~segments.is_unsafe].min() == shortest
    expected = np.minimum(HORIZON, segments.remaining_steps + 1)
    np.testing.assert_array_equal(segments.length, expected)


def test_short_segments_change_none_of_the_others(episodes):
    whole = split(episodes, stride=1, discount=0.99)
    short = split(episodes, stride=1, discount=0.99, shortest=2)
    kept = short.take(short.start_row <= NUM_STEPS - HORIZON)
    for field in dataclasses.fields(whole):
        np.testing.assert_array_equal(getattr(kept, field.name), getattr(whole, field.name))


def test_an_episode_that_never_fills_the_horizon_gives_no_segment_whatever_its_label(episodes):
    late = NUM_STEPS - HORIZON + 1  # Where a safe one has less than the horizon left.
    pushed = [
        dataclasses.replace(episode, first_step=late)
        for episode in episodes
        if episode.num_steps > late
    ]
    assert len({episode.is_safe for episode in pushed}) == 2
    mixed = Episodes(episodes.info, [*pushed, episodes[0]])
    assert set(split(mixed, stride=1, discount=0.99).episode) == {len(pushed)}


def test_the_longest_episode_stands_in_for_a_length_that_is_not_known(episodes):
    info = dataclasses.replace(episodes.info, num_steps=0)
    unknown, known = (
        split(Episodes(which, episodes), stride=1, discount=0.99) for which in (info, episodes.info)
    )
    np.testing.assert_array_equal(unknown.start_row, known.start_row)


def test_episodes_too_short_for_any_segment_are_refused_with_the_length_wanted(episodes):
    safe = next(episode for episode in episodes if episode.is_safe)
    arrays = {
        field.name: getattr(safe, field.name)[:4]
        for field in dataclasses.fields(safe)
        if isinstance(getattr(safe, field.name), np.ndarray)
    }
    short = Episodes(episodes.info, [dataclasses.replace(safe, **arrays)])
    assert len(split(short, stride=1, discount=0.99, shortest=3)) == 1
    with pytest.raises(ValueError, match=r"none of the 1 episodes .* a segment of 5 samples"):
        split(short, stride=1, discount=0.99, shortest=5)


def test_samples_of_a_segment_are_a_preview_stride_apart_and_so_are_the_steps_of_its_score():
    episodes = make_episodes(20)
    stride, horizon = 2, episodes.info.horizon // 2
    info = dataclasses.replace(episodes.info, horizon=horizon, preview_stride=stride)
    num_outputs = len(info.output_names)
    wide = [
        dataclasses.replace(
            one,
            desired_preview=one.desired_preview.reshape(len(one.time_s), -1, num_outputs)[
                :, ::stride
            ][:, :horizon].reshape(len(one.time_s), -1),
        )
        for one in episodes
    ]
    assert info.preview_step_s == 2 * episodes.info.step_s
    segments = split(Episodes(info, wide), stride=1, discount=0.9)
    for i in range(len(segments)):
        one = episodes[segments.episode[i]]
        row, count = segments.start_row[i], segments.length[i]
        rows = row + stride * np.arange(count)
        assert rows[-1] <= one.num_steps < rows[-1] + stride or count == horizon
        error = (one.desired_output - one.output)[rows]
        np.testing.assert_array_equal(segments.error[i, :count], error)
        assert row <= episodes.info.num_steps - stride * horizon
        if not one.is_safe:
            expected = 0.9 ** ((one.num_steps - row) / stride)
            assert segments.score[i] == pytest.approx(expected)


def test_a_set_says_scenario_plant_and_counts(episodes):
    assert repr(episodes) == (
        f"Episodes('lip', variation 'nominal', seed {episodes.info.seed}, 40 episodes: "
        f"{episodes.num_safe} safe, {episodes.num_unsafe} unsafe)"
    )
    assert repr(episodes[:0]).endswith("0 episodes)")
    assert episodes[3:5].info is episodes.info
    assert [episode.index for episode in episodes[3:5]] == [3, 4]


@pytest.mark.train
def test_a_table_has_every_row_and_every_column_by_name(episodes):
    table = episodes.to_frame()
    info = episodes.info
    assert table.num_rows == sum(len(episode.time_s) for episode in episodes)
    assert table.num_columns == 6 + sum(info.widths.values())
    is_of_it = table["episode"].to_numpy() == episodes[3].index
    for name, array in {
        f"state.{info.state_names[1]}": episodes[3].state[:, 1],
        f"margins.{info.constraint_names[0]}": episodes[3].margins[:, 0],
        f"desired_preview.{info.output_names[-1]}[{HORIZON - 1}]": (
            episodes[3].desired_preview[:, -1]
        ),
        "time_s": episodes[3].time_s,
    }.items():
        np.testing.assert_array_equal(table[name].to_numpy()[is_of_it], array)
    causes = set(np.array(table["cause"].to_pylist())[is_of_it])
    assert causes == {episodes[3].cause}
    assert episodes[:0].to_frame().column_names == table.column_names


def changed(episodes, **changes):
    return Episodes(episodes.info, [dataclasses.replace(episodes[7], **changes)])


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda of: changed(of, state=of[7].state[:, :-1]), "episode 7 of 'lip': state has shape"),
        (
            lambda of: changed(of, is_safe=False, cause="shelf"),
            r"unknown cause 'shelf'.*support.*height",
        ),
        (lambda of: split(of[:0], stride=1, discount=0.99), "none of the 0 episodes"),
        (
            lambda of: split(of, stride=1, discount=0.99, shortest=0),
            r"shortest is 0, exp.* 1\.\.10",
        ),
        (lambda of: split(of, stride=1, discount=0.99, shortest=11), "shortest is 11, expected 1"),
        (
            lambda of: dataclasses.replace(of.info, preview_stride=0),
            "preview_stride is 0, expected >",
        ),
    ],
)
def test_what_gives_no_segments_is_refused(episodes, ask, message):
    with pytest.raises(ValueError, match=message):
        ask(episodes)


def test_masked_entries_of_an_episode_are_not_numbers():
    (episode,) = make_episodes(1)
    masked = np.ma.array(episode.margins)
    masked[-1, 0] = np.ma.masked
    found = dataclasses.replace(episode, margins=masked)
    assert type(found.margins) is np.ndarray and np.isnan(found.margins[-1, 0])
    np.testing.assert_array_equal(found.margins[:-1], episode.margins[:-1])
