import csv
import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from c_programs import PORTS, Library, build, diagram_history
from command_line import call
from drake_safety import load_scenario
from drake_safety.assessments import load_assessment
from drake_safety.evaluation.shifts import plant_shifts
from drake_safety.learning.causes import is_on, is_outside, violated
from drake_safety.learning.change_detector import rows_of
from drake_safety.simulation.rollouts import run_motion, worker_loop

pytest.importorskip("onnx", reason="the extra 'onnx' is not installed")
pytest.importorskip("onnxruntime", reason="the extra 'walking' is not installed")
from test_onnx_graph import Runtime, every_kind_of_input

SCENARIO, DURATION_S, STRIDE = "laikago_balancing", 4.0, 2
SINGLE = 2e-5
COMPILERS = pytest.mark.skipif(
    not (shutil.which("gcc") and shutil.which("g++")), reason="gcc and g++ are not installed"
)


@pytest.fixture(scope="module")
def assessment():
    return load_assessment(SCENARIO)


@pytest.fixture(scope="module")
def widths(assessment):
    return [*(assessment.info_.widths[name] for name in PORTS[:-1]), 1]


@pytest.fixture(scope="module")
def motions():
    """Rows at the ports of a nominal motion and of one with a joint that is locked."""
    scenario = load_scenario(SCENARIO)
    shift = plant_shifts(scenario, scenario.make_loop())["locked_joint"]
    shifted = scenario.with_variation("locked_joint", shift.variation)
    rows = {}
    for name in ("nominal", "locked_joint"):
        loop = worker_loop(shifted, name)()
        one = run_motion(loop, seed=5, until_s=DURATION_S, with_features=True)
        hold = np.zeros((len(one.time_s), 1))
        rows[name] = np.concatenate([rows_of(one), one.margins, hold], axis=1)
    return rows


def frozen(rows):
    """Rows with a held disturbance, a gap, frozen inputs and a lost safe set."""
    rows = rows.copy()
    rows[20, 3] = np.nan
    rows[40:60, -1] = 1.0
    rows[100:108] = rows[100]
    rows[10, -3] = -0.01
    rows[12, -2] = np.nan
    rows[14:18, -4] = np.inf
    return rows


def blind(rows):
    """Rows of which every third is not finite."""
    rows = rows.copy()
    rows[40::3, 5] = np.nan
    return rows


@pytest.fixture(scope="module")
def cases(motions):
    """Rows, and the beginning of the cause of their alarm."""
    nominal = motions["nominal"]
    return {
        "nominal": (nominal, ""),
        "locked joint": (motions["locked_joint"], "joint "),
        "frozen": (frozen(nominal), "inputs frozen"),
        "blind": (blind(nominal), "blind: "),
    }


CASES = ["nominal", "locked joint", "frozen", "blind"]


@pytest.mark.parametrize("case", CASES)
def test_graphs_say_what_a_diagram_says(case, assessment, cases, widths, tmp_path):
    rows, cause = cases[case]
    run = {}
    for name in ("assessor", "monitor"):
        assessment.to_onnx(tmp_path / name, name)
        run[name] = Runtime(tmp_path / name)
    parts = np.split(rows, np.cumsum(widths)[:-1], axis=1)
    inputs = dict(zip(PORTS, parts, strict=True))
    contract = run["monitor"].contract
    memory, alarm, said = np.zeros((1, len(contract["inputs"]["memory"]))), 0.0, []
    for k in range(len(rows)):
        row = {name: values[k : k + 1] for name, values in inputs.items()}
        hold = {"hold": row.pop("hold")}
        if k % STRIDE == 0:
            assessed = run["assessor"](row | {"alarm": np.full((1, 1), alarm)})
        del row["margins"]
        watched = run["monitor"](row | hold | {"memory": memory})
        memory, alarm = watched.pop("next_memory"), float(watched["alarm"][0])
        said.append({name: np.ravel(values) for name, values in (assessed | watched).items()})
    found = {name: np.array([one[name] for one in said]) for name in said[0]}
    expected = diagram_history(assessment, rows, widths)
    check_same(found, expected, assessment, contract["causes"])
    assert expected["alarm"].any() == (case != "nominal")
    causes = {str(text) for text in expected["alarm_cause"]}
    assert all(text.startswith(cause) for text in causes - {""}) and "" in causes
    assert (expected["belief"][:, 0] > 0.5).any()


