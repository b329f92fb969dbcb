import re

import numpy as np
import pytest

from command_line import call
from drake_safety import SafetyAssessment, load_scenario, run_episode, run_episodes
from drake_safety.cli.training_folder import MODES, assessment_file
from drake_safety.learning.assessment_parameters import PaperReading
from drake_safety.learning.segments import Episodes
from drake_safety.logs.episodes import cut_log, motions_from_log
from drake_safety.logs.mcap_recorder import McapRecorder
from drake_safety.simulation.feedback import EpisodePairs, pair_starts
from drake_safety.simulation.rollouts import episodes_info
from log_files import balancing_scenario, frame_of, map_beside, recorded, save

pytestmark = pytest.mark.train

INDICES = (10, 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scenario of short episodes and what was learned from a few of them."""
    folder = tmp_path_factory.mktemp("short")
    (folder / "short.yaml").write_text(balancing_scenario().to_yaml())
    scenario = load_scenario(folder / "short.yaml")
    # Plain t-SNE spreads these few segments over more cells.
    assessment = scenario.assessment
    assessment.exaggeration = 1.0
    assessment.paper = PaperReading(stride=0, standardized=True, dropout=0.0, epochs=40)
    episodes = run_episodes(scenario, 64, seed=11, num_workers=1)
    assert 8 <= episodes.num_unsafe <= 53
    for mode in MODES:
        scenario.assessment.mode = mode
        scenario.assessment.perplexity, scenario.assessment.epochs = 5.0, 20
        SafetyAssessment(scenario.assessment).fit(episodes).save(assessment_file(folder, mode))
    return folder


def load(folder, mode):
    return SafetyAssessment.load(assessment_file(folder, mode))


def logged(index, folder, **missing):
    """A recorded run as a CSV file, without the values of some rows by column, and its map."""
    frame = frame_of(recorded(index))
    for column, row in missing.items():
        frame.loc[row, column] = np.nan
    folder.mkdir(exist_ok=True)
    path = save(frame, folder)
    return "--log", path, "--map", map_beside(path)


def test_logs_adapt_as_the_runs_that_they_are_of(folder, tmp_path, monkeypatch, capsys):
    given = [logged(index, tmp_path / f"{index}") for index in INDICES]
    options = ("--assessment", folder, *given[0][:2], *given[1])
    assert not call(monkeypatch, "adapt", folder / "short.yaml", *options)
    printed = capsys.readouterr().out
    assert "adapted to 'run': 1 of 2 pairs end differently" in printed
    held_out = (
        r"^sharpened: too few to tell on 2 held-out logs: Brier score 0\.\d+ before, 0\.\d+ a"
    )
    assert re.search(held_out, printed, flags=re.MULTILINE)
    scenario = load_scenario(folder / "short.yaml")
    # What logs adapt to that never were in a file.
    logs = [recorded(index) for index in INDICES]
    actual, starts = cut_log(logs, scenario)
    unwritten = pair_starts(scenario, actual, starts).feedback()
    motions = motions_from_log(logs, scenario)
    # What the recorded runs themselves adapt to, without any log.
    loops = scenario.make_loop("actual"), scenario.make_loop("nominal")
    actual, nominal = (
        Episodes(episodes_info(loop, seed=0), [run_episode(loop, index) for index in INDICES])
        for loop in loops
    )
    hash_ = scenario.simulation_hash("nominal")
    pairs = EpisodePairs(actual=actual, nominal=nominal, nominal_hash=hash_).feedback()
    assert sorted(pair.differs for pair in pairs) == [False, True]
    for mode in MODES:
        before, adapted = load(folder, mode), load(folder / "adapted-run", mode)
        same = load(folder, mode).adapt(unwritten, motions=motions)
        near = load(folder, mode).adapt(pairs)
        changed = np.abs(adapted.beliefs_ - before.beliefs_).max()
        assert changed > 0.05
        np.testing.assert_allclose(adapted.beliefs_, same.beliefs_, atol=1e-6)
        change = adapted.correction_.change
        np.testing.assert_allclose(change, same.correction_.change, atol=1e-6)
        maps = [
            gamma.detector_.predictor.weights["linear.weight"] for gamma in (adapted, same, before)
        ]
        np.testing.assert_allclose(maps[0], maps[1], atol=1e-4)
        assert np.abs(maps[0] - maps[2]).max() > 0.01
        # A twin of a log draws noise of its own, and its plan is another polynomial between rows.
        atol = min(0.1 * changed, 0.02)
        np.testing.assert_allclose(adapted.beliefs_, near.beliefs_, atol=atol)
        np.testing.assert_allclose(change, near.correction_.change, atol=0.05)


def test_a_recorded_simulation_adapts_without_a_map(folder, capsys, monkeypatch, tmp_path):
    loop, path = load_scenario(folder / "short.yaml").make_loop("actual"), tmp_path / "run.mcap"
    with McapRecorder(loop, path) as recorder:
        run_episode(loop, INDICES[1], monitor=recorder)
    options = ("--assessment", folder, "--log", path, "--out", tmp_path / "out")
    assert not call(monkeypatch, "adapt", folder / "short.yaml", *options)
    assert "adapted to 'run': 0 of 1 pairs end differently" in capsys.readouterr().out
    assert load(tmp_path / "out", "paper").adaptation_.num_sets == 1


def test_a_log_is_cut_where_a_value_is_missing(folder, capsys, monkeypatch, tmp_path):
    options = ("--assessment", folder, "--out", tmp_path / "out")
    log = logged(0, tmp_path, gyro_x=20)
    assert not call(monkeypatch, "adapt", folder / "short.yaml", *log, *options)
    printed = capsys.readouterr().out
    assert "99.2 % of 0.6 s are kept, in 2 pieces" in printed
    assert "line 22, column 'gyro_x': the value is nan" in printed
    assert load(tmp_path / "out", "sharpened").adaptation_.num_sets == 1
    assert "sharpened: only one pair: nothing is held out" in printed


def test_a_promise_after_logs_is_for_a_plant_that_is_named(folder, capsys, monkeypatch, tmp_path):
    scenario = load_scenario(folder / "short.yaml")
    actual, starts = cut_log(recorded(0), scenario)
    pairs = pair_starts(scenario, actual, starts).feedback()
    load(folder, MODES[0]).adapt(pairs).save(assessment_file(tmp_path, MODES[0]))
    few = ("--episodes", 24, "--workers", 1, "--miss-rate", 0.5, "--false-alarm-rate", 0.5)
    command = ("calibrate", folder / "short.yaml", "--assessment", tmp_path, *few)
    assert call(monkeypatch, *command) == 2
    printed = " ".join(capsys.readouterr().out.split())
    assert "a promise holds for a simulated plant, --variation actual" in printed
    assert not load(tmp_path, MODES[0]).calibrations_
    assert call(monkeypatch, *command, "--variation", "actual") == 0
    for calibration in load(tmp_path, MODES[0]).calibrations_.values():
        assert "on the plant 'simulated actual'" in calibration.promise
