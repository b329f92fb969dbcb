"""Assessments with a valid checksum and impossible content are refused where they are read."""

import copy
import json

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save

from drake_safety import SafetyAssessment
from drake_safety.assessments import shipped_folder
from drake_safety.learning import assessment_file

FEW = 40


@pytest.fixture(scope="module")
def content():
    """Entries and arrays of a shipped assessment with few of its training segments."""
    path = shipped_folder("laikago_balancing") / "sharpened.safetensors"
    with safe_open(path, framework="numpy") as file:
        entries = json.loads(file.metadata()[assessment_file.SCHEMA])
        arrays = {name: file.get_tensor(name) for name in file.keys()}
    for name in ("cause", "heads", "multiplicity", "nearest", "score"):
        arrays[f"training_{name}"] = arrays[f"training_{name}"][:FEW]
    arrays["training_points"] = arrays["training_points"][:, :FEW]
    return {key: entries[key] for key in entries if key != "sha256"}, arrays


@pytest.fixture
def loaded(content, tmp_path):
    """Loads the content with other arrays and entries, under the checksum that they have."""

    def load(arrays=None, entries=None):
        stored = content[1] | (arrays or {})
        stored = {name: np.ascontiguousarray(one) for name, one in stored.items()}
        told = copy.deepcopy(content[0])
        for place, value in (entries or {}).items():
            *folders, key = place.split(".")
            inner = told
            for folder in folders:
                inner = inner[folder]
            inner[key] = value
        text = assessment_file._to_json(told | {"sha256": assessment_file._digest(told, stored)})
        path = tmp_path / "forged.safetensors"
        path.write_bytes(save(stored, {assessment_file.SCHEMA: text}))
        return SafetyAssessment.load(path)

    return load


def put(array, value, place=0):
    changed = array.copy()
    changed.flat[place] = value
    return changed


def test_the_content_without_a_change_is_loaded(loaded):
    assert loaded().info_.scenario == "laikago_balancing"


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("beliefs", lambda a: put(a, np.nan), r"has nan, expected 0 to 1"),
        ("beliefs", lambda a: put(a, -0.1), r"has -0\.1, expected 0 to 1"),
        ("beliefs", lambda a: a / 2, "do not sum to 1"),
        ("beliefs", lambda a: a[:, 1:], r"has the shape \(3, 195, \d\), expected \(3, 196, \d\)"),
        ("beliefs", lambda a: a[..., :-1], "has the shape"),
        ("correction.change", lambda a: a[:3], r"has the shape \(3,\), expected \(4,\)"),
        ("correction.guard", lambda a: put(a, 7), "has 7.0, expected 0 to 1"),
        ("detector.limits", lambda a: put(a, np.nan), "has nan"),
        ("detector.limits", lambda a: put(a, -1.0), "has -1"),
        ("detector.predictor.scale", np.zeros_like, "has 0.0"),
        ("detector.predictor.hidden.1.bias", lambda a: a[:1], r"has the shape \(1,\), its weight"),
        (
            "detector.predictor.hidden.1.weight",
            lambda a: a[:5],
            r"has the shape \(5, 256\), expected \(256, ",
        ),
        ("detector.settings", lambda a: put(a, 0.0, 2), "step 0.0 s"),
        ("detector.settings", lambda a: put(a, np.nan), "has nan"),
        ("detector.columns", lambda a: put(a, 10**6), "has 1000000.0, expected 0 to"),
        ("detector.watched", lambda a: put(a, -1), "has -1.0, expected 0 to"),
        ("embedding.trunk.0.weight", lambda a: put(a, np.inf), "has inf"),
        ("embedding.trunk.1.weight", lambda a: a[:, 5:], "has the shape"),
        ("novelty.mean", lambda a: a[1:], "has the shape"),
        ("novelty.covariance", np.negative, "variances of 'novelty' are negative"),
        ("training_score", lambda a: a + 1.0, "expected 0 to 1"),
        ("training_points", lambda a: a[:, 1:], "has the shape"),
        ("training_cause", lambda a: put(a, 99), "has 99.0, expected -1 to"),
        ("training_multiplicity", np.zeros_like, "has 0.0"),
        ("trees.feature", lambda a: put(a, 60000), "has 60000.0, expected 0 to"),
        ("trees.threshold", lambda a: put(a, np.nan), "has nan"),
        ("trees.value", lambda a: a[:, :-1], "has the shape"),
    ],
)
def test_a_forged_array_is_refused_by_name(content, loaded, name, change, message):
    message = rf"forged\.safetensors.* damaged .*'{name}'.*{message}"
    if "to 1" in message or "negative" in message:
        message = message.replace(f"'{name}'.*", "")
    with pytest.raises(ValueError, match=message):
        loaded({name: change(content[1][name])})


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("parameters.horizon", 10**12, "'horizon' must be less than or equal to 10000"),
        ("parameters.resolution", 10**9, "'resolution' must be less than"),
        ("info.horizon", 10**12, r"horizon is 1000000000000, expected 1\.\.10000"),
        ("info.horizon", 11, "has the shape"),
        ("info.step_s", float("nan"), "step_s is nan"),
        ("info.constraint_names", ["a"], "has the shape"),
        ("numbers.base_logit.offset", float("nan"), "BaseLogit: 'offset' must"),
        ("numbers.base_logit.margin_unit", 0.0, "'margin_unit' must be greater than 0"),
        ("numbers.novelty_limits", [float("nan")] * 4, "its novelty has the counts"),
        ("numbers.novelty_counts", [0, 0], "its novelty has the counts"),
        ("numbers.used", [{"purpose": "training"}], "'variation' is missing"),
    ],
)
def test_a_forged_entry_is_refused(loaded, place, value, message):
    with pytest.raises(ValueError, match=rf"forged\.safetensors.* damaged .*{message}"):
        loaded(entries={place: value})
