import dataclasses

import numpy as np
import pytest

from drake_safety.learning import maps
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.maps import fitted_base_logit, held_out_segments
from drake_safety.learning.prediction import BaseLogit, sigmoid
from drake_safety.learning.segments import training_segments
from drake_safety.learning.trained_maps import EmbeddingOutput
from lip_episodes import make_episodes


def parameters(**changed):
    return AssessmentParameters(perplexity=5.0, first_row_weight=1.0, **changed)


@pytest.fixture(scope="module")
def segments():
    return training_segments(make_episodes(200), parameters())


def test_all_maps_leave_out_the_same_episodes_and_whole_ones(segments):
    held_out = held_out_segments(segments, parameters(held_out=0.1))
    assert held_out.shape == (len(segments),)
    left_out = set(segments.episode[held_out])
    assert len(left_out) == int(0.1 * len(np.unique(segments.episode)))
    assert left_out.isdisjoint(segments.episode[~held_out])
    # Never so much that nothing is left.
    most = held_out_segments(segments, parameters(held_out=0.9))
    assert len(set(segments.episode[most])) == len(np.unique(segments.episode)) // 2
    assert not held_out_segments(segments, parameters(held_out=0.0)).any()
    assert not held_out_segments(segments, parameters(mode="paper")).any()


@pytest.mark.train
def test_the_logit_is_fitted_on_an_ensemble_that_knows_none_of_the_episodes(monkeypatch):
    episodes = make_episodes(120, noise=0.002)
    settings = parameters(epochs=2, hidden_sizes=[24, 24], held_out=0.3)
    tried = []
    fit = maps.fitted_base_logit
    monkeypatch.setattr(maps, "fitted_base_logit", lambda *of: tried.append(of) or fit(*of))
    sizes = []
    train = maps.train_map

    def train_map(data, *arguments, **options):
        sizes.append(len(data.x))
        return train(data, *arguments, **options)

    monkeypatch.setattr(maps, "train_map", train_map)
    learned = SafetyAssessment(settings).fit(episodes)
    segments = training_segments(episodes, settings)
    held_out = held_out_segments(segments, settings)
    # Three maps are tried on what they have not learned; three others learn from all.
    assert sizes == [np.sum(~held_out)] * 3 + [len(segments)] * 3
    ((output, others, _, trees_logit),) = tried
    assert output.unsafe_logit.shape == (3, held_out.sum())
    np.testing.assert_array_equal(others.state, segments.state[held_out])
    assert learned.base_logit_ == fit(output, others, settings, trees_logit)
    # Nor have the trees that are tried.
    x = learned.columns_.of_rows(others)
    assert np.abs(trees_logit - learned.trees_.evaluate(x)).max() > 0.1
    assert np.mean((trees_logit > 0.0) == others.is_unsafe) < np.mean(
        (learned.trees_.evaluate(x) > 0.0) == others.is_unsafe
    )


def test_it_is_the_mean_of_the_maps_that_is_scaled_and_not_each_of_them(segments):
    rng = np.random.default_rng(0)
    said = rng.normal(scale=3.0, size=(3, len(segments)))
    is_unsafe = rng.random(len(segments)) < sigmoid(0.5 * said.mean(axis=0) + 0.4)
    output = EmbeddingOutput(np.zeros((*said.shape, 2)), said, np.zeros((*said.shape, 0)))
    relabelled = dataclasses.replace(segments, is_unsafe=is_unsafe)
    found = fitted_base_logit(output, relabelled, parameters())
    assert found.safety_slope == pytest.approx(0.5, abs=0.06)
    assert found.offset == pytest.approx(0.4, abs=0.15)
    # The slope of one of the three, each as noisy as that, is another.
    alone = EmbeddingOutput(*(part[:1] for part in output))
    assert fitted_base_logit(alone, relabelled, parameters()).safety_slope < 0.25


@pytest.mark.parametrize("safety_slope", [0.0, 0.4])
def test_each_head_counts_for_what_it_is_worth(segments, safety_slope):
    rng = np.random.default_rng(1)
    said = rng.normal(scale=2.0, size=(3, len(segments)))
    margins = rng.uniform(-0.03, 0.1, (*said.shape, 2))
    smallest = margins.mean(axis=0).min(axis=1)
    logit = safety_slope * said.mean(axis=0) + 1.0 - 1.5 * smallest / 0.02
    is_unsafe = rng.random(len(segments)) < sigmoid(logit)
    output = EmbeddingOutput(np.zeros((*said.shape, 2)), said, margins)
    relabelled = dataclasses.replace(segments, is_unsafe=is_unsafe)
    found = fitted_base_logit(output, relabelled, parameters())
    assert found.offset == pytest.approx(1.0, abs=0.3)
    assert found.margin_slope == pytest.approx(1.5, abs=0.3)
    assert found.safety_slope == pytest.approx(safety_slope, abs=0.08)
    alone = output._replace(unsafe_logit=np.full(said.shape, np.nan))
    logit = fitted_base_logit(alone, relabelled, parameters())
    logit = logit.of_heads(logit.heads(alone))
    assert np.isfinite(logit).all()


def test_the_trees_count_for_what_they_are_worth_beside_the_heads(segments):
    rng = np.random.default_rng(2)
    said, trees = rng.normal(scale=2.0, size=(4, len(segments))).reshape(2, 2, -1)
    output = EmbeddingOutput(np.zeros((*said.shape, 2)), said, np.zeros((*said.shape, 0)))
    is_unsafe = rng.random(len(segments)) < sigmoid(0.4 * said.mean(axis=0) + 0.4 * trees[0])
    relabelled = dataclasses.replace(segments, is_unsafe=is_unsafe)
    found = fitted_base_logit(output, relabelled, parameters(), trees[0])
    assert (found.safety_slope, found.trees_slope) == pytest.approx((0.4, 0.4), abs=0.1)
    # Never surer than both, though these are worth twice what they say.
    less_sure = output._replace(unsafe_logit=0.4 * said)
    bounded = fitted_base_logit(less_sure, relabelled, parameters(), 0.2 * trees[0])
    assert bounded.safety_slope + bounded.trees_slope == pytest.approx(1.0)
    ratio = bounded.trees_slope / bounded.safety_slope
    assert ratio == pytest.approx(2.0 * found.trees_slope / found.safety_slope, rel=1e-2)
    # What says the opposite counts for nothing.
    assert fitted_base_logit(output, relabelled, parameters(), -trees[0]).trees_slope == 0.0
    heads = found.heads(output, 9.0 * trees[0])
    assert np.abs(heads[:, 2]).max() == 8.0
    expected = found.offset + heads @ np.array(found.slopes)
    np.testing.assert_allclose(found.of_heads(heads), np.clip(expected, -8.0, 8.0))


def test_the_logit_is_that_of_the_mean_head_and_the_smallest_mean_margin_and_is_limited():
    worth = {"offset": -0.2, "safety_slope": 0.8, "margin_slope": 1.3}
    logit = BaseLogit(margin_unit=0.02, margin_range=(-0.03, 0.1), **worth)
    output = EmbeddingOutput(
        np.zeros((2, 1, 2)), np.array([[1.0], [9.0]]), np.array([[[0.02, 0.5]], [[0.04, 0.5]]])
    )
    expected = -0.2 + 0.8 * np.mean([1.0, 8.0]) - 1.3 * 0.03 / 0.02
    heads = logit.heads(output)
    assert logit.of_heads(heads)[0] == pytest.approx(expected)
    assert dataclasses.replace(logit, safety_slope=10.0).of_heads(heads)[0] == 8.0
