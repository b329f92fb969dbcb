"""Stills of the robots of a comparison with their results."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_safety.evaluation.comparison import row_estimate
from drake_safety.evaluation.figure_style import drawing_style, new_figure
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.legged_loop import LeggedLoop

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLUMNS = 4
_SIZE = (480, 400)  # Of a still [pixels].


def standing_still(loop: ClosedLoop) -> np.ndarray | None:
    """A still of the standing robot, RGB (height, width, 3); None for a task without legs.

    Args:
        loop: A closed loop.
    """
    from drake_safety.evaluation.stills import StillCamera

    if not isinstance(loop, LeggedLoop):
        return None
    context = loop.CreateDefaultContext()
    loop.reset_to(context, None, loop.standing_start())
    positions = loop.plant.GetPositions(loop.plant.GetMyContextFromRoot(context))
    width, height = _SIZE
    return StillCamera(loop, positions, width=width, height=height).render(positions)


def comparison_figure(
    rows: Sequence[Mapping[str, Any]], stills: Mapping[str, np.ndarray]
) -> Figure:
    """Plots stills in a grid with AUC and falls below.

    Args:
        rows: Rows of the comparison.
        stills: By scenario, RGB (height, width, 3); rows without a still are left out.
    """
    shown = [row for row in rows if row["scenario"] in stills]
    num_columns = min(_COLUMNS, len(shown))
    num_rows = math.ceil(len(shown) / num_columns)
    with drawing_style():
        fig = new_figure(3.0 * num_columns, 3.25 * num_rows)
        panels = np.atleast_1d(fig.subplots(num_rows, num_columns)).ravel()
        for axes in panels:
            axes.set_axis_off()
        for axes, row in zip(panels, shown, strict=False):
            axes.imshow(stills[row["scenario"]])
            axes.set_title(row["scenario"].replace("_", " "), loc="left")
            axes.text(
                0.0,
                -0.04,
                "\n".join(_captions(row)),
                transform=axes.transAxes,
                va="top",
            )
    return fig


def _captions(row: Mapping[str, Any]) -> list[str]:
    captions = []
    auc = row_estimate(row, "auc")
    if auc is not None:
        captions.append(f"AUC at planning time {auc.value:.3f}")
    ends = [row_estimate(row, f"falls_{how}_recovery") for how in ("without", "with")]
    if None not in ends:
        before, after = (100 * end.value for end in ends if end is not None)
        captions.append(f"falls {before:.0f} % → {after:.1f} %")
    return captions
