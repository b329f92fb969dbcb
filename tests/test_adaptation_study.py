import pytest

from drake_safety.evaluation.metrics import auc
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.segments import split
from lip_assessments import QUICK, worse
from lip_episodes import make_episodes
from studies.adaptation import pool_estimates, scores

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def assessment():
    parameters = AssessmentParameters(**QUICK | {"epochs": 6, "perplexity": 8.0})
    return SafetyAssessment(parameters).fit(make_episodes(110, noise=0.002))


@pytest.fixture(scope="module")
def judged():
    return make_episodes(40, seed=9, noise=0.002)


def test_scores_are_those_of_what_is_published(assessment, judged):
    segments = split(judged, stride=1, discount=1.0, shortest=10)
    result = assessment.predict(segments.state, segments.desired_preview, segments.features)
    found, unsafe, label = scores(assessment, judged), 1.0 - result.probability, segments.is_unsafe
    assert found["brier"] == pytest.approx(((unsafe - label) ** 2).mean())
    assert found["auc"] == pytest.approx(auc(unsafe, label, segments.episode).value)
    assert found["unsafe_recall"] == pytest.approx((unsafe > 0.5)[label].mean())
    assert found["safe_recall"] == pytest.approx((unsafe <= 0.5)[~label].mean())


def test_pools_differ(assessment, judged):
    pools = [(worse(), judged), (worse()[:30], make_episodes(40, seed=10, noise=0.002))]
    found = pool_estimates(assessment, pools, sizes=(10, 30, 40))
    assert not any(method == "adapted 40" for _, method, _ in found)
    estimate = found["sharpened.calibrated", "adapted 30", "brier"]
    by_hand = [scores(assessment.adapt(feedback[:30]), test)["brier"] for feedback, test in pools]
    assert (estimate.low, estimate.high) == (min(by_hand), max(by_hand))
    with pytest.raises(ValueError, match="only 30 pairs of episodes"):
        pool_estimates(assessment, pools, sizes=(41,))
