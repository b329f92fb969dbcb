"""The studies' commands, on a task that is cheap."""

import json
import shutil
import sys

import pytest
import typer

from drake_safety.evaluation.metrics import proportion
from drake_safety.evaluation.results import Results
from drake_safety.simulation import rollouts
from drake_safety.simulation.scenario import load_scenario
from shuttle_task import train_shuttle
from studies import ablation_study, planning_study
from studies.__main__ import app, main
from studies.learning_curve import parse_sizes


def call(monkeypatch, *arguments):
    """Runs a command as a shell would; returns its exit code."""
    monkeypatch.setattr(sys, "argv", ["studies", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        main()
    return stop.value.code


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shuttle")
    return train_shuttle(folder), folder


@pytest.mark.slow
def test_an_ablation_writes_a_row_a_variant_and_goes_on_where_it_was_stopped(
    monkeypatch, capsys, run
):
    file, folder = run
    options = ("--assessment", folder, "--quick", "--workers", 1, "--episodes", 40)
    options += ("--calibration-episodes", 30, "--seed", 100)
    assert call(monkeypatch, "ablate", file, *options) in (0, None)
    printed = capsys.readouterr().out
    report = json.loads((folder / "ablation_quick.json").read_text())
    names = [row["name"] for row in report["rows"]]
    assert names[0] == "baseline"
    assert {"score_weight=0.1", "horizon=half", "episodes=half", "paper"} <= set(names)
    for row in report["rows"]:
        assert row["name"] in printed and row["figures"]["k0.auc"]["n"] == 40
    # The shuttle's states are not named after what they are, and nobody has adapted.
    assert report["left_out"].keys() >= {"horizon H", "velocities", "n_f"}
    assert "left out, n_f: there are no pairs" in printed
    for suffix in (".csv", ".png", ".svg"):
        assert (folder / f"ablation_quick{suffix}").is_file()
    monkeypatch.setattr(ablation_study, "unsafe_scores", None)
    monkeypatch.setattr(rollouts, "run_episode", None)
    assert call(monkeypatch, "ablate", file, *options) in (0, None)
    again = json.loads((folder / "ablation_quick.json").read_text())
    assert again["rows"] == report["rows"]
    assert call(monkeypatch, "ablate", file, "--assessment", folder, "--seed", 0) == 2
    assert "start as the" in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_a_plan_study_tells_what_choosing_by_gamma_is_worth(monkeypatch, capsys, run, tmp_path):
    file, trained = run
    folder = tmp_path / "never_judged"  # Others evaluate theirs, which chooses a threshold.
    folder.mkdir()
    shutil.copy(trained / "sharpened.safetensors", folder)
    options = ("--assessment", folder, "--episodes", 10, "--candidates", 3, "--workers", 1)
    assert call(monkeypatch, "plan-study", file, *options, "--out", tmp_path) in (0, None)
    printed = capsys.readouterr().out
    report = json.loads((tmp_path / "planning.json").read_text())
    shares = [report[f"planning.{name}"]["value"] for name in ("default", "best_in_hindsight")]
    assert shares[0] <= report["planning.chosen"]["value"] <= shares[1]
    assert report["planning.default"]["n"] == report["candidates"] + 7 == 10
    for name in ("default plan", "chosen by Γ", "best in hindsight", "promises nothing"):
        assert name in printed
    # The motions are kept with the assessment: a second study simulates nothing.
    monkeypatch.setattr(planning_study, "run_episode", None)
    assert call(monkeypatch, "plan-study", file, *options, "--out", tmp_path / "b") in (0, None)
    again = json.loads((tmp_path / "b" / "planning.json").read_text())
    assert all(again[key] == report[key] for key in report if key.startswith("planning."))
    monkeypatch.undo()
    assert call(monkeypatch, "plan-study", file, *options, "--seed", 0) == 2
    assert "start as the" in capsys.readouterr().out


@pytest.mark.slow
def test_a_learning_curve_is_drawn_and_stored_with_the_evaluation(monkeypatch, capsys, run):
    file, folder = run
    options = ("--assessment", folder, "--episodes", 30, "--calibration-episodes", 20)
    options += ("--workers", 1, "--seed", 100)
    assert call(monkeypatch, "learning-curve", file, *options, "--sizes", "40,60") in (0, None)
    assert "Learning curve" in capsys.readouterr().out
    curve = Results.read(folder / "learning_curve.json")
    assert {"plans.learning_curve.40.auc", "plans.learning_curve.60.fair.brier"} <= curve.keys()
    assert curve.entries["command"].startswith("python -m studies learning-curve ")
    assert (folder / "learning_curve.png").is_file()
    assert call(monkeypatch, "learning-curve", file, *options, "--sizes", "61") == 2
    assert "60 training episodes; got sizes [61]" in capsys.readouterr().out
    # Stored beside the evaluation that it belongs to, and refused beside another.
    judged = {"plans.sharpened.auc": proportion(29, 30)}
    Results(judged, curve.entries).write(folder / "evaluation.json")
    stored = folder / "stored.json"
    assert call(monkeypatch, "store", "--assessment", folder, "--out", stored) in (0, None)
    found = Results.read(stored)
    assert {"plans.sharpened.auc", "plans.learning_curve.40.auc"} <= found.keys()
    Results(judged, curve.entries | {"seed": 7}).write(folder / "evaluation.json")
    assert call(monkeypatch, "store", "--assessment", folder, "--out", stored) == 2
    assert "is of another training or other seeds" in " ".join(capsys.readouterr().out.split())
    for name in ("evaluation.json", "learning_curve.json"):
        (folder / name).unlink()


def test_sizes_of_a_learning_curve_are_numbers_between_commas():
    assert parse_sizes("512,1024") == (512, 1024)
    assert parse_sizes("") == ()
    with pytest.raises(ValueError, match="--sizes 'many': give numbers of episodes"):
        parse_sizes("many")


@pytest.mark.slow
def test_adaptation_is_judged_on_several_pools_beside_its_baselines(monkeypatch, capsys, run):
    file, folder = run
    scenario = load_scenario(file)
    name = next(one for one in scenario.variations if one != "nominal")
    options = ("--assessment", folder, "--variation", name, "--feedback", 40, "--evaluate", 20)
    options += ("--pools", 2, "--oracle", 40, "--scratch", "--workers", 1)
    assert call(monkeypatch, "adaptation", file, *options) in (0, None)
    printed = capsys.readouterr().out
    assert "2 pools of feedback" in " ".join(printed.split())
    study = folder / f"adapted-{name}"
    report = json.loads((study / "study.json").read_text())
    assert report["feedback_sets"] == [40, 40]
    keys = {"prior", "adapted.40", "oracle", "scratch.40"}
    assert {f"sharpened.{key}.calibrated.brier" for key in keys} <= report.keys()
    for picture in ("study_calibrated", "study_grid", "adaptation_sharpened"):
        assert (study / f"{picture}.png").is_file()


@pytest.mark.train
def test_what_has_no_state_planes_has_no_truth_to_be_simulated(monkeypatch, capsys, run):
    file, folder = run
    assert call(monkeypatch, "truth", file, "--assessment", folder) == 2
    assert "has no state planes" in " ".join(capsys.readouterr().out.split())


def test_every_study_says_in_a_sentence_what_it_does():
    commands = typer.main.get_command(app).commands
    assert list(commands) == [
        "ablate",
        "plan-study",
        "learning-curve",
        "adaptation",
        "readings",
        "converged",
        "kills",
        "scale",
        "soak",
        "truth",
        "walking",
        "bench",
        "store",
        "readme",
        "ship",
    ]
    assert all(command.help for command in commands.values())
