"""Common arguments and output of the commands."""

from __future__ import annotations

import math
import shlex
import sys
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Column, Table

from drake_safety.files import progress

if TYPE_CHECKING:
    import numpy as np
    from pydrake.geometry import Meshcat

    from drake_safety.cli.training_folder import AssessmentFolder
    from drake_safety.evaluation.metrics import Estimate
    from drake_safety.learning.assessment import SafetyAssessment
    from drake_safety.simulation.closed_loop import ClosedLoop

ScenarioArgument = Annotated[
    str,
    typer.Argument(
        help="Name of a scenario (see `scenarios`), or the path of your own YAML file.",
        autocompletion=lambda incomplete: _scenario_names(incomplete),
    ),
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
ClusterOption = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        help="Address of dask's scheduler, such as tcp://10.0.0.1:8786, whose workers simulate in "
        "place of processes of this machine.",
    ),
]
LOOPBACK = "127.0.0.1"
"""Address that only this machine reaches."""
HostOption = Annotated[
    str,
    typer.Option(
        "--host",
        help="Address that serves the page; 0.0.0.0 for every one of this machine. Whoever reaches "
        "it can use the controls: there is no password.",
    ),
]

TARGET, COMMAND = "--target", "--command"

# Square brackets are units here, not markup. Output to a file has no width of its own.
console = Console(markup=False, width=None if sys.stdout.isatty() else 120)


def open_viewer(host: str, port: int | None = None, *, has_rate: bool = True) -> Meshcat:
    """Starts a Meshcat server.

    Args:
        host: Address that serves the page.
        port: Its port; a free one by default.
        has_rate: Whether the real-time rate is shown.

    Raises:
        ValueError: The server does not start.
    """
    from pydrake.geometry import Meshcat, MeshcatParams

    try:
        return Meshcat(MeshcatParams(host=host, port=port, show_stats_plot=has_rate))
    except RuntimeError as error:
        place = host if port is None else f"{host}:{port}"
        raise ValueError(f"no page can be served at {place}: {error}") from error


def warn_of_empty_scene(meshcat: Meshcat, task: str) -> None:
    """Prints a warning if a task has drawn nothing; only what was published counts as drawn.

    Args:
        meshcat: The Meshcat server.
        task: The task, as the scenario names it.
    """
    if not meshcat.HasPath("/drake"):
        told = f"warning: task '{task}' draws nothing in Meshcat (nothing is under /drake)"
        console.print(told, style="yellow", highlight=False, soft_wrap=True)


def new_table(*columns: str, title: str | None = None) -> Table:
    """A table whose cells fold if they do not fit, so that no number is truncated."""
    return Table(*(Column(name, overflow="fold") for name in columns), title=title)


def interval(estimate: Estimate, scale: float = 1.0, digits: int = 3) -> str:
    """An estimate with its interval; a dash for NaN."""
    if math.isnan(estimate.value):
        return "-"
    value, low, high = (scale * x for x in (estimate.value, estimate.low, estimate.high))
    return f"{value:.{digits}f} ({low:.{digits}f}–{high:.{digits}f})"


def cause_words(
    loop: ClosedLoop, assessment: SafetyAssessment, masses: np.ndarray, margins: np.ndarray
) -> str:
    """The constraint most likely to be violated, with its predicted margin if there is one.

    Args:
        loop: The closed loop with the constraints.
        assessment: The assessment that predicted them.
        masses: b_unsafe split by constraint, (n_c,).
        margins: Predicted margins, (n_c,) [m, rad].
    """
    from drake_safety.learning.causes import describe_margin, likely_cause

    names = loop.constraint_names
    cause = likely_cause(names, masses, margins, assessment.parameters.margin_unit)
    if not cause:
        return "unknown"
    return describe_margin(cause, margins[names.index(cause)], loop.angular_constraints)


def print_path(what: str, path: Path) -> None:
    """Prints a path without line breaks, so that it can be copied."""
    console.print(what, str(path), soft_wrap=True, highlight=False)


def print_shipped(folder: AssessmentFolder, assessment: SafetyAssessment | None = None) -> None:
    """Prints which assessment is used by default, and what its monitor promises."""
    if folder.is_shipped:
        print_path("assessment        comes with the package,", folder.path)
    if assessment is not None:
        console.print(assessment.detector_.describe(), highlight=False, soft_wrap=True)


def command_line(program: str = "drake-safety", option: str = "") -> str:
    """The command line.

    Args:
        program: Name of the program.
        option: An option that is added unless it is there; "" for none.
    """
    added = [option] if option and option not in sys.argv else []
    return shlex.join([*program.split(), *sys.argv[1:], *added])


def _scenario_names(incomplete: str) -> list[str]:
    """The package's scenarios that begin with a word; without Drake, so that a shell is quick."""
    names = (Path(file.name) for file in files("drake_safety.diagrams").iterdir())
    return sorted(
        name.stem for name in names if name.suffix == ".yaml" and name.stem.startswith(incomplete)
    )


def versions() -> dict[str, str]:
    """Versions of the library and of packages that its results depend on."""
    from drake_safety.learning.segments import installed_versions

    return installed_versions("drake", "numpy", "scipy", "scikit-learn", "torch")


open_stages = partial(progress.open_stages, console)
"""Shows progress while a block runs: bars on a terminal, a line every 10 s elsewhere."""
