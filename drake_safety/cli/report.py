"""``drake-safety report``: one HTML page of a run, and the README's tables."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drake_safety.cli.console import console, open_stages, print_path
from drake_safety.cli.provenance import versions
from drake_safety.cli.training_folder import MODES, assessment_file, episodes_folder

if TYPE_CHECKING:
    from drake_safety.evaluation.report.run_folder import Run


def report(
    run: Annotated[
        Path | None, typer.Argument(metavar="[RUN]", help="Folder that `train` and more wrote.")
    ] = None,
    store: Annotated[
        Path | None,
        typer.Option(help="Also keep the evaluation here, compactly: docs/results/NAME.json."),
    ] = None,
    ship: Annotated[
        Path | None,
        typer.Option(
            help="Also put the assessments here, with their evaluation and first verdicts, in a "
            "folder named after the scenario: `assessments` of a checkout goes into the package."
        ),
    ] = None,
    readme: Annotated[
        Path | None,
        typer.Option(
            help="Also rewrite this README's tables, between <!-- results: NAME --> and "
            "<!-- end -->, from docs/results/NAME.json beside it."
        ),
    ] = None,
) -> None:
    """Write one self-contained HTML page about a run, into RUN/report.

    A run that is not finished gets a page, too: it says what is missing.
    """
    if run is None and (readme is None or store is not None or ship is not None):
        raise ValueError("report: name the folder of a run; without one only --readme has a sense")
    if run is not None:
        _report(run, store, ship)
    if readme is not None:
        from drake_safety.evaluation.report.readme import rewrite_readme

        for name in rewrite_readme(readme):
            print_path(f"results of {name} in", readme)


def _report(folder: Path, store: Path | None, ship: Path | None) -> None:
    from drake_safety.evaluation.report.page import write_report
    from drake_safety.evaluation.report.results import store_results
    from drake_safety.evaluation.report.run_folder import read_run

    run = read_run(
        folder,
        episodes=episodes_folder(folder),
        assessments={mode: assessment_file(folder, mode) for mode in MODES},
    )
    if not (store is None and ship is None) and not run.results.figures:
        raise ValueError(
            f"report: {folder} holds no evaluation to store: `drake-safety evaluate` makes one"
        )
    if ship is not None:
        print_path("shipped", _ship(run, ship))
    page = write_report(run, versions=versions(), angular_constraints=_angular_constraints(run))
    for missing in run.missing:
        console.print("missing", f"{missing.what}. {missing.why}", soft_wrap=True, highlight=False)
    print_path("page   ", page)
    if store is not None:
        store_results(run.results, store, train_command=run.extra.get("command"))
        print_path("stored ", store)


def _ship(run: Run, into: Path) -> Path:
    from drake_safety.evaluation.shipping import ship
    from drake_safety.simulation.scenario import load_scenario

    if "command" not in run.extra:
        raise ValueError(
            f"report: {run.folder} does not tell what its assessments were trained with: there is "
            f"no command in {episodes_folder(run.folder)}"
        )
    with open_stages() as stages:
        return ship(
            run.results,
            {mode: assessment_file(run.folder, mode) for mode in MODES},
            into,
            load_scenario(run.scenario_name),
            train_command=str(run.extra["command"]),
            progress=partial(stages, "first fresh episodes"),
        )


def _angular_constraints(run: Run) -> tuple[str, ...]:
    """Constraints whose margins are angles; none where the task cannot be asked any more."""
    import yaml

    from drake_safety.simulation.capabilities import angular_constraints
    from drake_safety.simulation.scenario import parse_scenario

    if not run.scenario:
        return ()
    try:
        scenario = parse_scenario(
            yaml.safe_dump(run.scenario), name=run.scenario_name, folder=run.folder
        )
        return angular_constraints(scenario.make_loop())
    except (ValueError, OSError, RuntimeError):
        return ()
