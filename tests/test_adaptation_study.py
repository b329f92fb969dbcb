import numpy as np
import pytest

from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.beliefs import safe_share
from drake_safety.learning.prediction import is_unknown
from lip_assessments import QUICK, worse
from lip_episodes import make_episodes
from studies.adaptation import Pool, TestSet, pool_estimates, scores

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def assessment():
    parameters = AssessmentParameters(**QUICK | {"epochs": 6, "perplexity": 8.0})
    return SafetyAssessment(parameters).fit(make_episodes(110, noise=0.002))


@pytest.fixture(scope="module")
def judged():
    return TestSet.of(make_episodes(40, seed=9, noise=0.002), 10)


def test_scores_are_those_of_what_is_published(assessment, judged):
    segments = judged.segments
    result = assessment.predict(segments.state, segments.desired_preview, segments.features)
    found = scores(assessment, judged)
    for name, probability in (
        ("calibrated", result.probability),
        ("grid", safe_share(result.belief)),
    ):
        unsafe, first = 1.0 - probability, segments.is_first
        squared = (unsafe - segments.is_unsafe) ** 2
        assert found[name]["brier"] == pytest.approx(squared.mean())
        assert found[f"{name}.k0"]["brier"] == pytest.approx(squared[first].mean())
        caught = (unsafe > 0.5)[segments.is_unsafe].mean()
        assert found[name]["unsafe_recall"] == pytest.approx(caught)
        unknown = is_unknown(result.belief, assessment.parameters.initial_uncertainty)
        assert found[name]["unknown"] == unknown.mean()


def test_pools_differ(assessment, judged):
    other = TestSet.of(make_episodes(40, seed=10, noise=0.002), 10)
    pools = [Pool(feedback=worse(), test=judged), Pool(feedback=worse()[:30], test=other)]
    found = pool_estimates(
        assessment, pools, sizes=(10, 30, 40), baselines={"other": assessment.adapt(worse())}
    )
    assert not any(method == "adapted 40" for _, method, _ in found)
    form = f"{assessment.parameters.mode}.calibrated"
    estimate = found[form, "adapted 30", "brier"]
    by_hand = [
        scores(assessment.adapt(pool.feedback[:30]), pool.test)["calibrated"]["brier"]
        for pool in pools
    ]
    assert (estimate.low, estimate.high) == (min(by_hand), max(by_hand))
    before = [scores(assessment, pool.test)["calibrated"]["brier"] for pool in pools]
    won = found[form, "adapted 30", "pools_won"]
    assert won.value == np.mean(np.array(by_hand) < before)
    differing = sum(one.differs for pool in pools for one in pool.feedback)
    assert found[assessment.parameters.mode, "", "gap"].value == pytest.approx(differing / 70)
    with pytest.raises(ValueError, match="only 30 pairs of episodes"):
        pool_estimates(assessment, pools, sizes=(41,))
