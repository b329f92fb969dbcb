import json
import shutil

import numpy as np
import pytest

import drake_safety
from command_line import call, study
from drake_safety import assessments
from drake_safety.assessments import assessed_scenarios, load_assessment, shipped_folder
from drake_safety.cli.training_folder import MODES, assessment_file, episodes_folder
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.assessment_file import file_hash
from drake_safety.simulation.dataset import load_episodes
from drake_safety.simulation.scenario import load_scenario
from studies.documents import CARD_FILE, EVALUATION_FILE, card_text
from studies.publish import NUM_EPISODES, check_shipped
from toy_tasks import SHUTTLING, train_shuttle

NAME = "shuttling"


@pytest.mark.slow
@pytest.mark.parametrize("name", assessed_scenarios())
def test_what_is_shipped_is_what_was_evaluated(name):
    folder = shipped_folder(name)
    results = check_shipped(folder, load_scenario(name))
    assert set(results.entries["assessment_sha256"]) == set(MODES)
    assert len(results.entries["first_episodes"]) == NUM_EPISODES
    assert {"command", "train_command", "seed", "versions"} <= set(results.entries)
    assert any(key[1:] == ("sharpened", "unsafe_recall") for key in results)
    assert load_assessment(name).info_.scenario == name


@pytest.mark.parametrize("name", assessed_scenarios())
def test_a_card_is_what_shipping_would_write_now(name):
    folder = shipped_folder(name)
    card = (folder / CARD_FILE).read_text(encoding="utf-8")
    assert card == card_text(folder, load_scenario(name)), "`python -m studies readme` writes it"
    assert sum(path.stat().st_size for path in folder.iterdir()) < 10e6


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A whole run of a scenario that seems to come with the package; for all to read."""
    folder = tmp_path_factory.mktemp("run")
    train_shuttle(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("drake_safety.simulation.scenario._FOLDER", folder)
        options = ("--assessment", folder, "--workers", 1)
        calibrated = ("--episodes", 120, "--miss-rate", 0.1)
        assert call(patch, "calibrate", NAME, *options, *calibrated) == 0
        patch.setattr("drake_safety.cli.evaluate.save", lambda figure, path: [])
        judged = ("--episodes", 30, "--calibration-episodes", 20)
        assert call(patch, "evaluate", NAME, *options, *judged) == 0
    return folder


@pytest.fixture(scope="module")
def shipped(run, tmp_path_factory):
    """Where the run's assessments were shipped to; for all to read."""
    into = tmp_path_factory.mktemp("shipped")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("drake_safety.simulation.scenario._FOLDER", run)
        assert study(patch, "ship", "--assessment", run, "--into", into) == 0
    return into


@pytest.fixture
def scenario(run, monkeypatch):
    monkeypatch.setattr("drake_safety.simulation.scenario._FOLDER", run)
    return load_scenario(NAME)


@pytest.fixture
def package(shipped, scenario, monkeypatch, tmp_path):
    """The package seems to hold a copy of what was shipped; the working folder is an empty one."""
    shutil.copytree(shipped, tmp_path / "package")
    monkeypatch.setattr(assessments, "_FOLDER", tmp_path / "package")
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "package"


@pytest.mark.slow
def test_a_shipment_holds_the_run_s_files_and_what_is_known_of_them(run, shipped, scenario):
    results = check_shipped(shipped / NAME, scenario, num_workers=1)
    written = {path.name for path in (shipped / NAME).iterdir()}
    assert written == {"sharpened.safetensors", "paper.safetensors", EVALUATION_FILE, CARD_FILE}
    assert f'load_assessment("{NAME}")' in (shipped / NAME / CARD_FILE).read_text()
    entries = results.entries
    for mode in MODES:
        files = [assessment_file(folder, mode) for folder in (run, shipped / NAME)]
        assert {file_hash(file) for file in files} == {entries["assessment_sha256"][mode]}
        assert {one["kind"] for one in entries["calibrations"][mode]} == {"plan", "motion"}
    assert entries["train_command"] == f"drake-safety train {NAME} --out runs/own"
    assert entries["seed"] == 1_000_000
    assert results["plans", "sharpened", "unsafe_recall"].n > 0


