"""``drake-safety report``: one HTML page of a run, and the README's tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drake_safety.cli.console import console, print_path
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
    if run is None and (readme is None or store is not None):
        raise ValueError("report: name the folder of a run; without one only --readme has a sense")
    if run is not None:
        _report(run, store)
    if readme is not None:
        from drake_safety.evaluation.report.readme import rewrite_readme

        for name in rewrite_readme(readme):
            print_path(f"results of {name} in", readme)


def _report(folder: Path, store: Path | None) -> None:
    from drake_safety.evaluation.report.page import write_report
    from drake_safety.evaluation.report.results import store_results
    from drake_safety.evaluation.report.run_folder import read_run

    run = read_run(
        folder,
        episodes=episodes_folder(folder),
        assessments={mode: assessment_file(folder, mode) for mode in MODES},
    )
    if store is not None and not run.results.figures:
        raise ValueError(f"report: {folder} holds no evaluation to store")
    page = write_report(run, versions=versions(), angular_constraints=_angular_constraints(run))
    for missing in run.missing:
        console.print("missing", f"{missing.what}. {missing.why}", soft_wrap=True, highlight=False)
    print_path("page   ", page)
    if store is not None:
        store_results(run.results, store, train_command=run.extra.get("command"))
        print_path("stored ", store)


def _angular_constraints(run: Run) -> tuple[str, ...]:
    """Constraints whose margins are angles; none where the task cannot be asked any more."""
    import yaml

    from drake_safety.simulation.scenario import parse_scenario

    if not run.scenario:
        return ()
    try:
        scenario = parse_scenario(
            yaml.safe_dump(run.scenario), name=run.scenario_name, folder=run.folder
        )
        return tuple(scenario.make_loop().angular_constraints)
    except (ValueError, OSError, RuntimeError):
        return ()
