import copy
import json
import operator
import subprocess
import sys
from dataclasses import fields, replace

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from threadpoolctl import threadpool_limits

from drake_safety.evaluation.metrics import area_under_curve
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.assessment_file import SCHEMA, SCHEMA_VERSION, _digest
from drake_safety.learning.beliefs import EMPTY
from drake_safety.learning.prediction import Correction, is_unknown
from drake_safety.learning.segments import split, training_segments
from lip_assessments import (
    QUICK,
    calibration,
    held_out_segments,
    inputs,
    quick_assessment,
    quick_episodes,
)
from lip_episodes import make_episodes

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


def test_parameters_that_change_afterwards_change_nothing_that_was_learned():
    parameters = AssessmentParameters(hidden_sizes=[8, 8])
    learner = SafetyAssessment(parameters)
    parameters.mode, parameters.hidden_sizes[0] = "paper", 3
    assert (learner.parameters.mode, learner.parameters.hidden_sizes) == ("sharpened", [8, 8])


def test_held_out_episodes_are_told_apart(assessment, held_out):
    result = assessment.predict(*inputs(held_out))
    area = area_under_curve(-result.belief[:, 0], held_out.is_unsafe)
    assert area > (0.88 if assessment.uses_features else 0.75)


def test_the_probability_is_b_safe_without_heads_and_zero_where_it_is_dont_know(
    assessment, held_out
):
    result = assessment.predict(*inputs(held_out))
    np.testing.assert_allclose(result.belief.sum(axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(result.cause_probability.sum(axis=1), result.belief[:, 1])
    assert np.all(result.belief >= 0.0)
    assert np.all(result.belief[:, 0] <= 0.7 + 1e-9)
    assert np.all((result.probability >= 0.0) & (result.probability <= 1.0))
    unknown = is_unknown(result.belief, assessment.parameters.initial_uncertainty)
    assert unknown.any() and not unknown.all()
    np.testing.assert_array_equal(result.probability[unknown], 0.0)
    if not assessment.uses_features:
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
    if not assessment.uses_features:
        assert np.all(np.isnan(result.predicted_margins))
        return
    assert np.all(np.isfinite(result.predicted_margins))
    error = np.abs(result.predicted_margins - np.clip(held_out.future_margins, -0.03, 0.10))
    assert np.median(error) < 0.02
    is_clear = held_out.is_unsafe & (result.belief[:, 1] > 0.4)
    named = result.cause_probability.argmax(axis=1)
    assert (named == held_out.cause)[is_clear].mean() > 0.9


def test_a_loaded_assessment_runs_with_numpy_alone(assessment, held_out, path):
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


def test_features_may_enter_a_second_time_spread_out_near_zero(held_out):
    parameters = AssessmentParameters(
        feature_unit=0.05, raw_input_scale=0.2, **QUICK | {"epochs": 1}
    )
    doubled = SafetyAssessment(parameters).fit(quick_episodes()[:60])
    info = doubled.info_
    num_raw = len(info.state_names) + info.horizon * len(info.output_names)
    assert doubled.embedding_.num_inputs == num_raw + 2 * len(info.feature_names)
    state, preview, features = inputs(held_out, slice(0, 20))
    result = doubled.predict(state, preview, features)
    one = doubled.predict_one(state[3], preview[3], features[3])
    np.testing.assert_allclose(one.belief, result.belief[3], atol=1e-5)
    features[:] = np.nan
    assert np.all(doubled.predict(state, preview, features).belief == EMPTY)


def test_an_assessment_says_scenario_mode_and_counts(assessment):
    mode = assessment.parameters.mode
    assert repr(SafetyAssessment()) == "SafetyAssessment(mode 'sharpened', not fitted)"
    told = repr(assessment)
    assert told.startswith(f"SafetyAssessment('lip', mode '{mode}', ")
    assert told.endswith(f"training on {len(quick_episodes())} episodes of 'nominal')")


@pytest.mark.parametrize("mode", ["sharpened", "paper"])
def test_short_segments_of_safe_episodes_are_learned_from_where_they_are_asked_for(mode):
    few, sizes = quick_episodes()[:40], {}
    for shortest in (0, 10, 3):
        parameters = AssessmentParameters(mode=mode, shortest_segment=shortest)
        is_asked = shortest and mode == "sharpened"  # The paper's mode knows none.
        expected = split(few, stride=1, discount=0.99, shortest=shortest if is_asked else None)
        sizes[shortest] = len(training_segments(few, parameters))
        assert sizes[shortest] == len(expected)
    assert sizes[0] == sizes[10]  # The horizon.
    assert (sizes[3] > sizes[0]) == (mode == "sharpened")


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda a, s, p, f: a.predict(s[:, 1:], p, f), r"of 'lip': state .*\d+, 5\), expected \("),
        (lambda a, s, p, f: a.predict_one(s[0, 1:], p[0], f[0]), r"shape \(5,\), expected \(6,\)"),
        (lambda a, s, p, f: a.predict_one(s, p, f), "predict assesses many inputs"),
        (
            lambda a, s, p, f: a.predict(s, p, f, beliefs=a.beliefs_[:, 1:]),
            "the shape of beliefs is",
        ),
        (lambda a, s, p, f: a.predict(p, s, f), r"state has the shape \(\d+, \d+\), exp"),
        (
            lambda a, s, p, f: a.predict(s, np.hstack([p, p[:, :1]]), f),
            r"desired_preview has the shape \(\d+, \d+\), exp",
        ),
        (
            lambda a, s, p, f: a.predict(s, p[1:], f),
            r"desired_preview has the shape \((\d+), \d+\), expected \((?!\1)\d+, \d+\), as",
        ),
        (lambda a, s, p, f: a.predict(s[0], p[0], f[0]), r"shape \(6,\), expected \(N, n_s\)"),
        (
            lambda a, s, p, f: a.predict([["three"] * 6], p[:1], f[:1]),
            r"state must be an array of numbers: .*'three'",
        ),
    ],
)
def test_inputs_that_do_not_fit_are_refused_by_name(assessment, held_out, ask, message):
    with pytest.raises(ValueError, match=message):
        ask(assessment, *inputs(held_out))


