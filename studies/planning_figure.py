"""Plot of planning with Γ: shares of safe motions by choice of the plan."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from drake_safety.evaluation.figure_style import (
    FAINT_INK,
    INK,
    SAFE_COLOUR,
    drawing_style,
    new_figure,
)
from studies.planning_study import PLANS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from drake_safety.evaluation.metrics import Estimate


def planning_figure(estimates: Mapping[str, Estimate]) -> Figure:
    """Plots the share of safe motions for each choice; a line marks the default plan.

    Args:
        estimates: Those of a :class:`~studies.planning_study.PlanningStudy`; missing ones and NaN
            are left out.
    """
    rows = [
        (key, name, estimates[key])
        for key, name in PLANS.items()
        if key in estimates and math.isfinite(estimates[key].value)
    ]
    with drawing_style():
        fig = new_figure(7.0, 1.1 + 0.36 * len(rows))
        axes = fig.subplots()
        for i, (key, _, estimate) in enumerate(rows):
            colour = SAFE_COLOUR if key.startswith("chosen") else INK
            ends = [100.0 * estimate.low, 100.0 * estimate.high]
            axes.plot(ends, [-i, -i], color=colour, linewidth=1.8)
            axes.plot(100.0 * estimate.value, -i, "o", color=colour, markersize=6)
            if key == "default":
                axes.axvline(100.0 * estimate.value, color=FAINT_INK, linewidth=0.8, zorder=0)
        axes.set_yticks([-i for i in range(len(rows))], [f"{name} ({f.n})" for _, name, f in rows])
        axes.set_ylim(-len(rows) + 0.4, 0.6)
        axes.set_title("Planning with Γ")
        axes.set_xlabel("motions that stay safe [%], with 95 % intervals")
        axes.grid(axis="x", color="#eceef0", linewidth=0.7)
        axes.set_axisbelow(True)
    return fig
