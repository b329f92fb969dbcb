import math
from types import SimpleNamespace

import numpy as np
import pytest

from drake_safety.learning.calibration import (
    MOTION,
    PLAN,
    SAFE,
    UNKNOWN,
    UNSAFE,
    Calibration,
    allowed_misses,
    calibrate,
    episode_scores,
    episodes_needed,
    least_miss_rate,
    score_threshold,
)
from lip_assessments import calibration as made
from lip_assessments import scored_episodes


def unsafe(n):
    return np.ones(n, dtype=bool)


@pytest.mark.parametrize(
    ("num_unsafe", "missed"), [(18, -1), (19, 0), (38, 0), (39, 1), (99, 4), (100, 4)]
)
def test_on_average_the_rank_among_one_more_than_were_seen_decides(num_unsafe, missed):
    assert allowed_misses(num_unsafe, 0.05) == missed
    if missed >= 0:
        score = np.linspace(0.1, 0.9, num_unsafe)
        assert np.sum(score <= score_threshold(score, unsafe(num_unsafe), 0.05)) == missed


@pytest.mark.parametrize("miss_rate", [0.01, 0.05, 0.1])
@pytest.mark.parametrize("confidence", [0.9, 0.95])
@pytest.mark.parametrize("num_unsafe", [30, 59, 400])
def test_with_confidence_as_many_are_missed_as_clopper_and_pearson_s_bound_allows(
    miss_rate, confidence, num_unsafe
):
    from scipy.stats import beta

    missed = allowed_misses(num_unsafe, miss_rate, confidence=confidence)

    def bound(count):
        return beta.ppf(confidence, count + 1, num_unsafe - count)

    assert missed == -1 or bound(missed) <= miss_rate
    assert bound(missed + 1) > miss_rate


def test_the_number_of_episodes_that_it_takes_is_the_least_that_does():
    # The known figure: 59 without a miss show at most 5 % with 95 % confidence.
    assert episodes_needed(0.05, confidence=0.95) == 59
    assert episodes_needed(0.01) == 99
    for miss_rate, confidence in [(0.01, None), (0.05, None), (0.05, 0.95), (0.01, 0.99)]:
        needed = episodes_needed(miss_rate, confidence=confidence)
        assert allowed_misses(needed, miss_rate, confidence=confidence) >= 0
        assert allowed_misses(needed - 1, miss_rate, confidence=confidence) == -1
    assert allowed_misses(24, least_miss_rate(24)) == 0


def test_with_confidence_few_calibrations_break_the_promise():
    from scipy.stats import norm

    rng = np.random.default_rng(4)
    thresholds = [
        score_threshold(rng.normal(size=150), unsafe(150), 0.05, confidence=0.9) for _ in range(400)
    ]
    # The true miss rate of a threshold is known here.
    share_broken = np.mean(norm.cdf(thresholds) > 0.05)
    assert 0.01 <= share_broken <= 0.1
    on_average = [score_threshold(rng.normal(size=150), unsafe(150), 0.05) for _ in range(400)]
    assert np.mean(norm.cdf(on_average) > 0.05) > 0.3


def test_a_threshold_lies_midway_below_the_sample_it_must_not_miss():
    score = np.array([0.1, 0.4, 0.6, 0.9])
    label = np.array([False, False, True, True])
    assert score_threshold(score, label, 0.4) == pytest.approx(0.5)
    # A safe sample with the same score cannot be told apart, and is refused as well.
    tied = score_threshold(np.array([0.1, 0.6, 0.6, 0.9]), label, 0.4)
    assert tied == pytest.approx(0.35)


def test_where_an_unsafe_sample_has_the_lowest_score_nothing_is_accepted():
    threshold = score_threshold(np.zeros(3), np.array([True, False, False]), 0.5)
    assert threshold < 0.0
    # As a safety probability it refuses what is taken for certainly safe, rounding included.
    assert 1.0 < 1.0 - threshold


def test_unsafe_samples_that_nobody_knows_stay_above_every_threshold():
    score, label = np.array([0.1, 0.3, np.nan]), np.array([False, False, True])
    assert score_threshold(score, label, 0.5) == 0.3