def test_features_that_do_not_fit_are_refused_where_they_are_used(assessment, held_out):
    state, preview, features = inputs(held_out)
    if assessment.uses_features:
        with pytest.raises(ValueError, match=r"features has the shape"):
            assessment.predict(state, preview, features[:, :-1])
        with pytest.raises(ValueError, match=r"features are missing, expected \d+ columns: \["):
            assessment.predict(state, preview)


@pytest.mark.parametrize(
    ("name", "value", "num_episodes", "message"),
    [
        ("horizon", 12, 40, "'lip' is 10"),
        ("horizon", 10, 2, "needs more than 90 segments"),
        ("discount", 1.1, 40, "discount"),
        ("paper.loss", "sharp", 40, "'paper.loss' must be 'squared' or 'norm'; got 'sharp'"),
        ("adaptation.count", "sharp", 40, "count"),
    ],
)
def test_what_cannot_be_learned_is_refused_and_nothing_is_known(name, value, num_episodes, message):
    learner = SafetyAssessment()
    part, _, name = name.rpartition(".")
    setattr(operator.attrgetter(f"parameters.{part}".rstrip("."))(learner), name, value)
    with pytest.raises(ValueError, match=message):
        learner.fit(quick_episodes()[:num_episodes])
    with pytest.raises(ValueError, match="not fitted"):
        learner.predict(np.zeros((1, 6)), np.zeros((1, 30)))


def assert_same_detector(one, other):
    for name, array in one.detector_.arrays().items():
        np.testing.assert_array_equal(array, other.detector_.arrays()[name], err_msg=name)


