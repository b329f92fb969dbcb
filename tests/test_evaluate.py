import shutil
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from command_line import call
from drake_safety.assessments import shipped_folder
from drake_safety.cli.training_folder import MODES, fresh_episodes_folder, load_assessment
from drake_safety.evaluation.results import Results
from drake_safety.learning.seeds import SHIFTS
from drake_safety.simulation import rollouts
from drake_safety.simulation.dataset import completed
from drake_safety.simulation.scenario import load_scenario
from toy_tasks import train_shuttle


@pytest.fixture(scope="module")
def shuttle_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shuttle")
    return train_shuttle(folder), folder


@pytest.mark.train
def test_without_an_assessment_that_of_the_package_is_evaluated_and_not_written(
    monkeypatch, capsys, tmp_path
):
    given = []

    @contextmanager
    def evaluating(scenario, learned, folder, *others):
        given.append((scenario.name, learned, folder))
        yield SimpleNamespace(entries={}, assessments={}, fresh=lambda *_: None, scorers=[])

    monkeypatch.chdir(tmp_path)
    for name, stands_for in (("evaluating", evaluating), ("add_verdicts", None)):
        monkeypatch.setattr(f"drake_safety.cli.evaluate.{name}", stands_for or (lambda *_: None))
    monkeypatch.setattr("drake_safety.cli.evaluate.add_reliability", lambda *_: None)
    assert call(monkeypatch, "evaluate", "laikago_balancing", "--throws", 0) == 0
    out = Path("runs/laikago_balancing-shipped")
    learned = (shipped_folder("laikago_balancing"), out)
    assert given == [("laikago_balancing", learned, out)]
    assert "assessment        comes with the package" in capsys.readouterr().out


OPTIONS = ("--episodes", 30, "--calibration-episodes", 20, "--workers", 1, "--seed", 100)


def evaluate_shuttle(monkeypatch, run, *arguments):
    file, folder = run
    return call(monkeypatch, "evaluate", file, "--assessment", folder, *OPTIONS, *arguments)


@pytest.mark.slow
def test_fresh_targets_are_judged_kept_and_not_simulated_again(monkeypatch, capsys, shuttle_run):
    file, folder = shuttle_run
    assert evaluate_shuttle(monkeypatch, shuttle_run) == 0
    printed = capsys.readouterr().out
    assert "all targets" in printed and "paper uses its next H steps" in printed
    first = Results.read(folder / "evaluation.json")
    judged = {method for _, method, metric in first if metric == "brier"}
    assert judged == {"sharpened", "paper", "paper_at_06"}
    assert first["plans", "paper_at_06", "threshold"].value == 0.6
    assert first["plans", "outcomes", "safe"].n == 30
    assert first["plans", "sharpened", "threshold"].n == first.entries["calibration_episodes"] == 20
    assert (folder / "reliability.png").is_file()
    # What takes throws or runs is no part of it.
    assert not {"throws", "segments"} & {key[0] for key in first}
    hash_ = load_scenario(file).simulation_hash()
    kept = [fresh_episodes_folder(folder, hash_, seed, {}) for seed in (100, 103)]
    assert [len(completed(path)) for path in kept] == [30, 20]
    # Once all are there, one of each set is simulated again, to know the set.
    again = count_episodes(monkeypatch)
    monkeypatch.setattr("drake_safety.cli.evaluate.save", lambda figure, path: [])
    assert evaluate_shuttle(monkeypatch, shuttle_run) == 0
    assert len(again) == 2
    assert dict(Results.read(folder / "evaluation.json")) == dict(first)


def count_episodes(monkeypatch):
    """A list that grows by an index whenever an episode is simulated."""
    indices, run_episode = [], rollouts.run_episode

    def counted(loop, index, **options):
        indices.append(index)
        return run_episode(loop, index, **options)

    monkeypatch.setattr(rollouts, "run_episode", counted)
    return indices


