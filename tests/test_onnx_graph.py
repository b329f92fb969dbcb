import copy
import dataclasses
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

import naive
from command_line import call
from drake_safety.assessments import assessed_scenarios, load_assessment
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.novelty import Novelty
from drake_safety.learning.prediction import Correction, is_unknown

onnx = pytest.importorskip("onnx", reason="the extra 'onnx' is not installed")
onnxruntime = pytest.importorskip("onnxruntime", reason="the extra 'walking' is not installed")

DOCUMENTED = Path(__file__).resolve().parents[1] / "docs/export.md"
NUM_INPUTS, NUM_NAIVE = 6000, 25
SINGLE = 2e-5  # Largest difference of probabilities by rounding of single precision.


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


def every_kind_of_input(assessment, num=NUM_INPUTS):
    """Inputs like those of training, ever farther from them, far outside, and not finite."""
    rng, known, info = np.random.default_rng(0), assessment.novelty_.training, assessment.info_
    x = rng.multivariate_normal(known.mean, known.covariance, size=num, method="eigh")
    spread = np.repeat([0.5, 0.75, 1.0, 2.0, 10.0], num // 5)[:, None]
    x = known.mean + spread * (x - known.mean)
    names = ["state", "desired_preview", *["features"] * assessment.uses_features]
    parts = np.split(x, np.cumsum([info.widths[name] for name in names]), axis=1)
    ports = {name: part.copy() for name, part in zip(names, parts, strict=False)}
    rows = rng.permutation(num)[: num // 10]
    for name, values in ports.items():
        values[rows[:20]] = rng.normal(scale=1e3, size=(20, values.shape[1]))
        odd = 6 * [np.nan, np.inf, -np.inf, 1e14, 1e16, -1e200]
        for row, value in zip(rows[20:], odd, strict=False):
            if rng.random() < 0.5 or name == "state":
                values[row, rng.integers(values.shape[1])] = value
    return ports


def check_equal(assessment, run, ports=None):
    """Checks that graph and naive loop say what `predict` says; returns that."""
    ports = every_kind_of_input(assessment) if ports is None else ports
    outputs, expected = run(ports), assessment.predict(**ports)
    names = ["probability" if name == "safety_probability" else name for name in outputs]
    assert sorted(names) == sorted(vars(expected))
    assert all(values.dtype == np.float64 for values in outputs.values())
    said = dict(zip(names, outputs.values(), strict=True))
    known, finite = expected.novelty <= 1.0, np.isfinite(expected.novelty)
    for name in ("belief", "probability", "cause_probability"):
        np.testing.assert_allclose(said[name], getattr(expected, name), rtol=0.0, atol=SINGLE)
    rows_of = {"predicted_margins": known, "embedding": known, "fall_probability": finite}
    for name, rows in rows_of.items():
        value = getattr(expected, name)
        np.testing.assert_array_equal(np.isnan(said[name]), np.isnan(value))
        np.testing.assert_allclose(said[name][rows], value[rows], rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(said["novelty"], expected.novelty, rtol=1e-9)
    x = assessment.inputs_of(*ports.values(), *[None] * (3 - len(ports)))
    for row in np.flatnonzero(finite)[:: finite.sum() // NUM_NAIVE]:
        belief, probability, margins, distance, fall = naive.prediction(assessment, x[row])
        one = expected.one(row)
        both = np.concatenate([one.belief, one.cause_probability])
        np.testing.assert_allclose(both, belief, atol=SINGLE)
        np.testing.assert_allclose(one.probability, probability, atol=SINGLE)
        np.testing.assert_allclose(one.novelty, distance, rtol=1e-5)
        if known[row]:
            wanted = margins if len(margins) else np.nan
            np.testing.assert_allclose(one.predicted_margins, wanted, atol=1e-5)
            np.testing.assert_allclose(one.fall_probability, fall, atol=1e-3)
    return expected


@pytest.mark.parametrize(
    ("name", "mode"),
    [*((name, "sharpened") for name in assessed_scenarios()), ("laikago_balancing", "paper")],
)
def test_graph_of_shipped_assessment_predicts_every_kind_of_input(name, mode, tmp_path):
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


def adapted_by_hand(assessment):
    """As adapted to feedback: correction, guard, beliefs and novelty differ."""
    rng = np.random.default_rng(1)
    adapted, old = copy.copy(assessment), assessment.correction_
    adapted.correction_ = Correction(
        change=np.array([-0.5, 0.2, -0.1, 0.3])[: len(old.change)],
        hidden=rng.normal(scale=0.02, size=old.hidden.shape),
        hidden_range=np.array([-1.0, 1.5]),
        guard=(rng.random(old.guard.shape) < 0.5).astype(float),
    )
    adapted.beliefs_ = assessment.beliefs_[:, ::-1]
    novelty, known = assessment.novelty_, assessment.novelty_.training
    span = known.largest - known.least
    ends = {"least": known.least - 10.0 * span, "largest": known.largest + 10.0 * span}
    wider = dataclasses.replace(known, covariance=100.0 * known.covariance, **ends)
    limits, plan = novelty.limits, novelty.plan
    adapted.novelty_ = Novelty(training=known, limits=limits, plan=plan, feedback=wider)
    return adapted


def test_graph_of_adapted_assessment_has_its_present_adaptation(tmp_path):
    before = load_assessment("laikago_balancing")
    adapted = adapted_by_hand(before)
    ports = every_kind_of_input(before)
    said = check_equal(adapted, exported(adapted, tmp_path), ports)
    earlier = before.predict(**ports)
    assert np.abs(said.probability - earlier.probability).max() > 0.1
    assert np.sum((said.novelty <= 1.0) & (earlier.novelty > 1.0)) > 20
    # The guard holds some of it back.
    free = dataclasses.replace(adapted.correction_, guard=np.zeros_like(adapted.correction_.guard))
    unheld = adapted.predict(**ports, correction=free).probability
    assert np.max(unheld - said.probability) > 0.01


def test_graph_takes_one_row_or_many_and_has_the_same_bytes_again(tmp_path):
    assessment = load_assessment("go2_walking")
    runtime = exported(assessment, tmp_path)
    ports = every_kind_of_input(assessment, 1000)
    together = runtime(ports)
    alone = runtime({name: values[500:501] for name, values in ports.items()})
    np.testing.assert_allclose(alone["belief"][0], together["belief"][500], atol=SINGLE)
    # The same assessment gives the same file.
    load_assessment("go2_walking").to_onnx(tmp_path / "again")
    assert (tmp_path / "gamma.onnx").read_bytes() == (tmp_path / "again").read_bytes()


def test_second_runtime_agrees(tmp_path):
    from onnx.reference import ReferenceEvaluator

    assessment = adapted_by_hand(load_assessment("atlas_reaching"))
    assessment.to_onnx(tmp_path / "gamma.onnx")
    evaluator = ReferenceEvaluator(str(tmp_path / "gamma.onnx"))

    def run(inputs):
        with np.errstate(all="ignore"):
            return dict(zip(evaluator.output_names, evaluator.run(None, inputs), strict=True))

    check_equal(assessment, run, every_kind_of_input(assessment, 500))


def test_metadata_are_the_contract(tmp_path):
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
    expected = {"scenario": "laikago_balancing", "mode": "sharpened", "plant": "nominal"}
    expected |= {"adaptation": None, "schema_version": 1, "constraint_names": info.constraint_names}
    assert {name: contract[name] for name in expected} == expected
    assert len(contract["calibrations"]) == 4  # Of plans and motions, nominal and of the family.
    for stored, one in zip(
        contract["calibrations"], assessment.calibrations_.values(), strict=True
    ):
        for name in ("kind", "threshold", "variation", "promise"):
            assert stored[name] == getattr(one, name)
    unsure = np.array([[0.0, 0.0, contract["unknown_above"]]])
    assert not is_unknown(unsure, assessment.parameters.initial_uncertainty)
    assert is_unknown(unsure + 1e-9, assessment.parameters.initial_uncertainty)


def test_missing_extra_and_missing_fit_are_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ValueError, match=r"the package 'onnx' is not installed: pip .*\[onnx\]"):
        load_assessment("go2_walking").to_onnx(tmp_path / "gamma.onnx")
    with pytest.raises(ValueError, match="not fitted"):
        SafetyAssessment().to_onnx(tmp_path / "gamma.onnx")
    assert list(tmp_path.iterdir()) == []


def test_command_writes_the_file_and_prints_the_promise(monkeypatch, capsys, tmp_path):
    file = tmp_path / "robot" / "gamma.onnx"
    assert call(monkeypatch, "export", "laikago_balancing", "--out", file) == 0
    printed = capsys.readouterr().out
    calibration = load_assessment("laikago_balancing").calibrations_["plan"]
    assert f"safe from {calibration.threshold:.4f}" in printed
    assert calibration.promise in printed and str(file) in printed
    assert Runtime(file).contract["scenario"] == "laikago_balancing"


def test_python_of_the_page_prints_a_verdict(monkeypatch, capsys, tmp_path):
    load_assessment("laikago_balancing").to_onnx(tmp_path / "gamma.onnx")
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"^```python\n(.*?)^```$", DOCUMENTED.read_text(), re.DOTALL | re.M)
    exec(code, {})
    assert capsys.readouterr().out.split()[-1] in ("safe", "unsafe", "unknown")
