"""``drake-safety evaluate``: judges Γ on fresh episodes and throws, beside its rivals."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.table import Table

from drake_safety.cli.arguments import AssessmentOption, ScenarioArgument, WorkersOption
from drake_safety.cli.console import console, new_table, open_stages, print_path
from drake_safety.cli.provenance import command_line, versions
from drake_safety.cli.training_folder import MODES, episodes_folder, load_assessment

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

    from drake_safety.evaluation.metrics import Figure
    from drake_safety.evaluation.throw_study import ThrowStudy, TriggerRule
    from drake_safety.learning.segments import EpisodesInfo


def evaluate(
    scenario: ScenarioArgument,
    assessment: AssessmentOption,
    episodes: Annotated[int, typer.Option(help="Fresh nominal episodes.", min=1)] = 1000,
    throws: Annotated[int, typer.Option(help="Fresh balls at the actual plant.", min=0)] = 600,
    calibration_episodes: Annotated[
        int, typer.Option(help="Other nominal episodes, to choose the recalls' thresholds.", min=20)
    ] = 300,
    calibration_throws: Annotated[
        int, typer.Option(help="Other balls, to choose the classifiers' thresholds.", min=1)
    ] = 200,
    seed: Annotated[int, typer.Option(help="Seed of everything that is fresh.")] = 1_000_000,
    out: Annotated[
        Path | None, typer.Option(help="Folder for tables and pictures; ASSESSMENT's by default.")
    ] = None,
    workers: WorkersOption = None,
) -> None:
    """Judge Γ on fresh episodes and throws, beside the paper's form and direct classifiers."""
    from drake_safety.evaluation.embedding_figure import embedding_figure
    from drake_safety.evaluation.episode_study import evaluate_episodes
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.roc_figure import roc_figure
    from drake_safety.evaluation.scorers import assessment_scorer, classifier_scorers
    from drake_safety.evaluation.throw_study import evaluate_throws, trigger_rules
    from drake_safety.simulation.dataset import load_episodes
    from drake_safety.simulation.rollouts import run_episodes
    from drake_safety.simulation.scenario import load_scenario

    loaded = load_scenario(scenario)
    if throws and not hasattr(loaded.parameters, "recovery"):
        raise ValueError(f"evaluate: {loaded.task} has no recovery to judge: pass --throws 0")
    folder = out or assessment
    sharpened, paper = (load_assessment(assessment, mode) for mode in MODES)
    train_set = load_episodes(episodes_folder(assessment))
    used = range(seed, seed + 4)  # Episodes, throws, and those that thresholds are chosen on.
    if train_set.info.seed in used:
        raise ValueError(
            f"evaluate: seeds {used.start} to {used.stop - 1} would be used, and "
            f"{train_set.info.seed} is the training episodes' own; choose another"
        )
    with open_stages() as stages:
        run_set = partial(run_episodes, loaded, num_workers=workers)
        test_set = run_set(episodes, seed=seed, progress=partial(stages, "fresh nominal episodes"))
        _check_same_simulation(train_set.info, test_set.info)
        calibration_set = run_set(
            calibration_episodes, seed=seed + 3, progress=partial(stages, "calibration episodes")
        )
        classifiers = classifier_scorers(train_set, stages)
        scorers = [
            assessment_scorer("sharpened", sharpened, is_normalized=True),
            assessment_scorer("paper", paper, is_normalized=True),
            *classifiers,
        ]
        figures, scores, labels = evaluate_episodes(scorers, calibration_set, test_set)
        pictures = [
            *save(embedding_figure(sharpened, test_set), folder / "embedding_sharpened"),
            *save(embedding_figure(paper, test_set), folder / "embedding_paper"),
            *save(
                roc_figure({name: (score, labels) for name, score in scores.items()}),
                folder / "roc",
            ),
        ]
        rules: list[TriggerRule] = []
        if throws:
            recovery = loaded.parameters.recovery
            rules = trigger_rules(
                sharpened,
                paper,
                classifiers,
                threshold=recovery.threshold,
                is_normalized=recovery.is_normalized,
            )
            study = evaluate_throws(
                loaded,
                rules,
                num_throws=throws,
                num_calibration=calibration_throws,
                seed=seed + 1,
                calibration_seed=seed + 2,
                num_workers=workers,
                progress=stages,
            )
            figures |= study.figures
            figures["throws.falls_with_recovery"] = figures["throws.sharpened.falls_with_recovery"]
            pictures += save(_throws_picture(study), folder / "throws")
    report = {
        "command": command_line(),
        "scenario": loaded.name,
        "scenario_hash": test_set.info.scenario_hash,
        "seed": seed,
        "training_seed": train_set.info.seed,
        "training_episodes": len(train_set),
        "versions": versions(),
        **{key: figure.to_json() for key, figure in figures.items()},
    }
    file = folder / "evaluation.json"
    file.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    names = [scorer.name for scorer in scorers]
    console.print(_episodes_table(figures, names, "segments", "per segment"))
    console.print(_episodes_table(figures, names, "episodes", "per episode, at k = 0"))
    if rules:
        console.print(_throws_table(figures, [rule.name for rule in rules]))
    print_path("figures", file)
    for picture in pictures:
        print_path("picture", picture)