@pytest.mark.slow
def test_another_file_or_scenario_in_its_place_is_noticed(run, package, scenario, tmp_path):
    (tmp_path / f"{NAME}.yaml").write_text(SHUTTLING.replace("duration_s: 0.8", "duration_s: 1.2"))
    with pytest.raises(ValueError, match=r"has the hash \w+, '.*' is of \w+: train"):
        check_shipped(package / NAME, load_scenario(tmp_path / f"{NAME}.yaml"), num_workers=1)
    file = assessment_file(package / NAME, "sharpened")
    other = SafetyAssessment.load(file)
    other.parameters.epochs, thresholds = 1, other.calibrations_
    other.fit(load_episodes(episodes_folder(run)))
    other.calibrations_ = thresholds
    other.save(file)
    with pytest.raises(ValueError, match=r"the files have the SHA-256 .* what was evaluated had"):
        check_shipped(package / NAME, scenario, num_workers=1)
    # Even under its own hash it does not say what was said.
    evaluation = package / NAME / "evaluation.json"
    content = json.loads(evaluation.read_text())
    content["entries"]["assessment_sha256"]["sharpened"] = file_hash(file)
    evaluation.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"fresh episode \d of seed \d+ was .* and is now"):
        check_shipped(package / NAME, scenario, num_workers=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("uncalibrated", "holds no calibrated threshold: `drake-safety calibrate` chooses one"),
        ("changed", "`drake-safety evaluate` them as they are now"),
    ],
)
def test_what_was_not_evaluated_as_it_is_is_not_shipped(
    run, scenario, monkeypatch, capsys, tmp_path, change, message
):
    folder, into = tmp_path / "run", tmp_path / "into"
    shutil.copytree(run, folder, ignore=shutil.ignore_patterns("fresh"))
    file = assessment_file(folder, "paper")
    learned = SafetyAssessment.load(file)
    if change == "uncalibrated":
        learned.calibrations_ = {}
    else:
        learned.beliefs_ = learned.beliefs_[:, ::-1]
    learned.save(file)
    assert study(monkeypatch, "ship", "--assessment", folder, "--into", into) == 2
    assert message in capsys.readouterr().out
    assert not into.exists()


@pytest.mark.slow
def test_in_python_a_shipped_assessment_is_loaded_by_the_scenario_s_name(package, shipped):
    assert assessed_scenarios() == [NAME]
    for mode in MODES:
        loaded = drake_safety.load_assessment(NAME, mode)
        assert loaded.parameters.mode == mode
        original = SafetyAssessment.load(assessment_file(shipped / NAME, mode))
        np.testing.assert_array_equal(loaded.beliefs_, original.beliefs_)
        by_folder = drake_safety.load_assessment(shipped / NAME, mode)
        np.testing.assert_array_equal(by_folder.beliefs_, original.beliefs_)
    with pytest.raises(ValueError, match=r"are \['paper', 'sharpened'\]; got 'blunt'"):
        load_assessment(NAME, "blunt")
    with pytest.raises(ValueError, match=r"of scenario 'pendulum' .* \['shuttling'\]: .*train"):
        load_assessment("pendulum")


@pytest.mark.slow
def test_a_command_takes_the_shipped_assessment_and_says_so(package, monkeypatch, capsys, tmp_path):
    before = {path: path.read_bytes() for path in package.rglob("*") if path.is_file()}
    calibrated = ("--episodes", 60, "--miss-rate", 0.2, "--workers", 1)
    assert call(monkeypatch, "calibrate", NAME, *calibrated) == 0
    printed = capsys.readouterr().out
    assert f"comes with the package, {package / NAME}" in printed
    assert "at most 20 % of unsafe episodes called safe" in printed
    # What is written goes to the working folder, never into the package.
    assert {path: path.read_bytes() for path in package.rglob("*") if path.is_file()} == before
    own = tmp_path / "work" / "runs" / f"{NAME}-shipped"
    assert {path.name for path in own.iterdir()} >= {f"{mode}.safetensors" for mode in MODES}
    # A given folder is used in place of the shipped one.
    assert call(monkeypatch, "calibrate", NAME, "--assessment", own, *calibrated) == 0
    assert "comes with the package" not in capsys.readouterr().out


@pytest.mark.parametrize("form", ["masked", "rows of masked", "integers"])
def test_masked_inputs_are_not_known_and_integers_are_judged_as_floats(form):
    assessment = load_assessment("laikago_balancing")
    names = ("state", "desired_preview", "features")
    rows = {name: np.ones((2, assessment.info_.widths[name])) for name in names}
    expected = assessment.predict(**rows)
    values = np.ma.array(rows["features"], dtype=int if form == "integers" else float)
    values[1, 0] = np.ma.masked
    rows["features"] = list(values) if form == "rows of masked" else values
    result = assessment.predict(**rows)
    assert np.isinf(result.novelty[1]) and result.novelty[0] == expected.novelty[0]
    np.testing.assert_array_equal(result.belief, [expected.belief[0], [0.0, 0.0, 1.0]])
