import copy
from dataclasses import replace

import numpy as np
import pytest

from cart_episodes import assert_identical
from drake_safety.learning import adaptation
from drake_safety.learning.adaptation import DiscrepancyFunction
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.assessment_parameters import AdaptationParameters, AssessmentParameters
from drake_safety.learning.beliefs import EMPTY, UNCERTAINTY, from_scores, fuse
from drake_safety.learning.change_detector import usual_rows
from drake_safety.learning.feedback import feedback_segments, pair_episodes
from drake_safety.learning.grid import Grid
from drake_safety.learning.segments import Episodes
from drake_safety.learning.training_scores import TrainingScores, prior_beliefs
from lip_assessments import NUM_PAIRS, better, inputs, pairs_with, quick_assessment, worse
from lip_episodes import make_episodes


@pytest.fixture(scope="module")
def fitted():
    return {mode: quick_assessment(mode) for mode in ("sharpened", "paper")}


@pytest.fixture(scope="module")
def sharpened(fitted):
    return fitted["sharpened"]


@pytest.fixture(scope="module")
def adapted_worse(sharpened):
    return sharpened.adapt(worse())


def feedback_cells(assessment, segments):
    """Cells of each map that hold feedback segments."""
    x = assessment.inputs_of(segments.state, segments.desired_preview, segments.features)
    return [assessment.grid_.locate(points) for points in assessment.embedding_.embed(x)]


def prior_of(assessment):
    return prior_beliefs(assessment.training_, assessment.grid_, assessment.parameters, 2)


@pytest.mark.train
def test_without_differing_pair_no_learned_cell_changes(sharpened):
    adapted = sharpened.adapt(pairs_with(lambda episode: False))
    learned = sharpened.beliefs_[..., UNCERTAINTY] < 1.0
    np.testing.assert_array_equal(adapted.beliefs_[learned], sharpened.beliefs_[learned])
    np.testing.assert_array_equal(adapted.correction_.change, 0.0)
    assert (adapted.adaptation_.num_differing, adapted.adaptation_.num_sets) == (0, NUM_PAIRS)


@pytest.mark.train
@pytest.mark.parametrize("is_unsafe", [False, True])
def test_cells_that_training_leaves_empty_are_filled_by_feedback(sharpened, is_unsafe):
    assessment = copy.copy(sharpened)
    feedback = pairs_with(lambda episode: episode.is_safe == is_unsafe)
    segments = feedback_segments(feedback, assessment.parameters)
    cells = feedback_cells(assessment, segments)[0]
    cells = cells[cells >= 0]
    # Training that has not reached where the feedback is.
    is_far = ~np.isin(assessment.grid_.locate(assessment.training_.points[0]), cells)
    known = assessment.training_
    names = ("heads", "score", "cause", "nearest", "multiplicity")
    rows = {name: getattr(known, name)[is_far] for name in names}
    assessment.training_ = replace(known, points=known.points[:, is_far], **rows)
    assessment.beliefs_ = prior_of(assessment)
    assert np.all(assessment.beliefs_[0, cells, UNCERTAINTY] == 1.0)
    adapted = assessment.adapt(feedback).beliefs_[0]
    count = np.bincount(cells, minlength=len(adapted))
    is_filled = count >= assessment.parameters.min_count
    assert is_filled.sum() > 3
    np.testing.assert_allclose(adapted[is_filled, UNCERTAINTY], 0.3)
    assert np.all(adapted[(count > 0) & ~is_filled, UNCERTAINTY] == 1.0)
    masses = adapted[is_filled, :2].sum(axis=0)
    # The scores of unsafe episodes are discounted.
    assert masses[1 if is_unsafe else 0] > (0.7 if is_unsafe else 0.99) * masses.sum()


@pytest.mark.train
def test_gamma_falls_for_robot_that_fails_more_and_rises_for_one_that_fails_less(
    sharpened, adapted_worse
):
    before = sharpened.beliefs_[..., 0].sum()
    assert adapted_worse.beliefs_[..., 0].sum() < before - 0.1
    assert sharpened.adapt(better()).beliefs_[..., 0].sum() > before + 0.1


