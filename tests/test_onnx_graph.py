import copy
import dataclasses
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from packaging.version import Version

from command_line import call
from drake_safety.assessments import assessed_scenarios, load_assessment
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.fall_logit import FallLogit
from drake_safety.learning.inputs import InputColumns
from drake_safety.learning.novelty import Novelty
from drake_safety.learning.prediction import Correction, is_unknown
from drake_safety.learning.trained_maps import Embedding
from drake_safety.learning.trees import Trees

onnx = pytest.importorskip("onnx", reason="the extra 'onnx' is not installed")
onnxruntime = pytest.importorskip("onnxruntime", reason="the extra 'walking' is not installed")

DOCUMENTED = Path(__file__).resolve().parents[1] / "docs/export.md"
FIELDS = {
    "belief": "belief",
    "safety_probability": "probability",
    "cause_probability": "cause_probability",
    "predicted_margins": "predicted_margins",
    "novelty": "novelty",
    "embedding": "embedding",
    "fall_probability": "fall_probability",
}
"""Output port and field of `Prediction`."""
NUM_INPUTS = 6000
TAKES_NO_ROWS = Version("1.32")
"""The first onnxruntime that takes an empty batch through the graph's search of the grid."""
SINGLE = 2e-5
"""Largest difference of probabilities by rounding of single precision."""


class Runtime:
    """A file in onnxruntime."""

    def __init__(self, path):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        providers = ["CPUExecutionProvider"]
        self.session = onnxruntime.InferenceSession(str(path), options, providers=providers)

    def __call__(self, inputs):
        names = [port.name for port in self.session.get_outputs()]
        return dict(zip(names, self.session.run(None, inputs), strict=True))

    @property
    def contract(self):
        stored = self.session.get_modelmeta().custom_metadata_map
        return {name: json.loads(value) for name, value in stored.items()}


def exported(assessment, folder):
    assessment.to_onnx(folder / "gamma.onnx")
    return Runtime(folder / "gamma.onnx")


def ports_of(assessment, x):
    """The arguments of `predict` for inputs x (N, n_x), random where a state is not used."""
    info = assessment.info_
    is_used = assessment.columns_.is_used
    state = np.random.default_rng(9).normal(size=(len(x), len(is_used)))
    ends = np.cumsum([is_used.sum(), info.widths["desired_preview"], info.widths["features"]])
    state[:, is_used], preview, features, _ = np.split(x, ends, axis=1)
    ports = {"state": state, "desired_preview": np.ascontiguousarray(preview)}
    if assessment.uses_features and info.feature_names:
        ports["features"] = np.ascontiguousarray(features)
    return ports


