"""Common options and output of the commands."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text
from typer import Argument, Option

from drake_safety.files import progress
from drake_safety.learning.segments import installed_versions

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat
    from pydrake.systems.framework import Context, Diagram

    Monitor = Callable[[Context], object]


ScenarioArgument = Annotated[
    str, Argument(help="Name of a scenario (see `scenarios`), or the path of your own YAML file.")
]
AssessmentOption = Annotated[
    Path | None, Option(help="Folder of `train`; by default of the package.", file_okay=False)
]
TrainingOption = Annotated[Path, Option(help="Folder that `train` wrote.", file_okay=False)]
ModeOption = Annotated[str, Option(help="'sharpened' or 'paper'.")]
VariationOption = Annotated[str, Option(help="Variation of the plant.")]
TargetOption = Annotated[
    str | None,
    Option(
        "--target",
        "--command",
        metavar="X Y Z | NAME",
        help="Target in the world [m], or command, v_x v_y [m/s] and yaw rate [rad/s]; or a name.",
    ),
]
HandOption = Annotated[str | None, Option(help="Reaching hand; the trained one by default.")]
RecoveryOption = Annotated[
    bool | None, Option(help="Whether Γ triggers recovery; by default in balancing only.")
]
MapOption = Annotated[
    Path | None, Option("--map", help="Map of their columns (YAML); or that of an MCAP file.")
]
McapOption = Annotated[
    Path | None, Option("--mcap", help="MCAP file to write of it.", dir_okay=False)
]
WorkersOption = Annotated[int | None, Option(help="Worker processes; one a core by default.")]
ClusterOption = Annotated[
    str | None, Option(help="Address of dask's scheduler, whose workers simulate instead.")
]
LOOPBACK = "127.0.0.1"
"""Address that only this machine reaches."""

_HIDDEN = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]")


def visible(text: str) -> str:
    """A text without characters that move the cursor or hide others: ESC is ␛."""
    return _HIDDEN.sub(lambda m: chr(0x2400 + ord(m[0])) if m[0] < " " else "\ufffd", text)


class _Console(Console):
    """A console on which texts of files print nothing but themselves."""

    def print(self, *objects: Any, **options: Any) -> None:
        """Prints texts, and tables of :func:`new_table`."""
        for one in objects:
            if isinstance(one, Text):
                one.plain = visible(one.plain)
        plain = (visible(f"{x}") if isinstance(x, (str, Path, Exception)) else x for x in objects)
        super().print(*plain, **options)


# Square brackets are units here, not markup. Output to a file has no width of its own.
console = _Console(markup=False, width=None if sys.stdout.isatty() else 120)
show = console.print
say = partial(console.print, highlight=False, soft_wrap=True)
"""Prints words or a path without line breaks, so that they can be copied."""
open_stages = partial(progress.open_stages, console)
"""Shows progress while a block runs: bars on a terminal, a line every 10 s elsewhere."""


def new_table(*columns: str, rows: Iterable[Iterable[str]] = (), title: str | None = None) -> Table:
    """A table whose cells fold if they do not fit, columns of single words (names) last."""
    table, cells = Table(title=title), [[*map(visible, row)] for row in rows]
    for name, *column in zip(columns, *cells, strict=True):
        table.add_column(name, overflow="fold", no_wrap=not any(" " in one for one in column))
    for row in cells:
        table.add_row(*row)
    return table


def open_viewer(host: str = LOOPBACK) -> Meshcat:
    """Starts a Meshcat server at a free port, without the real-time rate."""
    from pydrake.geometry import Meshcat, MeshcatParams

    return Meshcat(MeshcatParams(host=host, port=0, show_stats_plot=False))


def recorded(
    diagram: Diagram, path: Path | None, monitor: Monitor | None = None
) -> AbstractContextManager[Monitor | None]:
    """Context manager with a monitor that also records into an MCAP file, if there is a path."""
    if path is None:
        return nullcontext(monitor)
    from drake_safety.logs.mcap_recorder import McapRecorder

    say("MCAP     ", path)
    return McapRecorder(diagram, path, monitor)


def given(**options: Any) -> dict[str, Any]:
    """The options that are given: not None."""
    return {name: value for name, value in options.items() if value is not None}


def command_line(program: str = "drake-safety", *options: str) -> str:
    """The command line, with further options."""
    return shlex.join([*program.split(), *sys.argv[1:], *options])


def made_by(scenario: str, program: str = "drake-safety") -> dict[str, Any]:
    """Provenance of results: the command line, the scenario and the versions."""
    return {"command": command_line(program), "scenario": scenario, "versions": versions()}


def versions() -> dict[str, str]:
    """Versions of the library and of packages that its results depend on."""
    return installed_versions("drake", "numpy", "scipy", "scikit-learn", "torch")
