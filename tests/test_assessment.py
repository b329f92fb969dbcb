import subprocess
import sys
from dataclasses import fields

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.beliefs import EMPTY
from drake_safety.learning.prediction import is_unknown
from drake_safety.learning.segments import split
from drake_safety.learning.training import segments_for
from lip_assessments import QUICK, held_out_segments, inputs, quick_assessment, quick_episodes
from lip_episodes import make_episodes

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def episodes():
    return quick_episodes()


@pytest.fixture(scope="module")
def held_out():
    return held_out_segments()


@pytest.fixture(scope="module", params=["sharpened", "paper"])
def assessment(request):
    return quick_assessment(request.param)


def area_under_curve(score, is_positive):
    positive, negative = score[is_positive], score[~is_positive]
    difference = positive[:, None] - negative
    return ((difference > 0.0) + 0.5 * (difference == 0.0)).mean()


def test_parameters_that_change_afterwards_change_nothing_that_was_learned():
    parameters = AssessmentParameters(hidden_sizes=[8, 8])
    learner = SafetyAssessment(parameters)
    parameters.mode, parameters.hidden_sizes[0] = "paper", 3
    assert (learner.parameters.mode, learner.parameters.hidden_sizes) == ("sharpened", [8, 8])


def test_held_out_episodes_are_told_apart(assessment, held_out):
    result = assessment.predict(*inputs(held_out))
    area = area_under_curve(result.belief[:, 0], ~held_out.is_unsafe)
    assert area > (0.88 if assessment.parameters.is_sharpened else 0.75)


def test_masses_sum_to_one_and_causes_to_the_unsafe_mass(assessment, held_out):
    result = assessment.predict(*inputs(held_out))
    np.testing.assert_allclose(result.belief.sum(axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(result.cause_probability.sum(axis=1), result.belief[:, 1])
    assert np.all(result.belief >= 0.0)
    assert np.all(result.belief[:, 0] <= 0.7 + 1e-9)


def test_the_probability_is_b_safe_without_heads_and_zero_where_it_is_dont_know(
    assessment, held_out
):
    result = assessment.predict(*inputs(held_out))
    assert np.all((result.probability >= 0.0) & (result.probability <= 1.0))
    unknown = is_unknown(result.belief, assessment.parameters.initial_uncertainty)
    assert unknown.any() and not unknown.all()
    np.testing.assert_array_equal(result.probability[unknown], 0.0)
    if not assessment.parameters.is_sharpened:
        np.testing.assert_array_equal(result.probability, result.belief[:, 0])


@pytest.mark.parametrize("num_maps", [2, 4, 6, 10])
@pytest.mark.parametrize("initial", [0.1, 0.3, 0.55, 0.7])
def test_it_is_dont_know_if_half_of_the_maps_know_nothing(num_maps, initial):
    # As `predict` averages a filled cell of every map that has one, and the empty belief.
    def mean_uncertainty(num_outside):
        masses = np.add.reduce(np.full(num_maps - num_outside, initial)) / num_maps
        return masses + (1.0 - (num_maps - num_outside) / num_maps)

    half = num_maps // 2
    beliefs = [(0.0, 0.0, mean_uncertainty(n)) for n in (half - 1, half, half + 1)]
    np.testing.assert_array_equal(is_unknown(np.array(beliefs), initial), [False, True, True])


def test_one_input_alone_has_the_same_bits_as_among_many(assessment, held_out):
    # Some rows are unlike training, some outside the grid, some not finite.
    scale = np.ones((len(held_out), 1))
    scale[::5], scale[1::50] = 10.0, np.nan
    given = [part * scale for part in inputs(held_out)]
    result = assessment.predict(*given)
    assert 0.05 < (result.belief[:, 2] == 1.0).mean() < 0.9
    rows = np.arange(0, len(held_out), 23)
    for row in rows:
        one = assessment.predict_one(*(part[row] for part in given))
        for field in fields(one):
            np.testing.assert_array_equal(
                getattr(one, field.name), getattr(result, field.name)[row], err_msg=field.name
            )
    some = assessment.predict(*(part[rows] for part in given))
    for field in fields(some):
        name = field.name
        np.testing.assert_array_equal(getattr(some, name), getattr(result, name)[rows])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e200])