def check_same(found, expected, assessment, causes):
    """Checks beliefs, levels, alarms and causes, row by row."""
    for name in ("belief", "safety_probability", "cause_probability"):
        np.testing.assert_allclose(found[name], expected[name], rtol=0.0, atol=SINGLE)
    np.testing.assert_allclose(found["levels"], expected["levels"], atol=1e-4)
    np.testing.assert_allclose(found["judged_share"], expected["judged_share"], atol=1e-12)
    np.testing.assert_array_equal(found["alarm"], expected["alarm"])
    assert len(causes) == 6 * len(assessment.detector_.watched) + 2
    for index, text in zip(found["cause"].ravel(), expected["alarm_cause"], strict=True):
        if index < 0.0:
            assert str(text) == ""
            continue
        name = causes[int(index)]
        state, _, memory = name.partition(", ")
        words = [name] if not memory else [f"({state} ", memory.partition(" ")[2]]
        assert all(word in str(text) for word in words), (name, str(text))
        assert ("irregular" in memory) == ("irregular" in str(text))


def test_assessor_heeds_margins_and_alarm_as_the_system_does(assessment, tmp_path):
    assessment.to_onnx(tmp_path / "assessor.onnx", "assessor")
    ports, rng = every_kind_of_input(assessment, 1000), np.random.default_rng(3)
    n_c = len(assessment.info_.constraint_names)
    margins = rng.normal(0.5, 0.5, size=(1000, n_c))
    odd = rng.random(margins.shape) < 0.1
    margins[odd] = rng.choice([np.nan, np.inf, -np.inf, 0.0], size=odd.sum())
    alarm = rng.choice(
        [0.0, 0.5, 0.6, 1.0, np.nan, np.inf, -np.inf], size=1000, p=[0.7, *[0.05] * 6]
    )
    said = Runtime(tmp_path / "assessor.onnx")(
        ports | {"margins": margins, "alarm": alarm[:, None]}
    )
    predictions, seen = assessment.predict(**ports), set()
    for row in range(1000):
        expected = predictions.one(row)
        if outside := bool(is_outside(margins[row])):
            expected = expected.outside(violated(margins[row]))
        np.testing.assert_allclose(said["belief_without_alarm"][row], expected.belief, atol=SINGLE)
        without = said["probability_without_alarm"][row]
        np.testing.assert_allclose(without, expected.probability, atol=SINGLE)
        if on := bool(is_on(alarm[row])):
            expected = expected.unknown()
        np.testing.assert_allclose(said["belief"][row], expected.belief, atol=SINGLE)
        np.testing.assert_allclose(
            said["safety_probability"][row], expected.probability, atol=SINGLE
        )
        cause = said["cause_probability"][row]
        np.testing.assert_allclose(cause, expected.cause_probability, atol=SINGLE)
        seen.add((outside, on, bool(expected.belief[1] > 0.1)))
    assert len(seen) == 6  # An alarm leaves nothing unsafe.


@pytest.fixture(scope="module")
def generated(assessment, tmp_path_factory):
    pytest.importorskip("emx_onnx_cgen", reason="the extra 'c' is not installed")
    folder = tmp_path_factory.mktemp("c")
    assessment.to_c(folder / "gamma.c")
    return folder


@pytest.mark.slow
@COMPILERS
def test_c_says_what_a_diagram_says(generated, assessment, cases, widths):
    library = Library(generated / "gamma.c", assessment.info_, assessment.detector_)
    assessment.to_onnx(generated / "monitor.onnx", "monitor")
    causes = Runtime(generated / "monitor.onnx").contract["causes"]
    for rows, _ in cases.values():
        library.monitor[:] = 0.0
        found = library.history(rows, STRIDE)
        check_same(found, diagram_history(assessment, rows, widths), assessment, causes)