def test_learning_gives_the_same_bits_for_any_number_of_threads():
    episodes, found, seen = make_episodes(120, noise=0.002), [], []
    for number in (1, 2):
        with threadpool_limits(number):
            learner = SafetyAssessment(AssessmentParameters(**QUICK))
            found.append(learner.fit(episodes, lambda *report: seen.append(report)))
    one, other = found
    np.testing.assert_array_equal(one.beliefs_, other.beliefs_)
    for name in ("points", "heads"):
        pair = (getattr(each.training_, name) for each in found)
        np.testing.assert_array_equal(*pair)
    np.testing.assert_array_equal(one.novelty_.limits, other.novelty_.limits)
    assert_same_detector(one, other)
    stages = ["monitor", "distances", "t-SNE", "training", "beliefs"]
    assert list(dict.fromkeys(stage for stage, *_ in seen)) == stages
    assert all(0 <= done <= total == 100 for _, done, total in seen)


def test_what_is_saved_is_loaded_to_the_bit(assessment, held_out, tmp_path, path):
    loaded = SafetyAssessment.load(path)
    assert loaded.parameters == assessment.parameters
    assert loaded.info_ == assessment.info_
    before, after = (a.predict(*inputs(held_out)) for a in (assessment, loaded))
    for field in fields(before):
        np.testing.assert_array_equal(getattr(before, field.name), getattr(after, field.name))
    np.testing.assert_array_equal(loaded.training_.points, assessment.training_.points)
    assert loaded.embedding_.is_same(assessment.embedding_)
    assert_same_detector(loaded, assessment)
    assert np.isfinite(loaded.embedding_.input_range).all() == assessment.uses_features
    assert list(tmp_path.iterdir()) == [path]


def test_trees_speak_beside_the_maps_unless_they_are_switched_off(assessment, held_out):
    if not assessment.uses_features:
        assert assessment.trees_ is None
        return
    without = SafetyAssessment(AssessmentParameters(**QUICK, trees=False)).fit(quick_episodes())
    assert (without.trees_, without.base_logit_.trees_slope) == (None, 0.0)
    assert without.training_.heads.shape[1] + 1 == assessment.training_.heads.shape[1] == 3
    assert assessment.base_logit_.trees_slope > 0.1
    found, expected = (a.predict(*inputs(held_out)) for a in (assessment, without))
    assert np.abs(found.probability - expected.probability).max() > 0.05
    # The rest of it is the maps'.
    for name in ("belief", "cause_probability", "embedding", "predicted_margins", "novelty"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    gradients = (a.unsafe_logits(*inputs(held_out)) for a in (assessment, without))
    np.testing.assert_array_equal(*(gradient for *_, gradient in gradients))
    area = [area_under_curve(-one.probability, held_out.is_unsafe) for one in (found, expected)]
    assert area[0] > area[1] - 0.005


def test_a_file_of_the_version_before_trees_is_read_to_the_bit(assessment, held_out, path):
    before = copy.copy(assessment)
    if before.trees_ is not None:
        before.trees_ = None
        before.base_logit_ = replace(before.base_logit_, trees_slope=0.0)
        before.training_ = replace(before.training_, heads=before.training_.heads[:, :2])
        before.correction_ = Correction.none(before.embedding_, before.grid_)
    before.save(path)
    with safe_open(path, framework="numpy") as file:
        entries, tensors = json.loads(file.metadata()[SCHEMA]), load_file(path)
    entries |= {"schema_version": 11}
    del entries["sha256"], entries["parameters"]["trees"]
    if entries["numbers"]["base_logit"] is not None:
        del entries["numbers"]["base_logit"]["trees_slope"]
    entries["sha256"] = _digest(entries, tensors)
    save_file(tensors, path, {SCHEMA: json.dumps(entries)})
    loaded = SafetyAssessment.load(path)
    assert not loaded.parameters.trees
    one, other = (a.predict(*inputs(held_out)) for a in (before, loaded))
    for field in fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))
    if before.base_logit_ is not None:
        logit = before.base_logit_
        heads = logit.heads(before.embedding_.evaluate(before.inputs_of(*inputs(held_out))))
        said = heads[:, 0] * logit.safety_slope + heads[:, 1] * logit.margin_slope
        said = 1.0 / (1.0 + np.exp(np.clip(logit.offset + said, -8.0, 8.0)))
        is_known = other.probability > 0.0
        np.testing.assert_array_equal(other.probability[is_known], said[is_known])