def test_an_input_that_is_not_finite_gets_the_empty_belief(assessment, held_out, bad):
    known = np.flatnonzero(assessment.predict(*inputs(held_out)).belief[:, 2] < 1.0)[:3]
    state, preview, features = (part.copy() for part in inputs(held_out, known))
    state[1, 2] = bad
    result = assessment.predict(state, preview, features)
    one = assessment.predict_one(state[1], preview[1], features[1])
    for belief, probability in (
        (result.belief[1], result.probability[1]),
        (one.belief, one.probability),
    ):
        np.testing.assert_array_equal(belief, EMPTY)
        assert probability == 0.0
    assert np.all(np.isfinite(result.belief))
    np.testing.assert_array_equal(
        result.belief[[0, 2]], assessment.predict(*inputs(held_out, known)).belief[[0, 2]]
    )
    assert result.belief[0, 2] < 1.0


def test_other_beliefs_may_be_given_in_place_of_the_learned_ones(assessment, held_out):
    beliefs = np.zeros_like(assessment.beliefs_)
    beliefs[..., 1] = beliefs[..., 3] = 1.0
    result = assessment.predict(*inputs(held_out, slice(0, 50)), beliefs=beliefs)
    is_inside = result.belief[:, 2] < 1e-9
    assert is_inside.mean() > 0.9
    np.testing.assert_allclose(result.belief[is_inside, 1], 1.0)
    np.testing.assert_allclose(result.cause_probability[is_inside, 0], 1.0)
    one = assessment.predict_one(*inputs(held_out, 0), beliefs=beliefs)
    np.testing.assert_allclose(one.belief, result.belief[0], atol=1e-9)
    with pytest.raises(ValueError, match="the shape of beliefs is"):
        assessment.predict(*inputs(held_out), beliefs=beliefs[:, 1:])


def test_a_cell_holds_the_fusion_of_the_scores_that_the_map_sends_there(assessment):
    cells = assessment.grid_.locate(assessment.training_.points[0])
    filled, counts = np.unique(cells[cells >= 0], return_counts=True)
    for cell, count in zip(filled, counts, strict=True):
        belief = assessment.beliefs_[0, cell]
        if count < assessment.parameters.min_count:
            np.testing.assert_array_equal(belief[:3], EMPTY)
        else:
            # Equal uncertainties: F is the mean of the masses.
            here, training = cells == cell, assessment.training_
            score = np.average(training.score[here], weights=training.multiplicity[here])
            np.testing.assert_allclose(belief[:3], [0.7 * (1 - score), 0.7 * score, 0.3])


def test_predicted_margins_and_causes_name_what_will_be_violated(assessment, held_out):
    result = assessment.predict(*inputs(held_out))
    if not assessment.parameters.is_sharpened:
        assert np.all(np.isnan(result.predicted_margins))
        return
    assert np.all(np.isfinite(result.predicted_margins))
    error = np.abs(result.predicted_margins - np.clip(held_out.future_margins, -0.03, 0.10))
    assert np.median(error) < 0.02
    is_clear = held_out.is_unsafe & (result.belief[:, 1] > 0.4)
    named = result.cause_probability.argmax(axis=1)
    assert (named == held_out.cause)[is_clear].mean() > 0.9


def test_the_same_seed_learns_the_same_assessment(episodes):
    parameters = AssessmentParameters(**{**QUICK, "epochs": 1})
    first, again = (SafetyAssessment(parameters).fit(episodes[:60]) for _ in range(2))
    np.testing.assert_array_equal(first.beliefs_, again.beliefs_)
    np.testing.assert_array_equal(first.training_.points, again.training_.points)


def test_progress_runs_through_the_stages(episodes):
    seen = []
    SafetyAssessment(AssessmentParameters(**{**QUICK, "epochs": 1})).fit(
        episodes[:60], lambda stage, done, total: seen.append((stage, done / total))
    )
    assert list(dict.fromkeys(stage for stage, _ in seen)) == [
        "distances",
        "t-SNE",
        "training",
        "innovation",
        "beliefs",
    ]
    assert all(0.0 <= fraction <= 1.0 for _, fraction in seen)


