"""Files of assessments: what is saved is loaded to the bit, and what is damaged is refused."""

import dataclasses

import numpy as np
import pytest

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.assessment_file import SCHEMA, SCHEMA_VERSION
from drake_safety.learning.calibration import calibrate
from lip_assessments import held_out_segments, inputs, quick_assessment

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def held_out():
    return held_out_segments()


@pytest.fixture(scope="module", params=["sharpened", "paper"])
def assessment(request):
    return quick_assessment(request.param)


def test_what_is_saved_is_loaded_to_the_bit(assessment, held_out, tmp_path):
    path = tmp_path / "assessment.safetensors"
    assessment.save(path)
    loaded = SafetyAssessment.load(path)
    assert loaded.parameters == assessment.parameters
    assert loaded.info_ == assessment.info_
    before, after = (a.predict(*inputs(held_out)) for a in (assessment, loaded))
    for field in dataclasses.fields(before):
        np.testing.assert_array_equal(getattr(before, field.name), getattr(after, field.name))
    np.testing.assert_array_equal(loaded.training_.points, assessment.training_.points)
    assert loaded.embedding_.is_same(assessment.embedding_)
    assert np.isfinite(loaded.embedding_.input_range).all() == assessment.parameters.is_sharpened
    assert list(tmp_path.iterdir()) == [path]


def test_a_calibration_is_kept_with_the_assessment(assessment, tmp_path):
    score = np.linspace(0, 1, 200)
    found = calibrate(score, score > 0.4, kind="plan", miss_rate=0.05, confidence=0.9)
    path = tmp_path / "gamma.safetensors"
    assert assessment.calibrations_ == {}
    assessment.calibrations_ = {"plan": found}
    assessment.save(path)
    assessment.calibrations_ = {}
    assert SafetyAssessment.load(path).calibrations_ == {"plan": found}
    assessment.save(path)
    assert SafetyAssessment.load(path).calibrations_ == {}


def test_a_failed_save_leaves_the_earlier_file_and_nothing_else(assessment, tmp_path, monkeypatch):
    path = tmp_path / "assessment.safetensors"
    assessment.save(path)
    content = path.read_bytes()

    def full_disk(descriptor):
        raise OSError("no space left")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(OSError, match="no space"):
        assessment.save(path)
    assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


def test_a_truncated_a_foreign_and_an_outdated_file_are_refused(assessment, tmp_path):
    from safetensors.numpy import load_file, save_file

    path = tmp_path / "assessment.safetensors"
    assessment.save(path)
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
    save_file(load_file(path), tmp_path / "hollow", {SCHEMA: '{"schema_version": 9}'})
    with pytest.raises(ValueError, match="damaged safety assessment: it has no 'sha256'"):
        SafetyAssessment.load(tmp_path / "hollow")
    for text in ("", "[]", "{}", "[" * 100_000):
        save_file(load_file(path), tmp_path / "torn", {SCHEMA: text})
        with pytest.raises(ValueError, match="torn' is a damaged safety assessment"):
            SafetyAssessment.load(tmp_path / "torn")


def test_every_flipped_bit_is_noticed(assessment, tmp_path):
    path = tmp_path / "assessment.safetensors"
    assessment.save(path)
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
