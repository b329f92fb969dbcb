"""``drake-safety report``: one HTML page of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument

from drake_safety.cli.console import say, versions
from drake_safety.cli.training_folder import episodes_folder
from drake_safety.evaluation.report import write_report


def report(
    run: Annotated[Path, Argument(help="Folder written by `train` and other commands.")],
) -> None:
    """Write RUN/report.html, a self-contained page of what is there."""
    say("page", write_report(run, episodes=episodes_folder(run), versions=versions()))
