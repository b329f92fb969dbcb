"""Assessments with a valid checksum and impossible content are refused where they are read."""

import copy
import functools
import json
import operator

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
        stored = {name: np.ascontiguousarray(array) for name, array in stored.items()}
        forged = copy.deepcopy(content[0])
        for place, value in (entries or {}).items():
            *folders, key = place.split(".")
            functools.reduce(operator.getitem, folders, forged)[key] = value
        text = json.dumps(forged | {"sha256": assessment_file.digest(forged, stored)})
        path = tmp_path / "forged.safetensors"
        path.write_bytes(save(stored, {assessment_file.SCHEMA: text}))
        return SafetyAssessment.load(path)

    return load


def put(array, value, place=0):
    changed = array.copy()
    changed.flat[place] = value
    return changed


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("beliefs", lambda a: put(a, np.nan)),
        ("beliefs", lambda a: a / 2),
        ("correction.guard", lambda a: put(a, 7)),
        ("detector.limits", lambda a: put(a, -1.0)),
        ("detector.predictor.hidden.1.bias", lambda a: a[:1]),
        ("detector.settings", lambda a: put(a, 0.0, 2)),
        ("detector.columns", lambda a: put(a, 10**6)),
        ("beliefs", lambda a: a[..., :-1]),
        ("embedding.trunk.0.weight", lambda a: put(a, np.inf)),
        ("embedding.trunk.1.weight", lambda a: a[:, 5:]),
        ("trees.value", lambda a: a[:, :-1]),
        ("novelty.covariance", np.negative),
        ("training_cause", lambda a: put(a, 99)),
        ("training_multiplicity", np.zeros_like),
    ],
)
def test_forged_array_is_refused_by_name(content, loaded, name, change):
    assert loaded().info_.scenario == "laikago_balancing"  # Without the change.
    name_or_group = name.split(".")[0]
    with pytest.raises(ValueError, match=rf"forged\.safetensors.* damaged .*'{name_or_group}"):
        loaded({name: change(content[1][name])})


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("parameters.resolution", 10**9, "'resolution' must be less than"),
        ("info.horizon", 10**12, "horizon 1000000000000, prev"),
        ("info.constraint_names", ["a"], "has the shape"),
        ("numbers.base_logit.offset", float("nan"), "BaseLogit: 'offset' must"),
        ("numbers.novelty_limits", [float("nan")] * 4, "its novelty has the counts"),
        ("numbers.used", [{"purpose": "training"}], "'variation' is missing"),
    ],
)
def test_forged_entry_is_refused(loaded, place, value, message):
    with pytest.raises(ValueError, match=rf"forged\.safetensors.* damaged .*{message}"):
        loaded(entries={place: value})
