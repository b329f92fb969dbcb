"""Studies of the paper's mode: readings, its own verdict, and their tables."""

import numpy as np
import pytest

from drake_safety.cli.training_folder import episodes_folder, training_options
from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.results import Results
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.simulation.scenario import load_scenario
from lip_assessments import QUICK
from lip_episodes import make_episodes
from studies.converged import judged_rules, nominal_feedback, recalls
from studies.documents import render
from studies.readings import Reading, readings_of


@pytest.mark.parametrize(
    ("name", "options"),
    [("laikago_balancing", {"ball": False}), ("atlas_reaching", {"exploring": False})],
)
def test_the_papers_mode_learns_from_episodes_without_disturbances(name, options, tmp_path):
    scenario = load_scenario(name)
    assert training_options(scenario, "paper") == options
    assert training_options(scenario, "sharpened") == {}
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


def test_the_tables_of_the_papers_mode_say_what_was_found():
    one = Estimate(0.5, 0.4, 0.6, 100)
    rows = ("auc", "safe_recall", "unsafe_recall", "threshold")
    keys = [
        f"{kind}.{rule}.{key}"
        for kind in ("segments", "first")
        for rule in ("literal", "converged", "normalized", "conformal")
        for key in rows
    ]
    throws = [
        f"throws.{rule}.{key}"
        for rule in ("before", "converged")
        for key in ("falls_with_recovery", "false_triggers")
    ]
    entries = {"command": "python -m studies x", "training_episodes": 64, "seed": 3}
    entries |= {"feedback_episodes": 9, "feedback_pairs": 8, "names": ["default", "raw x"]}
    estimates = {f"readings.{i}.{key}": one for i in range(2) for key in keys}
    estimates |= {f"converged.{key}": one for key in keys}
    found = Results(estimates, {"readings": entries, "converged": entries})
    text = render("readings", found)
    assert "python -m studies x" in text and "| raw x | 0.500 (0.400–0.600) |" in text
    assert "64 episodes" in text and "100 fresh ones of seed 3" in text
    text = render("converged", found)
    assert "k = 0: b_safe < 0.6, after adaptation | 0.50 | 0.500" in text
    assert "fair" not in text and "throws" not in text
    estimates |= {f"converged.{key}": one for key in [*throws, "throws.falls_without_recovery"]}
    text = render("converged", Results(estimates, found.entries))
    assert "| after adaptation | 50.0 % (40.0–60.0) | 50.0 % (40.0–60.0) |" in text
    assert "after 8 pairs" in text


def test_the_summary_shows_the_papers_mode_after_its_adaptation():
    one, entries = Estimate(0.25, 0.2, 0.3, 50), {"training_episodes": 8}
    keys = ["segments.paper.auc", "episodes.paper.auc", "episodes.share_unsafe"]
    keys += ["converged.segments.converged.auc", "converged.first.converged.auc"]
    keys += ["converged.throws.converged.falls_with_recovery"]
    keys += ["converged.throws.converged.false_triggers"]
    found = Results(
        dict.fromkeys(keys, one),
        entries | {"converged": entries | {"training_episodes": 9}},
    )
    text = render("summary", found)
    assert "`paper` has learned from 9 episodes." in text
    rates = "25.0 % (20.0–30.0) | 25.0 % (20.0–30.0)"
    auc = "0.250 (0.200–0.300) | 0.250 (0.200–0.300)"
    assert f"| `paper`, b_safe < 0.6 after adaptation | {auc} | {rates} |" in text