@pytest.mark.slow
@COMPILERS
@pytest.mark.parametrize(
    ("compiler", "options"),
    [
        ("gcc", ["-std=c99", "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover"]),
        ("g++", ["-std=c++17", "-O3", "-x", "c++"]),
    ],
)
def test_example_prints_the_verdict_of_every_row(
    compiler, options, generated, assessment, cases, widths
):
    build(compiler, *options, "example.c", "gamma.c", "-lm", "-o", "example", folder=generated)
    names = subprocess.run([generated / "example"], capture_output=True, text=True, check=True)
    rows = frozen(cases["locked joint"][0])
    table = generated / "rows.csv"
    np.savetxt(table, rows, delimiter=",", fmt="%.17g", header=names.stdout.strip(), comments="")
    table.write_bytes(table.read_bytes().replace(b"\n", b"\r\n").rstrip())
    columns = names.stdout.strip().split(",")
    assert columns[0] == "state base_x" and columns[-1] == "hold" and len(columns) == rows.shape[1]
    done = subprocess.run([generated / "example", table], capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == ""
    printed = list(csv.DictReader(done.stdout.splitlines()))
    one_by_one = diagram_history(assessment, rows, widths)["alarm"].ravel()
    np.testing.assert_array_equal([float(one["alarm"]) for one in printed], one_by_one)
    calibration = assessment.calibrations_["motion"]
    verdicts = {one["verdict"] for one in printed}
    assert verdicts == {"safe", "unsafe", "don't know"}
    for one in printed:
        probability = float(one["safety_probability"])
        if float(one["unknown"]) <= 0.65:
            assert one["verdict"] == calibration.verdicts(np.array([probability]))[0]
        else:
            assert one["verdict"] == "don't know" and probability == 0.0
    wrong = {
        f"{names.stdout}1.0,2.0\n": f"row 0 needs {len(columns)} numbers",
        names.stdout.replace(*columns[:2]): "column 0 must be 'state base_x'",
        names.stdout.strip() + ",more\n": f"column {len(columns) - 1} must be 'hold'",
    }
    for text, message in wrong.items():
        table.write_text(text)
        done = subprocess.run([generated / "example", table], capture_output=True, text=True)
        assert done.returncode == 1 and message in done.stderr


@pytest.mark.slow
@COMPILERS
def test_command_writes_the_promise_and_sources_that_link_with_others(
    generated, monkeypatch, capsys, tmp_path
):
    file = tmp_path / "robot" / "safety.c"
    assert call(monkeypatch, "export", SCENARIO, "--out", file, "--prefix", "node1") == 0
    printed = capsys.readouterr().out
    calibration = load_assessment(SCENARIO).calibrations_["motion"]
    header = file.with_suffix(".h").read_text()
    assert calibration.promise in printed and calibration.promise in header
    assert f"NODE1_MOTION_THRESHOLD {calibration.threshold}" in header
    assert "NODE1_STATE_BASE_Z = 2," in header and "#define NODE1_STEP_S 0.04 " in header
    assert {one.name for one in file.parent.iterdir()} == {"safety.c", "safety.h", "example.c"}
    # No memory is allocated, and nothing but C's own headers is included.
    source = file.read_text()
    assert "alloc(" not in source and "free(" not in source
    included = {line for line in source.splitlines() if line.startswith("#include")}
    standard = ("stdint", "stdbool", "math", "float", "limits", "string")
    assert included == {*(f"#include <{one}.h>" for one in standard), '#include "safety.h"'}
    main = f'#include "safety.h"\n#include "{generated}/gamma.h"\nint main(void) {{\n'
    main += "    static node1_monitor a;\n    static node1_inputs in;\n"
    main += "    node1_watch(&in, &a);\n    return (int)a.alarm;\n}\n"
    (file.parent / "main.c").write_text(main)
    options = ["-std=c99", "-O0", "main.c", "safety.c", str(generated / "gamma.c"), "-lm"]
    build("gcc", *options, "-o", "main", folder=file.parent)
    assert subprocess.run([file.parent / "main"]).returncode == 0


def test_errors_name_what_was_given(monkeypatch, assessment, tmp_path):
    with pytest.raises(ValueError, match=r"'gamma', 'assessor', 'monitor'\]; got 'gama'"):
        assessment.to_onnx(tmp_path / "gamma.onnx", "gama")
    with pytest.raises(ValueError, match=r"prefix must be a name in C, .* got '2legs'"):
        assessment.to_c(tmp_path / "2legs.c")
    own = tmp_path / "own"
    own.mkdir()
    (own / "example.c").write_text("int main() {}")
    for file in (tmp_path / "example.c", own / "gamma.c"):
        with pytest.raises(ValueError, match=r"it also writes 'example\.c' there, which would be"):
            assessment.to_c(file)
    for words in (["gamma.cpp"], ["gamma.c", "--part", "monitor"], ["a.onnx", "--prefix", "b"]):
        assert call(monkeypatch, "export", SCENARIO, "--out", tmp_path / words[0], *words[1:]) == 2
    shutil.rmtree(own)
    monkeypatch.setitem(sys.modules, "emx_onnx_cgen", None)
    with pytest.raises(ValueError, match=r"'emx_onnx_cgen' is not installed: pip .*\[c\]"):
        assessment.to_c(tmp_path / "gamma.c")
    assert list(tmp_path.iterdir()) == []


def test_metadata_of_monitor_and_assessor_are_their_contract(assessment, tmp_path):
    for part in ("assessor", "monitor"):
        assessment.to_onnx(tmp_path / part, part)
        runtime = Runtime(tmp_path / part)
        shapes = {port.name: port.shape[1] for port in runtime.session.get_inputs()}
        assert shapes == {name: len(names) for name, names in runtime.contract["inputs"].items()}
    info = assessment.info_
    assert runtime.contract["step_s"] == assessment.detector_.step_s
    assert json.loads(json.dumps(runtime.contract["monitored"])) == [
        info.state_names[i] for i in assessment.detector_.watched
    ]
