import numpy as np

from lip_assessments import scored_episodes
from studies.promises import repeated_splits


def test_promises_are_kept_on_the_half_that_was_not_calibrated_with_and_paid_for():
    kept = repeated_splits(*scored_episodes(np.random.default_rng(0)))
    assert [one.miss_rate for one in kept] == [0.01, 0.05, 0.1]
    for one in kept:
        assert one.observed.low <= one.miss_rate <= one.observed.high
        assert one.observed.value <= 1.15 * one.miss_rate
    recalls = [one.safe_recall.value for one in kept]
    assert recalls[0] < recalls[2] - 0.2 and recalls == sorted(recalls)
    # With confidence fewer splits break the promise.
    sure = repeated_splits(
        *scored_episodes(np.random.default_rng(0)), miss_rates=[0.1], confidence=0.95
    )
    assert sure[0].share_broken < 0.5 * kept[2].share_broken
    assert sure[0].safe_recall.value < recalls[2]


def test_a_promise_that_takes_more_episodes_says_how_many():
    score, label = scored_episodes(np.random.default_rng(1), n=100)
    few = repeated_splits(score, label, miss_rates=[0.01, 0.1], num_splits=5)
    assert (few[0].num_needed, few[0].num_calibration) == (99, label.sum() // 2)
    assert few[0].observed.n == 0
    assert np.isnan(few[0].observed.value)
    assert few[1].observed.n == label.sum()
