"""A small run as `train` and `evaluate` leave it: pendulums in both modes, a motion of theirs."""

from drake_safety.evaluation.figure_style import new_figure, save
from drake_safety.evaluation.metrics import proportion
from drake_safety.evaluation.results import Results
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.simulation.dataset import EpisodeWriter
from lip_episodes import make_episodes

QUICKEST = dict(epochs=2, ensemble_size=1, hidden_sizes=[16], perplexity=10, min_count=3)
QUICKEST |= dict(resolution=6, cell_length=20.0)


def make_figures():
    """Figures of an evaluation of either kind; gradient boosting is ahead in the AUC."""
    estimates = {("episodes", "", "share_unsafe"): proportion(30, 60)}
    for name, count in (("sharpened", 54), ("paper", 40), ("gradient_boosting", 57)):
        for kind in ("segments", "episodes"):
            for column in ("auc", "safe_recall", "unsafe_recall", "brier"):
                estimates[kind, name, column] = proportion(count, 60)
        estimates["throws", name, "threshold"] = proportion(24, 60)
        estimates["throws", name, "falls_with_recovery"] = proportion(60 - count, 60)
        estimates["throws", name, "false_triggers"] = proportion(2, 30)
        estimates["throws", name, "falls_missed"] = proportion(0, 20)
    estimates["throws", "", "falls_without_recovery"] = proportion(20, 60)
    estimates["calibration.plan", "sharpened", "miss_rate"] = proportion(1, 40)
    return estimates


def write_run(folder):
    """Writes a whole run; returns its sharpened assessment."""
    episodes = make_episodes(60)
    with EpisodeWriter(
        folder / "episodes", episodes.info, {"command": "drake-safety train lip --episodes 60"}
    ) as writer:
        for episode in episodes:
            writer.append(episode)
    assessments = {}
    for mode in ("sharpened", "paper"):
        parameters = AssessmentParameters(mode=mode, **QUICKEST)
        assessments[mode] = SafetyAssessment(parameters).fit(episodes)
        assessments[mode].save(folder / f"{mode}.safetensors")
    command = "drake-safety evaluate lip --assessment /somebodys/own/lip --episodes 60"
    Results(make_figures(), {"command": command}).write(folder / "evaluation.json")
    for name in ("run/timeline", "roc", "a_new_figure"):
        figure = new_figure(4.0, 3.0)
        figure.subplots().plot([0, 1])
        save(figure, folder / name)
    (folder / "run/recording.html").write_text("<!doctype html><title>robot</title>")
    return assessments["sharpened"]
