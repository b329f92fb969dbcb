"""Arguments and options that several commands take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ScenarioArgument = Annotated[
    str,
    typer.Argument(help="Name of a scenario (see `scenarios`), or the path of your own YAML file."),
]
AssessmentOption = Annotated[
    Path | None,
    typer.Option(
        "--assessment",
        help="Folder that `train` wrote; by default the scenario's own trained assessment, which "
        "comes with the package.",
        file_okay=False,
    ),
]
TrainingOption = Annotated[
    Path,
    typer.Option(
        "--assessment", help="Folder that `train` wrote, with its episodes.", file_okay=False
    ),
]
WorkersOption = Annotated[
    int | None, typer.Option("--workers", help="Worker processes; one a core by default.")
]
