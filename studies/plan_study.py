"""``python -m studies plan-study``: the gain of choosing plans by Γ."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from drake_safety.cli.console import (
    AssessmentOption,
    ScenarioArgument,
    WorkersOption,
    console,
    interval,
    new_table,
    open_stages,
    print_path,
    print_shipped,
    versions,
)
from drake_safety.cli.training_folder import (
    assessment_folder,
    check_fresh,
    goal_threshold,
    load_assessment,
)
from drake_safety.learning.seeds import PLANNING
from studies import command_line


def plan_study(
    scenario: ScenarioArgument,
    assessment: AssessmentOption = None,
    episodes: Annotated[int, typer.Option(help="Fresh starts to plan from.", min=1)] = 200,
    candidates: Annotated[
        int, typer.Option(help="Plans of each start, all of them simulated.", min=2)
    ] = 9,
    seed: Annotated[int, typer.Option(help="Seed of the starts.")] = PLANNING.first,
    mode: Annotated[str, typer.Option(help="'sharpened' or 'paper'.")] = "sharpened",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the results; by default ASSESSMENT, or else runs/SCENARIO-shipped."
        ),
    ] = None,
    workers: WorkersOption = None,
) -> None:
    """Compare the default plan, the plan with the highest Γ, and the best in hindsight.

    Simulates every candidate plan of every start: EPISODES times CANDIDATES motions. They are kept
    in ASSESSMENT as they finish: a stopped study continues when called again.
    """
    from drake_safety.evaluation.figure_style import save
    from drake_safety.simulation.scenario import load_scenario
    from studies.planning_figure import planning_figure
    from studies.planning_study import (
        PLANS,
        planning_study,
        planning_verdict,
        run_trials,
    )

    loaded = load_scenario(scenario)
    learned = assessment_folder(loaded, assessment)
    gamma = load_assessment(learned.path, mode)
    check_fresh(gamma, loaded, (seed,))
    rule = goal_threshold(learned.path, gamma)
    print_shipped(learned)
    with open_stages() as stages:
        trials = run_trials(
            loaded,
            episodes,
            num_plans=candidates,
            seed=seed,
            num_workers=workers,
            path=planning_folder(learned.out, loaded.simulation_hash(), seed, candidates),
            progress=partial(stages, "candidate motions"),
        )
    study = planning_study(gamma, trials, threshold=rule.threshold)
    table = new_table(
        "plan",
        "executed",
        "safe [%]",
        title=f"{episodes} fresh starts, {candidates} plans each; Γ accepts a plan of "
        f"{interval(study.estimates['accepted'], 100, 1)} %",
    )
    for key, name in PLANS.items():
        estimate = study.estimates[key]
        table.add_row(name, f"{estimate.n}", interval(estimate, 100, 1))
    report = {
        "command": command_line(),
        "scenario": loaded.name,
        "scenario_hash": loaded.simulation_hash(),
        "mode": mode,
        "seed": seed,
        "candidates": candidates,
        "threshold": rule.threshold,
        "versions": versions(),
        **{f"planning.{key}": estimate.to_json() for key, estimate in study.estimates.items()},
    }
    folder = out or learned.out
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "planning.json"
    file.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    console.print(table)
    console.print(planning_verdict(study.estimates), highlight=False, soft_wrap=True)
    console.print(
        f"threshold {rule.threshold:.3f}, {rule.origin}",
        highlight=False,
        soft_wrap=True,
    )
    print_path("figures", file)
    for picture in save(planning_figure(study.estimates), folder / "planning"):
        print_path("picture", picture)


def planning_folder(folder: Path, scenario_hash: str, seed: int, num_plans: int) -> Path:
    """Folder of the executed motions.

    Args:
        folder: Folder of the training.
        scenario_hash: Hash of the simulation.
        seed: Seed of the starts.
        num_plans: Number of candidates of each start.
    """
    return folder / "planning" / f"{scenario_hash[:12]}-{seed}-of-{num_plans}"
