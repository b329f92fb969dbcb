import copy
from dataclasses import fields, replace

import numpy as np
import pytest

from drake_safety.learning import adaptation
from drake_safety.learning.assessment import (
    AdaptationParameters,
    AssessmentParameters,
    SafetyAssessment,
)
from drake_safety.learning.beliefs import (
    EMPTY,
    UNCERTAINTY,
    average_cells,
    from_scores,
    fuse,
    safe_share,
)
from drake_safety.learning.change_detector import usual_rows
from drake_safety.learning.discrepancy import DiscrepancyFunction, updated_uncertainty
from drake_safety.learning.feedback import feedback_segments, pair_episodes
from drake_safety.learning.grid import Grid
from drake_safety.learning.segments import Episodes
from drake_safety.learning.training_scores import TrainingScores, prior_beliefs
from lip_assessments import NUM_PAIRS, QUICK, better, inputs, pairs_with, worse
from lip_episodes import make_episodes


def learned(mode, **changed):
    quick = QUICK | {"epochs": 6, "perplexity": 8.0} | changed
    episodes = make_episodes(130, noise=0.002)
    return SafetyAssessment(AssessmentParameters(mode=mode, **quick)).fit(episodes)


@pytest.fixture(scope="module")
def fitted():
    return {mode: learned(mode) for mode in ("sharpened", "paper")}


@pytest.fixture
def sharpened(fitted):
    return fitted["sharpened"]


@pytest.fixture
def paper(fitted):
    return fitted["paper"]


def feedback_cells(assessment, feedback, is_wanted):
    """Cells of each map that hold feedback segments which `is_wanted(segments)` chooses."""
    segments = feedback_segments(feedback, assessment.parameters)
    x = assessment.inputs_of(segments.state, segments.desired_preview, segments.features)
    points = assessment.embedding_.embed(x)
    return [assessment.grid_.locate(p[is_wanted(segments)]) for p in points]


def prior_of(assessment):
    return prior_beliefs(assessment.training_, assessment.grid_, assessment.parameters, 2)


@pytest.mark.train
def test_without_a_differing_pair_no_learned_cell_changes(sharpened):
    feedback = pairs_with(lambda episode: False)
    adapted = sharpened.adapt(feedback)
    learned = sharpened.beliefs_[..., UNCERTAINTY] < 1.0
    np.testing.assert_array_equal(adapted.beliefs_[learned], sharpened.beliefs_[learned])
    np.testing.assert_array_equal(adapted.correction_.change, 0.0)
    assert adapted.adaptation_.num_differing == 0
    assert adapted.adaptation_.num_sets == NUM_PAIRS


@pytest.mark.train
@pytest.mark.parametrize("is_unsafe", [False, True])
def test_cells_that_training_leaves_empty_are_filled_by_what_the_actual_robot_did(
    sharpened, is_unsafe
):
    assessment = copy.copy(sharpened)
    feedback = pairs_with(lambda episode: episode.is_safe == is_unsafe)
    cells = feedback_cells(assessment, feedback, lambda segments: slice(None))[0]
    cells = cells[cells >= 0]
    # Training that has not reached where the feedback is.
    is_far = ~np.isin(assessment.grid_.locate(assessment.training_.points[0]), cells)
    known = assessment.training_
    rows = {
        name: getattr(known, name)[is_far]
        for name in ("heads", "score", "cause", "nearest", "multiplicity")
    }
    assessment.training_ = replace(known, points=known.points[:, is_far], **rows)
    assessment.beliefs_ = prior_of(assessment)
    assert np.all(assessment.beliefs_[0, cells, UNCERTAINTY] == 1.0)
    adapted = assessment.adapt(feedback).beliefs_[0]
    count = np.bincount(cells, minlength=len(adapted))
    is_filled = count >= assessment.parameters.min_count
    assert is_filled.sum() > 3
    np.testing.assert_allclose(
        adapted[is_filled, UNCERTAINTY], assessment.parameters.initial_uncertainty
    )
    assert np.all(adapted[(count > 0) & ~is_filled, UNCERTAINTY] == 1.0)
    known = adapted[is_filled, :2].sum(axis=0)
    # The scores of unsafe episodes are discounted.
    assert known[1 if is_unsafe else 0] > (0.7 if is_unsafe else 0.99) * known.sum()


