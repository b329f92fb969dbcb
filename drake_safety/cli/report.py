"""``drake-safety report``: one HTML page of a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drake_safety.cli.console import console, print_path, versions
from drake_safety.cli.training_folder import MODES, assessment_file, episodes_folder

if TYPE_CHECKING:
    from drake_safety.evaluation.report.run_folder import Run


def report(
    run: Annotated[Path, typer.Argument(help="Folder written by `train` and other commands.")],
) -> None:
    """Write a self-contained HTML page of a run into RUN/report.

    The page of an unfinished run lists the missing parts.
    """
    from drake_safety.evaluation.report.page import write_report
    from drake_safety.evaluation.report.run_folder import read_run

    read = read_run(
        run,
        episodes=episodes_folder(run),
        assessments={mode: assessment_file(run, mode) for mode in MODES},
    )
    page = write_report(read, versions=versions(), angular_constraints=_angular_constraints(read))
    for missing in read.missing:
        console.print("missing", f"{missing.what}. {missing.why}", soft_wrap=True, highlight=False)
    print_path("page   ", page)


def _angular_constraints(run: Run) -> tuple[str, ...]:
    """Constraints whose margins are angles; empty if the task cannot be loaded."""
    import yaml

    from drake_safety.simulation.scenario import parse_scenario

    if not run.scenario:
        return ()
    try:
        scenario = parse_scenario(
            yaml.safe_dump(run.scenario), name=run.scenario_name, folder=run.folder
        )
        return scenario.make_loop().angular_constraints
    except (ValueError, OSError, RuntimeError):
        return ()
