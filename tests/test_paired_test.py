"""Sequential tests: the law of every bet, and thousands of replays."""

import math

import numpy as np
import pytest

import naive
from drake_safety.evaluation.paired_test import _SHARES, _WEIGHTS, betting_log_e, interim_estimate

ALPHA = 0.05
NUM_REPLAYS = 500


def failures(rng, baseline, candidate, num_pairs, shared):
    """Differences of two loops that share a part of the baseline's failures, (replays, pairs)."""
    common = shared * baseline
    draw = rng.random((3, NUM_REPLAYS, num_pairs), dtype=np.float32)
    both = draw[0] < common
    one, two = (draw[i + 1] < (p - common) for i, p in enumerate((baseline, candidate)))
    return (both | two).astype(np.int8) - (both | one).astype(np.int8)


@pytest.mark.parametrize("is_above", [True, False])
@pytest.mark.parametrize("mean", [-0.6, 0.02])
def test_the_capital_is_that_of_one_bet_after_the_other(mean, is_above):
    outcomes = np.random.default_rng(1).choice([-1.0, -0.3, 0.0, 0.25, 1.0], 60)
    values, counts = np.unique(outcomes, return_counts=True)
    expected = naive.capital(outcomes, mean, _SHARES, _WEIGHTS, is_above)
    sign = 1 if is_above else -1
    found = betting_log_e(sign * values, counts, sign * mean)
    assert math.exp(found) == pytest.approx(expected)


def test_a_confidence_sequence_ends_where_the_capital_is_one_over_alpha():
    outcomes = np.random.default_rng(2).choice([-0.25, 0.0, 0.5, 1.0], 300)
    looks = []
    for n in (1, 60, 300):
        looks.append(interim_estimate(outcomes[:n], looks, ALPHA))
    assert [one.n for one in looks] == [1, 60, 300]
    first, *_, last = looks
    assert last.value == pytest.approx(outcomes.mean())
    assert -1 <= first.low <= looks[1].low <= last.low < last.value
    assert last.value < last.high <= looks[1].high <= first.high <= 1
    values, counts = np.unique(outcomes, return_counts=True)
    for sign, end in ((1, last.low), (-1, last.high)):
        log_e = betting_log_e(sign * values, counts, sign * end)
        assert log_e == pytest.approx(-math.log(ALPHA))
    # What a look has excluded stays so.
    first = interim_estimate(np.ones(50), [], ALPHA)
    assert interim_estimate(np.zeros(1000), [first], ALPHA).low == first.low > 0.8


REFERENCE_BETS = ((1, 0.0), (-1, 0.0), (-1, 0.05))


def spaced_failures(num_pairs):
    """Of 50 pairs the candidate fails alone in two and the baseline in one."""
    outcomes = np.zeros(2000)
    outcomes[7::25], outcomes[3::50] = 1.0, -1.0
    return outcomes[:num_pairs]


@pytest.mark.parametrize(
    ("num_pairs", "capitals", "low", "high", "theirs"),
    [
        (400, (1.68477147, 0.19746072, 4.44609599), -0.01692377, 0.05942813, 0.08605378),
        (2000, (128.682307, 0.06396619, 37395.6907), 0.00342914, 0.03727799, 0.03536122),
    ],
)
def test_capital_and_ends_are_those_of_confseq(num_pairs, capitals, low, high, theirs):
    # By confseq 0.0.11 (Waudby-Smith, Ramdas, Howard): betting_mart of (1 + outcome) / 2, for each
    # share u with bets u / m, theta 1 and trunc_scale 1, weighted; ends where that is 1 / ALPHA.
    # Theirs: the width of its predmix_empbern_cs with alpha 2 * ALPHA and running_intersection.
    outcomes = spaced_failures(num_pairs)
    values, counts = np.unique(outcomes, return_counts=True)
    log_e = [betting_log_e(sign * values, counts, sign * m) for sign, m in REFERENCE_BETS]
    assert np.exp(log_e) == pytest.approx(capitals)
    found = interim_estimate(outcomes, [], ALPHA)
    assert (found.low, found.high) == pytest.approx((low, high), abs=1e-7)
    assert found.high - found.low < theirs


@pytest.mark.parametrize("kind", [(0.02, 0.02, 0.0), (0.3, 0.3, 0.8), (0.05, 0.1, 0.0), "graded"])
def test_either_end_excludes_the_true_mean_in_at_most_a_share_alpha_of_replays(kind):
    rng = np.random.default_rng(4)
    if kind == "graded":
        grades, shares = [-1.0, -0.25, 0.0, 0.5, 1.0], [0.02, 0.1, 0.8, 0.05, 0.03]
        outcomes, mean = rng.choice(grades, (NUM_REPLAYS, 1600), p=shares), 0.01
        assert outcomes.mean() == pytest.approx(mean, abs=0.002)
    else:
        baseline, candidate, shared = kind
        outcomes, mean = failures(rng, baseline, candidate, 1600, shared), candidate - baseline
    values, looks = np.unique(outcomes), np.arange(4, 1601, 4)
    counts = np.stack([np.cumsum(outcomes == v, axis=1)[:, looks - 1] for v in values], axis=-1)
    for sign in (1, -1):
        log_e = betting_log_e(sign * values, counts, sign * mean)
        assert (log_e >= -math.log(ALPHA)).any(axis=1).mean() <= ALPHA
