from dataclasses import asdict, replace

import numpy as np
import pytest

from drake_safety.evaluation.metrics import Bootstrap
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.beliefs import safe_share
from drake_safety.learning.segments import Episodes
from lip_episodes import make_episodes
from studies.ablation import (
    BASELINE,
    Variant,
    judged_segments,
    list_variants,
    unsafe_scores,
    variant_estimates,
)

pytestmark = pytest.mark.train

BASE = AssessmentParameters(
    epochs=3, ensemble_size=1, hidden_sizes=[16], perplexity=8.0, min_count=3
)
FEW = Bootstrap(num_resamples=20)
VARIANTS = [Variant(name=BASELINE), Variant(name="min_count 20", changes={"min_count": 20})]


@pytest.fixture(scope="module")
def sets():
    """Training episodes, and fresh ones for thresholds and for the test."""
    return [make_episodes(n, seed=seed, noise=0.002) for seed, n in enumerate((70, 40, 40))]


@pytest.fixture(scope="module")
def scores(sets):
    return {one.name: unsafe_scores(one, BASE, *sets) for one in VARIANTS}


def test_the_baseline_is_what_training_makes_of_the_same_episodes(sets, scores):
    training, calibration, test = sets
    segments = judged_segments(test, BASE)
    result = (
        SafetyAssessment(BASE)
        .fit(training)
        .predict(segments.state, segments.desired_preview, segments.features)
    )
    np.testing.assert_array_equal(scores[BASELINE]["test"], 1.0 - safe_share(result.belief))
    np.testing.assert_array_equal(scores[BASELINE]["calibrated"], 1.0 - result.probability)
    seen = judged_segments(calibration, BASE)
    found = {
        name: variant_estimates(one, scores[BASELINE], seen, segments, bootstrap=FEW)
        for name, one in scores.items()
    }
    for set_ in ("segments", "k0"):
        base = found[BASELINE][set_]
        assert (base["auc_gain"].value, base["auc_gain"].high) == (0.0, 0.0)
        for one in found.values():
            gain = one[set_]["auc"].value - base["auc"].value
            assert one[set_]["auc_gain"].value == pytest.approx(gain)
            assert one[set_]["auc"].n == 40


def test_what_a_variant_does_not_see_makes_no_difference_to_it(sets):
    blind, before = Variant(name="blind", without=["feature_0", "state_3"]), sets[2]
    changed = Episodes(
        before.info,
        [
            replace(
                one,
                features=one.features + np.eye(len(before.info.feature_names))[0],
                state=one.state + 7.0 * np.eye(len(before.info.state_names))[3],
            )
            for one in before
        ],
    )
    for ours, theirs in zip(blind.recut(before, 10), blind.recut(changed, 10), strict=True):
        np.testing.assert_array_equal(ours.state, theirs.state)
        np.testing.assert_array_equal(ours.features, theirs.features)
    assert "state_3" not in blind.recut(before, 10).info.state_names


def test_a_shorter_horizon_is_the_beginning_of_what_was_recorded(sets):
    episodes = sets[0]
    half = Variant(name="half").recut(episodes, 5)
    assert half.info.horizon == 5
    for ours, recorded in zip(half, episodes, strict=True):
        # The first five desired outputs from each row on.
        for k in range(5):
            rows = slice(0, len(recorded.time_s) - k)
            np.testing.assert_allclose(
                ours.desired_preview[rows, 3 * k : 3 * k + 3], recorded.desired_output[k:]
            )


def test_each_variant_makes_one_choice_otherwise():
    base, rates = AssessmentParameters(shortest_segment=8), ["velocity_x", "capture_point"]
    found = list_variants(base, 200, state_names=["x", "velocity_x"], rate_names=rates)
    assert found[0] == Variant(name=BASELINE)
    assert len({variant.name for variant in found}) == len(found)
    for variant in found[1:]:
        parameters = variant.parameters(base)
        differs = {k for k, v in asdict(parameters).items() if v != asdict(base)[k]}
        same = {k for k, v in variant.changes.items() if v == getattr(base, k)}
        assert differs == set(variant.changes) - same
        assert differs or variant.num_episodes or variant.without
        # The extent of the grid is no choice of these.
        assert parameters.resolution * parameters.cell_length == pytest.approx(140.0)
    assert [list(v.without) for v in found if "velocities" in v.name] == [rates[:1], rates]
    choices = {variant.name.partition(" ")[0] for variant in found}
    assert choices > {"score_weight", "horizon", "perplexity", "resolution", "min_count", "paper"}
    assert {v.num_episodes for v in found if "episodes" in v.name} == {25, 50, 100}
    plain = list_variants(base, 200, state_names=["x", "velocity_x"], rate_names=[])
    assert not any(variant.without for variant in plain)


def test_everyone_is_judged_at_the_baselines_rows_and_what_cannot_be_learned_says_why(sets):
    scores = unsafe_scores(Variant(name="horizon", changes={"horizon": 5}), BASE, *sets)
    assert len(scores["test"]) == len(judged_segments(sets[2], BASE))
    assert len(scores["calibration"]) == len(judged_segments(sets[1], BASE))
    crowded = Variant(name="crowded", changes={"perplexity": 5000.0})
    assert "needs more than 15000" in str(unsafe_scores(crowded, BASE, *sets)["failed"])
