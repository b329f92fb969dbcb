from types import SimpleNamespace

import numpy as np
import pytest

from drake_safety.evaluation.episode_study import (
    PROMISED_UNSAFE_RECALL,
    evaluate_causes,
    evaluate_episodes,
    evaluate_plans,
    first_segments,
    promised_miss_rate,
)
from drake_safety.evaluation.metrics import auc
from drake_safety.evaluation.scorers import Scorer
from drake_safety.learning.segments import split
from lip_episodes import SUPPORT, make_episodes


def inside(state, *_):
    """The less of the support is left at the capture point, the less safe."""
    capture = state[:, :2] + state[:, 3:5] / np.sqrt(9.81 / 0.42)
    return 1.0 / (1.0 + np.exp(-30.0 * (SUPPORT - np.abs(capture)).min(axis=1)))


SCORERS = [
    Scorer(name="sharpened", probability=inside),
    Scorer(name="blind", probability=lambda state, *_: np.full(len(state), 0.5)),
]


@pytest.fixture(scope="module")
def fresh():
    return make_episodes(40, seed=1)


@pytest.fixture(scope="module")
def calibration():
    return make_episodes(30, seed=2)


def test_every_segment_counts_and_at_planning_time_every_episode_once(fresh, calibration):
    estimates = evaluate_episodes(SCORERS, calibration, fresh)
    segments = split(fresh, stride=1, discount=1.0)
    area = auc(SCORERS[0].unsafe_score(segments), segments.is_unsafe, segments.episode)
    assert estimates["segments", "sharpened", "auc"] == area
    assert estimates["segments", "blind", "auc"].value == 0.5
    recalls = [estimates["episodes", "sharpened", f"{kind}_recall"] for kind in ("safe", "unsafe")]
    assert [estimate.n for estimate in recalls] == [fresh.num_safe, fresh.num_unsafe]
    share = estimates["episodes", "", "share_unsafe"]
    assert share.value == fresh.num_unsafe / len(fresh)


def test_plans_are_judged_once_by_a_stored_threshold_or_one_of_the_calibration_set(
    fresh, calibration
):
    found = evaluate_plans(SCORERS, calibration, fresh, {"blind": 0.4})
    assert found["plans", "blind", "threshold"].value == 0.6
    assert found["plans", "blind", "unsafe_recall"].value == 1.0
    limit = 1.0 - found["plans", "sharpened", "threshold"].value
    segments = split(fresh, stride=1, discount=1.0, shortest=1)
    first = segments.take(segments.is_first)
    unsafe = SCORERS[0].unsafe_score(first)[first.is_unsafe]
    assert found["plans", "sharpened", "unsafe_recall"].value == np.mean(unsafe > limit)
    assert found["plans", "sharpened", "unsafe_recall"].n == fresh.num_unsafe
    # The lowest calibration score of an unsafe plan, as so few allow no miss.
    assert found["plans", "", "promised_unsafe_recall"].value < PROMISED_UNSAFE_RECALL
    shares = [one.value for key, one in found.items() if key[1] == "outcomes"]
    assert sum(shares) == pytest.approx(1.0)
    assert found["plans", "outcomes", "safe"].value == fresh.num_safe / len(fresh)


def test_the_likely_cause_of_refused_plans_is_compared_with_the_violated_constraint(fresh):
    first, names = first_segments(fresh), fresh.info.constraint_names
    margins = np.ones((len(first), len(names)))
    for row, episode in zip(margins, fresh, strict=True):
        row[names.index(episode.cause) if episode.cause else 0] = -0.01
    wrong, accepted = np.flatnonzero(first.is_unsafe)[:2]
    margins[wrong] = np.roll(margins[wrong], 1)
    probability = np.where(np.arange(len(first)) == accepted, 0.9, 0.2)
    predicted = SimpleNamespace(
        probability=probability, predicted_margins=margins, cause_probability=np.zeros_like(margins)
    )
    found = evaluate_causes(predicted, fresh, margin_unit=0.02, threshold=0.6)
    refused = fresh.num_unsafe - 1
    right = found["plans", "causes", "right_cause"]
    assert (right.value, right.n) == ((refused - 1) / refused, refused)


def test_a_promise_needs_unsafe_plans_and_is_what_their_number_allows():
    with pytest.raises(ValueError, match="0 of 9 calibration plans are unsafe; it takes 124"):
        promised_miss_rate(np.zeros(9, dtype=bool))
    assert promised_miss_rate(np.ones(500, dtype=bool)) == 1.0 - PROMISED_UNSAFE_RECALL
    assert promised_miss_rate(np.ones(19, dtype=bool)) == pytest.approx(0.05)
