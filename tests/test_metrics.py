import math

import numpy as np
import pytest
from scipy.stats import poisson

from drake_safety.evaluation.metrics import (
    Bootstrap,
    area_under_curve,
    auc,
    median,
    proportion,
    rate_per_hour,
    segment_estimates,
    threshold_at,
)
from drake_safety.learning.segments import split
from lip_episodes import make_episodes


@pytest.fixture(scope="module")
def segments():
    return split(make_episodes(80, seed=1), stride=1, discount=0.99)


def test_a_proportion_has_the_clopper_pearson_interval_of_the_tables():
    # 8 of 10 in any table of exact binomial limits.
    estimate = proportion(8, 10)
    assert (estimate.value, estimate.n) == (0.8, 10)
    assert (estimate.low, estimate.high) == pytest.approx((0.4439, 0.9748), abs=1e-4)
    # One-sided 97.5 % is the lower end of a two-sided 95 % interval.
    assert proportion(59, 59).low == pytest.approx(0.025 ** (1 / 59))
    assert proportion(59, 59).high == 1.0
    nothing = proportion(0, 0)
    assert math.isnan(nothing.value)
    assert (nothing.low, nothing.high, nothing.n) == (0.0, 1.0, 0)


def test_the_interval_of_the_median_covers_the_truth_about_as_often_as_promised():
    rng = np.random.default_rng(1)
    estimates = [median(rng.exponential(size=51)) for _ in range(200)]
    share = np.mean([estimate.low <= np.log(2.0) <= estimate.high for estimate in estimates])
    assert 0.90 <= share <= 0.99
    assert median(np.array([1.0, 2.0, math.inf])).value == 2.0
    assert median(np.array([1.0, math.inf, math.inf])).value == math.inf


@pytest.mark.train
def test_the_area_agrees_with_scikit_learn_with_weights_and_ties():
    from sklearn.metrics import roc_auc_score

    rng = np.random.default_rng(0)
    score = rng.integers(0, 9, 300).astype(float)
    label, weight = rng.random(300) < 0.3, rng.integers(0, 4, 300)
    expected = roc_auc_score(label, score, sample_weight=weight)
    assert area_under_curve(score, label)(weight) == pytest.approx(expected)


def test_a_score_that_is_nan_counts_as_the_most_unsafe():
    label = np.array([False, True, True, False])
    known = np.array([0.1, 0.2, 5.0, 0.3])
    unknown = np.array([0.1, 0.2, np.nan, 0.3])
    each = np.arange(4)
    assert auc(unknown, label, each) == auc(known, label, each)
    assert threshold_at(unknown, label) <= 0.3
    assert math.isnan(auc(known, np.ones(4, dtype=bool), each).value)
    assert threshold_at(np.array([np.inf, 0.2, np.inf]), label[1:]) < math.inf


def test_the_interval_of_the_area_covers_the_truth_about_as_often_as_promised():
    rng = np.random.default_rng(3)
    truth = 0.5 * (1.0 + math.erf(0.5))  # Normal scores one standard deviation apart.
    num_covered = 0
    for trial in range(200):
        label = rng.random(120) < 0.5
        bootstrap = Bootstrap(num_resamples=200, seed=trial)
        estimate = auc(rng.normal(size=120) + label, label, np.arange(120), bootstrap=bootstrap)
        num_covered += estimate.low <= truth <= estimate.high
    assert 0.90 <= num_covered / 200 <= 0.99


def test_rates_have_the_exact_interval_of_a_poisson_process():
    estimate = rate_per_hour(5, 7200.0, 100)
    assert estimate.value == 2.5
    assert poisson.sf(4, 2 * estimate.low) == pytest.approx(0.025)
    assert poisson.cdf(5, 2 * estimate.high) == pytest.approx(0.025)
    assert rate_per_hour(0, 3600.0, 1).low == 0.0
    assert math.isnan(rate_per_hour(0, 0.0, 0).value)


def test_no_other_threshold_has_a_better_balanced_accuracy():
    rng = np.random.default_rng(4)
    label = rng.random(200) < 0.2
    score = np.round(rng.normal(size=200) + label, 1)

    def balanced(threshold):
        return 0.5 * ((score[label] > threshold).mean() + (score[~label] <= threshold).mean())

    best = max(balanced(t) for t in np.linspace(-5, 5, 1001))
    assert balanced(threshold_at(score, label)) == pytest.approx(best)
    # Midway where both classes lie apart.
    apart = np.array([0.1, 0.2, 0.3, 0.7, 0.9])
    assert threshold_at(apart, apart > 0.5) == pytest.approx(0.5)


def test_segment_recalls_are_shares_of_segments_with_episodes_behind_them(segments):
    noise = np.random.default_rng(0).normal(size=len(segments))
    score = 1.0 / (1.0 + np.exp(-(2.0 * segments.is_unsafe - 1.0 + noise)))
    estimates = segment_estimates(segments, score, threshold=0.6)
    label = segments.is_unsafe
    assert estimates["unsafe_recall"].value == pytest.approx((score[label] > 0.6).mean())
    assert estimates["safe_recall"].value == pytest.approx((score[~label] <= 0.6).mean())
    assert estimates["brier"].value == pytest.approx(((score - label) ** 2).mean())
    assert estimates["auc"] == auc(score, label, segments.episode)
    assert estimates["auc"].n == estimates["brier"].n == len(np.unique(segments.episode))
    assert estimates["safe_recall"].n == len(np.unique(segments.episode[~label]))
    for estimate in estimates.values():
        assert estimate.low < estimate.value < estimate.high
    # The truth is perfect, and its recalls are still uncertain.
    estimates = segment_estimates(segments, label.astype(float), threshold=0.5)
    assert estimates["unsafe_recall"].low < estimates["unsafe_recall"].value == 1.0
    # Of one segment an episode they are proportions.
    first, score = segments.take(segments.is_first), score[segments.is_first]
    estimates = segment_estimates(first, score, threshold=0.5)
    unsafe = score[first.is_unsafe] > 0.5
    assert estimates["unsafe_recall"] == proportion(unsafe.sum(), len(unsafe))
