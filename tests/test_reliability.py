import numpy as np
import pytest

from drake_safety.evaluation.metrics import proportion
from drake_safety.evaluation.reliability import reliability, verdict_shares
from drake_safety.learning.calibration import PLAN, calibrate
from lip_assessments import scored_episodes


def once(p, label, **options):
    return reliability(p, label, np.arange(len(p)), **options)


def test_every_episode_has_one_verdict():
    found = calibrate(*scored_episodes(np.random.default_rng(2)), kind=PLAN, miss_rate=0.05)
    score, label = scored_episodes(np.random.default_rng(3), n=400)
    shares = {name: one.value for name, one in verdict_shares(found, score, label).items()}
    assert shares["promised_miss_rate"] == 0.05
    of_safe = shares["safe_recall"] + shares["safe_unknown"] + shares["false_alarm_rate"]
    assert of_safe == pytest.approx(1.0)
    assert shares["miss_rate"] == np.mean(score[label] <= 1.0 - found.threshold)
    assert shares["unsafe_unknown"] > 0.0


def test_probabilities_that_come_true_lie_on_the_diagonal_and_overconfident_ones_do_not():
    rng = np.random.default_rng(4)
    p = rng.random(20000)
    label = rng.random(20000) < p
    true = once(p, label)
    assert true.error < 0.02
    for expected, observed in zip(true.expected, true.observed, strict=True):
        assert observed.low <= expected <= observed.high
    # As far from one half again as it should be, where that is possible: off by |p - 1/2|.
    bold = once(np.clip(2.0 * p - 0.5, 0.0, 1.0), label)
    assert bold.error == pytest.approx(0.125, abs=0.02)


def test_equal_probabilities_share_a_bin():
    one = once(np.array([0.2, 0.2, 0.2, 1.0]), np.array([True, False, False, True]))
    np.testing.assert_allclose(one.expected, [0.2, 1.0])
    assert one.observed == [proportion(1, 3), proportion(1, 1)]
    assert one.error == pytest.approx(3 / 4 * (1 / 3 - 0.2))


def test_repeating_the_rows_of_an_episode_adds_no_certainty():
    score, label = scored_episodes(np.random.default_rng(5), n=200)
    rows = (np.repeat(score, 20), np.repeat(label, 20))
    often = reliability(*rows, np.repeat(np.arange(200), 20), num_bins=2)
    independent = reliability(*rows, np.arange(4000), num_bins=2)
    single = once(score, label, num_bins=2)
    for many, alone, few in zip(often.observed, independent.observed, single.observed, strict=True):
        assert many.n == few.n == alone.n / 20
        assert many.high - many.low > 3.0 * (alone.high - alone.low)
        assert many.high - many.low == pytest.approx(few.high - few.low, rel=0.3)
    assert often.error == pytest.approx(single.error)
