"""Plot of an ablation: estimates and intervals of all variants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from drake_safety.evaluation.figure_style import (
    FAINT_INK,
    INK,
    SAFE_COLOUR,
    drawing_style,
    new_figure,
    spoken,
)
from studies.ablation import BASELINE
from studies.ablation_study import AblationRow

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PANELS = {"auc": "AUC, every segment", "k0.auc": "AUC, first step (k = 0)", "brier": "Brier"}


def ablation_figure(rows: Sequence[AblationRow], panels: Mapping[str, str] | None = None) -> Figure:
    """Plots the rows of an ablation by choice; a line marks the baseline.

    Args:
        rows: The rows, with the baseline.
        panels: Titles by key of the estimate.
    """
    panels = PANELS if panels is None else panels
    heights: list[float] = []
    top = 0.0
    for i, row in enumerate(rows):
        # Space before each choice.
        top += 1.0 if i == 0 or row.group == rows[i - 1].group else 1.6
        heights.append(-top)
    with drawing_style():
        fig = new_figure(11.0, 1.2 + 0.27 * top)
        all_axes = fig.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (key, title) in zip(all_axes, panels.items(), strict=True):
            for row, height in zip(rows, heights, strict=True):
                estimate = row.estimates[key]
                colour = INK if row.name == BASELINE else SAFE_COLOUR
                axes.plot(
                    [estimate.low, estimate.high], [height, height], color=colour, linewidth=1.6
                )
                axes.plot(estimate.value, height, "o", color=colour, markersize=5)
                if row.name == BASELINE:
                    axes.axvline(estimate.value, color=FAINT_INK, linewidth=0.8, zorder=0)
            axes.set_title(title)
            axes.grid(axis="x", color="#eceef0", linewidth=0.7)
        all_axes[0].set_yticks(heights, [spoken(row.name).replace("=", " = ") for row in rows])
    return fig
