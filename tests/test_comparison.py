"""The table over several scenarios, and that finished rows are not made again."""

import csv
import io
import json

import pytest

from drake_safety.evaluation import comparison
from drake_safety.evaluation.comparison import (
    Effort,
    compare_scenario,
    figure_names,
    to_csv,
    to_markdown,
)
from drake_safety.evaluation.metrics import Figure
from drake_safety.simulation.scenario import load_scenario
from shuttle_task import shuttling

NAME = "laikago_balancing"
ROW = {
    "scenario": NAME,
    "robot": "laikago",
    "episodes": 256,
    "throws": 40,
    "auc": Figure(0.95, 0.93, 0.97, 100).to_json(),
    "falls_without_recovery": Figure(0.4, 0.25, 0.55, 40).to_json(),
    "falls_with_recovery": Figure(float("nan"), 0.0, 1.0, 0).to_json(),
}


def test_markdown_has_shares_in_percent_and_a_dash_where_nothing_was_found():
    head, _, line = to_markdown([ROW]).splitlines()
    cells = dict(zip(head.split(" | "), line.split(" | "), strict=True))
    assert cells["auc"] == "0.950 [0.930, 0.970]"
    assert cells["falls without recovery"] == "40.0 [25.0, 55.0]"
    assert cells["falls with recovery"] == "–"


def test_csv_has_every_figure_with_its_interval():
    (row,) = csv.DictReader(io.StringIO(to_csv([ROW])))
    assert (row["scenario"], row["episodes"]) == (NAME, "256")
    assert [float(row[f"auc_{end}"]) for end in ("value", "low", "high")] == [0.95, 0.93, 0.97]
    assert row["falls_with_recovery_value"] == ""
    assert {f"{name}_value" for name in figure_names()} < set(row)


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


def test_a_task_without_recovery_has_a_row_without_falls(tmp_path):
    effort = Effort(num_episodes=120, num_fresh=40, num_throws=5, seed=0)
    stages = []
    row = compare_scenario(
        shuttling(),
        tmp_path,
        effort,
        num_workers=1,
        progress=lambda stage, done, total: stages.append(stage),
    )
    assert row["throws"] == 0 and row["auc"]["n"] == 40
    assert 0.5 < row["auc"]["value"] <= 1.0
    assert not any(name.startswith("falls") for name in row)
    assert {"shuttling: training", "shuttling: t-SNE"} <= set(stages)
    cells = to_markdown([row]).splitlines()[-1].split(" | ")
    assert cells[-1].startswith("–")
