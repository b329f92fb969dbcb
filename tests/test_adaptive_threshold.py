import math

import numpy as np
import pytest

from drake_safety.learning.adaptive_threshold import AdaptiveThreshold
from drake_safety.learning.calibration import PLAN, calibrate


def promised(miss_rate=0.05, num=2000, seed=0):
    rng = np.random.default_rng(seed)
    is_unsafe = rng.random(num) < 0.5
    gamma = 1.0 / (1.0 + np.exp(-rng.normal(np.where(is_unsafe, -2.0, 2.0))))
    return calibrate(1.0 - gamma, is_unsafe, kind=PLAN, miss_rate=miss_rate)


def outcomes(mean_unsafe, num, seed=1):
    """Γ of unsafe episodes, which a shift makes look safer."""
    rng = np.random.default_rng(seed)
    return 1.0 / (1.0 + np.exp(-rng.normal(mean_unsafe, size=num)))


@pytest.mark.parametrize("mean_unsafe", [-2.0, 1.0, 4.0])
@pytest.mark.parametrize("step", [0.3, 1.0])
def test_the_miss_rate_is_kept_under_any_shift(mean_unsafe, step):
    calibration = promised()
    adaptive = AdaptiveThreshold(calibration, step)
    gammas = outcomes(mean_unsafe, 4000)
    missed = []
    for gamma in gammas:
        missed.append(adaptive.is_safe(gamma))
        adaptive.update(gamma, True)
    for num in (50, 500, 4000):
        assert np.mean(missed[:num]) <= 0.05 + (24 / step + 1) / num
    assert np.mean(missed[1000:]) == pytest.approx(0.05, abs=0.02)
    fixed = np.mean(gammas >= calibration.threshold)
    assert (fixed > 0.9) == (mean_unsafe == 4.0)


def test_safe_episodes_change_nothing_and_the_verdict_is_that_of_the_threshold():
    calibration = promised()
    adaptive = AdaptiveThreshold(calibration)
    adaptive.update(0.1, False)
    assert adaptive.threshold == pytest.approx(calibration.threshold)
    assert adaptive.is_safe(calibration.threshold + 1e-6)
    assert not adaptive.is_safe(calibration.threshold - 1e-6)
    assert not adaptive.is_safe(math.nan)


def test_misses_at_the_highest_probability_end_in_refusing_everything():
    adaptive = AdaptiveThreshold(promised())
    for _ in range(30):
        adaptive.update(1.0, True)
    assert adaptive.threshold > 1.0
    assert not adaptive.is_safe(1.0)


@pytest.mark.parametrize("step", [0.0, -1.0, math.inf, math.nan])
def test_a_step_that_is_not_positive_is_refused(step):
    with pytest.raises(ValueError, match="step must be positive"):
        AdaptiveThreshold(promised(), step)
