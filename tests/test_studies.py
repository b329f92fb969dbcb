"""Every study's command on the smallest real input: what it writes, and what it says."""

import itertools
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from command_line import call, study
from drake_safety.assessments import shipped_folder
from drake_safety.cli.training_folder import MODES, assessment_file
from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.rare_failures import RareFailures
from drake_safety.evaluation.results import Results
from drake_safety.learning.assessment_file import file_hash
from studies import rare
from studies.figures import PICTURES
from toy_tasks import SCENARIO, train_shuttle

ROOT = Path(__file__).resolve().parents[1]
FRESH = "--episodes 40 --calibration-episodes 30 --seed 100"
# By command line: the file that it writes, and some of its rows.
STUDIES = {
    f"evaluate {FRESH}": (
        "evaluation",
        "plans.mlp.auc, plans.gradient_boosting.safe_recall, difference.first.mlp.brier",
    ),
    "features --without to_the_* --episodes 40": (
        "features",
        "rows.all.auc, first.all.brier, rows.without to_the_*.auc, first.without to_the_*.brier",
    ),
    "adaptation --feedback 40 --evaluate 20 --pools 2 --boosting": (
        "adapted-actual/study",
        "sharpened.calibrated.adapted 40.brier, "
        "boosting.refitted 40.auc, paper.grid.adapted 40.brier",
    ),
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shuttle")
    return train_shuttle(folder), folder


def results_of(file, rows):
    """The results in a file: figures, each with an interval around it, if there is a sample."""
    found = Results.read(file)
    by_name = {".".join(filter(None, key)): row for key, row in found.items()}
    for name in rows.split(", "):
        assert math.isfinite(by_name[name].value), name
    for key, row in found.items():
        if math.isfinite(row.value):
            is_never = key[2].startswith("lead_to_") and math.isnan(row.low)
            low = -math.inf if is_never else row.low  # JSON has no infinity.
            assert low <= row.value <= row.high, key
    return found


@pytest.mark.slow
@pytest.mark.parametrize("line", STUDIES)
def test_a_study_of_a_run_writes_its_figures(monkeypatch, run, line):
    scenario, folder = run
    (command, *options), (name, rows) = line.split(" "), STUDIES[line]
    arguments = (scenario, "--assessment", folder, "--workers", 1, *options)
    assert study(monkeypatch, command, *arguments) == 0
    found = results_of(folder / f"{name}.json", rows)
    assert found.entries["command"].startswith(f"python -m studies {command} ")
    if name == "adapted-actual/study":
        assert found.entries["feedback_sets"] == [40, 40]
    if name == "features":
        assert found.entries["all"] - found.entries["without to_the_*"] == 2
    if name == "evaluation":
        # Beside baselines Γ has the figures that `drake-safety evaluate` gives.
        alone = ("evaluate", scenario, "--assessment", folder, "--workers", 1, *FRESH.split(" "))
        monkeypatch.setattr("drake_safety.cli.evaluate.save", lambda figure, path: [])
        assert call(monkeypatch, *alone) == 0
        same = Results.read(folder / "evaluation.json")
        assert {key: found[key] for key in same} == dict(same)


@pytest.mark.slow
def test_walking_is_judged_on_tours_pushes_commands_and_engines(monkeypatch, tmp_path):
    shutil.copy(assessment_file(shipped_folder("go2_walking"), MODES[0]), tmp_path)
    # Baselines need training episodes, which do not ship.
    monkeypatch.setattr("studies.walking.training_episodes", lambda *of: None)
    monkeypatch.setattr("studies.walking.classifier_scorers", lambda *_, **__: [])
    monkeypatch.setattr("studies.walking._DURATIONS_S", {"tour": 0.4, "push": 0.4, "command": 0.4})
    monkeypatch.setattr("studies.walking._SPEED_S", 0.4)
    counts = ("tours", "pushes", "commands", "guarded-tours", "speeds")
    options = itertools.chain.from_iterable((f"--{name}", 1) for name in counts)
    arguments = ("go2_walking", "--assessment", tmp_path, "--workers", 1, *options)
    rows = "tours.without_fall, tours.monitor.false_alarms_per_hour, pushes.fallen, "
    rows += "alarm.without_leaving.sharpened.false_alarms_per_hour_at_5, "
    rows += "guard.falls_with, guard.unchanged_inside, speed.difference_to_mujoco_m_s"
    assert study(monkeypatch, "walking", *arguments) == 0
    results_of(tmp_path / "walking.json", rows)


@pytest.mark.train
def test_rates_of_rare_failures_stand_beside_random_episodes(monkeypatch, tmp_path):
    file = tmp_path / "glide.yaml"
    file.write_text(f"{SCENARIO}parameters: {{speed_m_s: 0.9}}\n")
    system = rare.System(scenario=str(file), episodes=60, repetitions=3)
    monkeypatch.setattr("studies.rare.SYSTEMS", {"glide": system})
    assert study(monkeypatch, "rare", "glide", "--samples", 40, "--out", tmp_path) == 0
    found = Results.read(tmp_path / "rare.json")
    counts = {"rate": 60, "mean": 3, "held": 3, "episodes": 3, "saved": 3}
    assert {key[2]: row.n for key, row in found.items()} == counts
    assert found["glide", "rare", "episodes"].value >= 40


def test_saved_episodes_are_of_the_error_about_the_share_of_random_episodes():
    found = [
        RareFailures(
            rate=Estimate(rate, rate - 0.004, rate + 0.004, 40),
            search_rate=rate,
            simulations=100,
            plain_rollouts=1.0,
            failures=[],
            random=[],
        )
        for rate in (0.008, 0.012, 0.016)
    ]
    failed = np.repeat([1, 0], [20, 1980])
    rows = rare.judged(found, failed)
    assert rows["rate"].value == pytest.approx(1e4)
    assert rows["mean"].value == pytest.approx(1.2e4)
    assert rows["mean"].low < 1e4 < rows["mean"].high
    assert rows["held"].value == pytest.approx(2 / 3)
    error = (0.002**2 + 0.002**2 + 0.006**2) / 3
    assert rows["saved"].value == pytest.approx(0.01 * 0.99 / error / 100)
    assert rare.judged(found, failed[1:])["saved"].value > rows["saved"].value  # About the mean.


@pytest.mark.parametrize("name", [name for name, (_, source) in PICTURES.items() if source])
def test_pictures_of_the_documents_show_what_ships(name):
    """A picture's thresholds and figures are of one file: `python -m studies figures` draws it."""
    source = PICTURES[name][1]
    with Image.open(ROOT / f"docs/pictures/{name}.png") as image:
        assert image.text["Source"] == f"{source} {file_hash(ROOT / source)}"


def test_figures_draws_pictures_by_name_and_knows_all_of_the_documents(monkeypatch, tmp_path):
    monkeypatch.chdir(ROOT)
    assert study(monkeypatch, "figures", "pushes_go2", "--out", tmp_path) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["pushes_go2.png"]
    assert study(monkeypatch, "figures", "nothing", "--out", tmp_path) == 2
    there = {path.stem for path in (ROOT / "docs/pictures").iterdir()}
    assert there == {*PICTURES, "compose"}
    text = "".join(path.read_text() for path in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
    assert set(re.findall(r"pictures/(\w+)\.", text)) == there