def every_kind_of_input(assessment, num=NUM_INPUTS):
    """Inputs like those of training, ever farther from them, far outside, and not finite."""
    rng = np.random.default_rng(0)
    known = assessment.novelty_.training
    x = rng.multivariate_normal(known.mean, known.covariance, size=num, method="eigh")
    spread = np.repeat([0.5, 0.75, 1.0, 2.0, 10.0], num // 5)[:, None]
    x = known.mean + spread * (x - known.mean)
    ports = ports_of(assessment, x)
    rows = rng.permutation(num)[: num // 10]
    for name, values in ports.items():
        values[rows[:20]] = rng.normal(scale=1e3, size=(20, values.shape[1]))
        for row, odd in zip(
            rows[20:], 6 * [np.nan, np.inf, -np.inf, 1e14, 1e16, -1e200], strict=False
        ):
            if rng.random() < 0.5 or name == "state":
                values[row, rng.integers(values.shape[1])] = odd
    return ports


def difference(found, expected):
    """The largest difference, infinite where only one is not finite."""
    assert found.shape == expected.shape
    is_same = (found == expected) | (np.isnan(found) & np.isnan(expected))
    with np.errstate(invalid="ignore"):
        apart = np.abs(found - expected)
    return np.where(is_same, 0.0, np.where(np.isnan(apart), np.inf, apart)).max(initial=0.0)


def check_equal(assessment, runtime, ports=None):
    """Checks that all outputs are those of `predict`; returns these."""
    ports = every_kind_of_input(assessment) if ports is None else ports
    found, expected = runtime(ports), assessment.predict(**ports)
    assert found.keys() == FIELDS.keys()
    finite = np.isfinite(expected.novelty)
    for name in ("belief", "safety_probability", "cause_probability"):
        apart = difference(found[name], getattr(expected, FIELDS[name]))
        assert apart <= SINGLE, name
    for name in ("predicted_margins", "embedding"):
        value = getattr(expected, FIELDS[name])
        np.testing.assert_array_equal(np.isnan(found[name]), np.isnan(value))
        known = finite & (expected.novelty <= 1.0)
        assert difference(found[name][known], value[known]) <= 1e-3, name
    fall, value = found["fall_probability"], expected.fall_probability
    np.testing.assert_array_equal(np.isnan(fall), np.isnan(value))
    np.testing.assert_allclose(fall[finite], value[finite], atol=1e-3)
    np.testing.assert_array_equal(np.isinf(found["novelty"]), ~finite)
    np.testing.assert_allclose(found["novelty"], expected.novelty, rtol=1e-9)
    assert all(values.dtype == np.float64 for values in found.values())
    return expected


@pytest.mark.parametrize("mode", ["sharpened", "paper"])
@pytest.mark.parametrize("name", assessed_scenarios())
def test_the_graph_of_a_shipped_assessment_says_what_predict_says_of_every_kind_of_input(
    name, mode, tmp_path
):
    assessment = load_assessment(name, mode)
    expected = check_equal(assessment, exported(assessment, tmp_path))
    # All kinds were among them: judged, of empty cells, novel and not finite.
    unknown = is_unknown(expected.belief, assessment.parameters.initial_uncertainty)
    is_novel = expected.novelty > 1.0
    assert np.mean(~unknown) > 0.3
    assert np.sum(unknown & ~is_novel) > 0
    assert np.sum(is_novel & np.isfinite(expected.novelty)) > 50
    assert 20 < np.sum(np.isinf(expected.novelty)) < 100
    assert np.ptp(expected.probability) > 0.5


def without_margins(assessment):
    weights = dict(assessment.embedding_.weights)
    for name in ("output.weight", "output.bias"):
        weights[name] = weights[name][..., :2]
    return with_maps(assessment, weights, 0)


def without_safety_heads(assessment):
    maps = assessment.embedding_
    kept = {name: w for name, w in maps.weights.items() if not name.startswith("safety.")}
    return with_maps(assessment, kept, maps.num_margins)


def with_maps(assessment, weights, num_margins):
    changed, limits = copy.copy(assessment), assessment.embedding_.input_range
    changed.embedding_ = Embedding(weights, num_margins=num_margins, input_range=limits)
    return changed


def with_whole_numbers(assessment):
    changed = copy.copy(assessment)
    whole = {"margin_unit": 1, "margin_range": (-1, 2), "offset": 1, "safety_slope": 1}
    changed.base_logit_ = dataclasses.replace(changed.base_logit_, **whole, margin_slope=2)
    changed.grid_ = dataclasses.replace(changed.grid_, cell_length=10)
    changed.parameters = dataclasses.replace(changed.parameters, feature_unit=1)
    changed.columns_ = InputColumns(changed.info_, changed.parameters)
    return changed


def with_trees(assessment):
    """Beside fifty trees of three nodes."""
    rng, known = np.random.default_rng(5), assessment.novelty_.training
    feature = rng.integers(len(known.mean), size=(3, 50))
    threshold = known.mean[feature] + known.scale[feature] * rng.normal(size=feature.shape)
    left = np.repeat([[0b0011], [0b0001], [0b0100]], 50, axis=1)
    changed = copy.copy(assessment)
    changed.trees_ = Trees(
        feature=feature, threshold=threshold, left=left, value=rng.normal(size=(50, 4))
    )
    changed.base_logit_ = dataclasses.replace(assessment.base_logit_, trees_slope=0.8)
    changed.correction_ = Correction.none(changed.embedding_, changed.grid_, changed.trees_)
    return changed


def with_falls(assessment):
    """With a probability of a fall of all margins and two features."""
    num_columns, num_margins = len(assessment.columns_.names), assessment.embedding_.num_margins
    changed, columns = copy.copy(assessment), (num_columns - 3, num_columns - 1)
    weights = np.random.default_rng(6).normal(scale=0.3, size=num_margins + 3)
    changed.fall_logit_ = FallLogit(columns=columns, weights=tuple(weights), offset=-0.5)
    return changed


def without_velocities(assessment):
    """That of the paper's mode whose x has no velocities."""
    changed, parameters, known = copy.copy(assessment), assessment.parameters, assessment.novelty_
    reading = dataclasses.replace(parameters.paper, velocities=False)
    changed.parameters = dataclasses.replace(parameters, paper=reading)
    changed.columns_ = InputColumns(assessment.info_, changed.parameters)
    is_kept = np.ones(len(known.training.mean), dtype=bool)
    is_kept[: known.plan.start] = changed.columns_.is_used
    maps = assessment.embedding_
    weights = dict(maps.weights)
    weights["trunk.0.weight"] = weights["trunk.0.weight"][:, is_kept]
    changed.embedding_ = Embedding(weights, num_margins=0)
    mean, covariance = known.training.mean[is_kept], known.training.covariance[is_kept][:, is_kept]
    changed.novelty_ = Novelty(
        training=dataclasses.replace(known.training, mean=mean, covariance=covariance),
        limits=known.limits,
        plan=changed.columns_.plan,
    )
    return changed


def adapted_by_hand(assessment, *, has_hidden=True, seed=1):
    """As adapted to feedback: correction, guard, beliefs and novelty differ."""
    rng = np.random.default_rng(seed)
    adapted, embedding, grid = copy.copy(assessment), assessment.embedding_, assessment.grid_
    hidden = rng.normal(scale=0.02, size=(embedding.num_members, embedding.num_activations + 1))
    adapted.correction_ = Correction(
        change=np.array([-0.5, 0.2, -0.1, 0.3])[: len(assessment.correction_.change)],
        hidden=hidden if has_hidden else np.zeros_like(hidden),
        hidden_range=np.array([-1.0, 1.5]),
        guard=(rng.random((embedding.num_members, grid.num_cells)) < 0.5).astype(float),
    )
    adapted.beliefs_ = assessment.beliefs_[:, ::-1]
    known = assessment.novelty_.training
    wider = dataclasses.replace(known, covariance=100.0 * known.covariance)
    if known.least is not None:
        span = known.largest - known.least
        ends = {"least": known.least - 10.0 * span, "largest": known.largest + 10.0 * span}
        wider = dataclasses.replace(wider, **ends)
    old = assessment.novelty_
    adapted.novelty_ = Novelty(training=known, limits=old.limits, plan=old.plan, feedback=wider)
    return adapted


@pytest.mark.parametrize("has_hidden", [True, False])
def test_the_graph_of_an_adapted_assessment_is_that_of_its_present_adaptation(has_hidden, tmp_path):
    before = load_assessment("laikago_balancing")
    before = with_trees(before) if has_hidden else before
    adapted = adapted_by_hand(before, has_hidden=has_hidden)
    ports = every_kind_of_input(before)
    said = check_equal(adapted, exported(adapted, tmp_path), ports)
    earlier = before.predict(**ports)
    assert np.abs(said.probability - earlier.probability).max() > 0.1
    assert np.sum((said.novelty <= 1.0) & (earlier.novelty > 1.0)) > 20
    # The guard holds some of it back.
    free = dataclasses.replace(adapted.correction_, guard=np.zeros_like(adapted.correction_.guard))
    unheld = adapted.predict(**ports, correction=free).probability
    assert np.max(unheld - said.probability) > 0.01


@pytest.mark.parametrize(
    ("name", "mode", "change", "spread"),
    [
        ("laikago_balancing", "sharpened", without_margins, 0.5),
        ("laikago_balancing", "sharpened", without_safety_heads, 0.5),
        ("laikago_balancing", "sharpened", with_trees, 0.5),
        ("go2_walking", "sharpened", with_falls, 0.5),
        ("laikago_balancing", "paper", without_velocities, 0.5),
        ("atlas_reaching", "sharpened", with_whole_numbers, 0.0),  # All of it is novel.
    ],
)
def test_the_graph_has_the_heads_the_inputs_and_the_numbers_of_the_assessment(
    name, mode, change, spread, tmp_path
):
    assessment = change(load_assessment(name, mode))
    expected = check_equal(assessment, exported(assessment, tmp_path))
    assert np.ptp(expected.probability) >= spread


def test_any_number_of_rows_is_taken_none_too(tmp_path):
    assessment = load_assessment("go2_walking")
    runtime = exported(assessment, tmp_path)
    ports = every_kind_of_input(assessment)
    together = runtime(ports)
    for row in (0, 500):
        alone = runtime({name: values[row : row + 1] for name, values in ports.items()})
        np.testing.assert_allclose(alone["belief"][0], together["belief"][row], atol=SINGLE)
    if Version(onnxruntime.__version__) >= TAKES_NO_ROWS:
        none = runtime({name: values[:0] for name, values in ports.items()})
        assert (none["belief"].shape, none["safety_probability"].shape) == ((0, 3), (0,))
    # The same assessment gives the same file.
    load_assessment("go2_walking").to_onnx(tmp_path / "again")
    assert (tmp_path / "gamma.onnx").read_bytes() == (tmp_path / "again").read_bytes()


def test_a_second_runtime_agrees(tmp_path):
    from onnx.reference import ReferenceEvaluator

    assessment = adapted_by_hand(with_trees(load_assessment("atlas_reaching")))
    assessment.to_onnx(tmp_path / "gamma.onnx")
    evaluator = ReferenceEvaluator(str(tmp_path / "gamma.onnx"))

    def run(inputs):
        with np.errstate(all="ignore"):
            return dict(zip(FIELDS, evaluator.run(list(FIELDS), inputs), strict=True))

    check_equal(assessment, run)


def test_the_metadata_are_the_contract(tmp_path):
    assessment = load_assessment("laikago_balancing")
    runtime = exported(assessment, tmp_path)
    contract, info = runtime.contract, assessment.info_
    ports = contract["inputs"]
    preview = [f"desired {name}" for name in ports["desired_preview"]]
    names = [*ports["state"], *preview, *ports["features"]]
    assert names == assessment.columns_.names
    widths = {port.name: port.shape[1] for port in runtime.session.get_inputs()}
    assert widths == {name: len(columns) for name, columns in ports.items()}
    ahead_s = contract["horizon"] * contract["preview_step_s"]
    assert ahead_s == pytest.approx(info.horizon * info.preview_stride * info.step_s)
    told = {"scenario": "laikago_balancing", "mode": "sharpened", "plant": "nominal"}
    told |= {"adaptation": None, "schema_version": 1, "constraint_names": info.constraint_names}
    assert {name: contract[name] for name in told} == told
    for kind, one in assessment.calibrations_.items():
        (stored,) = [entry for entry in contract["calibrations"] if entry["kind"] == kind]
        for name in ("threshold", "variation", "promise"):
            assert stored[name] == getattr(one, name)
    unsure = np.array([[0.0, 0.0, contract["unknown_above"]]])
    assert not is_unknown(unsure, assessment.parameters.initial_uncertainty)
    assert is_unknown(unsure + 1e-9, assessment.parameters.initial_uncertainty)


def test_where_onnx_is_not_installed_the_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ValueError, match=r"the package 'onnx' is not installed: pip .*\[onnx\]"):
        load_assessment("go2_walking").to_onnx(tmp_path / "gamma.onnx")
    with pytest.raises(ValueError, match="not fitted"):
        SafetyAssessment().to_onnx(tmp_path / "gamma.onnx")
    assert list(tmp_path.iterdir()) == []


def test_the_command_writes_the_file_and_prints_what_is_promised(monkeypatch, capsys, tmp_path):
    file = tmp_path / "robot" / "gamma.onnx"
    assert call(monkeypatch, "export", "laikago_balancing", "--out", file) == 0
    told = capsys.readouterr().out
    calibration = load_assessment("laikago_balancing").calibrations_["plan"]
    assert f"safe from {calibration.threshold:.4f}" in told
    assert calibration.promise in told
    assert str(file) in told
    assert Runtime(file).contract["scenario"] == "laikago_balancing"


@pytest.mark.parametrize("is_calibrated", [True, False])
def test_the_python_of_the_page_runs_and_prints_a_verdict(
    is_calibrated, monkeypatch, capsys, tmp_path
):
    assessment = load_assessment("laikago_balancing")
    if not is_calibrated:
        assessment.calibrations_ = {}
    assessment.to_onnx(tmp_path / "gamma.onnx")
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"^```python\n(.*?)^```$", DOCUMENTED.read_text(), re.DOTALL | re.M)
    exec(code, {})
    assert capsys.readouterr().out.split()[-1] in ("safe", "unsafe", "unknown")
