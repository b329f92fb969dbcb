import math
from types import SimpleNamespace

import numpy as np
import pytest

from drake_safety.evaluation.metrics import area_under_curve
from drake_safety.simulation.motion import Motion
from studies.fall_alarm import fit_fall_alarm

pytestmark = pytest.mark.train
NAMES = ("watched", "tracking_error_x", "other")


def predict(state, preview, features):
    """Margins that tell leaving from falling, and a probability that does not."""
    return SimpleNamespace(predicted_margins=state, probability=np.zeros(len(state)))


GAMMA = SimpleNamespace(predict=predict)


def episodes(seed, num=60):
    rng = np.random.default_rng(seed)
    found = []
    for i in range(num):
        falls = i % 3 == 0
        state = rng.normal(size=(10, 2)) - [0.0, 2.0 * falls]
        features = rng.normal(size=(10, 3))
        features[0, 1] = np.nan
        found.append(
            Motion(
                time_s=0.1 * np.arange(10),
                ports={"state": state, "desired_preview": features, "features": features},
                fall_time_s=0.8 if falls else math.inf,
            )
        )
    return found


def fitted(motions):
    return fit_fall_alarm(GAMMA, motions, NAMES, {"alarm": "watched"})


def test_it_ranks_rows_before_a_fall_and_knows_nothing_of_those_that_are_not_finite():
    alarm, fresh = fitted(episodes(0)), episodes(1)
    values = [alarm.value(motion) for motion in fresh]
    assert alarm.name == "fall" and all(np.isnan(value[0]) for value in values)
    score = np.concatenate([-value[1:8] for value in values])
    label = np.repeat([motion.has_fallen for motion in fresh], 7)
    assert area_under_curve(score, label) > 0.9


def test_neither_the_fallen_robot_nor_another_feature_matters():
    motions = episodes(2)
    before = fitted(motions).value(motions[1])
    for motion in motions:
        motion["state"][motion.time_s >= motion.fall_time_s] = 100.0
        motion["features"][:, 2] = 7.0
    np.testing.assert_allclose(fitted(motions).value(motions[1]), before)


def test_without_a_fall_there_is_nothing_to_learn():
    with pytest.raises(ValueError, match="0 of 40 episodes end in a fall"):
        fitted([motion for motion in episodes(3) if not motion.has_fallen])