def test_a_calibration_is_kept_with_the_assessment(assessment, tmp_path):
    found = calibration(confidence=0.9)
    path = tmp_path / "gamma.safetensors"
    assert assessment.calibrations_ == {}
    assessment.calibrations_ = {"plan": found}
    assessment.save(path)
    assessment.calibrations_ = {}
    assert SafetyAssessment.load(path).calibrations_ == {"plan": found}
    assessment.save(path)
    assert SafetyAssessment.load(path).calibrations_ == {}


def test_a_failed_save_leaves_the_earlier_file_and_nothing_else(
    assessment, tmp_path, monkeypatch, path
):
    content = path.read_bytes()

    def full_disk(descriptor):
        raise OSError("no space left")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(OSError, match="no space"):
        assessment.save(path)
    assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


def test_a_truncated_a_foreign_and_an_outdated_file_are_refused(tmp_path, path):
    content = path.read_bytes()
    for size in (0, 5, 200, len(content) // 2, len(content) - 1):
        (tmp_path / "short").write_bytes(content[:size])
        with pytest.raises(ValueError, match="not a safety assessment or truncated"):
            SafetyAssessment.load(tmp_path / "short")
    save_file({"x": np.zeros(3)}, tmp_path / "foreign")
    with pytest.raises(ValueError, match="is not a safety assessment: its metadata has the entr"):
        SafetyAssessment.load(tmp_path / "foreign")
    metadata = {"schema": SCHEMA, "schema_version": "8"}
    save_file(load_file(path), tmp_path / "old", metadata)
    with pytest.raises(ValueError, match=f"schema version 8, this version reads {SCHEMA_VERSION}"):
        SafetyAssessment.load(tmp_path / "old")
    save_file(
        load_file(path), tmp_path / "hollow", {SCHEMA: f'{{"schema_version": {SCHEMA_VERSION}}}'}
    )
    with pytest.raises(ValueError, match="damaged safety assessment: it has no 'sha256'"):
        SafetyAssessment.load(tmp_path / "hollow")
    for text in ("", "[]", "{}", "[" * 100_000):
        save_file(load_file(path), tmp_path / "torn", {SCHEMA: text})
        with pytest.raises(ValueError, match="torn' is a damaged safety assessment"):
            SafetyAssessment.load(tmp_path / "torn")


def test_every_flipped_bit_is_noticed(path):
    content = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    header = int(content[:8].view(np.uint64)[0])
    rng = np.random.default_rng(0)
    # Half of them in names, shapes and metadata, half in numbers.
    places = np.concatenate(
        [rng.integers(8, 8 + header, 150), rng.integers(8 + header, len(content), 150)]
    )
    for place in places:
        damaged = content.copy()
        damaged[place] ^= np.uint8(1 << rng.integers(8))
        path.write_bytes(damaged.tobytes())
        with pytest.raises(ValueError, match=r"assessment\.safetensors"):
            SafetyAssessment.load(path)


def test_the_same_assessment_gives_the_same_bytes(assessment, tmp_path):
    paths = [tmp_path / f"{i}.safetensors" for i in range(5)]
    for path in paths:
        assessment.save(path)
    SafetyAssessment.load(paths[0]).save(paths[-1])
    assert len({path.read_bytes() for path in paths}) == 1


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.safetensors"):
        SafetyAssessment.load(tmp_path / "nowhere.safetensors")
