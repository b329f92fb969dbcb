import numpy as np
import pytest

from drake_safety.evaluation.episode_study import evaluate_episodes
from drake_safety.evaluation.metrics import area_under_curve
from drake_safety.evaluation.scorers import Scorer
from lip_episodes import SUPPORT, make_episodes


def inside(state, *_):
    """The less of the support is left at the capture point, the less safe."""
    capture = state[:, :2] + state[:, 3:5] / np.sqrt(9.81 / 0.42)
    return 1.0 / (1.0 + np.exp(-30.0 * (SUPPORT - np.abs(capture)).min(axis=1)))


SCORERS = [
    Scorer(name="sharpened", probability=inside),
    Scorer(name="mlp", probability=lambda state, *_: np.full(len(state), 0.5)),
    Scorer(name="gradient_boosting", probability=lambda state, *_: 1.0 - inside(state)),
]


@pytest.fixture(scope="module")
def fresh():
    return make_episodes(40, seed=1)


@pytest.fixture(scope="module")
def study(fresh):
    return evaluate_episodes(SCORERS, make_episodes(30, seed=2), fresh)


def test_every_scorer_has_every_figure_per_segment_and_at_planning_time(study):
    estimates, scores, _ = study
    assert list(scores) == [scorer.name for scorer in SCORERS]
    for kind in ("segments", "episodes"):
        for name in scores:
            for key in ("auc", "safe_recall", "unsafe_recall", "brier"):
                assert f"{kind}.{name}.{key}" in estimates


def test_the_scores_are_those_the_figures_come_from(study):
    estimates, scores, is_unsafe = study
    for name, score in scores.items():
        assert estimates[f"segments.{name}.auc"].value == area_under_curve(score, is_unsafe)
    assert estimates["segments.mlp.auc"].value == 0.5


def test_the_assessment_is_compared_with_the_better_of_the_classifiers(study):
    estimates, *_ = study
    difference = estimates["segments.sharpened_minus_best_classifier.auc"]
    assert difference.value == pytest.approx(estimates["segments.sharpened.auc"].value - 0.5)


def test_at_planning_time_every_episode_counts_once(study, fresh):
    estimates, *_ = study
    recalls = [estimates[f"episodes.sharpened.{key}"] for key in ("safe_recall", "unsafe_recall")]
    assert [estimate.n for estimate in recalls] == [fresh.num_safe, fresh.num_unsafe]
    share = estimates["episodes.share_unsafe"]
    assert share.value == fresh.num_unsafe / len(fresh)


def test_thresholds_come_from_the_calibration_set_alone(study, fresh):
    calibration = make_episodes(30, seed=2)
    estimates, *_ = evaluate_episodes(SCORERS, calibration, calibration)
    again, *_ = evaluate_episodes(SCORERS, fresh, calibration)
    name = "segments.sharpened"
    assert estimates[f"{name}.auc"] == again[f"{name}.auc"]
    # No other threshold is better on the set that it was chosen on.
    best, other = (
        found[f"{name}.safe_recall"].value + found[f"{name}.unsafe_recall"].value
        for found in (estimates, again)
    )
    assert best >= other
