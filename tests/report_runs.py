"""A small run as `train` and `evaluate` leave it: pendulums in both modes, a motion of theirs."""

import json

from drake_safety.evaluation.ablation_study import AblationFile, AblationRow
from drake_safety.evaluation.figure_style import new_figure, save
from drake_safety.evaluation.metrics import Figure, proportion
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.simulation.dataset import EpisodeWriter
from lip_episodes import make_episodes

MODES = ("sharpened", "paper")
SCENARIO = "name: lip\ntask: nowhere.to_be:Found\nrobot: pendulum\nparameters: {push: {}}\n"


def make_figures():
    """Figures of an evaluation of either kind; gradient boosting is ahead in the AUC."""
    figures = {"episodes.share_unsafe": proportion(30, 60)}
    for name, count in (("sharpened", 54), ("paper", 40), ("gradient_boosting", 57)):
        for kind in ("segments", "episodes"):
            for column in ("auc", "safe_recall", "unsafe_recall", "brier"):
                figures[f"{kind}.{name}.{column}"] = proportion(count, 60)
        prefix = f"throws.{name}."
        figures[f"{prefix}threshold"] = proportion(24, 60)
        figures[f"{prefix}falls_with_recovery"] = proportion(60 - count, 60)
        figures[f"{prefix}false_triggers"] = proportion(2, 30)
        figures[f"{prefix}falls_missed"] = proportion(0, 20)
    figures["throws.falls_without_recovery"] = proportion(20, 60)
    figures["calibration.sharpened.miss_rate_5"] = proportion(1, 40)
    return figures


def write_evaluation(folder, scenario_hash="0" * 64):
    content = {
        "command": "drake-safety evaluate lip --assessment /somebodys/own/lip --episodes 60",
        "scenario": "lip",
        "scenario_hash": scenario_hash,
        "seed": 1000,
        "training_seed": 0,
        "training_episodes": 60,
        "versions": {"lip": "1"},
        **{key: figure.to_json() for key, figure in make_figures().items()},
    }
    (folder / "evaluation.json").write_text(json.dumps(content))


def make_planning(gain=(0.5, 0.2, 0.8)):
    """Figures of a plan study in which Γ comes half the way to hindsight."""
    figures = {
        "default": proportion(24, 40),
        "any_candidate": proportion(26, 40),
        "chosen": proportion(30, 40),
        "chosen_if_accepted": proportion(27, 30),
        "best_in_hindsight": proportion(36, 40),
        "accepted": proportion(30, 40),
        "gain": Figure(*gain, 40),
    }
    return {f"planning.{key}": figure for key, figure in figures.items()}


def write_planning(folder, scenario_hash="0" * 64, **options):
    content = {
        "command": "drake-safety plan-study lip --assessment runs/lip",
        "scenario": "lip",
        "scenario_hash": scenario_hash,
        "candidates": 5,
        **{key: figure.to_json() for key, figure in make_planning(**options).items()},
    }
    (folder / "planning.json").write_text(json.dumps(content))


def make_ablation_rows():
    """A baseline, a variant that it beats, one that beats it, and one that may be as good."""
    gains = {
        "baseline": (0.0, 0.0, 0.0),
        "perplexity=10": (-0.05, -0.08, -0.02),
        "resolution=7": (0.02, 0.01, 0.03),
        "min_count=1": (0.004, -0.01, 0.02),
    }
    rows = []
    for name, gain in gains.items():
        figures = {"auc_gain": Figure(*gain, 60), "k0.auc_gain": Figure(*gain, 60)}
        for key in ("auc", "safe_recall", "unsafe_recall", "brier", "calibrated_auc"):
            figures[key] = figures[f"k0.{key}"] = proportion(50, 60)
        rows.append(
            AblationRow(name=name, group=name.partition("=")[0], fingerprint=name, figures=figures)
        )
    return rows


def write_ablation(path, scenario_hash="0" * 64, **entries):
    counted = {"before_feedback": {"auc": proportion(40, 60).to_json()}}
    counted["n_f_total"] = {"auc": proportion(45, 60).to_json()}
    AblationFile(
        path=path,
        entries={
            "command": "drake-safety ablate lip --assessment runs/lip",
            "scenario": "lip",
            "scenario_hash": scenario_hash,
            "left_out": {"horizon H": "longer ones were not recorded"},
            "n_f": {"actual.paper": counted},
            **entries,
        },
        rows={row.name: row for row in make_ablation_rows()},
    ).write()


def write_run(folder):
    """Writes a whole run; returns its episodes and its sharpened assessment."""
    episodes = make_episodes(60)
    extra = {"command": "drake-safety train lip --episodes 60", "scenario_yaml": SCENARIO}
    with EpisodeWriter(folder / "episodes", episodes.info, extra) as writer:
        for episode in episodes:
            writer.append(episode)
    assessments = {}
    for mode in MODES:
        parameters = AssessmentParameters(
            mode=mode,
            epochs=2,
            ensemble_size=1,
            hidden_sizes=[16],
            perplexity=10,
            min_count=3,
            resolution=6,
            cell_length=20.0,
        )
        assessments[mode] = SafetyAssessment(parameters).fit(episodes)
        assessments[mode].save(folder / f"{mode}.safetensors")
    write_evaluation(folder)
    write_planning(folder)
    write_ablation(folder / "ablation.json")
    for name in ("run/timeline", "roc", "a_new_figure"):
        figure = new_figure(4.0, 3.0)
        figure.subplots().plot([0, 1])
        save(figure, folder / name)
    recording = "<!doctype html><title>robot</title><p id='robot'>A robot</p>"
    (folder / "run/recording.html").write_text(recording)
    events = {"command": "drake-safety run lip", "columns": ["time [s]"], "rows": [["0.60"]]}
    (folder / "run/run.json").write_text(json.dumps(events))
    return episodes, assessments["sharpened"]
