import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import beta, norm

from drake_safety.learning.calibration import (
    MOTION,
    PLAN,
    SAFE,
    UNKNOWN,
    UNSAFE,
    allowed_misses,
    calibrate,
    episode_scores,
    episodes_needed,
    score_threshold,
)
from lip_assessments import calibration, scored_episodes


def unsafe(n):
    return np.ones(n, dtype=bool)


@pytest.mark.parametrize(("num_unsafe", "missed"), [(18, -1), (19, 0), (38, 0), (39, 1), (99, 4)])
def test_on_average_the_rank_among_one_more_than_were_recorded_decides(num_unsafe, missed):
    assert allowed_misses(num_unsafe, 0.05) == missed
    if missed >= 0:
        score = np.linspace(0.1, 0.9, num_unsafe)
        assert np.sum(score <= score_threshold(score, unsafe(num_unsafe), 0.05)) == missed


@pytest.mark.parametrize(
    ("miss_rate", "num_unsafe"), [(0.05, 30), (0.05, 59), (0.01, 400), (0.1, 400)]
)
def test_with_confidence_as_many_are_missed_as_clopper_and_pearson_allow(miss_rate, num_unsafe):
    missed = allowed_misses(num_unsafe, miss_rate, confidence=0.95)

    def bound(count):
        return beta.ppf(0.95, count + 1, num_unsafe - count)

    assert missed == -1 or bound(missed) <= miss_rate
    assert bound(missed + 1) > miss_rate


def test_number_of_episodes_is_the_least_that_suffices():
    # The known figure: 59 without a miss show at most 5 % with 95 % confidence.
    assert episodes_needed(0.05, confidence=0.95) == 59
    for miss_rate, confidence in [(0.01, None), (0.05, None), (0.05, 0.95), (0.01, 0.99)]:
        needed = episodes_needed(miss_rate, confidence=confidence)
        assert allowed_misses(needed, miss_rate, confidence=confidence) >= 0
        assert allowed_misses(needed - 1, miss_rate, confidence=confidence) == -1
    assert allowed_misses(24, 1 / 25) == 0


def test_with_confidence_few_calibrations_break_the_promise():
    rng = np.random.default_rng(4)

    def share_broken(**options):
        # The true miss rate of a threshold is known here.
        draws = (rng.normal(size=150) for _ in range(400))
        rates = [norm.cdf(score_threshold(d, unsafe(150), 0.05, **options)) for d in draws]
        return np.mean(np.array(rates) > 0.05)

    assert 0.01 <= share_broken(confidence=0.9) <= 0.1
    assert share_broken() > 0.3


def test_threshold_lies_midway_below_the_sample_it_must_not_miss():
    label = np.array([False, False, True, True])
    assert score_threshold(np.array([0.1, 0.4, 0.6, 0.9]), label, 0.4) == pytest.approx(0.5)
    # A safe sample with the same score cannot be told apart, and is refused as well.
    assert score_threshold(np.array([0.1, 0.6, 0.6, 0.9]), label, 0.4) == pytest.approx(0.35)
    # If an unsafe sample has the lowest score, nothing is accepted, rounding included.
    assert 1.0 < 1.0 - score_threshold(np.zeros(3), np.array([True, False, False]), 0.5)
    # An unknown one stays above every threshold.
    label = np.array([False, False, True])
    assert score_threshold(np.array([0.1, 0.3, np.nan]), label, 0.5) == 0.3


def test_either_class_is_called_the_other_as_seldom_as_promised():
    rng = np.random.default_rng(5)
    missed, false_alarms, unknown = [], [], []
    for _ in range(100):
        rates = {"miss_rate": 0.05, "false_alarm_rate": 0.1}
        thresholds = calibrate(*scored_episodes(rng, 400, 2.0), kind=PLAN, **rates)
        score, label = scored_episodes(rng, 400, 2.0)
        verdict = thresholds.verdicts(1.0 - score)
        missed.append(np.mean(verdict[label] == SAFE))
        false_alarms.append(np.mean(verdict[~label] == UNSAFE))
        unknown.append(np.mean(verdict == UNKNOWN))
    assert 0.04 <= np.mean(missed) <= 0.052
    assert 0.085 <= np.mean(false_alarms) <= 0.104
    assert np.mean(unknown) > 0.1


def test_verdict_changes_at_the_thresholds():
    verdicts = calibration().verdicts(np.array([0.8, 0.79, 0.3, 0.29, np.nan]))
    assert verdicts.tolist() == [SAFE, UNKNOWN, UNKNOWN, UNSAFE, UNKNOWN]


def test_plan_is_scored_by_its_first_row_and_motion_by_its_worst():
    segments = SimpleNamespace(
        episode=np.array([2, 2, 2, 5, 5]),
        is_first=np.array([True, False, False, True, False]),
        is_unsafe=np.array([True, True, True, False, False]),
    )
    score = np.array([0.2, 0.9, 0.4, 0.1, np.nan])
    for kind, expected in ((PLAN, [0.2, 0.1]), (MOTION, [0.9, math.inf])):
        scores, label = episode_scores(segments, score, kind)
        np.testing.assert_array_equal(scores, expected)
        np.testing.assert_array_equal(label, [True, False])


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda: score_threshold(np.ones(2), ~unsafe(2), 0.1), "at least 9 unsafe .* 0 are"),
        (lambda: score_threshold(np.full(2, np.nan), unsafe(2), 0.1), "none of the 2 scores"),
        (lambda: allowed_misses(100, 0.0), r"miss_rate is 0\.0, expected a value in"),
        (lambda: calibration(unsafe_below=0.9), r"unsafe_below 0\.9 exceeds 0\.8"),
        (lambda: episode_scores(None, None, "walk"), "unknown kind 'walk'"),
    ],
)
def test_promise_that_cannot_be_kept_is_refused(ask, message):
    with pytest.raises(ValueError, match=message):
        ask()
