"""The probability of a fall, fitted to episodes that go on after they leave the safe set.

Γ has learned whether an episode leaves the safe set, which a walking robot often does without a
fall. A logistic function of its outputs and of a few features ranks falls against all else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from drake_safety.evaluation.shift_study import SEEN
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.motion import Motion
from studies.alarms import TRACKING, Alarm

_LOGIT_LIMIT = 8.0
_INVERSE_PENALTY = 0.01  # Of inputs with unit variance.


def fit_fall_alarm(
    assessment: SafetyAssessment,
    episodes: Sequence[Motion],
    feature_names: Sequence[str],
    watched: Mapping[str, str],
) -> Alarm:
    """Fits the logit of a fall to the rows of episodes before it, and returns minus the logit.

    Its inputs are the predicted margins, the logit of the probability, the features that the task
    watches and the tracking errors.

    Args:
        assessment: Γ, with a margin head.
        episodes: Episodes that go on after they leave the safe set.
        feature_names: Columns of the features.
        watched: Features that the task watches, by alarm.

    Raises:
        ValueError: No episode ends in a fall, or every one does.
    """
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    num_falls = sum(motion.has_fallen for motion in episodes)
    if num_falls in (0, len(episodes)):
        raise ValueError(
            f"fit_fall_alarm: {num_falls} of {len(episodes)} episodes end in a fall; it takes both"
        )
    columns = [
        i
        for i, name in enumerate(feature_names)
        if name in watched.values() or name.startswith(TRACKING)
    ]

    def inputs(motion: Motion) -> np.ndarray:
        result = assessment.predict(*(motion[port] for port in SEEN))
        with np.errstate(divide="ignore"):
            logit = np.log(result.probability) - np.log1p(-result.probability)
        logit = np.clip(logit, -_LOGIT_LIMIT, _LOGIT_LIMIT)
        features = motion["features"][:, columns]
        return np.concatenate([result.predicted_margins, logit[:, None], features], axis=1)

    rows, labels = [], []
    for motion in episodes:
        found = inputs(motion)
        is_used = np.isfinite(found).all(axis=1) & (motion.time_s < motion.fall_time_s)
        is_used[: motion.first_row] = False
        rows.append(found[is_used])
        labels.append(np.full(len(rows[-1]), motion.has_fallen))
    model = make_pipeline(StandardScaler(), LogisticRegression(C=_INVERSE_PENALTY, max_iter=500))
    model.fit(np.concatenate(rows), np.concatenate(labels))

    def value(motion: Motion) -> np.ndarray:
        found = inputs(motion)
        is_known = np.isfinite(found).all(axis=1)
        logit = np.full(len(found), np.nan)
        if is_known.any():
            logit[is_known] = -model.decision_function(found[is_known])
        return logit

    return Alarm(name="fall", value=value)
