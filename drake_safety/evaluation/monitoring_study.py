"""Detection rate, lead time and false-alarm rate of alarms on pushed motions.

In a motion that stays in the safe set every alarm is false, and so is any alarm before the push. A
detection is an alarm between the push and the instant at which the robot leaves the safe set.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_safety.evaluation.alarms import Alarm
from drake_safety.evaluation.metrics import Estimate, auc, median, proportion
from drake_safety.evaluation.scorers import Scorer
from drake_safety.simulation.watched_motion import SEEN, WatchedMotion

FALSE_ALARM_SHARE = 0.05
"""Allowed share of safe calibration motions with a false alarm, the same for all alarms."""
_SLACK_S = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class MonitoringStudy:
    """The result of :func:`evaluate_alarms`.

    Attributes:
        estimates: By dotted key.
        thresholds: By alarm, the value below which it is raised.
        unsafe_score: By alarm, minus the lowest value of each motion, (N,).
        is_unsafe: Whether each motion leaves the safe set, (N,).
        lead_s: By alarm, the lead time of each motion that leaves the safe set [s]; negative for a
            late alarm, minus infinity for none.
    """

    estimates: dict[str, Estimate]
    thresholds: dict[str, float]
    unsafe_score: dict[str, np.ndarray]
    is_unsafe: np.ndarray
    lead_s: dict[str, np.ndarray]


def begun(
    motions: Sequence[WatchedMotion], scorer: Scorer, threshold: float
) -> list[WatchedMotion]:
    """The motions whose plan is accepted at their first row, so that the robot begins them.

    Args:
        motions: Motions, pushed or not.
        scorer: Scorer of the plans.
        threshold: Lowest safety probability of an accepted plan.
    """
    if not motions:
        return []
    first_rows = (np.stack([getattr(motion, name)[0] for motion in motions]) for name in SEEN)
    is_accepted = scorer.probability(*first_rows) >= threshold
    return [motion for motion, begins in zip(motions, is_accepted, strict=True) if begins]


def first_alarm(
    motion: WatchedMotion, value: np.ndarray, threshold: float, *, since_s: float = 0.0
) -> float:
    """Time of the first value below a threshold [s]; infinite if there is none.

    Args:
        motion: The motion.
        value: Value of each row, (N,); NaN is below every threshold.
        threshold: The threshold.
        since_s: Earliest time that counts [s].
    """
    is_alarm = ~(value >= threshold) & (motion.time_s >= since_s - _SLACK_S)
    return float(motion.time_s[int(np.argmax(is_alarm))]) if is_alarm.any() else math.inf


def lowest_value(motion: WatchedMotion, value: np.ndarray) -> float:
    """The lowest value of a motion; if it leaves the safe set, from the push until then.

    Args:
        motion: The motion.
        value: Value of each row, (N,); NaN is minus infinity.
    """
    value = np.where(np.isnan(value), -math.inf, value)
    if motion.has_left:
        time = motion.time_s
        value = value[
            (time >= motion.push_time_s - _SLACK_S) & (time < motion.leave_time_s - _SLACK_S)
        ]
    return float(value.min(initial=math.inf))


def persisting(value: np.ndarray, num_rows: int) -> np.ndarray:
    """The largest of each value and those before it, (N,); NaN is minus infinity.

    Args:
        value: Value of each row, (N,).
        num_rows: Number of values, of which those before the first are infinite.
    """
    value = np.where(np.isnan(value), -math.inf, value)
    padded = np.concatenate([np.full(num_rows - 1, math.inf), value])
    return np.lib.stride_tricks.sliding_window_view(padded, num_rows).max(axis=1)


def equal_share_threshold(lowest: np.ndarray, share: float) -> float:
    """The highest threshold with which at most a share of motions has an alarm.

    Args:
        lowest: Lowest value of each motion that stays safe, (N,).
        share: The share, in [0, 1).

    Raises:
        ValueError: There is no motion, or the share is out of range.
    """
    if not 0 <= share < 1:
        raise ValueError(f"monitoring: the share of false alarms must be in [0, 1); got {share}")
    if len(lowest) == 0:
        raise ValueError("monitoring: no calibration motion stays in the safe set")
    return float(np.sort(lowest)[math.floor(share * len(lowest))])


def rate_per_hour(count: int, duration_s: float, n: int, *, confidence: float = 0.95) -> Estimate:
    """Events per hour, with the exact interval of a Poisson process.

    Args:
        count: Number of events.
        duration_s: Observed time [s].
        n: Number of observed motions.
        confidence: Confidence of the interval.
    """
    from scipy.stats import chi2

    if not duration_s > 0:
        return Estimate.exact(math.nan, n)
    tail = 0.5 * (1.0 - confidence)
    hours = duration_s / 3600.0
    low = 0.5 * chi2.ppf(tail, 2 * count) if count else 0.0
    high = 0.5 * chi2.ppf(1.0 - tail, 2 * count + 2)
    return Estimate(count / hours, float(low / hours), float(high / hours), n)


def evaluate_alarms(
    alarms: Sequence[Alarm],
    calibration: Sequence[WatchedMotion],
    test: Sequence[WatchedMotion],
    *,
    false_alarm_share: float = FALSE_ALARM_SHARE,
    num_rows: int = 1,
) -> MonitoringStudy:
    """Compares alarms at the same share of false alarms on calibration motions.

    Motions that leave the safe set before the push are left out.

    Args:
        alarms: The alarms.
        calibration: Motions on which thresholds are chosen.
        test: Fresh motions.
        false_alarm_share: Allowed share of safe calibration motions with a false alarm.
        num_rows: Successive rows below the threshold that give an alarm.

    Raises:
        ValueError: No calibration motion stays safe, or the share is out of range.
    """
    calm = [motion for motion in calibration if not motion.has_left]
    judged = [motion for motion in test if not motion.leave_time_s < motion.push_time_s]
    is_unsafe = np.array([motion.has_left for motion in judged], dtype=bool)
    index = np.array([motion.index for motion in judged])
    estimates = _motion_estimates(judged, len(test))
    thresholds, scores, leads = {}, {}, {}
    for alarm in alarms:
        lowest = np.array(
            [lowest_value(one, persisting(alarm.value(one), num_rows)) for one in calm]
        )
        threshold = equal_share_threshold(lowest, false_alarm_share)
        values = [persisting(alarm.value(motion), num_rows) for motion in judged]
        score = -np.array([lowest_value(m, v) for m, v in zip(judged, values, strict=True)])
        found, lead_s = _alarm_estimates(judged, values, threshold)
        found["auc"] = auc(score, is_unsafe, index)
        found["threshold"] = Estimate.exact(threshold, len(calm))
        estimates |= {f"monitoring.{alarm.name}.{key}": estimate for key, estimate in found.items()}
        thresholds[alarm.name], scores[alarm.name], leads[alarm.name] = threshold, score, lead_s
    return MonitoringStudy(
        estimates=estimates,
        thresholds=thresholds,
        unsafe_score=scores,
        is_unsafe=is_unsafe,
        lead_s=leads,
    )


def _motion_estimates(judged: Sequence[WatchedMotion], num_test: int) -> dict[str, Estimate]:
    """Estimates of the motions themselves, the same for all alarms."""
    left = [motion for motion in judged if motion.has_left]
    hours = sum(float(motion.time_s[-1]) for motion in judged if not motion.has_left) / 3600.0
    return {
        "monitoring.motions.left_out": proportion(num_test - len(judged), num_test),
        "monitoring.motions.leave_safe_set": proportion(len(left), len(judged)),
        "monitoring.motions.fall": proportion(sum(m.has_fallen for m in left), len(judged)),
        "monitoring.motions.safe_hours": Estimate.exact(hours, len(judged) - len(left)),
        "monitoring.motions.push_to_leaving_s": median(
            np.array([motion.leave_time_s - motion.push_time_s for motion in left])
        ),
    }


def _alarm_estimates(
    judged: Sequence[WatchedMotion], values: Sequence[np.ndarray], threshold: float
) -> tuple[dict[str, Estimate], np.ndarray]:
    """Estimates of one alarm, and its lead times.

    Args:
        judged: The N motions.
        values: Values of the alarm at each row of the motions.
        threshold: Threshold of the alarm.
    """
    watched = list(zip(judged, values, strict=True))
    safe = [(motion, value) for motion, value in watched if not motion.has_left]
    left = [(motion, value) for motion, value in watched if motion.has_left]
    false = sum(math.isfinite(first_alarm(motion, value, threshold)) for motion, value in safe)
    early = sum(
        first_alarm(motion, value, threshold) < motion.push_time_s - _SLACK_S
        for motion, value in watched
    )
    safe_s = sum(float(motion.time_s[-1]) for motion, _ in safe)
    undisturbed_s = sum(min(motion.push_time_s, float(motion.time_s[-1])) for motion in judged)
    alarm_s = np.array(
        [first_alarm(motion, v, threshold, since_s=motion.push_time_s) for motion, v in left]
    )
    leave = np.array([motion.leave_time_s for motion, _ in left])
    pushed = np.array([motion.push_time_s for motion, _ in left])
    fall = np.array([motion.fall_time_s for motion, _ in left])
    has_fallen = np.isfinite(fall)
    lead_s = leave - alarm_s
    return {
        "detected": proportion(int(np.sum(alarm_s < leave - _SLACK_S)), len(left)),
        "lead_to_leaving_s": median(lead_s),
        "falls_detected": proportion(
            int(np.sum(alarm_s[has_fallen] < fall[has_fallen] - _SLACK_S)), int(has_fallen.sum())
        ),
        "lead_to_fall_s": median(fall[has_fallen] - alarm_s[has_fallen]),
        "after_push_s": median(alarm_s - pushed),
        "false_alarm_share": proportion(false, len(safe)),
        "false_alarms_per_hour": rate_per_hour(false, safe_s, len(safe)),
        "undisturbed_false_alarms_per_hour": rate_per_hour(early, undisturbed_s, len(judged)),
    }, lead_s
