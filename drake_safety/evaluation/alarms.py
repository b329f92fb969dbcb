"""Alarms: monitored values that raise an alarm when they fall below a threshold.

A value is larger where the robot is safer: Γ, the probability of a baseline classifier, or a
quantity that control engineers monitor, such as a margin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_safety.evaluation.scorers import Scorer, assessment_scorer
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.prediction import CALIBRATED, LITERAL, NORMALIZED
from drake_safety.simulation.watched_motion import WatchedMotion

PUBLISHED = {"": NORMALIZED, "_literal": LITERAL, "_calibrated": CALIBRATED}
"""Fields of an assessment's result, by the suffix of the alarm's name."""
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


def assessment_alarms(name: str, assessment: SafetyAssessment) -> list[Alarm]:
    """Alarms on normalised, literal and calibrated Γ.

    Args:
        name: Key of the first, and prefix of the others.
        assessment: A fitted assessment; without heads there is no calibrated Γ.
    """
    has_heads = assessment.base_logit_ is not None
    return [
        scorer_alarm(assessment_scorer(f"{name}{suffix}", assessment, published))
        for suffix, published in PUBLISHED.items()
        if has_heads or published != CALIBRATED
    ]


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
