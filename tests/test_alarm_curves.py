import math

import numpy as np
import pytest

from drake_safety.simulation.motion import Motion
from studies.alarm_curves import SHARES, Watched, equal_cost_estimates
from studies.alarms import Alarm, first_alarm

ALARM = Alarm(name="value", value=lambda motion: motion["value"])
STEP_S = 0.1


def motion(values, **times):
    ports = {"value": np.array(values, dtype=float)}
    return Motion(time_s=STEP_S * np.arange(len(values)), ports=ports, **times)


def random_motions(rng, num=60):
    """Pushed at 0.2 s: a third falls at 0.8 s, a third leaves the safe set, a third does not."""
    found = []
    for i in range(num):
        values = rng.normal(size=9) - 0.5 * (i % 3 == 0)
        values[rng.random(9) < 0.03] = np.nan
        ends = ({"leave_time_s": 0.5, "fall_time_s": 0.8}, {"leave_time_s": 0.5}, {})[i % 3]
        found.append(motion(values, push_time_s=0.2, **ends))
    return found


TOURS = [motion([1, 0, 0, 0, 1, 0, 0]), motion([0, 1, 1, 2])]


def watched(pushed, tours=TOURS):
    return Watched.of(ALARM, pushed, tours)


def announced(one, share):
    return one.announced(share)(np.ones(len(one.lowest)))


def test_a_fall_is_announced_by_a_row_between_the_push_and_0_2_s_before_the_fall():
    ends = {"push_time_s": 0.2, "leave_time_s": 0.6, "fall_time_s": 0.7}
    in_time = motion([1, 1, 1, 1, 1, 0, 1, 1], **ends)
    late = motion([1, 1, 1, 1, 1, 1, 0, 0], **ends)
    too_early = motion([1, 0, 1, 1, 1, 1, 1, 1], **ends)
    at_once = motion([0, 0], push_time_s=0.0, leave_time_s=0.1, fall_time_s=0.1)
    survives = motion([1, 0.5, 1], push_time_s=0.1)
    found = watched([in_time, late, too_early, at_once, survives])
    np.testing.assert_array_equal(found.warning, [0, 1, 1, math.inf, math.inf])
    np.testing.assert_array_equal(found.lowest, [0, 0, 0, 0, 0.5])
    # Only the first has a lower value than the survivor.
    assert announced(found, 0.0) == 1 / 4


def test_at_every_share_the_highest_allowed_threshold_is_applied():
    pushed = random_motions(np.random.default_rng(1))
    found = watched(pushed)
    for share in (0.0, *SHARES, 0.97):
        threshold = found.threshold(share)
        others = found.lowest[found.others]
        assert np.mean(others < threshold) <= share < np.mean(others <= threshold)
        fallen = []
        for one in pushed[::3]:
            value = np.nan_to_num(one["value"], nan=-math.inf)
            alarm_s = first_alarm(one, value, threshold, since_s=0.2)
            fallen.append(one.fall_time_s - alarm_s >= 0.2 - 1e-9)
        assert announced(found, share) == pytest.approx(np.mean(fallen))


def test_a_false_alarm_is_a_row_below_the_threshold_after_one_that_is_not():
    found = watched([motion([0.5] * 9, push_time_s=0.2, leave_time_s=0.5, fall_time_s=0.8)])
    assert found.undisturbed_s == pytest.approx(0.9) and len(found.undisturbed) == 2
    assert [found.num_false_alarms(one) for one in (0, 0.5, 1.5, 3)] == [0, 3, 2, 2]
    unknown = watched([], [motion([1, np.nan, 1])])
    assert unknown.num_false_alarms(-1e9) == 1


def test_differences_are_paired_and_seeds_averaged():
    rng = np.random.default_rng(4)
    sets = [watched(random_motions(rng)) for _ in range(3)]
    methods = {"sharpened": sets[:1], "same": sets[:1], "other": sets[1:]}
    found = equal_cost_estimates(methods, "sharpened", "same")
    found |= equal_cost_estimates(methods, "sharpened", "other")
    shares = {
        method: one
        for (set, method, metric), one in found.items()
        if (set, metric) == ("alarm.without_leaving", "announced_at_20")
    }
    same = shares["sharpened_minus_same"]
    assert (same.value, same.low, same.high) == (0.0, 0.0, 0.0)
    ours, *each = (announced(one, 0.2) for one in sets)
    mean = shares["other"].value
    assert (shares["sharpened"].value, mean) == pytest.approx((ours, np.mean(each)))
    difference = shares["sharpened_minus_other"]
    assert difference.value == pytest.approx(ours - mean)
    assert difference.low < difference.value < difference.high
    rate = found["alarm.without_leaving", "sharpened", "false_alarms_per_hour_at_50"]
    threshold = sets[0].threshold(0.5)
    assert rate.value == pytest.approx(sets[0].num_false_alarms(threshold) * 3600 / 0.9)