@pytest.mark.train
def test_gamma_falls_for_a_robot_that_fails_more_and_rises_for_one_that_fails_less(sharpened):
    before = sharpened.beliefs_[..., 0]
    lower, higher = (sharpened.adapt(sets).beliefs_[..., 0] for sets in (worse(), better()))
    assert lower.sum() < before.sum() - 0.1
    assert higher.sum() > before.sum() + 0.1


@pytest.mark.train
@pytest.mark.parametrize("make", [worse, better])
def test_gamma_never_rises_in_a_learned_cell_whose_feedback_was_unsafe(sharpened, make):
    feedback = make()
    adapted = sharpened.adapt(feedback)
    num_cells = sharpened.grid_.num_cells
    counts = [
        [np.bincount(cells[cells >= 0], minlength=num_cells) for cells in located]
        for located in (
            feedback_cells(sharpened, feedback, lambda segments: segments.is_unsafe),
            feedback_cells(sharpened, feedback, lambda segments: ~segments.is_unsafe),
        )
    ]
    num_held = 0
    for unsafe, safe, before, after, guard in zip(
        *counts, sharpened.beliefs_, adapted.beliefs_, adapted.correction_.guard, strict=True
    ):
        is_held = unsafe > safe
        num_held += is_held.sum()
        is_learned = before[:, UNCERTAINTY] < 1.0
        rise = (after - before)[is_held & is_learned, 0]
        assert len(rise) > 2
        assert np.all(rise <= 1e-12)
        np.testing.assert_array_equal(guard, is_held)
    assert num_held > 5
    # What is published rises nowhere either where all that is read are such cells.
    x = inputs(feedback[0].rows)
    all_guarded = replace(adapted.correction_, guard=np.ones_like(adapted.correction_.guard))
    held = sharpened.predict(*x, correction=all_guarded).probability
    assert np.all(held <= sharpened.predict(*x).probability + 1e-12)


@pytest.mark.train
def test_far_from_all_feedback_the_hidden_layer_adds_no_more_than_it_did_there(sharpened):
    correction = sharpened.adapt(worse()).correction_
    least, most = correction.hidden_range
    assert least < 0.0 < most
    x = sharpened.inputs_of(*inputs(worse()[0].rows))
    for factor in (1.0, -30.0, 30.0):
        added = correction.residual(sharpened.embedding_, factor * x)
        assert np.all((added >= least) & (added <= most))
    assert np.ptp(correction.residual(sharpened.embedding_, x)) > 0.0


@pytest.mark.train
@pytest.mark.parametrize(("offset", "expected"), [(1e5, 0.0), (-1e5, 1.0)])
def test_a_gap_of_any_size_gives_a_probability_online_and_offline(sharpened, offset, expected):
    own = sharpened.correction_
    extreme = replace(own, change=np.array([offset, 0.0, 0.0, 0.0]))
    x = inputs(worse()[0].rows)
    many = sharpened.predict(*x, correction=extreme).probability
    single = sharpened.predict_one(*(part[0] for part in x), correction=extreme).probability
    assert many[0] == pytest.approx(expected, abs=1e-9)
    assert single == pytest.approx(expected, abs=1e-9)


@pytest.mark.train
def test_the_monitor_knows_the_motions_that_an_adaptation_is_given(sharpened):
    def learned(motions):
        weights = sharpened.adapt(worse(), motions=motions).detector_.predictor.weights
        return weights["linear.weight"]

    motions, prior = make_episodes(20, seed=9, noise=0.01), sharpened.detector_
    expected = prior.with_motions(usual_rows(motions)).predictor.weights["linear.weight"]
    np.testing.assert_array_equal(learned(motions), expected)
    np.testing.assert_array_equal(learned(usual_rows(motions)), expected)
    assert not np.array_equal(prior.predictor.weights["linear.weight"], expected)
    assert sharpened.adapt(worse()).detector_ is prior
    # Of motion with more rows it takes those that are as far apart as in its training.
    finer = Episodes(replace(motions.info, step_s=0.5 * prior.step_s), list(motions))
    np.testing.assert_array_equal(learned(finer), learned([x[::2] for x in usual_rows(finer)]))
    other = Episodes(replace(motions.info, step_s=0.75 * prior.step_s), list(motions))
    with pytest.raises(ValueError, match=r"rows of the motions are 0.03 s apart, which does not"):
        learned(other)


