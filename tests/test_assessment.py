import operator

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file
from threadpoolctl import threadpool_limits

from cart_episodes import assert_identical
from command_line import python
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.assessment_file import SCHEMA, SCHEMA_VERSION
from drake_safety.learning.beliefs import EMPTY
from drake_safety.learning.prediction import is_unknown
from drake_safety.learning.segments import split, training_segments
from lip_assessments import QUICK, held_out_segments, inputs, quick_assessment, quick_episodes
from lip_episodes import make_episodes
from sprung_motions import same_detector

pytestmark = pytest.mark.train


@pytest.fixture
def held_out():
    return held_out_segments()


@pytest.fixture(scope="module", params=["sharpened", "paper"])
def assessment(request):
    return quick_assessment(request.param)


@pytest.fixture
def path(assessment, tmp_path):
    """Where the assessment is saved."""
    assessment.save(tmp_path / "assessment.safetensors")
    return tmp_path / "assessment.safetensors"


def test_held_out_episodes_are_told_apart_by_consistent_masses(assessment, held_out):
    from sklearn.metrics import roc_auc_score

    result = assessment.predict(*inputs(held_out))
    area = roc_auc_score(held_out.is_unsafe, -result.belief[:, 0])
    assert area > (0.8 if assessment.uses_features else 0.75)
    np.testing.assert_allclose(result.belief.sum(axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(result.cause_probability.sum(axis=1), result.belief[:, 1])
    assert np.all((result.belief >= 0.0) & (result.belief[:, :1] <= 0.7 + 1e-9))
    assert np.all((result.probability >= 0.0) & (result.probability <= 1.0))
    unknown = is_unknown(result.belief, assessment.parameters.initial_uncertainty)
    assert unknown.any() and not unknown.all()
    np.testing.assert_array_equal(result.probability[unknown], 0.0)
    if not assessment.uses_features:
        np.testing.assert_array_equal(result.probability, result.belief[:, 0])


@pytest.mark.parametrize(("num_maps", "initial"), [(2, 0.3), (10, 0.7)])
def test_belief_is_dont_know_if_half_of_the_maps_know_nothing(num_maps, initial):
    # As `predict` averages a filled cell of every map that has one, and the empty belief.
    def mean_uncertainty(num_outside):
        masses = np.add.reduce(np.full(num_maps - num_outside, initial)) / num_maps
        return masses + (1.0 - (num_maps - num_outside) / num_maps)

    half = num_maps // 2
    beliefs = [(0.0, 0.0, mean_uncertainty(n)) for n in (half - 1, half, half + 1)]
    np.testing.assert_array_equal(is_unknown(np.array(beliefs), initial), [False, True, True])


def test_input_alone_has_the_same_bits_as_among_many(assessment, held_out):
    # Some rows are unlike training, some outside the grid, some not finite.
    scale = np.ones((len(held_out), 1))
    scale[::5], scale[1::50] = 10.0, np.nan
    given = [part * scale for part in inputs(held_out)]
    result = assessment.predict(*given)
    assert 0.05 < (result.belief[:, 2] == 1.0).mean() < 0.9
    rows = np.arange(0, len(held_out), 43)
    assert_identical([assessment.predict(*(part[rows] for part in given))], [result.one(rows)])
    for row in rows:
        one = assessment.predict_one(*(part[row] for part in given))
        assert_identical([one], [result.one(row)])


@pytest.mark.parametrize("bad", [np.nan, 1e200])
def test_input_that_is_not_finite_gets_the_empty_belief(assessment, held_out, bad):
    known = np.flatnonzero(assessment.predict(*inputs(held_out)).belief[:, 2] < 1.0)[:3]
    state, preview, features = (part.copy() for part in inputs(held_out, known))
    expected = assessment.predict(state, preview, features)
    state[1, 2] = bad
    result = assessment.predict(state, preview, features)
    one = assessment.predict_one(state[1], preview[1], features[1])
    for prediction in (result.one(1), one):
        np.testing.assert_array_equal(prediction.belief, EMPTY)
        assert prediction.probability == 0.0
    np.testing.assert_array_equal(result.belief[[0, 2]], expected.belief[[0, 2]])
    assert result.belief[0, 2] < 1.0


def test_cell_holds_the_fusion_of_the_scores_that_the_map_sends_there(assessment):
    cells, training = assessment.grid_.locate(assessment.training_.points[0]), assessment.training_
    filled, counts = np.unique(cells[cells >= 0], return_counts=True)
    for cell, count in zip(filled, counts, strict=True):
        belief = assessment.beliefs_[0, cell]
        if count < assessment.parameters.min_count:
            np.testing.assert_array_equal(belief[:3], EMPTY)
        else:
            # Equal uncertainties: F is the mean of the masses.
            here = cells == cell
            score = np.average(training.score[here], weights=training.multiplicity[here])
            np.testing.assert_allclose(belief[:3], [0.7 * (1 - score), 0.7 * score, 0.3])


def test_predicted_margins_and_causes_name_what_will_be_violated(assessment, held_out):
    result = assessment.predict(*inputs(held_out))
    if not assessment.uses_features:
        assert np.all(np.isnan(result.predicted_margins))
        return
    error = np.abs(result.predicted_margins - np.clip(held_out.future_margins, -0.03, 0.10))
    assert np.median(error) < 0.02
    is_clear = held_out.is_unsafe & (result.belief[:, 1] > 0.4)
    named = result.cause_probability.argmax(axis=1)
    assert (named == held_out.cause)[is_clear].mean() > 0.9


def test_loaded_assessment_runs_with_numpy_alone(assessment, held_out, path):
    sizes = [part.shape[1] for part in inputs(held_out)]
    code = f"""
import sys, numpy as np
from drake_safety.learning.assessment import SafetyAssessment
assessment = SafetyAssessment.load({str(path)!r})
parts = [np.zeros(size) for size in {sizes}]
assessment.predict_one(*parts)
assessment.predict(*[part[None] for part in parts])
heavy = {{"torch", "openTSNE", "dtaidistance", "sklearn", "pydrake", "scipy", "numba"}}
sys.exit(", ".join(heavy & set(sys.modules)) or 0)
"""
    python("-c", code)


def test_features_enter_a_second_time_with_a_feature_unit(held_out):
    changes = QUICK | {"epochs": 1, "feature_unit": 0.05, "raw_input_scale": 0.2}
    doubled = SafetyAssessment(AssessmentParameters(**changes)).fit(quick_episodes()[:60])
    info = doubled.info_
    num_raw = len(info.state_names) + info.horizon * len(info.output_names)
    state, preview, features = inputs(held_out, slice(0, 20))
    x = doubled.inputs_of(state, preview, features)
    expected = np.hstack([features, np.arcsinh(features / 0.05)])
    np.testing.assert_array_equal(x[:, num_raw:], expected)
    features[:] = np.nan
    assert np.all(doubled.predict(state, preview, features).belief == EMPTY)


@pytest.mark.parametrize("mode", ["sharpened", "paper"])
def test_short_segments_of_safe_episodes_are_learned_from_when_sharpened(mode):
    few = quick_episodes()[:40]
    for shortest in (0, 3):
        parameters = AssessmentParameters(mode=mode, shortest_segment=shortest)
        expected = shortest if shortest and mode == "sharpened" else None
        segments = split(few, stride=1, discount=0.99, shortest=expected)
        assert len(training_segments(few, parameters)) == len(segments)


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda a, s, p, f: a.predict(s[:, 1:], p, f), r"of 'lip': state .*\d+, 5\), expected \("),
        (lambda a, s, p, f: a.predict(s[0], p[0], f[0]), "state has 1 axes, expected 2"),
        (lambda a, s, p, f: a.predict(s, p[1:], f), "desired_preview has the shape"),
        (lambda a, s, p, f: a.predict(s, p, f, beliefs=a.beliefs_[:, 1:]), "have the shapes"),
    ],
)
def test_inputs_that_do_not_fit_are_refused_by_name(assessment, held_out, ask, message):
    with pytest.raises(ValueError, match=message):
        ask(assessment, *inputs(held_out))