@pytest.mark.slow
def test_under_shifts_the_given_seed_is_used_whatever_it_is(monkeypatch, capsys, shuttle_run):
    file, folder = shuttle_run
    words = ("evaluate", file, "--assessment", folder, "--shifts", 8, "--episodes", 12)
    words += ("--hours", 0.01)
    # The default of evaluations without shifts is a seed like any other.
    for seed, given in ((1_000_000, ("--seed", 1_000_000)), (SHIFTS.first, ())):
        out = folder / f"shifts-{seed}"
        options = ("--workers", 1, "--out", out)
        assert call(monkeypatch, *words, *given, *options) == 0
        results = Results.read(out / "shifts.json")
        assert results.entries["seed"] == seed
        hash_ = load_scenario(file).simulation_hash()
        assert len(completed(fresh_episodes_folder(folder, hash_, seed, {}))) == 12
    printed = capsys.readouterr().out
    assert 'rows after its alarm count as "don\'t know"' in " ".join(printed.split())
    assert results.entries["kinds"]["nominal"] == "nominal"
    shifted = [name for name, kind in results.entries["kinds"].items() if kind == "plant"]
    for method in ("gamma", "paper"):
        for metric in ("unknown", "confident_error"):
            assert (f"shifts.{shifted[0]}", method, metric) in results
    for metric in ("delay_s", "alarmed", "confident_error_10s"):
        assert (f"shifts.{shifted[0]}", "monitor", metric) in results
    assert results["shifts.nominal", "monitor", "false_alarms_per_hour"].value >= 0.0


@pytest.mark.slow
def test_a_calibration_is_stored_and_used_by_who_evaluates(
    monkeypatch, capsys, shuttle_run, tmp_path
):
    file, trained = shuttle_run
    folder = tmp_path / "run"
    shutil.copytree(trained, folder)
    run = (file, folder)
    calibrate = ("calibrate", file, "--assessment", folder, "--episodes", 120, "--workers", 1)
    assert call(monkeypatch, *calibrate, "--miss-rate", 0.1) == 0
    printed = capsys.readouterr().out
    assert "at most 10 % of unsafe episodes called safe, on average" in printed
    stored = {mode: load_assessment(folder, mode).calibrations_ for mode in MODES}
    for mode in MODES:
        assert stored[mode].keys() == {"plan", "motion"}
        assert stored[mode]["plan"].miss_rate == 0.1
        assert stored[mode]["plan"].num_unsafe + stored[mode]["plan"].num_safe == 120
    # The episodes are kept: another promise simulates one, to know them.
    again = count_episodes(monkeypatch)
    assert call(monkeypatch, *calibrate, "--miss-rate", 0.01) == 2
    assert "needs at least 99 unsafe episodes; of 120 episodes" in capsys.readouterr().out
    assert load_assessment(folder, "sharpened").calibrations_ == stored["sharpened"]
    assert len(again) == 1
    monkeypatch.undo()
    monkeypatch.setattr("drake_safety.cli.evaluate.save", lambda figure, path: [])
    assert evaluate_shuttle(monkeypatch, run) == 0
    found = Results.read(folder / "evaluation.json")
    threshold = found["plans", "sharpened", "threshold"].value
    assert threshold == pytest.approx(stored["sharpened"]["plan"].threshold)
    assert found["calibration.plan", "sharpened", "promised_miss_rate"].value == 0.1
    missed = found["calibration.plan", "sharpened", "miss_rate"].value
    assert missed == pytest.approx(1.0 - found["plans", "sharpened", "unsafe_recall"].value)
    assert evaluate_shuttle(monkeypatch, run, "--seed", 2_000_000) == 2
    printed = " ".join(capsys.readouterr().out.split())
    assert "start as the 120 'nominal' episodes of its calibration" in printed
    assert "choose another seed, such as 2000001" in printed
    # A robot may be trained in one mode.
    (folder / "paper.safetensors").unlink()
    assert evaluate_shuttle(monkeypatch, run) == 0
    alone = Results.read(folder / "evaluation.json")
    own = {key: row for key, row in found.items() if key[1] == "sharpened"}
    assert own.items() <= alone.items()
    assert "paper" not in {key[1] for key in alone}


@pytest.mark.train
def test_seeds_of_the_training_are_refused_before_anything_is_simulated(
    monkeypatch, capsys, shuttle_run
):
    monkeypatch.setattr(rollouts, "run_episode", None)
    assert evaluate_shuttle(monkeypatch, shuttle_run, "--seed", -3) == 2
    assert "seed 0 gives episodes that start as the 60 'nominal'" in capsys.readouterr().out
