import pytest

from drake_safety import SafetyAssessment, run_episodes
from drake_safety.simulation.scenario import parse_scenario
from gliding_task import SCENARIO


@pytest.mark.train
def test_true_shows_the_progress_of_episodes_and_of_learning(capsys, tmp_path):
    scenario = parse_scenario(SCENARIO, name="gliding", folder=tmp_path)
    episodes = run_episodes(scenario, 12, num_workers=1, progress=True)
    assert "episodes of 'gliding': 12/12" in capsys.readouterr().err
    scenario.assessment.perplexity = 5.0
    SafetyAssessment(scenario.assessment).fit(episodes, progress=True)
    printed = capsys.readouterr().err
    assert "t-SNE: 100/100" in printed and "beliefs: 100/100" in printed