@pytest.mark.parametrize(
    ("name", "value", "num_episodes", "message"),
    [
        ("horizon", 12, 40, "'lip' is 10"),
        ("horizon", 10, 2, "needs more than 90 segments"),
        ("adaptation.gate", -1.0, 40, r"'adaptation\.gate' must be greater"),
    ],
)
def test_what_cannot_be_learned_is_refused(name, value, num_episodes, message):
    learner = SafetyAssessment()
    part, _, name = name.rpartition(".")
    setattr(operator.attrgetter(f"parameters.{part}".rstrip("."))(learner), name, value)
    with pytest.raises(ValueError, match=message):
        learner.fit(quick_episodes()[:num_episodes])
    with pytest.raises(ValueError, match="not fitted"):
        learner.predict(np.zeros((1, 6)), np.zeros((1, 30)))


def test_learning_gives_the_same_bits_for_any_number_of_threads():
    episodes, learned, reports = make_episodes(120, noise=0.002), [], []
    for number in (1, 2):
        with threadpool_limits(number):
            learner = SafetyAssessment(AssessmentParameters(**QUICK | {"epochs": 3}))
            learned.append(learner.fit(episodes, lambda *report: reports.append(report)))
    one, other = learned
    np.testing.assert_array_equal(one.beliefs_, other.beliefs_)
    np.testing.assert_array_equal(one.training_.points, other.training_.points)
    np.testing.assert_array_equal(one.training_.heads, other.training_.heads)
    np.testing.assert_array_equal(one.novelty_.limits, other.novelty_.limits)
    assert same_detector(one.detector_, other.detector_)
    stages = ["monitor", "distances", "t-SNE", "training", "beliefs"]
    assert list(dict.fromkeys(stage for stage, *_ in reports)) == stages
    assert all(0 <= done <= total == 100 for _, done, total in reports)


