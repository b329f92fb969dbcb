"""``python -m studies compare``: one table and one picture of several evaluated runs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from drake_safety.cli.console import console, new_table, say
from drake_safety.evaluation.figure_style import drawing_style, new_figure, save
from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.stills import StillCamera
from drake_safety.evaluation.tables import Column
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.scenario import load_scenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLUMNS = {
    "unsafe [%]": ("episodes.share_unsafe",),
    "AUC at k = 0 [%]": ("episodes.sharpened.auc", "plans.sharpened.auc"),
    "safe recall [%]": ("episodes.sharpened.safe_recall", "plans.sharpened.safe_recall"),
    "unsafe recall [%]": ("episodes.sharpened.unsafe_recall", "plans.sharpened.unsafe_recall"),
    "falls alone [%]": ("throws.falls_without_recovery",),
    "falls with recovery [%]": ("throws.sharpened.falls_with_recovery",),
    "false triggers [%]": ("throws.sharpened.false_triggers",),
    "beyond a speed limit [%]": ("throws.sharpened.recoveries_with_joint_velocity",),
}
"""Keys of the estimates by column; of several, the one that the run has."""
_POINTS = Column("", "", "points", digits=1)
_NUM_COLUMNS = 4
_SIZE = (480, 400)  # Of a still [pixels].


def compare(
    runs: Annotated[list[Path], typer.Argument(help="Folders of `train` with an evaluation.json.")],
    out: Annotated[Path, typer.Option(help="Folder for the picture.")] = Path("runs"),
) -> None:
    """Compare evaluated runs of several scenarios, and draw the robots with their figures."""
    rows, stills = {}, {}
    for run in runs:
        results = Results.read(run / "evaluation.json")
        name = results.entries["scenario"]
        rows[name] = results
        still = standing_still(load_scenario(name).make_loop())
        if still is not None:
            stills[name] = still
    table = new_table("scenario", *_COLUMNS)
    for name, estimates in rows.items():
        found = (_first(estimates, keys) for keys in _COLUMNS.values())
        table.add_row(name, *map(_POINTS.text, found))
    console.print(table)
    if stills:
        for picture in save(comparison_figure(rows, stills), out / "comparison"):
            say("picture", picture)


def _first(estimates: Mapping[str, Estimate], keys: tuple[str, ...]) -> Estimate | None:
    return next((estimates[key] for key in keys if key in estimates), None)


def standing_still(loop: ClosedLoop) -> np.ndarray | None:
    """A still of the standing robot, RGB (height, width, 3); None for a task without legs."""
    if not isinstance(loop, LeggedLoop):
        return None
    context = loop.CreateDefaultContext()
    loop.reset_to(context, None, loop.standing_start())
    positions = loop.plant.GetPositions(loop.plant.GetMyContextFromRoot(context))
    width, height = _SIZE
    return StillCamera(loop, positions, width=width, height=height).render(positions)


def comparison_figure(
    rows: Mapping[str, Mapping[str, Estimate]], stills: Mapping[str, np.ndarray]
) -> Figure:
    """Plots stills in a grid with AUC and falls below; both arguments are by scenario."""
    num_columns = min(_NUM_COLUMNS, len(stills))
    num_rows = math.ceil(len(stills) / num_columns)
    with drawing_style():
        fig = new_figure(3.0 * num_columns, 3.25 * num_rows)
        panels = np.atleast_1d(fig.subplots(num_rows, num_columns)).ravel()
        for axes in panels:
            axes.set_axis_off()
        for axes, (name, still) in zip(panels, stills.items(), strict=False):
            axes.imshow(still)
            axes.set_title(name.replace("_", " "), loc="left")
            words = "\n".join(_captions(rows[name]))
            axes.text(0.0, -0.04, words, transform=axes.transAxes, va="top")
    return fig


def _captions(estimates: Mapping[str, Estimate]) -> list[str]:
    captions = []
    auc = _first(estimates, _COLUMNS["AUC at k = 0 [%]"])
    if auc is not None:
        captions.append(f"AUC at planning time {auc.value:.3f}")
    if "throws.falls_without_recovery" in estimates:
        before = 100 * estimates["throws.falls_without_recovery"].value
        after = 100 * estimates["throws.sharpened.falls_with_recovery"].value
        captions.append(f"falls {before:.0f} % → {after:.1f} %")
    return captions
