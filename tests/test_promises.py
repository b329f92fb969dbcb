import numpy as np

from lip_assessments import scored_episodes
from studies.promises import MISS_RATES, repeated_splits


def test_promises_are_kept_on_the_half_that_was_not_calibrated_with_and_paid_for():
    scored = scored_episodes(np.random.default_rng(0))
    kept = {miss_rate: repeated_splits(*scored, miss_rate) for miss_rate in MISS_RATES}
    for miss_rate, found in kept.items():
        assert found["missed"].low <= miss_rate <= found["missed"].high
        assert found["missed"].value <= 1.15 * miss_rate
    recalls = [found["safe_recall"].value for found in kept.values()]
    assert recalls[0] < recalls[2] - 0.2 and recalls == sorted(recalls)
    # With confidence fewer splits break the promise.
    sure = repeated_splits(*scored, 0.1, confidence=0.95)
    assert sure["broken"].value < 0.5 * kept[0.1]["broken"].value
    assert sure["safe_recall"].value < recalls[2]
    # A promise of 1 % takes 99 unsafe episodes in each half.
    score, label = scored_episodes(np.random.default_rng(1), n=100)
    assert repeated_splits(score, label, 0.01, num_splits=5) == {}
    assert repeated_splits(score, label, 0.1, num_splits=5)["missed"].n == label.sum()
