"""``python -m studies figures``: the pictures of README and docs, from what ships."""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from matplotlib.figure import Figure

from drake_safety import record_episodes
from drake_safety.assessments import shipped_folder
from drake_safety.cli.console import open_stages, say
from drake_safety.cli.run import run
from drake_safety.cli.training_folder import MODES, goal_threshold, load_assessment
from drake_safety.evaluation.embedding_figure import embedding_figure
from drake_safety.evaluation.figure_style import save
from drake_safety.evaluation.interval_figure import interval_figure
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.robot_figure import robot_figure
from drake_safety.evaluation.truth_figure import truth_figure
from drake_safety.learning.seeds import DEMONSTRATION
from drake_safety.simulation.feedback import run_pairs
from drake_safety.simulation.rollouts import run_episodes
from drake_safety.simulation.scenario import load_scenario
from studies.adaptation_figure import adaptation_figure
from studies.moving_pictures import recovery, walking
from studies.reachable_region import reachable_region, region_figure

_ROOT = Path(__file__).resolve().parents[1]
_SEED = DEMONSTRATION.first
_REACHING: dict[str, Any] = {"target": "blue_box", "push": ["torso"], "force": True}
_WALKING: dict[str, Any] = {"target": "0.5 0 0", "push": ["side"], "force": True}
_WALKING |= {"variation": "nominal"}  # On another one the monitor may alarm before the push.
_ELSEWHERE = (
    "compose.svg, which `python docs/generator/diagram_picture.py` draws by GraphViz, and "
    "alarms_*.png of `python -m studies walking`"
)


def _of_run(picture: str, scenario: str, folder: Path, **options: Any) -> Path:
    """A picture of `drake-safety run`."""
    run(scenario, out=folder, **options)
    return folder / "run" / picture


def _embedding(folder: Path) -> Figure:
    scenario = load_scenario("atlas_reaching")
    episodes = run_episodes(scenario, 100, seed=_SEED, **scenario.options_for("evaluation"))
    return embedding_figure(load_assessment(shipped_folder(scenario.name), MODES[0]), episodes)


def _adaptation(folder: Path) -> Figure:
    pairs = run_pairs(load_scenario("laikago_balancing"), 160, seed=_SEED)
    prior = load_assessment(shipped_folder("laikago_balancing"), MODES[1])
    return adaptation_figure(prior, pairs.feedback())


def _region(folder: Path) -> Figure:
    scenario = load_scenario("atlas_reaching")
    shipped = shipped_folder(scenario.name)
    gamma = load_assessment(shipped, MODES[0])
    threshold = goal_threshold(shipped, gamma).threshold
    with open_stages() as stages:
        region = reachable_region(scenario, gamma, stages, threshold=threshold)
    return region_figure(region, list(scenario.make_loop().constraint_names))


def _shapes(folder: Path) -> Figure:
    return robot_figure(load_scenario("g1_walking").make_loop())


def _own_task(folder: Path) -> Figure:
    sys.path.insert(0, str(_ROOT / "examples"))
    quadrotor = import_module("quadrotor")
    plane = np.zeros((41, 41, 12))
    plane[..., 2], plane[..., 8] = np.linspace(0.0, 2.2, 41)[:, None], np.linspace(-11.0, 5.0, 41)
    starts = plane.reshape(-1, 12)

    def reset(diagram: Any, context: Any, rng: Any) -> None:
        (number,) = rng.bit_generator.seed_seq.spawn_key  # Of the episode.
        plant = diagram.GetSubsystemByName("quadrotor")
        plant.GetMyMutableContextFromRoot(context).SetContinuousState(starts[number])

    gamma, options = quadrotor.learn(), {"seed": 1, "duration_s": 2.0, "step_s": quadrotor.STEP_S}
    options |= {"reset": reset, "constraint_names": ["height", "tilt"]}
    episodes = record_episodes(quadrotor.make_diagram, len(starts), **options)
    labels = "vertical speed [m/s]", "height [m]"
    return truth_figure(gamma, episodes, "state_8", "state_2", labels=labels)


def _shifts(name: str, folder: Path) -> Figure:
    """How often Γ is sure and wrong and says "don't know", and when the monitor alarms."""
    results = Results.read(_ROOT / f"docs/results/{name}.json")
    shown = ("gamma", "confident_error"), ("gamma", "unknown"), ("monitor", "delay_s")
    rows = [
        replace(row, set="", method=row.set.removeprefix("shifts."))
        for method, metric in shown
        for row in results.select(method=method, metric=metric)
        if row.set.startswith("shifts.")
    ]
    return interval_figure(rows)


def _adaptation_study(folder: Path) -> Figure:
    results = Results.read(_ROOT / "docs/results/adaptation/laikago-payload-pools.json")
    kinds = "sharpened.calibrated", "paper.grid"
    metrics = "brier", "auc", "unsafe_recall"
    rows = [row for row in results.values() if row.set in kinds and row.metric in metrics]
    return interval_figure(rows)


PICTURES: dict[str, Callable[[Path], Figure | Path]] = {
    "recovery": recovery,
    "walking": walking,
    "timeline": partial(_of_run, "timeline.png", "laikago_balancing", push=["ball"]),
    "path": partial(_of_run, "path.png", "laikago_balancing", push=["ball"], mode="paper"),
    "reaching": partial(_of_run, "timeline.png", "atlas_reaching", **_REACHING),
    "walking_timeline": partial(_of_run, "timeline.png", "g1_walking", **_WALKING),
    "embedding": _embedding,
    "adaptation": _adaptation,
    "adaptation_study": _adaptation_study,
    "shifts_laikago": partial(_shifts, "laikago"),
    "shifts_atlas": partial(_shifts, "atlas"),
    "collision_shapes": _shapes,
    "own_task": _own_task,
    "region": _region,
}
"""Draws a picture, or writes it into a folder, by name."""
SLOW = ("region",)
"""Drawn only by name."""


def figures(
    names: Annotated[
        list[str] | None, typer.Argument(help=f"Of {', '.join(PICTURES)}; all but {SLOW[0]}.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the pictures.")] = Path("docs/pictures"),
) -> None:
    """Draw the pictures of README and docs from the shipped assessments and stored results."""
    if unknown := set(names or ()) - set(PICTURES):
        raise ValueError(f"figures: no picture {sorted(unknown)}; there are {list(PICTURES)}")
    out.mkdir(parents=True, exist_ok=True)
    for name in names or [one for one in PICTURES if one not in SLOW]:
        begin_s = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            drawn = PICTURES[name](Path(folder))
            if isinstance(drawn, Figure):
                drawn = save(drawn, Path(folder) / name)[0]
            picture = out / f"{name}{drawn.suffix}"
            shutil.copyfile(drawn, picture)
        say(f"{time.monotonic() - begin_s:4.0f} s ", picture)
    if not names:
        say("left as they are:", ", ".join(SLOW), "which takes minutes, and", _ELSEWHERE)