def _throws_picture(study: ThrowStudy) -> Picture:
    from drake_safety.evaluation.throws_figure import throws_figure

    balls = [log.throw for log in study.logs]
    return throws_figure(
        np.array([ball.speed_m_s for ball in balls]),
        np.array([ball.direction_rad for ball in balls]),
        {
            "balancing alone": study.outcomes(),
            "with recovery, triggered by Γ": study.outcomes("sharpened"),
        },
        mass_kg=np.array([ball.mass_kg for ball in balls]),
    )


def _check_same_simulation(trained: EpisodesInfo, fresh: EpisodesInfo) -> None:
    if trained.scenario_hash != fresh.scenario_hash:
        raise ValueError(
            f"evaluate: the assessment's episodes were made by scenario '{trained.scenario}' with "
            f"hash {trained.scenario_hash[:12]}, but '{fresh.scenario}' now has hash "
            f"{fresh.scenario_hash[:12]}: train again"
        )


def _interval(figure: Figure, scale: float = 1.0, digits: int = 3) -> str:
    value, low, high = (scale * x for x in (figure.value, figure.low, figure.high))
    return f"{value:.{digits}f} ({low:.{digits}f}–{high:.{digits}f})"


def _episodes_table(figures: dict[str, Figure], names: list[str], kind: str, title: str) -> Table:
    columns = ("auc", "safe_recall", "unsafe_recall", "brier")
    table = new_table("scorer", *columns, title=f"Fresh nominal episodes, {title}")
    for name in names:
        table.add_row(name, *(_interval(figures[f"{kind}.{name}.{key}"]) for key in columns))
    return table


def _throws_table(figures: dict[str, Figure], names: list[str]) -> Table:
    alone = figures["throws.falls_without_recovery"]
    table = new_table(
        "trigger",
        "Γ_thre",
        "falls [%]",
        "false triggers [%]",
        "falls missed",
        "after impact [ms]",
        "before the fall [s]",
        title=f"{alone.n} fresh throws at the actual plant; balancing alone falls in "
        f"{_interval(alone, 100, 1)} %",
    )
    for name in names:
        prefix = f"throws.{name}."
        missed = figures[f"{prefix}falls_missed"]
        table.add_row(
            name,
            f"{figures[f'{prefix}threshold'].value:.2f}",
            _interval(figures[f"{prefix}falls_with_recovery"], 100, 1),
            _interval(figures[f"{prefix}false_triggers"], 100, 1),
            f"{round(missed.value * missed.n) if missed.n else 0} of {missed.n}",
            f"{1000 * figures[f'{prefix}trigger_after_impact_s'].value:.0f}",
            f"{figures[f'{prefix}trigger_before_fall_s'].value:.2f}",
        )
    return table
