"""A small run as `train` and `evaluate` leave it: pendulums in both modes, a motion of theirs."""

import json

from drake_safety.evaluation.figure_style import new_figure, save
from drake_safety.evaluation.metrics import proportion
from drake_safety.evaluation.results import Results
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.simulation.dataset import EpisodeWriter
from lip_episodes import make_episodes

MODES = ("sharpened", "paper")
QUICKEST = dict(epochs=2, ensemble_size=1, hidden_sizes=[16], perplexity=10, min_count=3)
QUICKEST |= dict(resolution=6, cell_length=20.0)
SCENARIO = "name: lip\ntask: nowhere.to_be:Found\nrobot: pendulum\nparameters: {push: {}}\n"


def make_figures():
    """Figures of an evaluation of either kind; gradient boosting is ahead in the AUC."""
    estimates = {"episodes.share_unsafe": proportion(30, 60)}
    for name, count in (("sharpened", 54), ("paper", 40), ("gradient_boosting", 57)):
        for kind in ("segments", "episodes"):
            for column in ("auc", "safe_recall", "unsafe_recall", "brier"):
                estimates[f"{kind}.{name}.{column}"] = proportion(count, 60)
        estimates[f"throws.{name}.threshold"] = proportion(24, 60)
        estimates[f"throws.{name}.falls_with_recovery"] = proportion(60 - count, 60)
        estimates[f"throws.{name}.false_triggers"] = proportion(2, 30)
        estimates[f"throws.{name}.falls_missed"] = proportion(0, 20)
    estimates["throws.falls_without_recovery"] = proportion(20, 60)
    estimates["calibration.plan.sharpened.miss_rate"] = proportion(1, 40)
    return estimates


def write_evaluation(folder, scenario_hash="0" * 64):
    command = "drake-safety evaluate lip --assessment /somebodys/own/lip --episodes 60"
    entries = {"command": command, "scenario": "lip", "scenario_hash": scenario_hash}
    entries |= {"seed": 1000, "training_seed": 0, "training_episodes": 60, "versions": {"lip": "1"}}
    Results(make_figures(), entries).write(folder / "evaluation.json")


def write_run(folder):
    """Writes a whole run; returns its episodes and its sharpened assessment."""
    episodes = make_episodes(60)
    extra = {"command": "drake-safety train lip --episodes 60", "scenario_yaml": SCENARIO}
    with EpisodeWriter(folder / "episodes", episodes.info, extra) as writer:
        for episode in episodes:
            writer.append(episode)
    assessments = {}
    for mode in MODES:
        parameters = AssessmentParameters(mode=mode, **QUICKEST)
        assessments[mode] = SafetyAssessment(parameters).fit(episodes)
        assessments[mode].save(folder / f"{mode}.safetensors")
    write_evaluation(folder)
    for name in ("run/timeline", "roc", "a_new_figure"):
        figure = new_figure(4.0, 3.0)
        figure.subplots().plot([0, 1])
        save(figure, folder / name)
    recording = "<!doctype html><title>robot</title><p id='robot'>A robot</p>"
    (folder / "run/recording.html").write_text(recording)
    events = {"command": "drake-safety run lip", "columns": ["time [s]"], "rows": [["0.60"]]}
    (folder / "run/run.json").write_text(json.dumps(events))
    return episodes, assessments["sharpened"]
