"""The map of an assessment before and after feedback of an actual robot."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from drake_safety.evaluation import figure_style as style
from drake_safety.evaluation.embedding_figure import draw_bar, draw_values, show_beliefs
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import UNCERTAINTY, safe_share

_NUM_MARKED = 3


def adaptation_figure(prior: SafetyAssessment, adapted: SafetyAssessment, words: str) -> Figure:
    """Plots the cells of the first map, and numbers the cells that changed most."""
    grid, cells = prior.grid_, [one.beliefs_[0] for one in (prior, adapted)]
    shares, empty = map(safe_share, cells), [one[:, UNCERTAINTY] >= 1.0 for one in cells]
    before, after = shares
    with style.drawing_style():
        fig = style.new_figure(style.PAGE_WIDTH, style.PAGE_WIDTH)
        panels = fig.subplots(1, 2).tolist()
        titles = "Before feedback", f"After {words}"
        for axes, share, is_empty, title in zip(
            panels, (before, after), empty, titles, strict=True
        ):
            draw_values(axes, grid, share, is_empty)
            axes.set_title(title)
        change = np.where(empty[0] | empty[1], 0.0, np.abs(after - before))
        lines = []
        for number, cell in enumerate(np.argsort(-change)[:_NUM_MARKED].tolist(), start=1):
            corner = grid.centres[cell] - 0.5 * grid.cell_length
            for axes in panels:
                edge: dict[str, Any] = {"fill": False, "edgecolor": style.INK, "linewidth": 2.0}
                axes.add_patch(Rectangle(corner, grid.cell_length, grid.cell_length, **edge))
                look = {"boxstyle": "circle,pad=0.15", "fc": "white", "ec": style.INK, "lw": 0.8}
                place: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 8}
                axes.text(*grid.centres[cell], f"{number}", bbox=look, **place)
            lines.append(f"{number}: {before[cell]:.2f} → {after[cell]:.2f}")
        panels[1].set_xlabel(",  ".join(lines))
        label = "safe share of a cell's belief; hatched: don't know"
        draw_bar(fig, panels, label)
        show_beliefs(fig, panels, grid, empty[0] & empty[1], room=1.4)
    return fig
