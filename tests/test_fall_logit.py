import copy
from dataclasses import replace

import numpy as np
import pytest

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.fall_logit import FallLogit
from drake_safety.learning.segments import DIVERGED, Episodes
from lip_assessments import quick_assessment
from lip_episodes import make_episodes

pytestmark = pytest.mark.train
INPUTS = ("state", "desired_preview", "features")


def until_falls(seed, num=160):
    """Episodes of which those that leave the safe set to the left end in a fall."""
    episodes = make_episodes(num, seed=seed, noise=0.002)
    falls = np.array([not e.is_safe and e.state[-1, 1] > 0.0 for e in episodes])
    pairs = zip(episodes, falls, strict=True)
    ended = [replace(e, is_safe=not fell, cause=e.cause if fell else "") for e, fell in pairs]
    return Episodes(episodes.info, ended), falls


@pytest.fixture(scope="module")
def fitted():
    assessment = quick_assessment("sharpened")
    return assessment.fit_falls(until_falls(11)[0], assessment.info_.state_names)


def rows_of(episodes):
    return [np.concatenate([getattr(episode, name) for episode in episodes]) for name in INPUTS]


def test_falls_are_told_from_other_ends(fitted):
    from sklearn.metrics import roc_auc_score

    _, falls = until_falls(12)
    left = [e for e in make_episodes(160, seed=12, noise=0.002) if not e.is_safe]
    said = fitted.predict(*(np.stack([getattr(e, name)[-2] for e in left]) for name in INPUTS))
    label = falls[[episode.index for episode in left]]
    assert 10 < label.sum() < len(label) - 10
    area = roc_auc_score(label, said.fall_probability)
    assert area > max(0.7, roc_auc_score(label, 1.0 - said.probability) + 0.1)


def test_row_alone_and_file_have_the_same_bits(fitted, tmp_path):
    rows = rows_of(until_falls(13, num=5)[0])
    rows[0][3, 1] = np.nan
    many = fitted.predict(*rows).fall_probability
    alone = [fitted.predict_one(*row).fall_probability for row in zip(*rows, strict=True)]
    np.testing.assert_array_equal(many, alone)
    # Certain where nothing is known.
    assert many[3] == 1.0 and (np.delete(many, 3) < 1.0).all()
    fitted.save(tmp_path / "file")
    read = SafetyAssessment.load(tmp_path / "file")
    np.testing.assert_array_equal(read.predict(*rows).fall_probability, many)
    assert read.used_[-1].purpose == "falls"


def test_what_cannot_be_learned_from_is_refused(fitted):
    before = copy.copy(fitted)
    episodes, _ = until_falls(14, num=40)
    with pytest.raises(ValueError, match=r"unknown features \['nowhere'\]"):
        before.fit_falls(episodes, ["nowhere"])
    with pytest.raises(ValueError, match="seed 0 gives episodes that start as"):
        before.fit_falls(until_falls(0, num=40)[0], [])
    safe = [replace(episode, is_safe=True, cause="") for episode in episodes]
    with pytest.raises(ValueError, match="0 of 40 episodes end in a fall"):
        before.fit_falls(Episodes(episodes.info, safe), [])
    assert before.fall_logit_ is fitted.fall_logit_
    before.base_logit_ = before.fall_logit_ = None
    assert np.isnan(before.predict(*rows_of(episodes[:2])).fall_probability).all()
    with pytest.raises(ValueError, match="maps with heads"):
        before.fit_falls(episodes, [])


def test_diverged_simulation_and_fallen_robot_teach_nothing(fitted):
    episodes, falls = until_falls(15)
    expected = copy.copy(fitted).fit_falls(episodes, []).fall_logit_
    episodes[int(np.flatnonzero(falls)[0])].state[-1] += 100.0
    odd = replace(episodes[0], index=999, is_safe=False, cause=DIVERGED)
    more = Episodes(episodes.info, [*episodes, odd])
    assert copy.copy(fitted).fit_falls(more, []).fall_logit_ == expected


def test_weights_are_those_of_inputs_with_units():
    rng = np.random.default_rng(0)
    inputs = [rng.normal(size=(20, 3)) * [1e-3, 1.0, 50.0] for _ in range(200)]
    logit = FallLogit.fit(inputs, [rows[:, 2].mean() > 0.0 for rows in inputs], [0])
    margins, unsafe_logit, column = np.split(inputs[0], 3, axis=1)
    expected = inputs[0] @ logit.weights + logit.offset
    np.testing.assert_allclose(logit.of(margins, unsafe_logit[:, 0], column), expected, atol=1e-12)
