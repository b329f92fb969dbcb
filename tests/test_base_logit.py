"""The logit L of an unsafe end: scaled by what maps say of episodes that they have not learned."""

import dataclasses

import numpy as np
import pytest

from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.prediction import BaseLogit, sigmoid
from drake_safety.learning.trained_maps import EmbeddingOutput
from drake_safety.learning.training import fitted_base_logit, held_out_segments, segments_for
from lip_episodes import make_episodes


def parameters(**changed):
    return AssessmentParameters(perplexity=5.0, first_row_weight=1.0, **changed)


@pytest.fixture(scope="module")
def segments():
    return segments_for(make_episodes(200), parameters()).segments


def test_each_map_leaves_out_other_episodes_and_whole_ones(segments):
    held_out = held_out_segments(segments, parameters(held_out=0.1))
    assert held_out.shape == (3, len(segments))
    left_out = [set(segments.episode[rows]) for rows in held_out]
    num_episodes = len(np.unique(segments.episode))
    assert [len(episodes) for episodes in left_out] == [int(0.1 * num_episodes)] * 3
    assert len(set.union(*left_out)) == 3 * int(0.1 * num_episodes)
    for rows, episodes in zip(held_out, left_out, strict=True):
        assert episodes.isdisjoint(segments.episode[~rows])


def test_a_map_never_leaves_out_so_much_that_nothing_is_left(segments):
    held_out = held_out_segments(segments, parameters(held_out=0.9))
    num_episodes = len(np.unique(segments.episode))
    for rows in held_out:
        assert len(set(segments.episode[rows])) == num_episodes // 4
    none = held_out_segments(segments, parameters(held_out=0.0))
    assert none.shape == (3, len(segments))
    assert not none.any()
    assert not held_out_segments(segments, parameters(mode="paper")).any()


def test_maps_that_know_their_own_episodes_by_heart_are_scaled_by_the_others(segments):
    rng = np.random.default_rng(0)
    held_out = held_out_segments(segments, parameters(held_out=0.25))
    said = rng.normal(scale=3.0, size=held_out.shape)
    # Each segment is held out by one map at most: its label follows what that one says.
    truth = (held_out * said).sum(axis=0)
    is_unsafe = rng.random(len(segments)) < sigmoid(0.5 * truth + 0.4)
    by_heart = np.where(is_unsafe, 8.0, -8.0)
    output = EmbeddingOutput(
        np.zeros((*held_out.shape, 2)),
        np.where(held_out, said, by_heart),
        np.zeros((*held_out.shape, 0)),
    )
    relabelled = dataclasses.replace(segments, is_unsafe=is_unsafe)
    found = fitted_base_logit(output, held_out, relabelled, parameters())
    assert found.safety_slope == pytest.approx(0.5, abs=0.06)
    assert found.offset == pytest.approx(0.4, abs=0.15)
    own = fitted_base_logit(output, np.zeros_like(held_out), relabelled, parameters())
    assert own.safety_slope > 1.2 * found.safety_slope


@pytest.mark.parametrize("safety_slope", [0.0, 0.4])
def test_each_head_counts_for_what_it_is_worth(segments, safety_slope):
    rng = np.random.default_rng(1)
    held_out = held_out_segments(segments, parameters(held_out=0.25))
    said = rng.normal(scale=2.0, size=held_out.shape)
    margins = rng.uniform(-0.03, 0.1, (*held_out.shape, 2))
    logit = safety_slope * said + 1.0 - 1.5 * margins.min(axis=2) / 0.02
    is_unsafe = rng.random(len(segments)) < sigmoid((held_out * logit).sum(axis=0))
    output = EmbeddingOutput(np.zeros((*held_out.shape, 2)), said, margins)
    relabelled = dataclasses.replace(segments, is_unsafe=is_unsafe)
    found = fitted_base_logit(output, held_out, relabelled, parameters())
    assert found.offset == pytest.approx(1.0, abs=0.3)
    assert found.margin_slope == pytest.approx(1.5, abs=0.3)
    assert found.safety_slope == pytest.approx(safety_slope, abs=0.06)
    alone = output._replace(unsafe_logit=np.full(held_out.shape, np.nan))
    logit = fitted_base_logit(alone, held_out, relabelled, parameters())
    logit = logit.of_heads(logit.heads(alone))
    assert np.isfinite(logit).all()


def test_the_logit_is_that_of_the_mean_head_and_the_smallest_mean_margin_and_is_limited():
    logit = BaseLogit(
        margin_unit=0.02,
        margin_range=(-0.03, 0.1),
        offset=-0.2,
        safety_slope=0.8,
        margin_slope=1.3,
    )
    output = EmbeddingOutput(
        np.zeros((2, 1, 2)), np.array([[1.0], [9.0]]), np.array([[[0.02, 0.5]], [[0.04, 0.5]]])
    )
    expected = -0.2 + 0.8 * np.mean([1.0, 8.0]) - 1.3 * 0.03 / 0.02
    heads = logit.heads(output)
    assert logit.of_heads(heads)[0] == pytest.approx(expected)
    assert dataclasses.replace(logit, safety_slope=10.0).of_heads(heads)[0] == 8.0
