import numpy as np
import pytest

from drake_safety.evaluation.scorers import Scorer
from drake_safety.learning.segments import split
from lip_episodes import make_episodes
from studies.baselines import KINDS, DirectClassifier, classifier_differences

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


def test_a_classifier_ranks_unsafe_segments_of_fresh_episodes_above_safe_ones(classifier, fresh):
    from sklearn.metrics import roc_auc_score

    probability, label = predict(classifier, fresh), fresh.is_unsafe
    assert np.all((probability >= 0.0) & (probability <= 1.0))
    assert roc_auc_score(label, probability) > 0.9
    assert ((probability - label) ** 2).mean() < 0.6 * label.mean() * (1.0 - label.mean())


def test_an_input_that_is_not_finite_is_unknown_and_disturbs_no_other(classifier, fresh):
    some = fresh.take(np.arange(6))
    expected = predict(classifier, some)
    some.state[2, 0], some.features[4, 1] = np.nan, np.inf
    probability = predict(classifier, some)
    assert np.flatnonzero(np.isnan(probability)).tolist() == [2, 4]
    np.testing.assert_allclose(probability[[0, 1, 3, 5]], expected[[0, 1, 3, 5]], rtol=1e-9)


def test_early_stopping_holds_out_whole_episodes(training):
    segments = split(training, stride=1, discount=1.0)
    is_held_out = DirectClassifier("mlp")._held_out(segments)
    held_out = np.unique(segments.episode[is_held_out])
    assert not np.isin(segments.episode[~is_held_out], held_out).any()
    for is_class in (segments.is_unsafe, ~segments.is_unsafe):
        share = len(np.unique(segments.episode[is_held_out & is_class]))
        assert share / len(np.unique(segments.episode[is_class])) == pytest.approx(0.1, abs=0.02)


def test_gamma_is_compared_with_the_mean_over_the_seeds_of_each_kind():
    test = make_episodes(60, seed=4)

    def scorer(name, skill):
        def probability(state, desired_preview, features):
            noise = np.random.default_rng(round(1e3 * skill)).normal(size=len(state))
            return 1.0 / (1.0 + np.exp(-skill * features[:, 0] - noise))

        return Scorer(name=name, probability=probability)

    gamma, worse = scorer("sharpened", 1.0), [scorer(f"mlp_{i}", 0.1 * i) for i in range(3)]
    equal = [scorer(f"gradient_boosting_{i}", 1.0) for i in range(3)]
    differences = classifier_differences(gamma, [*equal, *worse], test)
    assert {key[0] for key in differences} == {"difference.rows", "difference.first"}
    same = differences["difference.rows", "gradient_boosting", "auc"]
    assert (same.value, same.low, same.high, same.n) == (0.0, 0.0, 0.0, 60)
    each = [classifier_differences(gamma, [*equal, other], test) for other in worse]
    for key in (("difference.rows", "mlp", "auc"), ("difference.first", "mlp", "brier")):
        assert differences[key].value == pytest.approx(np.mean([d[key].value for d in each]))
