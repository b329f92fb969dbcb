from dataclasses import replace

import numpy as np
import pytest

from drake_safety import SafetyAssessment, run_episodes
from drake_safety.evaluation.scorers import assessment_scorer
from shuttle_task import BOX, FAIR_X_M, shuttling
from studies.reachable_region import SAFE, reachable_region, region_figure


@pytest.fixture(scope="module")
def assessment():
    scenario = shuttling()
    return SafetyAssessment(scenario.assessment).fit(run_episodes(scenario, 80, num_workers=1))


def on_plane(assessment, **options):
    return reachable_region(
        shuttling(), assessment, lambda *_: None, threshold=0.5, num_workers=1, **options
    )


@pytest.fixture(scope="module")
def region(assessment):
    return on_plane(assessment, x_m=0.9, step_m=0.3)


@pytest.mark.train
def test_the_truth_is_what_the_simulation_says_of_each_target(region):
    y = np.broadcast_to(region.simulated_y_m, region.outcomes.shape)
    # From the origin a mass that is carried beyond y = 1 leaves through the flank.
    np.testing.assert_array_equal(region.outcomes == "flank", y > 1.0)
    np.testing.assert_array_equal(region.outcomes == SAFE, y <= 1.0)


@pytest.mark.train
def test_the_assessment_is_asked_from_the_standing_posture(region, assessment):
    loop = shuttling().make_loop()
    context = loop.CreateDefaultContext()
    row, column = 2, 3
    loop.reset_standing(context, np.array([0.9, region.y_m[column], region.z_m[row]]))
    inputs = (
        loop.GetOutputPort(name).Eval(context)[None]
        for name in ("state", "desired_preview", "features")
    )
    (expected,) = assessment_scorer("sharpened", assessment).probability(*inputs)
    assert region.probability[row, column] == pytest.approx(expected, abs=1e-6)


@pytest.mark.train
def test_what_is_not_known_is_hatched_and_not_accepted(region):
    probability = np.full_like(region.probability, 0.9)
    probability[: len(probability) // 2] = np.nan
    half = replace(region, probability=probability)
    figure = region_figure(half, ["front", "flank"])
    left, right = figure.axes[0].get_xlim()
    assert left > right  # The robot's left.
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert not any(label.startswith("front") for label in labels)
    share = 100 * np.isnan(probability).mean()
    assert f"Γ: don't know, {share:.0f} %" in labels


@pytest.mark.train
def test_the_plane_covers_the_target_box_and_what_needs_no_simulation_is_finer(region, assessment):
    for fine, coarse, low, high in (
        (region.y_m, region.simulated_y_m, *BOX[:, 1]),
        (region.z_m, region.simulated_z_m, *BOX[:, 2]),
    ):
        assert (coarse[0], coarse[-1]) == (fine[0], fine[-1]) == (low, high)
        assert np.abs(coarse[:, None] - fine).min(axis=1).max() < 1e-12
        assert len(fine) > 2 * len(coarse)
    assert region.probability.shape == (len(region.z_m), len(region.y_m))
    assert region.is_reachable == {}  # A task without a hand.
    assert on_plane(assessment, step_m=0.8).x_m == pytest.approx(0.5 * (FAIR_X_M + BOX[1, 0]))
