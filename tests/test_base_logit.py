"""The logit L of an unsafe end: scaled by what maps say of episodes that they have not learned."""

import dataclasses

import numpy as np
import pytest

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.inputs import inputs
from drake_safety.learning.prediction import BaseLogit, sigmoid
from drake_safety.learning.trained_maps import EmbeddingOutput
from drake_safety.learning.training import fitted_base_logit, held_out_segments, segments_for
from lip_episodes import make_episodes


def parameters(**changed):
    return AssessmentParameters(perplexity=5.0, first_row_weight=1.0, **changed)


@pytest.fixture(scope="module")
def segments():
    return segments_for(make_episodes(200), parameters()).segments


def test_all_maps_leave_out_the_same_episodes_and_whole_ones(segments):
    held_out = held_out_segments(segments, parameters(held_out=0.1))
    assert held_out.shape == (len(segments),)
    left_out = set(segments.episode[held_out])
    assert len(left_out) == int(0.1 * len(np.unique(segments.episode)))
    assert left_out.isdisjoint(segments.episode[~held_out])


def test_the_maps_never_leave_out_so_much_that_nothing_is_left(segments):
    held_out = held_out_segments(segments, parameters(held_out=0.9))
    assert len(set(segments.episode[held_out])) == len(np.unique(segments.episode)) // 2
    assert not held_out_segments(segments, parameters(held_out=0.0)).any()
    assert not held_out_segments(segments, parameters(mode="paper")).any()


def test_the_logit_is_fitted_on_the_ensemble_that_it_is_asked_for():
    episodes = make_episodes(120, noise=0.002)
    changes = {"epochs": 2, "hidden_sizes": [24, 24], "held_out": 0.3}
    learned = SafetyAssessment(parameters(**changes)).fit(episodes)
    segments = segments_for(episodes, learned.parameters).segments
    held_out = held_out_segments(segments, learned.parameters)
    x = inputs(segments.state, segments.desired_preview, segments.features, learned.parameters)
    label = segments.is_unsafe[held_out]

    def mean_loss(base_logit):
        logit = base_logit.of_heads(base_logit.heads(learned.embedding_.evaluate(x[held_out])))
        return np.mean(np.logaddexp(0.0, logit) - label * logit)

    # Of what the ensemble says of episodes that no map knows, no other slopes are better.
    least = mean_loss(learned.base_logit_)
    for name in ("offset", "safety_slope", "margin_slope"):
        for change in (-0.05, 0.05):
            other = getattr(learned.base_logit_, name) + change
            if name == "offset" or other >= 0.0:
                moved = dataclasses.replace(learned.base_logit_, **{name: other})
                assert mean_loss(moved) > least - 1e-5


def test_maps_that_know_their_own_episodes_by_heart_are_scaled_by_the_others(segments):
    rng = np.random.default_rng(0)
    held_out = held_out_segments(segments, parameters(held_out=0.25))
    said = rng.normal(scale=3.0, size=(3, len(segments)))
    is_unsafe = rng.random(len(segments)) < sigmoid(0.5 * said.mean(axis=0) + 0.4)
    by_heart = np.where(is_unsafe, 8.0, -8.0)
    output = EmbeddingOutput(
        np.zeros((*said.shape, 2)),
        np.where(held_out, said, by_heart),
        np.zeros((*said.shape, 0)),
    )
    relabelled = dataclasses.replace(segments, is_unsafe=is_unsafe)
    found = fitted_base_logit(output, held_out, relabelled, parameters())
    assert found.safety_slope == pytest.approx(0.5, abs=0.1)
    assert found.offset == pytest.approx(0.4, abs=0.15)
    own = fitted_base_logit(output, np.zeros_like(held_out), relabelled, parameters())
    assert own.safety_slope > 1.2 * found.safety_slope


@pytest.mark.parametrize("safety_slope", [0.0, 0.4])
def test_each_head_counts_for_what_it_is_worth(segments, safety_slope):
    rng = np.random.default_rng(1)
    held_out = held_out_segments(segments, parameters(held_out=0.5))
    said = rng.normal(scale=2.0, size=(3, len(segments)))
    margins = rng.uniform(-0.03, 0.1, (*said.shape, 2))
    smallest = margins.mean(axis=0).min(axis=1)
    logit = safety_slope * said.mean(axis=0) + 1.0 - 1.5 * smallest / 0.02
    is_unsafe = rng.random(len(segments)) < sigmoid(logit)
    output = EmbeddingOutput(np.zeros((*said.shape, 2)), said, margins)
    relabelled = dataclasses.replace(segments, is_unsafe=is_unsafe)
    found = fitted_base_logit(output, held_out, relabelled, parameters())
    assert found.offset == pytest.approx(1.0, abs=0.3)
    assert found.margin_slope == pytest.approx(1.5, abs=0.3)
    assert found.safety_slope == pytest.approx(safety_slope, abs=0.08)
    alone = output._replace(unsafe_logit=np.full(said.shape, np.nan))
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
