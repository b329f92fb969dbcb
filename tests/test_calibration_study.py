import numpy as np
import pytest

from drake_safety.evaluation.calibration_study import (
    reliability,
    repeated_splits,
    verdict_shares,
)
from drake_safety.evaluation.reliability_figure import reliability_figure
from drake_safety.learning.calibration import PLAN, calibrate


def episodes(rng, n=1000):
    label = rng.random(n) < 0.5
    return 1.0 / (1.0 + np.exp(-(rng.normal(size=n) + 3.0 * (label - 0.5)))), label


@pytest.fixture(scope="module")
def kept():
    return repeated_splits(*episodes(np.random.default_rng(0)), num_splits=200)


def test_promises_are_kept_on_the_half_that_was_not_calibrated_with(kept):
    assert [one.miss_rate for one in kept] == [0.01, 0.05, 0.1]
    for one in kept:
        assert one.is_kept
        assert one.observed.low <= one.miss_rate <= one.observed.high
        assert one.observed.value <= 1.15 * one.miss_rate


def test_what_is_promised_is_paid_for_in_safe_recall(kept):
    recalls = [one.safe_recall.value for one in kept]
    assert recalls == sorted(recalls)
    assert recalls[0] < recalls[2] - 0.2
    assert kept[0].safe_recall.low < recalls[0] < kept[0].safe_recall.high


def test_with_confidence_fewer_splits_break_the_promise(kept):
    sure = repeated_splits(*episodes(np.random.default_rng(0)), miss_rates=[0.1], confidence=0.95)
    assert sure[0].share_broken < 0.5 * kept[2].share_broken
    assert sure[0].safe_recall.value < kept[2].safe_recall.value


def test_a_promise_that_takes_more_episodes_says_how_many():
    score, label = episodes(np.random.default_rng(1), n=100)
    few = repeated_splits(score, label, miss_rates=[0.01, 0.1], num_splits=5)
    assert (few[0].num_needed, few[0].num_calibration) == (99, label.sum() // 2)
    assert few[0].observed.n == 0
    assert np.isnan(few[0].observed.value)
    assert few[1].observed.n == label.sum()
    with pytest.raises(ValueError, match="of 100 episodes 0 are unsafe; it takes two"):
        repeated_splits(score, np.zeros(100, dtype=bool))


def test_every_episode_has_one_verdict():
    found = calibrate(*episodes(np.random.default_rng(2)), kind=PLAN, miss_rate=0.05)
    score, label = episodes(np.random.default_rng(3), n=400)
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
    true = reliability(p, label)
    assert true.calibration_error < 0.02
    assert np.all((true.low <= true.expected) & (true.expected <= true.high))
    # As far from one half again as it should be, where that is possible: off by |p - 1/2|.
    bold = reliability(np.clip(2.0 * p - 0.5, 0.0, 1.0), label)
    assert bold.calibration_error == pytest.approx(0.125, abs=0.02)


def test_equal_probabilities_share_a_bin_and_not_knowing_is_certainty():
    one = reliability(np.array([0.2, 0.2, 0.2, np.nan]), np.array([True, False, False, True]))
    np.testing.assert_allclose(one.expected, [0.2, 1.0])
    np.testing.assert_allclose(one.observed, [1 / 3, 1.0])
    np.testing.assert_array_equal(one.count, [3, 1])
    assert one.calibration_error == pytest.approx(3 / 4 * (1 / 3 - 0.2))


def test_what_is_no_probability_is_refused():
    with pytest.raises(ValueError, match=r"in \[0, 1\], got 1 of them in 2.0..2.0"):
        reliability(np.array([2.0]), np.array([True]))


def test_the_diagram_shows_each_curve_with_its_error():
    label = np.array([True, False] * 20)
    one = reliability(np.linspace(0, 1, 40), label)
    fig = reliability_figure({"sharpened": one, "paper": one})
    (legend,) = fig.legends
    told = [text.get_text() for text in legend.get_texts()]
    assert told == [f"{name}   {one.calibration_error:.3f}" for name in ("sharpened", "paper")]