def test_either_class_is_called_the_other_as_seldom_as_promised_and_the_rest_is_not_known():
    rng = np.random.default_rng(5)
    missed, false_alarms, unknown = [], [], []
    for _ in range(100):
        seen, coming = scored_episodes(rng, 400, 2.0), scored_episodes(rng, 400, 2.0)
        found = calibrate(*seen, kind=PLAN, miss_rate=0.05, false_alarm_rate=0.1)
        score, label = coming
        verdict = found.verdicts(1.0 - score)
        missed.append(np.mean(verdict[label] == SAFE))
        false_alarms.append(np.mean(verdict[~label] == UNSAFE))
        unknown.append(np.mean(verdict == UNKNOWN))
    assert 0.04 <= np.mean(missed) <= 0.052
    assert 0.085 <= np.mean(false_alarms) <= 0.104
    assert np.mean(unknown) > 0.1


def test_classes_that_lie_apart_leave_nothing_unknown():
    score = np.concatenate([np.linspace(0.0, 0.2, 50), np.linspace(0.8, 1.0, 50)])
    found = calibrate(score, score > 0.5, kind=PLAN, miss_rate=0.05, false_alarm_rate=0.05)
    assert found.unsafe_below == found.threshold
    assert (found.num_missed, found.num_accepted) == (1, 50)
    assert UNKNOWN not in found.verdicts(np.linspace(0, 1, 11))


def test_the_verdict_changes_at_the_thresholds_and_nan_is_not_known():
    verdicts = made().verdicts(np.array([0.8, 0.79, 0.3, 0.29, np.nan]))
    assert verdicts.tolist() == [SAFE, UNKNOWN, UNKNOWN, UNSAFE, UNKNOWN]


def test_a_calibration_says_what_it_promises_and_refuses_what_cannot_be():
    assert made().promise == (
        "at most 5 % of unsafe episodes called safe, on average, "
        "on the plant 'nominal' as long as it behaves as in its episodes"
    )
    assert made().origin == (
        f"calibrated on {made().num_unsafe + made().num_safe} episodes for a promised miss rate: "
        f"{made().promise}"
    )
    assert made(confidence=0.95).promise.startswith(
        "at most 5 % of unsafe episodes called safe, 95 % confidence, on the plant 'nominal'"
    )
    assert Calibration(**made().to_json()) == made()


def test_a_plan_is_scored_by_its_first_row_and_a_motion_by_its_worst():
    segments = SimpleNamespace(
        episode=np.array([2, 2, 2, 5, 5]),
        is_first=np.array([True, False, False, True, False]),
        is_unsafe=np.array([True, True, True, False, False]),
    )
    score = np.array([0.2, 0.9, 0.4, 0.1, np.nan])
    plan, label = episode_scores(segments, score, PLAN)
    np.testing.assert_array_equal(plan, [0.2, 0.1])
    np.testing.assert_array_equal(label, [True, False])
    motion, label = episode_scores(segments, score, MOTION)
    np.testing.assert_array_equal(motion, [0.9, math.inf])
    np.testing.assert_array_equal(label, [True, False])


def threshold_of(score, is_unsafe, **options):
    return score_threshold(np.array(score), np.array(is_unsafe), 0.1, **options)


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (
            lambda: threshold_of([0.1, 0.2], [False, False]),
            "at least 9 unsafe .* of 2 episodes 0 are",
        ),
        (lambda: threshold_of([0.1, 0.2], [True, False], confidence=0.95), "29 unsafe .*; of 2"),
        (lambda: threshold_of([np.nan, np.nan], [True, False]), "none of the 2 scores is finite"),
        (
            lambda: threshold_of([0.1], [True], confidence=1.0),
            "confidence is 1.0, expected a value",
        ),
        (lambda: threshold_of([0.1], [1]), "labels must be boolean"),
        (lambda: threshold_of([0.1, 0.2], [True]), "must be of equal length"),
        (
            lambda: calibrate(np.arange(30), np.arange(30) > 4, kind=PLAN, miss_rate=0.05),
            "needs at least 19 safe episodes; of 30 episodes 5 are",
        ),
        (lambda: allowed_misses(100, 0.0), r"miss_rate is 0\.0, expected a value in"),
        (lambda: episodes_needed(1.0), r"miss_rate is 1\.0, expected a value in"),
        (lambda: made(miss_rate=2.0), "miss_rate\n .* less than or equal to 1 .*input_value=2.0"),
        (lambda: made(unsafe_below=0.9), r"unsafe_below is 0\.9, .* the threshold 0\.8"),
        (lambda: episode_scores(None, None, "walk"), "unknown kind 'walk'"),
    ],
)
def test_a_promise_that_cannot_be_kept_is_refused(ask, message):
    with pytest.raises(ValueError, match=message):
        ask()