@pytest.mark.train
def test_gamma_never_rises_in_learned_cell_whose_feedback_was_unsafe(sharpened):
    feedback = better()
    adapted = sharpened.adapt(feedback)
    segments = feedback_segments(feedback, sharpened.parameters)
    num_held = 0
    of_maps = feedback_cells(sharpened, segments), sharpened.beliefs_, adapted.beliefs_
    for cells, before, after, guard in zip(*of_maps, adapted.correction_.guard, strict=True):
        vote = np.where(segments.is_unsafe, 1, -1)[cells >= 0]
        is_held = np.bincount(cells[cells >= 0], vote, minlength=len(before)) > 0
        num_held += is_held.sum()
        rise = (after - before)[is_held & (before[:, UNCERTAINTY] < 1.0), 0]
        assert len(rise) > 2
        assert np.all(rise <= 1e-12)
        np.testing.assert_array_equal(guard, is_held)
    assert num_held > 5
    # The probability does not rise either where all cells are guarded.
    x = inputs(feedback[0].rows)
    all_guarded = replace(adapted.correction_, guard=np.ones_like(adapted.correction_.guard))
    held = sharpened.predict(*x, correction=all_guarded).probability
    assert np.all(held <= sharpened.predict(*x).probability + 1e-12)


@pytest.mark.train
def test_hidden_layer_adds_no_more_far_away_than_at_feedback(adapted_worse):
    correction, embedding = adapted_worse.correction_, adapted_worse.embedding_
    least, most = correction.hidden_range
    assert least < 0.0 < most
    x = adapted_worse.inputs_of(*inputs(worse()[0].rows))
    for factor in (1.0, -30.0, 30.0):
        added = correction.residual(embedding.activations(factor * x))
        assert np.all((added >= least) & (added <= most))
    assert np.ptp(correction.residual(embedding.activations(x))) > 0.0


