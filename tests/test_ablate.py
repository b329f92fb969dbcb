"""The commands around ablations and pushed motions, on a task that is cheap."""

import json

import pytest

from command_line import call
from drake_safety.cli.training_folder import MODES, assessment_file, episodes_folder
from drake_safety.evaluation import ablation_study
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation import pushed_motions, rollouts
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import load_scenario
from shuttle_task import SCENARIO


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shuttle")
    file = folder / "shuttling.yaml"
    file.write_text(SCENARIO)
    scenario = load_scenario(file)
    episodes = run_episodes(scenario, 30, num_workers=1, path=episodes_folder(folder))
    for mode in MODES:
        scenario.assessment.mode = mode
        SafetyAssessment(scenario.assessment).fit(episodes).save(assessment_file(folder, mode))
    return file, folder


@pytest.mark.slow
def test_an_ablation_writes_a_row_a_variant_and_goes_on_where_it_was_stopped(
    monkeypatch, capsys, run
):
    file, folder = run
    options = ("--assessment", folder, "--quick", "--workers", 1, "--episodes", 20)
    options += ("--calibration-episodes", 20, "--seed", 100)
    assert call(monkeypatch, "ablate", file, *options) in (0, None)
    printed = capsys.readouterr().out
    report = json.loads((folder / "ablation_quick.json").read_text())
    names = [row["name"] for row in report["rows"]]
    assert names[0] == "baseline"
    assert {"score_weight=0.1", "horizon=half", "episodes=half", "paper"} <= set(names)
    for row in report["rows"]:
        assert row["name"] in printed and row["figures"]["k0.auc"]["n"] == 20
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
    assert "0 is the training episodes' own" in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_who_notices_pushes_is_part_of_the_evaluation(monkeypatch, capsys, run):
    file, folder = run
    options = ("--assessment", folder, "--episodes", 20, "--calibration-episodes", 20)
    options += ("--workers", 1, "--seed", 100, "--plane-step", 0, "--other-hand", 0)
    assert call(monkeypatch, "evaluate", file, *options, "--pushes", 15) in (0, None)
    printed = capsys.readouterr().out
    report = json.loads((folder / "evaluation.json").read_text())
    judged = {key.split(".")[1] for key in report if key.startswith("monitoring.")}
    assert judged == {
        "motions",
        "sharpened",
        "sharpened_literal",
        "sharpened_calibrated",
        "paper",
        "paper_literal",
        "gradient_boosting",
        "mlp",
        "front_margin",
        "smallest_margin",
    }
    pushed, refused = (report[f"monitoring.motions.{key}"] for key in ("leave_safe_set", "refused"))
    assert refused["n"] == 30 and pushed["n"] == 30 - round(30 * refused["value"])
    assert 0 < pushed["value"] < 1
    assert "Watching while it moves: pushes" in printed
    assert (folder / "monitoring.png").is_file()
    # The motions are kept, as the fresh episodes are: the second time nothing is simulated.
    monkeypatch.setattr(pushed_motions, "run_pushed_motion", None)
    monkeypatch.setattr(rollouts, "run_episode", None)
    assert call(monkeypatch, "evaluate", file, *options, "--pushes", 15) in (0, None)
    again = json.loads((folder / "evaluation.json").read_text())
    assert all(again[key] == report[key] for key in report if key.startswith("monitoring."))


def test_pushes_are_refused_where_there_is_no_way_to_push(monkeypatch, capsys, run, tmp_path):
    _, folder = run
    arguments = ("--assessment", folder, "--throws", 0, "--pushes", 3)
    assert call(monkeypatch, "evaluate", "laikago_balancing", *arguments) == 2
    assert "have no goal to be pushed on the way to" in " ".join(capsys.readouterr().out.split())
