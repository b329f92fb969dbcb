import dataclasses

import numpy as np
import pytest

from drake_safety.learning import maps
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.assessment_parameters import AssessmentParameters
from drake_safety.learning.maps import fitted_base_logit, held_out_segments
from drake_safety.learning.prediction import sigmoid
from drake_safety.learning.segments import training_segments
from drake_safety.learning.trained_maps import EmbeddingOutput
from lip_episodes import make_episodes


def parameters(**changed):
    return AssessmentParameters(perplexity=5.0, first_row_weight=1.0, **changed)


@pytest.fixture(scope="module")
def segments():
    return training_segments(make_episodes(200), parameters())


def outputs(logit, margins=None):
    """Outputs of maps, of which only the safety logits (K, N) and margins (K, N, n_c) matter."""
    margins = np.zeros((*logit.shape, 1)) if margins is None else margins
    return EmbeddingOutput(np.zeros((*logit.shape, 2)), logit, margins)


def fitted(output, segments, logit, seed=0, trees_logit=None):
    """The base logit fitted to ends that are as likely as a logit says."""
    is_unsafe = np.random.default_rng(seed).random(len(segments)) < sigmoid(logit)
    relabelled = dataclasses.replace(segments, is_unsafe=is_unsafe)
    return fitted_base_logit(output, relabelled, parameters(), trees_logit)


@pytest.mark.train
def test_logit_is_fitted_on_ensemble_that_has_not_learned_the_episodes(monkeypatch):
    episodes = make_episodes(120, noise=0.002)
    settings = parameters(epochs=2, hidden_sizes=[24, 24], held_out=0.3)
    fit, train, calls, sizes = maps.fitted_base_logit, maps.train_map, [], []
    monkeypatch.setattr(maps, "fitted_base_logit", lambda *args: calls.append(args) or fit(*args))

    def train_map(data, *arguments, **options):
        sizes.append(len(data.x))
        return train(data, *arguments, **options)

    monkeypatch.setattr(maps, "train_map", train_map)
    learned = SafetyAssessment(settings).fit(episodes)
    segments = training_segments(episodes, settings)
    held_out = held_out_segments(segments, settings)
    # Three maps are tried on what they have not learned; three others learn from all.
    assert sizes == [np.sum(~held_out)] * 3 + [len(segments)] * 3
    ((output, others, _, trees_logit),) = calls
    np.testing.assert_array_equal(others.state, segments.state[held_out])
    assert learned.base_logit_ == fit(output, others, settings, trees_logit)
    # Nor have the trees that are tried.
    final = learned.trees_.evaluate(learned.columns_.of_rows(others))
    accuracy = [np.mean((logit > 0.0) == others.is_unsafe) for logit in (trees_logit, final)]
    assert accuracy[0] < accuracy[1]


def test_mean_of_the_maps_is_scaled(segments):
    logit = np.random.default_rng(0).normal(scale=3.0, size=(3, len(segments)))
    actual = 0.5 * logit.mean(axis=0) + 0.4
    found = fitted(outputs(logit), segments, actual)
    assert found.safety_slope == pytest.approx(0.5, abs=0.06)
    assert found.offset == pytest.approx(0.4, abs=0.15)
    # Each map is as noisy as that; the slope of one of the three is another.
    assert fitted(outputs(logit[:1]), segments, actual).safety_slope < 0.25


@pytest.mark.parametrize("safety_slope", [0.0, 0.4])
def test_each_head_has_its_slope(segments, safety_slope):
    rng = np.random.default_rng(1)
    logit = rng.normal(scale=2.0, size=(3, len(segments)))
    margins = rng.uniform(-0.03, 0.1, (*logit.shape, 2))
    smallest = margins.mean(axis=0).min(axis=1)
    actual = safety_slope * logit.mean(axis=0) + 1.0 - 1.5 * smallest / 0.02
    found = fitted(outputs(logit, margins), segments, actual)
    assert found.offset == pytest.approx(1.0, abs=0.3)
    assert found.margin_slope == pytest.approx(1.5, abs=0.3)
    assert found.safety_slope == pytest.approx(safety_slope, abs=0.08)


def test_trees_have_their_slope_beside_the_heads(segments):
    rng = np.random.default_rng(2)
    logit, (trees, _) = rng.normal(scale=2.0, size=(4, len(segments))).reshape(2, 2, -1)
    output, actual = outputs(logit), 0.4 * logit.mean(axis=0) + 0.4 * trees
    found = fitted(output, segments, actual, trees_logit=trees)
    assert (found.safety_slope, found.trees_slope) == pytest.approx((0.4, 0.4), abs=0.1)
    # Never surer than both, though these are worth twice what they say.
    bounded = fitted(outputs(0.4 * logit), segments, actual, trees_logit=0.2 * trees)
    assert bounded.safety_slope + bounded.trees_slope == pytest.approx(1.0)
    ratio = bounded.trees_slope / bounded.safety_slope
    assert ratio == pytest.approx(2.0 * found.trees_slope / found.safety_slope, rel=1e-2)
    # What says the opposite counts for nothing.
    assert fitted(output, segments, actual, trees_logit=-trees).trees_slope == 0.0
