import io
import time

import pytest
from rich.console import Console

from drake_safety import SafetyAssessment, run_episodes
from drake_safety.files.progress import open_stages
from drake_safety.simulation.scenario import parse_scenario
from gliding_task import SCENARIO


def lines_of(file):
    return file.getvalue().splitlines()


@pytest.mark.parametrize(
    ("done", "is_coloured", "lines"),
    [
        (40, False, ["throws: 40/40 0:00:00 left 0:00:00", "still working, after 'throws'"]),
        (40, True, ["throws: 40/40 0:00:00 left 0:00:00", "still working, after 'throws'"]),
        (30, False, ["throws: 30/40 0:00:00 left -:--:--"]),  # Done by an earlier run.
    ],
)
def test_the_end_of_a_stage_is_a_line_and_so_is_silence_after_it(done, is_coloured, lines):
    console = Console(file=io.StringIO(), width=200, force_terminal=is_coloured or None)
    with open_stages(console, period_s=0.05) as stages:
        stages("throws", done, 40)
        assert lines_of(console.file) == lines[: done // 40]
        time.sleep(0.2)
    assert lines_of(console.file)[: len(lines)] == lines


@pytest.mark.train
def test_true_shows_the_progress_of_episodes_and_of_learning(capsys, tmp_path):
    scenario = parse_scenario(SCENARIO, name="gliding", folder=tmp_path)
    episodes = run_episodes(scenario, 12, num_workers=1, progress=True)
    assert "episodes of 'gliding': 12/12" in capsys.readouterr().err
    scenario.assessment.perplexity = 5.0
    SafetyAssessment(scenario.assessment).fit(episodes, progress=True)
    printed = capsys.readouterr().err
    assert "t-SNE: 100/100" in printed and "beliefs: 100/100" in printed