@pytest.mark.train
def test_the_earlier_assessment_stays_as_it_was_and_adapting_again_starts_from_it(sharpened):
    before = sharpened.beliefs_.copy()
    adapted = sharpened.adapt(worse())
    np.testing.assert_array_equal(sharpened.beliefs_, before)
    assert sharpened.adaptation_ is None
    np.testing.assert_array_equal(sharpened.correction_.change, 0.0)
    again = adapted.adapt(worse())
    np.testing.assert_array_equal(again.beliefs_, adapted.beliefs_)
    np.testing.assert_array_equal(prior_of(adapted), before)


@pytest.mark.train
def test_every_way_to_ask_an_adapted_assessment_gives_the_same(fitted, tmp_path):
    held_out = worse(12)
    for mode, assessment in fitted.items():
        adapted = assessment.adapt(worse())
        adapted.save(tmp_path / mode)
        loaded = SafetyAssessment.load(tmp_path / mode)
        assert loaded.adaptation_ == adapted.adaptation_
        segments = feedback_segments(held_out, assessment.parameters)
        given = inputs(segments, slice(None, None, 5))
        results = [
            adapted.predict(*given),
            loaded.predict(*given),
            assessment.predict(
                *given,
                beliefs=adapted.beliefs_,
                correction=adapted.correction_,
                novelty=adapted.novelty_,
            ),
        ]
        for field in fields(results[0]):
            for other in results[1:]:
                np.testing.assert_array_equal(
                    getattr(other, field.name), getattr(results[0], field.name)
                )
        for row in range(0, len(given[0]), 7):
            one = adapted.predict_one(*(part[row] for part in given))
            assert one.probability == pytest.approx(results[0].probability[row], abs=1e-3)
            np.testing.assert_allclose(one.belief, results[0].belief[row], atol=1e-3)
        unmoved = assessment.predict(*given)
        assert np.abs(unmoved.belief - results[0].belief).max() > 0.01


@pytest.mark.train
@pytest.mark.parametrize("trees", [False, True])
def test_grid_and_published_probability_move_the_same_way(sharpened, trees):
    sharpened = sharpened if trees else learned("sharpened", trees=False)
    given = inputs(feedback_segments(worse(), sharpened.parameters), slice(None, None, 3))
    before = sharpened.predict(*given)
    adapted = sharpened.adapt(worse())
    after = adapted.predict(*given)
    # Rows that were unknown have no probability to move.
    was_known = before.probability > 0.0
    published = (after.probability - before.probability)[was_known]
    grid = (safe_share(after.belief) - safe_share(before.belief))[was_known]
    assert published.mean() < -0.05
    assert grid.mean() < -0.05
    # Trees tell more inputs of a cell apart than maps do.
    assert np.corrcoef(published, grid)[0, 1] > (0.6 if trees else 0.7)
    beliefs = adapted.beliefs_
    np.testing.assert_allclose(beliefs[..., :3].sum(axis=2), 1.0)
    np.testing.assert_allclose(beliefs[..., 3:].sum(axis=2), beliefs[..., 1], atol=1e-12)


@pytest.mark.train
@pytest.mark.parametrize("num_sets", [1, NUM_PAIRS])
def test_in_the_papers_mode_a_cell_without_feedback_has_its_refused_prior(paper, num_sets):
    feedback = worse()[:num_sets]
    segments = feedback_segments(feedback, paper.parameters)
    x = paper.inputs_of(segments.state, segments.desired_preview, None)
    points = paper.embedding_.embed(x)[0]
    discrepancy = DiscrepancyFunction().fit(points, np.abs(segments.score - segments.nominal_score))
    mean, deviation = discrepancy.predict(paper.training_.points[0])
    mu = updated_uncertainty(mean, deviation, gate=0.3, least=0.1, initial=0.3)
    adapted = paper.adapt(feedback).beliefs_[0]
    cells = paper.grid_.locate(paper.training_.points[0])
    visited = set(paper.grid_.locate(points))
    count = 0
    for cell in set(cells) - visited - {-1}:
        members = cells == cell
        if members.sum() < paper.parameters.min_count:
            continue
        masses = from_scores(
            paper.training_.score[members], mu[members], paper.training_.cause[members], 2
        )
        np.testing.assert_allclose(adapted[cell], fuse(masses), atol=1e-9)
        if deviation[members].min() > 0.3:  # Of it the feedback says nothing.
            np.testing.assert_array_equal(adapted[cell], paper.beliefs_[0, cell])
        count += 1
    assert count > 0


