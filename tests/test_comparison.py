"""The table over several scenarios, and that finished rows are not made again."""

import json

import numpy as np
import pytest

from command_line import call
from drake_safety.evaluation import comparison
from drake_safety.evaluation.comparison import (
    Effort,
    compare_scenario,
    comparison_table,
)
from drake_safety.evaluation.comparison_figure import comparison_figure, standing_still
from drake_safety.evaluation.metrics import Estimate
from drake_safety.simulation.scenario import load_scenario
from shuttle_task import SCENARIO, shuttling

NAME = "laikago_balancing"
ROW = {
    "scenario": NAME,
    "robot": "laikago",
    "episodes": 256,
    "throws": 40,
    "auc": Estimate(0.95, 0.93, 0.97, 100).to_json(),
    "falls_without_recovery": Estimate(0.4, 0.25, 0.55, 40).to_json(),
    "falls_with_recovery": Estimate(float("nan"), 0.0, 1.0, 0).to_json(),
}


def test_markdown_has_shares_in_percent_and_a_dash_where_nothing_was_found():
    head, _, line = comparison_table([ROW]).to_markdown().splitlines()
    cells = dict(zip(head.split(" | "), line.split(" | "), strict=True))
    assert cells["auc"] == "0.950 (0.930–0.970)"
    assert cells["falls without recovery"] == "40.0 % (25.0–55.0)"
    assert cells["falls with recovery"] == "–"


def test_a_finished_row_is_read_again_and_another_effort_makes_another(tmp_path, monkeypatch):
    scenario = load_scenario(NAME)
    effort = Effort(num_episodes=256, num_fresh=100, num_throws=40, seed=0)
    made_by = {
        "scenario": scenario.to_yaml(),
        "simulation_hash": scenario.simulation_hash(),
        "actual_hash": scenario.simulation_hash("actual"),
        **vars(effort),
    }
    (tmp_path / "row.json").write_text(json.dumps({"made_by": made_by, "row": ROW}))

    class SimulatedError(Exception):
        pass

    def simulate(*args, **kwargs):
        raise SimulatedError

    monkeypatch.setattr(comparison, "run_episodes", simulate)
    progress = lambda stage, done, total: None  # noqa: E731
    assert compare_scenario(scenario, tmp_path, effort, progress=progress) == ROW
    more = Effort(num_episodes=512, num_fresh=100, num_throws=40, seed=0)
    with pytest.raises(SimulatedError):
        compare_scenario(scenario, tmp_path, more, progress=progress)


@pytest.mark.train
def test_a_task_without_recovery_has_a_row_without_falls(tmp_path, monkeypatch, capsys):
    file, out = tmp_path / "shuttling.yaml", tmp_path / "table"
    file.write_text(SCENARIO)
    options = ("--out", out, "--episodes", 120, "--fresh", 40, "--throws", 5, "--workers", 1)
    assert call(monkeypatch, "compare", file, *options) in (0, None)
    printed = capsys.readouterr().out
    (row,) = json.loads((out / "comparison.json").read_text())["rows"]
    assert row["throws"] == 0 and row["auc"]["n"] == 40
    assert 0.5 < row["auc"]["value"] <= 1.0
    assert not any(name.startswith("falls") for name in row)
    markdown = comparison_table([row]).to_markdown()
    assert (out / "comparison.md").read_text() == markdown + "\n"
    assert markdown.splitlines()[-1].split(" | ")[-1].startswith("–")
    assert "shuttling: training" in printed and "shuttling: t-SNE" in printed
    assert "picture" not in printed  # There is no robot to show.
    # Called again, it reads what it finished.
    monkeypatch.setattr(comparison, "run_episodes", None)
    assert call(monkeypatch, "compare", file, *options) in (0, None)
    assert json.loads((out / "comparison.json").read_text())["rows"] == [row]


def test_the_picture_shows_each_robot_with_what_its_row_says():
    falls = {
        "falls_without_recovery": Estimate(0.4, 0.25, 0.55, 40).to_json(),
        "falls_with_recovery": Estimate(0.025, 0.0, 0.1, 40).to_json(),
    }
    rows = [ROW | falls, {"scenario": "no_robot"}]
    picture = np.zeros((4, 5, 3), dtype=np.uint8)
    (axes,) = comparison_figure(rows, {NAME: picture}).axes
    assert axes.get_title(loc="left") == "laikago balancing"
    assert axes.texts[0].get_text() == "AUC at planning time 0.950\nfalls 40 % → 2.5 %"
    assert axes.images[0].get_array().shape == (4, 5, 3)


def test_a_robot_is_seen_standing_and_a_task_without_one_has_no_picture():
    assert standing_still(shuttling().make_loop()) is None
    still = standing_still(load_scenario(NAME).make_loop())
    height, width, _ = still.shape
    middle, corner = still[height // 2, width // 2], still[2, 2]
    assert np.abs(middle.astype(int) - corner).max() > 20
