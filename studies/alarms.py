"""Alarms on pushed motions: detection rate, lead time and false alarms.

An alarm is a monitored value, larger where the robot is safer, that falls below a threshold. In a
motion that stays in the safe set every alarm is false, and so is any before the push. A detection
is an alarm between the push and the instant at which the robot leaves the safe set.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from drake_safety.evaluation.metrics import Estimate, auc, median, proportion, rate_per_hour
from drake_safety.evaluation.results import Key
from drake_safety.evaluation.scorers import Scorer
from drake_safety.evaluation.shift_study import SEEN
from drake_safety.simulation.motion import Motion

FALSE_ALARM_SHARE = 0.05
"""Allowed share of safe calibration motions with a false alarm, the same for all alarms."""
NUM_ROWS = 2
"""Successive rows that give an alarm: a blow itself can make one row "don't know"."""
_ROTATION = ("rotation_x", "rotation_y", "rotation_z")
TRACKING = "tracking_error_"
"""Beginning of the names of features."""
_SLACK_S = 1e-9


class Alarm(NamedTuple):
    """A monitored value."""

    name: str  # Its key in tables.
    value: Callable[[Motion], np.ndarray]  # Of each row, (N,); NaN, "don't know", is an alarm.


def scorer_alarm(scorer: Scorer) -> Alarm:
    """An alarm on the safety probability of a scorer."""
    return Alarm(scorer.name, lambda one: scorer.probability(*(one[port] for port in SEEN)))


def threshold_alarms(
    state_names: Sequence[str], feature_names: Sequence[str], watched: Mapping[str, str]
) -> list[Alarm]:
    """Baseline alarms on recorded quantities.

    They are the features that the task names, such as the margins of base and capture point to the
    edge of the support polygon; the tracking error; the base's tilt; and the smallest margin of the
    safe set. The last uses the true state, which cannot be measured, and so has an advantage.
    """
    features, states = list(feature_names), list(state_names)

    def of_feature(column: int) -> Callable[[Motion], np.ndarray]:
        return lambda motion: motion["features"][:, column]

    values = {name: of_feature(features.index(feature)) for name, feature in watched.items()}
    if tracking := [i for i, name in enumerate(features) if name.startswith(TRACKING)]:
        values["tracking_error"] = lambda one: -np.linalg.norm(one["features"][:, tracking], axis=1)
    if set(_ROTATION) <= set(states):
        rotation = [states.index(name) for name in _ROTATION]
        values["tilt"] = lambda one: -tilt(one["state"][:, rotation])
    values["smallest_margin"] = lambda one: one["margins"].min(axis=1)
    return [*map(Alarm, values, values.values())]


def tilt(rotation: np.ndarray) -> np.ndarray:
    """Angle between a body's z axis and the vertical [rad], (N,), of rotation vectors (N, 3)."""
    return np.arccos(np.clip(Rotation.from_rotvec(rotation).as_matrix()[:, 2, 2], -1.0, 1.0))


def first_alarm(
    motion: Motion, value: np.ndarray, threshold: float, *, since_s: float = 0.0
) -> float:
    """Time of the first value below a threshold [s]; infinite if there is none."""
    is_alarm = ~(value >= threshold) & (motion.time_s >= since_s - _SLACK_S)
    return float(motion.time_s[int(np.argmax(is_alarm))]) if is_alarm.any() else math.inf


def lowest_value(motion: Motion, value: np.ndarray) -> float:
    """The lowest value (N,) of a motion; if it leaves the safe set, from the push until then."""
    value = np.where(np.isnan(value), -math.inf, value)
    if motion.has_left:
        time = motion.time_s
        value = value[
            (time >= motion.push_time_s - _SLACK_S) & (time < motion.leave_time_s - _SLACK_S)
        ]
    return float(value.min(initial=math.inf))


def persisting(value: np.ndarray, num_rows: int) -> np.ndarray:
    """The largest of each value and its predecessors, `num_rows` in all, (N,)."""
    value = np.where(np.isnan(value), -math.inf, value)
    padded = np.concatenate([np.full(num_rows - 1, math.inf), value])
    return np.lib.stride_tricks.sliding_window_view(padded, num_rows).max(axis=1)


def equal_share_threshold(lowest: np.ndarray, share: float) -> float:
    """The highest threshold with which at most a share of motions has an alarm."""
    if len(lowest) == 0:
        raise ValueError("alarms: no calibration motion stays in the safe set")
    return float(np.sort(lowest)[math.floor(share * len(lowest))])


def evaluate_alarms(
    alarms: Sequence[Alarm],
    calibration: Sequence[Motion],
    test: Sequence[Motion],
    *,
    num_rows: int = NUM_ROWS,
) -> dict[Key, Estimate]:
    """Compares alarms at the same share of false alarms on calibration motions.

    Motions that leave the safe set before the push are left out.
    """
    safe = [motion for motion in calibration if not motion.has_left]
    judged = [motion for motion in test if not motion.leave_time_s < motion.push_time_s]
    is_unsafe = np.array([motion.has_left for motion in judged], dtype=bool)
    index = np.array([motion.index for motion in judged])
    left = proportion(int(is_unsafe.sum()), len(judged))
    estimates = {("monitoring", "motions", "leave_safe_set"): left}
    for alarm in alarms:
        lowest = np.array([lowest_value(m, persisting(alarm.value(m), num_rows)) for m in safe])
        threshold = equal_share_threshold(lowest, FALSE_ALARM_SHARE)
        values = [persisting(alarm.value(motion), num_rows) for motion in judged]
        score = -np.array([lowest_value(m, v) for m, v in zip(judged, values, strict=True)])
        found = _alarm_estimates(judged, values, threshold)
        found["auc"] = auc(score, is_unsafe, index)
        estimates |= {("monitoring", alarm.name, key): one for key, one in found.items()}
    return estimates


def _alarm_estimates(
    judged: Sequence[Motion], values: Sequence[np.ndarray], threshold: float
) -> dict[str, Estimate]:
    watched = list(zip(judged, values, strict=True))
    safe = [(motion, value) for motion, value in watched if not motion.has_left]
    left = [(motion, value) for motion, value in watched if motion.has_left]
    false = sum(math.isfinite(first_alarm(motion, value, threshold)) for motion, value in safe)
    safe_s = sum(float(motion.time_s[-1]) for motion, _ in safe)
    alarm_s = np.array([first_alarm(m, v, threshold, since_s=m.push_time_s) for m, v in left])
    leave = np.array([motion.leave_time_s for motion, _ in left])
    return {
        "detected": proportion(int(np.sum(alarm_s < leave - _SLACK_S)), len(left)),
        "lead_to_leaving_s": median(leave - alarm_s),
        "false_alarms_per_hour": rate_per_hour(false, safe_s, len(safe)),
    }