def test_the_feedback_belief_is_the_average_with_an_uncertainty_that_decays():
    grid = Grid(resolution=2, cell_length=1.0)
    certain = from_scores(np.array([0.0, 1.0, 1.0]), 0.0, np.array([-1, 0, 0]), 1)
    cells = np.array([0, 0, 3])
    beliefs = adaptation.feedback_beliefs(certain, cells, grid, AdaptationParameters())
    mu = 0.3 * np.exp(-0.4)
    np.testing.assert_allclose(beliefs[0], [0.5 * (1 - mu), 0.5 * (1 - mu), mu, 0.5 * (1 - mu)])
    np.testing.assert_allclose(beliefs[3], [0.0, 0.7, 0.3, 0.7])
    np.testing.assert_array_equal(beliefs[1], [*EMPTY, 0.0])
    literal = AdaptationParameters(count="segments")
    beliefs = adaptation.feedback_beliefs(certain, cells, grid, literal)
    np.testing.assert_allclose(beliefs[[0, 3], 2], 0.3 * np.exp(-0.4 * 2))


def test_prior_and_feedback_are_fused_by_hand_worked_weights():
    prior = np.array([[0.63, 0.07, 0.3], [0.5, 0.2, 0.3], [0.0, 0.0, 1.0]])
    feedback = np.array([[0.0, 0.9, 0.1], EMPTY, [0.7, 0.0, 0.3]])
    both = adaptation.combined(prior, feedback)
    weights = np.array([0.7 / 0.3, 0.9 / 0.1])
    np.testing.assert_allclose(both[0, 0], weights[0] * 0.63 / weights.sum())
    np.testing.assert_allclose(both[0, 2], (0.7 + 0.9) / weights.sum())
    np.testing.assert_array_equal(both[1], prior[1])
    np.testing.assert_allclose(both[2], feedback[2])


@pytest.mark.train
def test_the_discrepancy_is_high_where_scores_differ_and_unknown_far_away():
    rng = np.random.default_rng(0)
    points = rng.uniform(-60.0, 60.0, (300, 2))
    difference = (points[:, 0] > 0.0).astype(float)
    discrepancy = DiscrepancyFunction().fit(points, difference)
    mean, deviation = discrepancy.predict(np.array([[40.0, 0.0], [-40.0, 0.0], [1e3, 0.0]]))
    assert mean[0] > 0.9
    assert mean[1] < 0.1
    assert deviation[:2].max() < 0.3
    assert deviation[2] == pytest.approx(1.0)
    assert mean[2] == pytest.approx(0.0, abs=1e-9)
    mu = updated_uncertainty(mean, deviation, gate=0.3, least=0.1, initial=0.3)
    np.testing.assert_allclose(mu, [0.1 + 0.9 * mean[0], 0.1 + 0.9 * mean[1], 0.3])


@pytest.mark.train
def test_points_that_are_not_finite_teach_nothing_and_are_not_known():
    points = np.array([[0.0, 0.0], [np.nan, 0.0], [5.0, 5.0]])
    discrepancy = DiscrepancyFunction().fit(points, np.array([1.0, 0.5, 1.0]))
    mean, deviation = discrepancy.predict(points)
    assert mean[0] > 0.5
    assert (mean[1], deviation[1]) == (0.0, 1.0)
    with pytest.raises(ValueError, match="none of the feedback's points"):
        DiscrepancyFunction().fit(points[1:2], np.ones(1))


@pytest.mark.train
def test_the_papers_update_can_be_asked_for_in_the_sharpened_mode(sharpened):
    adapted = sharpened.adapt(worse(), method="paper")
    assert adapted.adaptation_.method == "paper"
    np.testing.assert_array_equal(adapted.correction_.change, 0.0)
    assert np.any(adapted.beliefs_[..., UNCERTAINTY] < 0.29)


def test_a_pair_that_diverged_says_nothing():
    episodes = make_episodes(4, noise=0.002)
    broken = [replace(e, is_safe=False, cause="diverged") if e.index == 1 else e for e in episodes]
    feedback = pair_episodes(Episodes(episodes.info, broken), episodes)
    assert [one.actual.index for one in feedback] == [0, 2, 3]