def test_a_loaded_assessment_runs_with_numpy_alone(assessment, held_out, tmp_path):
    path = tmp_path / "assessment.safetensors"
    assessment.save(path)
    sizes = [part.shape[1] for part in inputs(held_out)]
    code = f"""
import sys, numpy as np
from drake_safety.learning.assessment import SafetyAssessment
assessment = SafetyAssessment.load({str(path)!r})
parts = [np.zeros(size) for size in {sizes}]
assessment.predict_one(*parts)
assessment.predict(*[part[None] for part in parts])
heavy = {{"torch", "openTSNE", "dtaidistance", "tslearn", "sklearn", "pydrake", "scipy", "numba"}}
sys.exit(", ".join(heavy & set(sys.modules)) or 0)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_inputs_of_another_width_are_refused_with_the_expected_one(assessment, held_out):
    state, preview, features = inputs(held_out)
    with pytest.raises(ValueError, match=r"of 'lip': state has the shape \(\d+, 5\), expected \("):
        assessment.predict(state[:, 1:], preview, features)
    with pytest.raises(ValueError, match=r"state has the shape \(5,\), expected \(6,\)"):
        assessment.predict_one(state[0, 1:], preview[0], features[0])
    with pytest.raises(ValueError, match="predict assesses many inputs"):
        assessment.predict_one(state, preview, features)


def test_episodes_of_another_horizon_and_too_few_episodes_are_refused(episodes):
    with pytest.raises(ValueError, match="'lip' is 10"):
        SafetyAssessment(AssessmentParameters(horizon=12)).fit(episodes)
    with pytest.raises(ValueError, match="needs more than 90 segments"):
        SafetyAssessment(AssessmentParameters()).fit(episodes[:2])


def test_nothing_can_be_asked_before_something_is_learned():
    with pytest.raises(ValueError, match="not fitted"):
        SafetyAssessment().predict(np.zeros((1, 6)), np.zeros((1, 30)))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mode", "blunt"),
        ("discount", 1.1),
        ("initial_uncertainty", -0.1),
        ("min_count", 0),
        ("cell_length", 0.0),
        ("dropout", 1.0),
        ("hidden_sizes", []),
        ("margin_range", [0.1, -0.1]),
        ("discount", float("nan")),
    ],
)
def test_parameters_out_of_range_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=name):
        AssessmentParameters(**{name: value})
    learner = SafetyAssessment()
    setattr(learner.parameters, name, value)
    with pytest.raises(ValueError, match=name):
        learner.fit(None)


@pytest.mark.parametrize(("part", "name"), [("paper", "loss"), ("adaptation", "count")])
def test_parameters_of_parts_are_checked_before_learning_too(part, name):
    learner = SafetyAssessment()
    setattr(getattr(learner.parameters, part), name, "sharp")
    with pytest.raises(ValueError, match=f"{name} is sharp"):
        learner.fit(None)


def test_the_defaults_are_the_papers_table():
    parameters = AssessmentParameters()
    assert parameters.discount == 0.99
    assert parameters.horizon == 10
    assert parameters.score_weight == 0.01
    assert parameters.initial_uncertainty == 0.3
    assert parameters.min_count == 5
    assert (parameters.resolution, parameters.cell_length) == (14, 10.0)


def test_features_may_enter_a_second_time_spread_out_near_zero(episodes, held_out):
    parameters = AssessmentParameters(
        feature_unit=0.05, raw_input_scale=0.2, **QUICK | {"epochs": 1}
    )
    doubled = SafetyAssessment(parameters).fit(episodes[:60])
    info = doubled.info_
    num_raw = len(info.state_names) + info.horizon * len(info.output_names)
    assert doubled.embedding_.num_inputs == num_raw + 2 * len(info.feature_names)
    state, preview, features = inputs(held_out, slice(0, 20))
    result = doubled.predict(state, preview, features)
    one = doubled.predict_one(state[3], preview[3], features[3])
    np.testing.assert_allclose(one.belief, result.belief[3], atol=1e-5)
    features[:] = np.nan
    assert np.all(doubled.predict(state, preview, features).belief == EMPTY)


@pytest.mark.parametrize(
    "wrong", [{"raw_input_scale": 0.0}, {"feature_unit": -1.0}, {"shortest_segment": 11}]
)
def test_scales_and_lengths_that_mean_nothing_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        AssessmentParameters(**wrong)


def trained_on(episodes, **changes):
    quick = QUICK | {"epochs": 1, "ensemble_size": 1} | changes
    return SafetyAssessment(AssessmentParameters(**quick)).fit(episodes)


def test_short_segments_of_safe_episodes_are_learned_from_where_they_are_asked_for(episodes):
    few = episodes[:40]
    sizes = {}
    for shortest in (0, 10, 3):
        learned = trained_on(few, shortest_segment=shortest)
        expected = split(few, stride=1, discount=0.99, shortest=shortest or None)
        sizes[shortest] = len(segments_for(few, learned.parameters)[0])
        assert sizes[shortest] == len(expected)
    assert sizes[0] == sizes[10] < sizes[3]  # The horizon is 10.


def test_the_papers_mode_knows_no_short_segments(episodes):
    few = episodes[:60]
    learned = [trained_on(few, mode="paper", shortest_segment=n, perplexity=5.0) for n in (0, 3)]
    sizes = {len(segments_for(few, assessment.parameters)[0]) for assessment in learned}
    assert sizes == {len(split(few, stride=1, discount=0.99))}


def test_parts_of_the_input_that_are_swapped_are_refused_by_name(assessment, held_out):
    state, preview, features = inputs(held_out)
    for name, swapped in {
        "state": (preview, state, features),
        "desired_preview": (state, np.hstack([preview, preview[:, :1]]), features),
    }.items():
        with pytest.raises(ValueError, match=rf"{name} has the shape \({len(state)}, \d+\), exp"):
            assessment.predict(*swapped)
    if assessment.parameters.is_sharpened:
        with pytest.raises(ValueError, match=r"features has the shape"):
            assessment.predict(state, preview, features[:, :-1])
        with pytest.raises(ValueError, match=r"features are missing, expected \d+ columns: \["):
            assessment.predict(state, preview)


def test_inputs_of_other_lengths_a_single_one_and_words_are_refused_by_name(assessment, held_out):
    state, preview, features = inputs(held_out)
    n, width = preview.shape
    message = rf"desired_preview has the shape \({n - 1}, {width}\), expected \({n}, {width}\), as"
    with pytest.raises(ValueError, match=message):
        assessment.predict(state, preview[1:], features)
    with pytest.raises(ValueError, match=r"state has the shape \(6,\), expected \(N, n_s\)"):
        assessment.predict(state[0], preview[0], features[0])
    with pytest.raises(ValueError, match=r"state must be an array of numbers: .*'three'"):
        assessment.predict([["three"] * 6], preview[:1], features[:1])


def test_an_assessment_says_scenario_mode_and_counts(assessment, episodes):
    mode = assessment.parameters.mode
    assert repr(SafetyAssessment()) == "SafetyAssessment(mode 'sharpened', not fitted)"
    told = repr(assessment)
    assert told.startswith(f"SafetyAssessment('lip', mode '{mode}', ")
    assert told.endswith(f"training on {len(episodes)} episodes of 'nominal')")


def test_learning_gives_the_same_bits_for_any_number_of_threads():
    episodes, found = make_episodes(120, noise=0.002), []
    for number in (1, 2):
        with threadpool_limits(number):
            found.append(SafetyAssessment(AssessmentParameters(**QUICK)).fit(episodes))
    one, other = found
    np.testing.assert_array_equal(one.beliefs_, other.beliefs_)
    for name in ("points", "heads"):
        pair = (getattr(each.training_, name) for each in found)
        np.testing.assert_array_equal(*pair)
    np.testing.assert_array_equal(one.novelty_.limits, other.novelty_.limits)
    for name, array in one.innovation_.arrays().items():
        np.testing.assert_array_equal(array, other.innovation_.arrays()[name], err_msg=name)
