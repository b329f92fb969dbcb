import copy
from dataclasses import replace

import numpy as np
import pytest

from drake_safety.evaluation.metrics import area_under_curve
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.fall_logit import FallLogit
from drake_safety.learning.segments import DIVERGED, Episodes
from lip_assessments import quick_assessment
from lip_episodes import make_episodes

pytestmark = pytest.mark.train


def until_falls(seed, num=160):
    """Episodes of which those that leave the safe set to the left end in a fall."""
    found = make_episodes(num, seed=seed, noise=0.002)
    falls = [not one.is_safe and one.state[-1, 1] > 0.0 for one in found]
    pairs = zip(found, falls, strict=True)
    ended = [replace(one, is_safe=not f, cause=one.cause if f else "") for one, f in pairs]
    return Episodes(found.info, ended), np.array(falls)


@pytest.fixture(scope="module")
def fitted():
    assessment = quick_assessment("sharpened")
    return assessment.fit_falls(until_falls(11)[0], assessment.info_.state_names)


def rows_of(episodes):
    return tuple(
        np.concatenate([getattr(one, name) for one in episodes])
        for name in ("state", "desired_preview", "features")
    )


def test_it_tells_falls_from_other_ends_where_the_probability_of_staying_safe_cannot(fitted):
    _, falls = until_falls(12)
    left = [one for one in make_episodes(160, seed=12, noise=0.002) if not one.is_safe]
    which = [one.index for one in left]
    names = ("state", "desired_preview", "features")
    said = fitted.predict(*(np.stack([getattr(one, name)[-2] for one in left]) for name in names))
    label = falls[which]
    assert 10 < label.sum() < len(label) - 10
    of_falls = area_under_curve(said.fall_probability, label)
    assert of_falls > area_under_curve(1.0 - said.probability, label) + 0.1
    assert of_falls > 0.7


def test_it_is_of_one_row_what_it_is_of_many_and_certain_where_nothing_is_known(fitted, tmp_path):
    rows = rows_of(until_falls(13, num=5)[0])
    rows[0][3, 1] = np.nan
    many = fitted.predict(*rows).fall_probability
    one = [fitted.predict_one(*row).fall_probability for row in zip(*rows, strict=True)]
    np.testing.assert_array_equal(many, one)
    assert many[3] == 1.0 and (np.delete(many, 3) < 1.0).all()
    fitted.save(tmp_path / "file")
    read = SafetyAssessment.load(tmp_path / "file")
    np.testing.assert_array_equal(read.predict(*rows).fall_probability, many)
    assert read.used_[-1].purpose == "falls"


def test_without_the_fit_there_is_no_such_probability(fitted):
    assessment = copy.copy(fitted)
    assessment.base_logit_ = assessment.fall_logit_ = None
    rows = rows_of(until_falls(13, num=2)[0])
    assert np.isnan(assessment.predict(*rows).fall_probability).all()
    with pytest.raises(ValueError, match="maps with margin heads"):
        assessment.fit_falls(until_falls(11)[0], [])


def test_what_cannot_be_learned_from_is_refused_and_changes_nothing(fitted):
    before = copy.copy(fitted)
    episodes, _ = until_falls(14, num=40)
    with pytest.raises(ValueError, match=r"no features \['nowhere'\]"):
        before.fit_falls(episodes, ["nowhere"])
    with pytest.raises(ValueError, match="seed 0 gives episodes that start as"):
        before.fit_falls(until_falls(0, num=40)[0], [])
    safe = [replace(one, is_safe=True, cause="") for one in episodes]
    with pytest.raises(ValueError, match="0 of 40 episodes end in a fall"):
        before.fit_falls(Episodes(episodes.info, safe), [])
    assert before.fall_logit_ is fitted.fall_logit_


def test_a_diverged_simulation_and_the_fallen_robot_teach_nothing(fitted):
    episodes, falls = until_falls(15)
    expected = copy.copy(fitted).fit_falls(episodes, []).fall_logit_
    last = episodes[int(np.flatnonzero(falls)[0])]
    last.state[-1] += 100.0
    odd = replace(episodes[0], index=999, is_safe=False, cause=DIVERGED)
    more = Episodes(episodes.info, [*episodes, odd])
    assert copy.copy(fitted).fit_falls(more, []).fall_logit_ == expected


def test_weights_are_those_of_inputs_with_units():
    rng = np.random.default_rng(0)
    inputs = [rng.normal(size=(20, 3)) * [1e-3, 1.0, 50.0] for _ in range(200)]
    falls = [one[:, 2].mean() > 0.0 for one in inputs]
    found = FallLogit.fit(inputs, falls, [4])
    x = np.zeros((20, 6))
    x[:, 4] = inputs[0][:, 2]
    logit = found.of(inputs[0][:, :1], inputs[0][:, 1], x)
    np.testing.assert_allclose(logit, inputs[0] @ found.weights + found.offset, atol=1e-12)