def test_saved_assessment_is_loaded_to_the_bit(assessment, held_out, tmp_path, path):
    loaded = SafetyAssessment.load(path)
    assert loaded.parameters == assessment.parameters
    assert loaded.info_ == assessment.info_
    assert_identical(*([a.predict(*inputs(held_out))] for a in (assessment, loaded)))
    np.testing.assert_array_equal(loaded.training_.points, assessment.training_.points)
    assert loaded.embedding_.is_same(assessment.embedding_)
    assert same_detector(loaded.detector_, assessment.detector_)
    assert np.isfinite(loaded.embedding_.input_range).all() == assessment.uses_features
    assert list(tmp_path.iterdir()) == [path]
    # The same assessment gives the same bytes.
    loaded.save(tmp_path / "again")
    assert path.read_bytes() == (tmp_path / "again").read_bytes()


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        (None, "is not a safety assessment of this version: its metadata has the entries"),
        ({SCHEMA: '{"schema_version": 11}'}, f"version 11, .* reads {SCHEMA_VERSION}: train"),
        ({SCHEMA: f'{{"schema_version": {SCHEMA_VERSION}}}'}, "damaged .*: it has no 'sha256'"),
        ({SCHEMA: "[" * 100_000}, "torn' is a damaged safety assessment"),
    ],
)
def test_foreign_and_outdated_files_are_refused(tmp_path, path, metadata, message):
    save_file(load_file(path), tmp_path / "torn", metadata)
    with pytest.raises(ValueError, match=message):
        SafetyAssessment.load(tmp_path / "torn")


def test_truncated_and_missing_files_are_refused(tmp_path, path):
    content = path.read_bytes()
    for size in (0, 200, len(content) - 1):
        (tmp_path / "short").write_bytes(content[:size])
        with pytest.raises(ValueError, match="not a safety assessment or truncated"):
            SafetyAssessment.load(tmp_path / "short")
    with pytest.raises(FileNotFoundError, match=r"nowhere\.safetensors"):
        SafetyAssessment.load(tmp_path / "nowhere.safetensors")


def test_every_flipped_bit_is_noticed(path):
    content = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    header = int(content[:8].view(np.uint64)[0])
    rng = np.random.default_rng(0)
    # Half of them in names, shapes and metadata, half in numbers.
    ends = ((8, 8 + header), (8 + header, len(content)))
    for place in np.concatenate([rng.integers(*span, 60) for span in ends]):
        damaged = content.copy()
        damaged[place] ^= np.uint8(1 << rng.integers(8))
        path.write_bytes(damaged.tobytes())
        with pytest.raises(ValueError, match=r"assessment\.safetensors"):
            SafetyAssessment.load(path)
