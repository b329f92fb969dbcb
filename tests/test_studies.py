import shutil
from dataclasses import replace

import pytest
import typer

from command_line import study as call
from drake_safety.cli.training_folder import MODES, assessment_file, episodes_folder
from drake_safety.evaluation.metrics import proportion
from drake_safety.evaluation.results import Results
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import load_scenario
from shuttle_task import train_shuttle
from studies import planning, scale
from studies.__main__ import app


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shuttle")
    return train_shuttle(folder), folder


def results_of(monkeypatch, capsys, folder, name, *arguments):
    """The results that a command writes into the folder as NAME.json, and what it prints."""
    assert call(monkeypatch, *arguments) == 0
    results = Results.read(folder / f"{name}.json")
    assert results.entries["command"].startswith(f"python -m studies {arguments[0]} ")
    return results, " ".join(capsys.readouterr().out.split())


FRESH = ("--episodes", 40, "--calibration-episodes", 30, "--seed", 100, "--workers", 1)


@pytest.mark.slow
def test_an_ablation_gives_rows_of_every_variant_and_goes_on_where_it_was_stopped(
    monkeypatch, capsys, run
):
    file, folder = run
    options = ("ablate", file, "--assessment", folder, "--only", "min_count", *FRESH)
    found, printed = results_of(monkeypatch, capsys, folder, "ablation", *options)
    names = ["baseline", "min_count 1", "min_count 20", "min_count 50"]
    assert [row.method for row in found.select(set="k0", metric="auc")] == names
    assert all(row.n == 40 for row in found.select(set="k0", metric="auc"))
    assert "min_count 20" in printed.replace("min count", "min_count")
    assert (folder / "ablation.png").is_file()
    monkeypatch.setattr(SafetyAssessment, "fit", None)
    again, _ = results_of(monkeypatch, capsys, folder, "ablation", *options)
    assert dict(again) == dict(found)
    assert call(monkeypatch, "ablate", file, "--assessment", folder, "--seed", 0) == 2
    assert "start as the" in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_a_plan_study_tells_what_choosing_by_gamma_is_worth(monkeypatch, capsys, run, tmp_path):
    file, trained = run
    folder = tmp_path / "never_judged"  # Others evaluate theirs, which chooses a threshold.
    folder.mkdir()
    shutil.copy(trained / "sharpened.safetensors", folder)
    options = ("plan-study", file, "--assessment", folder, "--episodes", 10, "--candidates", 3)
    options += ("--workers", 1, "--out", tmp_path)
    found, printed = results_of(monkeypatch, capsys, tmp_path, "planning", *options)
    shares = [
        found[f"planning.{name}.safe"] for name in ("default plan", "chosen", "best in hindsight")
    ]
    assert sorted(one.value for one in shares) == [one.value for one in shares]
    assert {one.n for one in shares} == {10}
    assert "promises nothing" in printed
    # The motions are kept with the assessment: a second study simulates nothing.
    monkeypatch.setattr(planning, "run_episode", None)
    again, _ = results_of(monkeypatch, capsys, tmp_path, "planning", *options)
    assert dict(again) == dict(found)
    monkeypatch.undo()
    assert call(monkeypatch, *options, "--seed", 0) == 2
    assert "start as the" in capsys.readouterr().out


@pytest.mark.slow
def test_studies_of_a_run_are_stored_with_its_evaluation(monkeypatch, capsys, run):
    file, folder = run
    options = (file, "--assessment", folder, "--episodes", 40, "--seed", 100, "--workers", 1)
    # A promised miss rate takes more than a hundred unsafe episodes.
    more = (*options, "--calibration-episodes", 300)
    found, _ = results_of(monkeypatch, capsys, folder, "converged", "converged", *more)
    assert {"converged.first.literal.auc", "converged.fair.converged.auc"} <= set(found)
    only = ("--calibration-episodes", 30, "--only", "none", "--sizes", 60)
    found, _ = results_of(monkeypatch, capsys, folder, "readings", "readings", *options, *only)
    assert found.entries["names"] == ["default, 60 episodes"]
    assert found["readings.0.first.normalized.auc"].n == 40
    assert call(monkeypatch, "readings", *options, "--only", "default") == 2
    assert "holds 60 episodes, expected at least 1024" in " ".join(capsys.readouterr().out.split())
    Results({"plans.sharpened.auc": proportion(29, 30)}, {"command": "x"}).write(
        folder / "evaluation.json"
    )
    stored = folder / "stored.json"
    assert call(monkeypatch, "store", "--assessment", folder, "--out", stored) == 0
    again = Results.read(stored)
    assert {"plans.sharpened.auc", "converged.first.literal.auc"} <= set(again)
    assert again.entries["converged"]["feedback_episodes"] == 300
    assert again.entries["readings"]["seed"] == 100
    for name in ("evaluation", "converged", "readings"):
        (folder / f"{name}.json").unlink()


@pytest.mark.slow
def test_adaptation_is_judged_on_several_pools_beside_its_baselines(monkeypatch, capsys, run):
    file, folder = run
    scenario = load_scenario(file)
    name = next(one for one in scenario.variations if one != "nominal")
    options = ("--assessment", folder, "--variation", name, "--feedback", 40, "--evaluate", 20)
    options += ("--pools", 2, "--oracle", 40, "--scratch", "--workers", 1)
    out = folder / f"adapted-{name}"
    found, _ = results_of(monkeypatch, capsys, out, "study", "adaptation", file, *options)
    assert found.entries["feedback_sets"] == [40, 40]
    for method in ("prior", "adapted 40", "oracle", "scratch 40"):
        assert found[f"sharpened.calibrated.{method}.brier"].n == 40
    for picture in ("study", "adaptation_sharpened"):
        assert (out / f"{picture}.png").is_file()


@pytest.mark.slow
def test_scale_learns_in_a_process_of_its_own_and_keeps_what_it_has(monkeypatch, capsys, run):
    file, folder = run
    options = ("scale", file, "--assessment", folder, "--sizes", "200", "--exact", "200")
    options += ("--episodes", 20, "--seed", 100, "--workers", 1)
    found, _ = results_of(monkeypatch, capsys, folder, "scale", *options)
    assert found["costs.paper 200.segments"].value >= 200
    assert "segments.paper 200 exact.approximate minus exact" in found
    monkeypatch.setattr(scale, "learned_row", None)
    again, _ = results_of(monkeypatch, capsys, folder, "scale", *options)
    assert dict(again) == dict(found)


@pytest.mark.slow
def test_the_truth_of_the_pendulum_is_told_by_plan_and_mode(monkeypatch, capsys, tmp_path):
    scenario = load_scenario("pendulum")
    episodes = run_episodes(scenario, 120, num_workers=1, path=episodes_folder(tmp_path))
    for mode in MODES:
        scenario.assessment = replace(scenario.assessment, mode=mode, epochs=2, ensemble_size=1)
        learned = SafetyAssessment(scenario.assessment).fit(episodes)
        learned.save(assessment_file(tmp_path, mode))
    options = ("--assessment", tmp_path, "--episodes", 20, "--resolution", 3, "--workers", 1)
    found, _ = results_of(
        monkeypatch, capsys, tmp_path, "known_truth", "truth", "pendulum", *options
    )
    assert found["hold.paper.safe_share"].n == 9
    assert found["random.sharpened.confident_errors"].n == 20
    assert (tmp_path / "known_truth_paper.png").is_file()


def test_every_study_says_in_a_sentence_what_it_does():
    commands = typer.main.get_command(app).commands
    assert all(command.help for command in commands.values())