def test_a_twin_that_has_ended_scores_one():
    one = next(pair for pair in pairs_with(lambda episode: False) if pair.actual.is_safe)
    twin = replace(one.twin, time_s=one.twin.time_s[:4], is_safe=False, cause="height")
    parameters = AssessmentParameters(discount=0.9)
    segments = feedback_segments([replace(one, twin=twin)], parameters)
    np.testing.assert_allclose(segments.nominal_score[:5], [0.9**3, 0.9**2, 0.9, 1.0, 1.0])
    np.testing.assert_array_equal(segments.score, 0.0)


def crowded_scores(num_segments, rng):
    """Two maps with a crowded cell each, and some segments elsewhere."""
    points = rng.normal([3.0, 3.0], 1.0, (2, num_segments, 2)).astype(np.float32)
    is_elsewhere = rng.random(num_segments) < 0.05
    points[:, is_elsewhere] = rng.uniform(-40.0, 40.0, (2, is_elsewhere.sum(), 2))
    score = np.where(rng.random(num_segments) < np.where(is_elsewhere, 0.9, 0.2), 0.8, 0.0)
    return TrainingScores(points=points, score=score, cause=np.where(score > 0.0, 0, -1))


def test_crowded_cells_keep_few_segments_and_their_beliefs_are_those_of_all():
    parameters, grid = AssessmentParameters(), Grid(resolution=14, cell_length=10.0)
    few, many = (crowded_scores(n, np.random.default_rng(0)) for n in (20_000, 80_000))
    kept = {len(one.thinned(grid, seed=0).score) for one in (few, many)}
    assert max(kept) < 0.5 * 20_000 + 0.1 * 80_000
    thinned = many.thinned(grid, seed=0)
    np.testing.assert_array_equal(thinned.counts(grid), many.counts(grid))
    np.testing.assert_allclose(thinned.multiplicity.sum(), 80_000, rtol=0.1)
    every, some = (prior_beliefs(one, grid, parameters, 1) for one in (many, thinned))
    np.testing.assert_array_equal(some[..., UNCERTAINTY], every[..., UNCERTAINTY])
    # 500 draws a cell have a standard error of 0.018.
    np.testing.assert_allclose(some, every, atol=0.07)


def test_cells_with_few_segments_keep_them_all():
    grid = Grid(resolution=14, cell_length=10.0)
    rng = np.random.default_rng(1)
    points = rng.uniform(-69.0, 69.0, (1, 5000, 2)).astype(np.float32)
    scores = TrainingScores(points=points, score=np.zeros(5000), cause=np.full(5000, -1))
    thinned = scores.thinned(grid, seed=0)
    np.testing.assert_array_equal(thinned.points, points)
    np.testing.assert_array_equal(thinned.multiplicity, 1.0)


def of_another(feedback, **changes):
    first, second = feedback
    return [first, replace(second, info=replace(second.info, **changes))]


@pytest.mark.train
@pytest.mark.parametrize(
    ("changed", "options", "message"),
    [
        (lambda sets: of_another(sets, scenario="other"), {}, "scenario: the feedback has other"),
        (lambda sets: of_another(sets, step_s=0.05), {}, "differ in step_s"),
        (lambda sets: of_another(sets, constraint_names=["a", "b"]), {}, "differ in constraint_na"),
        (lambda sets: [replace(one, nominal_hash="x") for one in sets], {}, "twin's scenario hash"),
        (lambda sets: [], {}, "got none, expected at least one pair"),
        (lambda sets: sets, {"method": "luck"}, "cannot adapt by 'luck'"),
        (lambda sets: sets, {"method": "recalibration"}, "'recalibration' needs maps with heads"),
    ],
)
def test_feedback_and_methods_that_do_not_fit_are_refused(
    sharpened, paper, changed, options, message
):
    with pytest.raises(ValueError, match=message):
        (paper if options else sharpened).adapt(changed(worse(2)), **options)


def test_a_twin_is_missing_or_begins_elsewhere():
    episodes = make_episodes(3, noise=0.002)
    with pytest.raises(ValueError, match=r"episode 2 .* has no nominal twin"):
        pair_episodes(episodes, episodes[:2])
    shifted = [replace(e, true_state=e.true_state + 0.1 * (e.index == 1)) for e in episodes]
    with pytest.raises(ValueError, match="twin of episode 1 starts in another state"):
        pair_episodes(episodes, Episodes(episodes.info, shifted))
    with pytest.raises(ValueError, match="average_cells"):
        average_cells(np.zeros((3, 3)), np.zeros(2, dtype=int), np.zeros(4))
