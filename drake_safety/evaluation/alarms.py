"""Alarms: monitored values that raise an alarm when they fall below a threshold.

A value is larger where the robot is safer: the probability of an assessment or of a baseline
classifier, or a quantity that control engineers monitor, such as a margin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_safety.evaluation.scorers import Scorer
from drake_safety.simulation.watched_motion import WatchedMotion

_ROTATION = ("rotation_x", "rotation_y", "rotation_z")
_TRACKING = "tracking_error_"


@dataclass(frozen=True, kw_only=True)
class Alarm:
    """A monitored value.

    Attributes:
        name: Its key in tables.
        value: Maps a motion to the value of each row, (N,); NaN means "don't know", an alarm.
    """

    name: str
    value: Callable[[WatchedMotion], np.ndarray]


def scorer_alarm(scorer: Scorer) -> Alarm:
    """An alarm on the safety probability of a scorer."""
    return Alarm(
        name=scorer.name,
        value=lambda motion: scorer.probability(
            motion.state, motion.desired_preview, motion.features
        ),
    )


def threshold_alarms(
    state_names: Sequence[str], feature_names: Sequence[str], watched: Mapping[str, str]
) -> list[Alarm]:
    """Baseline alarms on recorded quantities.

    They are the features that the task names, such as the margins of base and capture point to the
    edge of the support polygon; the tracking error; the base's tilt; and the smallest margin of the
    safe set. The last uses the true state, which cannot be measured, and so has an advantage.

    Args:
        state_names: Columns of the state.
        feature_names: Columns of the features.
        watched: Monitored features, by the name of the alarm.

    Raises:
        ValueError: A monitored feature does not exist.
    """
    features, states = list(feature_names), list(state_names)
    unknown = [name for name in watched.values() if name not in features]
    if unknown:
        raise ValueError(f"alarms: there are no features {unknown}; the features are {features}")

    def of_feature(column: int) -> Callable[[WatchedMotion], np.ndarray]:
        return lambda motion: motion.features[:, column]

    alarms = [
        Alarm(name=name, value=of_feature(features.index(feature)))
        for name, feature in watched.items()
    ]
    tracking = [i for i, name in enumerate(features) if name.startswith(_TRACKING)]
    if tracking:
        alarms.append(
            Alarm(
                name="tracking_error",
                value=lambda motion: -np.linalg.norm(motion.features[:, tracking], axis=1),
            )
        )
    if set(_ROTATION) <= set(states):
        rotation = [states.index(name) for name in _ROTATION]
        alarms.append(Alarm(name="tilt", value=lambda motion: -tilt(motion.state[:, rotation])))
    alarms.append(Alarm(name="smallest_margin", value=lambda motion: motion.margins.min(axis=1)))
    return alarms


def tilt(rotation: np.ndarray) -> np.ndarray:
    """Angle between a body's z axis and the vertical [rad], (N,).

    Args:
        rotation: Rotation vectors, (N, 3) [rad].
    """
    angle = np.linalg.norm(rotation, axis=1)
    share = np.divide(
        rotation[:, 2], angle, out=np.ones_like(angle), where=(angle > 0) | np.isnan(angle)
    )
    # R_zz of Rodrigues' formula.
    cosine = np.cos(angle)
    return np.arccos(np.clip(cosine + share**2 * (1.0 - cosine), -1.0, 1.0))
