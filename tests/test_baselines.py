import numpy as np
import pytest

from drake_safety.evaluation.baselines import KINDS, DirectClassifier
from drake_safety.evaluation.metrics import area_under_curve
from drake_safety.learning.segments import Episodes, split
from lip_episodes import make_episodes

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def training():
    return make_episodes(240, seed=0)


@pytest.fixture(scope="module")
def fresh():
    return split(make_episodes(80, seed=9), stride=1, discount=0.99)


@pytest.fixture(scope="module", params=KINDS)
def classifier(request, training):
    return DirectClassifier(request.param).fit(training)


def predict(classifier, segments):
    return classifier.predict_unsafe(segments.state, segments.desired_preview, segments.features)


def test_it_tells_unsafe_from_safe_segments_of_episodes_it_has_not_seen(classifier, fresh):
    probability = predict(classifier, fresh)
    assert probability.shape == (len(fresh),)
    assert np.all((probability >= 0.0) & (probability <= 1.0))
    assert area_under_curve(probability, fresh.is_unsafe) > 0.9


def test_its_probabilities_are_better_than_the_share_of_unsafe_segments(classifier, fresh):
    probability, label = predict(classifier, fresh), fresh.is_unsafe
    assert ((probability - label) ** 2).mean() < 0.6 * label.mean() * (1.0 - label.mean())


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_gives_the_same_bits(kind, training, fresh):
    once, again = (DirectClassifier(kind).fit(training[:60]) for _ in range(2))
    np.testing.assert_array_equal(predict(again, fresh), predict(once, fresh))


def test_an_input_that_is_not_finite_is_unknown_and_disturbs_no_other(classifier, fresh):
    some = fresh.take(np.arange(6))
    expected = predict(classifier, some)
    some.state[2, 0], some.features[4, 1] = np.nan, np.inf
    probability = predict(classifier, some)
    assert np.flatnonzero(np.isnan(probability)).tolist() == [2, 4]
    np.testing.assert_allclose(probability[[0, 1, 3, 5]], expected[[0, 1, 3, 5]], rtol=1e-9)


def test_a_column_that_never_changes_carries_nothing(classifier, fresh):
    constant = make_episodes(60, seed=0)
    for episode in constant:
        episode.features[:, -1] = 3.0
    fitted = DirectClassifier(classifier.kind).fit(constant)
    some = fresh.take(np.arange(50))
    some.features[:, -1] = 3.0
    expected = predict(fitted, some)
    some.features[:, -1] = 3.001
    np.testing.assert_allclose(predict(fitted, some), expected, atol=0.05)


def test_without_features_it_sees_the_paper_s_input(training, fresh):
    blind = DirectClassifier("gradient_boosting", uses_features=False).fit(training)
    info = training.info
    assert blind.num_inputs_ == len(info.state_names) + info.horizon * len(info.output_names)
    other = fresh.take(np.arange(9))
    expected = predict(blind, other)
    other.features[:] = 7.0
    np.testing.assert_array_equal(predict(blind, other), expected)


def test_the_episodes_that_decide_when_to_stop_are_held_out_whole(training):
    segments = split(training, stride=1, discount=1.0)
    is_held_out = DirectClassifier("mlp")._held_out(segments)
    held_out = np.unique(segments.episode[is_held_out])
    assert not np.isin(segments.episode[~is_held_out], held_out).any()
    for is_class in (segments.is_unsafe, ~segments.is_unsafe):
        share = len(np.unique(segments.episode[is_held_out & is_class]))
        assert share / len(np.unique(segments.episode[is_class])) == pytest.approx(0.1, abs=0.02)


def test_errors_say_what_was_expected(classifier, training, fresh):
    with pytest.raises(ValueError, match="unknown kind 'forest'; the kinds are"):
        DirectClassifier("forest")
    with pytest.raises(ValueError, match="has not been fitted yet"):
        predict(DirectClassifier(classifier.kind), fresh)
    with pytest.raises(ValueError, match=f"it was fitted to {classifier.num_inputs_}"):
        classifier.predict_unsafe(fresh.state, fresh.desired_preview)
    safe = Episodes(training.info, [episode for episode in training if episode.is_safe])
    with pytest.raises(ValueError, match="0 unsafe episodes, expected at least 2"):
        DirectClassifier(classifier.kind).fit(safe)
