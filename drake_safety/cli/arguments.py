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
    Path, typer.Option("--assessment", help="Folder that `train` wrote.", file_okay=False)
]
WorkersOption = Annotated[
    int | None, typer.Option("--workers", help="Worker processes; one a core by default.")
]
