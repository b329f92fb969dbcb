import numpy as np
import pytest

from drake_safety.cli.training_folder import episodes_folder
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.simulation.scenario import load_scenario
from lip_assessments import QUICK
from lip_episodes import make_episodes
from studies.converged import judged_rules, nominal_feedback, recalls
from studies.readings import Reading, readings_of


@pytest.mark.parametrize(
    ("name", "options"),
    [("laikago_balancing", {"ball": False}), ("atlas_reaching", {"exploring": False})],
)
def test_the_papers_mode_learns_from_episodes_without_disturbances(name, options, tmp_path):
    scenario = load_scenario(name)
    assert scenario.options_for("paper") == options
    scenario.make_loop(**options)
    assert episodes_folder(tmp_path, "paper") == tmp_path / "episodes"
    (tmp_path / "episodes_paper").mkdir()
    assert episodes_folder(tmp_path, "paper") == tmp_path / "episodes_paper"
    assert episodes_folder(tmp_path) == tmp_path / "episodes"


@pytest.mark.parametrize("name", ["laikago_balancing", "atlas_reaching"])
def test_every_reading_differs_from_the_default_in_what_it_names(name):
    scenario = load_scenario(name)
    readings = readings_of(scenario)
    default, *others = readings
    assert default == Reading(name="default")
    base = default.parameters(scenario.assessment)
    assert base.mode == "paper"
    for one in others:
        parameters = one.parameters(scenario.assessment)
        assert parameters != base or one.start or one.is_exploring
        changed = one.scenario(scenario).simulation_hash() != scenario.simulation_hash()
        assert changed == one.has_own_episodes(scenario.assessment)
    assert len({one.name for one in readings}) == len(readings)


@pytest.mark.train
def test_feedback_without_a_gap_leaves_less_uncertainty_and_refuses_less_at_the_papers_threshold():
    prior = SafetyAssessment(AssessmentParameters(mode="paper", **QUICK)).fit(make_episodes(240))
    other, test = make_episodes(60, seed=5), make_episodes(60, seed=6)
    feedback = nominal_feedback(prior, other)
    assert len(feedback) == 60 and not any(one.differs for one in feedback)
    adapted = prior.adapt(feedback, method="paper")
    filled = prior.beliefs_[0, :, 2] < 1.0
    assert adapted.beliefs_[0, filled, 2].mean() < prior.beliefs_[0, filled, 2].mean()
    fair = np.arange(60) % 2 == 0
    rules = {k: v for k, v in judged_rules(prior, adapted).items() if k != "conformal"}
    found = recalls(rules, other, test, fair)
    recall = "segments.{}.safe_recall"
    assert found[recall.format("converged")].value > found[recall.format("literal")].value
    assert found["first.literal.threshold"].value == pytest.approx(0.6)
    assert found["fair.literal.auc"].n == 30
    assert not any(key.startswith("fair") for key in recalls(rules, other, test, fair & False))