@pytest.mark.train
@pytest.mark.parametrize(("offset", "expected"), [(1e5, 0.0), (-1e5, 1.0)])
def test_correction_of_any_size_gives_probability(sharpened, offset, expected):
    extreme = replace(sharpened.correction_, change=np.array([offset, 0.0, 0.0, 0.0]))
    probability = sharpened.predict(*inputs(worse()[0].rows), correction=extreme).probability
    assert probability[0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.train
def test_monitor_knows_motions_given_to_adaptation(sharpened, adapted_worse):
    def learned(motions):
        weights = sharpened.adapt(worse(3), motions=motions).detector_.predictor.weights
        return weights["linear.weight"]

    motions, prior = make_episodes(20, seed=9, noise=0.01), sharpened.detector_
    expected = prior.with_motions(usual_rows(motions)).predictor.weights["linear.weight"]
    np.testing.assert_array_equal(learned(motions), expected)
    np.testing.assert_array_equal(learned(usual_rows(motions)), expected)
    assert not np.array_equal(prior.predictor.weights["linear.weight"], expected)
    assert adapted_worse.detector_ is prior
    # Of motion with more rows it takes those that are as far apart as in its training.
    finer = Episodes(replace(motions.info, step_s=0.5 * prior.step_s), list(motions))
    np.testing.assert_array_equal(learned(finer), learned([x[::2] for x in usual_rows(finer)]))
    other = Episodes(replace(motions.info, step_s=0.75 * prior.step_s), list(motions))
    with pytest.raises(ValueError, match=r"rows of the motions are 0.03 s apart, which does not"):
        learned(other)


@pytest.mark.train
def test_earlier_assessment_stays_and_adapting_again_starts_from_it(sharpened, adapted_worse):
    before = prior_of(sharpened)
    np.testing.assert_array_equal(sharpened.beliefs_, before)
    assert sharpened.adaptation_ is None
    np.testing.assert_array_equal(sharpened.correction_.change, 0.0)
    again = adapted_worse.adapt(worse())
    np.testing.assert_array_equal(again.beliefs_, adapted_worse.beliefs_)
    np.testing.assert_array_equal(prior_of(adapted_worse), before)


@pytest.mark.train
@pytest.mark.parametrize("mode", ["sharpened", "paper"])
def test_adapted_loaded_and_overridden_assessments_predict_the_same_bits(fitted, mode, tmp_path):
    assessment = fitted[mode]
    adapted = assessment.adapt(worse())
    adapted.save(tmp_path / "adapted")
    loaded = SafetyAssessment.load(tmp_path / "adapted")
    assert loaded.adaptation_ == adapted.adaptation_
    given = inputs(feedback_segments(worse(12), assessment.parameters), slice(None, None, 5))
    changes = {name: getattr(adapted, f"{name}_") for name in ("beliefs", "correction", "novelty")}
    expected = adapted.predict(*given)
    for other in (loaded.predict(*given), assessment.predict(*given, **changes)):
        assert_identical([other], [expected])
    one = adapted.predict_one(*(part[7] for part in given))
    np.testing.assert_array_equal(one.belief, expected.belief[7])
    assert np.abs(assessment.predict(*given).belief - expected.belief).max() > 0.01


@pytest.mark.train
@pytest.mark.parametrize("num_sets", [1, NUM_PAIRS])
def test_in_papers_mode_cell_without_feedback_has_refused_prior(fitted, num_sets):
    paper, feedback = fitted["paper"], worse()[:num_sets]
    segments = feedback_segments(feedback, paper.parameters)
    x = paper.inputs_of(segments.state, segments.desired_preview, None)
    points, training = paper.embedding_.embed(x)[0], paper.training_
    discrepancy = DiscrepancyFunction(points, np.abs(segments.score - segments.nominal_score))
    mean, deviation = discrepancy.predict(training.points[0])
    mu = np.where(deviation <= 0.3, 0.1 + 0.9 * mean, 0.3)
    adapted = paper.adapt(feedback).beliefs_[0]
    cells = paper.grid_.locate(training.points[0])
    visited, count = set(paper.grid_.locate(points)), 0
    for cell in set(cells) - visited - {-1}:
        members = cells == cell
        if members.sum() >= paper.parameters.min_count:
            masses = from_scores(training.score[members], mu[members], training.cause[members], 2)
            np.testing.assert_allclose(adapted[cell], fuse(masses), atol=1e-9)
            if deviation[members].min() > 0.3:  # Of it the feedback says nothing.
                np.testing.assert_array_equal(adapted[cell], paper.beliefs_[0, cell])
            count += 1
    assert count > 0


def test_feedback_belief_is_average_with_decaying_uncertainty():
    grid = Grid(resolution=2, cell_length=1.0)
    certain = from_scores(np.array([0.0, 1.0, 1.0]), 0.0, np.array([-1, 0, 0]), 1)
    cells = np.array([0, 0, 3])
    beliefs = adaptation.feedback_beliefs(certain, cells, grid, AdaptationParameters())
    mu = 0.3 * np.exp(-0.4)
    np.testing.assert_allclose(beliefs[0], [0.5 * (1 - mu), 0.5 * (1 - mu), mu, 0.5 * (1 - mu)])
    np.testing.assert_allclose(beliefs[3], [0.0, 0.7, 0.3, 0.7])
    np.testing.assert_array_equal(beliefs[1], [*EMPTY, 0.0])


@pytest.mark.train
def test_discrepancy_is_high_where_scores_differ_and_unknown_far_away():
    points = np.random.default_rng(0).uniform(-60.0, 60.0, (300, 2))
    difference = (points[:, 0] > 0.0).astype(float)
    points[7, 1] = np.nan  # Teaches nothing.
    asked = np.array([[40.0, 0.0], [-40.0, 0.0], [1e3, 0.0], [np.nan, 0.0]])
    mean, deviation = DiscrepancyFunction(points, difference).predict(asked)
    assert mean[0] > 0.9 and mean[1] < 0.1
    assert deviation[:2].max() < 0.3
    np.testing.assert_allclose(deviation[2:], 1.0)
    np.testing.assert_allclose(mean[2:], 0.0, atol=1e-9)
    with pytest.raises(ValueError, match="none of the feedback's points"):
        DiscrepancyFunction(points[7:8], np.ones(1))


def test_diverged_pair_is_left_out():
    episodes = make_episodes(4, noise=0.002)
    broken = [replace(e, is_safe=False, cause="diverged") if e.index == 1 else e for e in episodes]
    feedback = pair_episodes(Episodes(episodes.info, broken), episodes)
    assert [pair.actual.index for pair in feedback] == [0, 2, 3]


def test_twin_that_has_ended_scores_one():
    pair = next(pair for pair in pairs_with(lambda episode: False) if pair.actual.is_safe)
    twin = replace(pair.twin, time_s=pair.twin.time_s[:4], is_safe=False, cause="height")
    parameters = AssessmentParameters(discount=0.9)
    segments = feedback_segments([replace(pair, twin=twin)], parameters)
    np.testing.assert_allclose(segments.nominal_score[:5], [0.9**3, 0.9**2, 0.9, 1.0, 1.0])
    np.testing.assert_array_equal(segments.score, 0.0)


def crowded_scores(num_segments, rng):
    """Two maps with a crowded cell each, and some segments elsewhere."""
    points = rng.normal([3.0, 3.0], 1.0, (2, num_segments, 2)).astype(np.float32)
    is_elsewhere = rng.random(num_segments) < 0.05
    points[:, is_elsewhere] = rng.uniform(-40.0, 40.0, (2, is_elsewhere.sum(), 2))
    score = np.where(rng.random(num_segments) < np.where(is_elsewhere, 0.9, 0.2), 0.8, 0.0)
    return TrainingScores(points=points, score=score, cause=np.where(score > 0.0, 0, -1))


def test_crowded_cells_keep_few_segments_and_beliefs_of_all():
    parameters, grid = AssessmentParameters(), Grid(resolution=14, cell_length=10.0)
    many = crowded_scores(80_000, np.random.default_rng(0))
    thinned = many.thinned(grid, seed=0)
    assert len(thinned.score) < 0.5 * 20_000 + 0.1 * 80_000
    counts = [np.bincount(grid.locate(points), minlength=196) for points in many.points]
    np.testing.assert_array_equal(thinned.count, counts)
    np.testing.assert_allclose(thinned.multiplicity.sum(), 80_000, rtol=0.1)
    every, some = (prior_beliefs(scores, grid, parameters, 1) for scores in (many, thinned))
    np.testing.assert_array_equal(some[..., UNCERTAINTY], every[..., UNCERTAINTY])
    # 500 draws a cell have a standard error of 0.018.
    np.testing.assert_allclose(some, every, atol=0.07)
    # Cells with few segments keep them all.
    few = crowded_scores(400, np.random.default_rng(1))
    np.testing.assert_array_equal(few.thinned(grid, seed=0).points, few.points)


@pytest.mark.train
def test_feedback_that_does_not_fit_is_refused(sharpened):
    with pytest.raises(ValueError, match="it is other, expected lip"):
        sharpened.adapt([replace(p, info=replace(p.info, scenario="other")) for p in worse(2)])
    with pytest.raises(ValueError, match="nominal twin: scenario_hash differs"):
        sharpened.adapt([replace(p, nominal_hash="x") for p in worse(2)])


def test_twin_that_is_missing_or_begins_elsewhere_is_refused():
    episodes = make_episodes(3, noise=0.002)
    with pytest.raises(ValueError, match="episode 2 has no nominal twin"):
        pair_episodes(episodes, episodes[:2])
    shifted = [replace(e, true_state=e.true_state + 0.1 * (e.index == 1)) for e in episodes]
    with pytest.raises(ValueError, match="twin of episode 1 starts in another state"):
        pair_episodes(episodes, Episodes(episodes.info, shifted))
