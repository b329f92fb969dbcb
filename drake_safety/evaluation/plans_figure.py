"""Positions of targets, coloured by verdict and outcome."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drake_safety.evaluation.figure_style import (
    FALSE_ALARM_COLOUR,
    SAFE_COLOUR,
    UNSAFE_COLOUR,
    drawing_style,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from drake_safety.simulation.capabilities import GoalWords

MISS_COLOUR = "#111111"
# Verdict and outcome: name, class, colour, marker and size; errors are drawn on top.
_KINDS = (
    ("accepted, safe", "safe", SAFE_COLOUR, "o", 13.0),
    ("refused, unsafe", "unsafe", UNSAFE_COLOUR, "o", 13.0),
    ("refused, but safe", "safe", FALSE_ALARM_COLOUR, "s", 34.0),
    ("accepted, but unsafe", "unsafe", MISS_COLOUR, "X", 60.0),
)
# Title, and the horizontal and vertical coordinate.
_VIEWS = (("From behind the robot", 1, 2), ("From above", 1, 0))
_LABELS = ("x [m], forwards", "y [m], to the robot's left", "z [m]")
_WIDTH, _HEIGHT = 6.6, 2.4  # Width of the figure, and height without panels [inches].
_PANEL_WIDTH = 5.6


def plans_figure(
    goals: np.ndarray,
    is_unsafe: np.ndarray,
    is_refused: np.ndarray,
    words: GoalWords | None = None,
) -> Figure:
    """Plots goals in two views; the legend gives the number of each kind.

    Args:
        goals: Targets in the world, (N, 3) [m], or goals of another kind, (N, 3).
        is_unsafe: Outcome of each, (N,).
        is_refused: Verdict on each, (N,).
        words: What the goals are called; targets by default.

    Raises:
        ValueError: The arguments have different lengths.
    """
    goals = np.asarray(goals, dtype=float)
    shapes = [goals.shape, np.shape(is_unsafe), np.shape(is_refused)]
    if goals.ndim != 2 or goals.shape[1] != 3 or {s[0] for s in shapes} != {len(goals)}:
        raise ValueError(f"plans_figure: expected (N, 3), (N,), (N,); got shapes {shapes}")
    members = (
        ~is_unsafe & ~is_refused,
        is_unsafe & is_refused,
        ~is_unsafe & is_refused,
        is_unsafe & ~is_refused,
    )
    is_point = words is None or words.is_point
    labels = list(_LABELS)
    if words is not None and not is_point:
        labels = [f"{axis} [{unit}]" for axis, unit in zip(words.axes, words.units, strict=True)]
    totals = {"safe": int((~is_unsafe).sum()), "unsafe": int(is_unsafe.sum())}
    with drawing_style():
        # Both views share the horizontal axis y and the scale.
        span = np.ptp(goals, axis=0) if len(goals) else np.ones(3)
        heights = [max(span[up], 0.1) / max(span[right], 0.1) for _, right, up in _VIEWS]
        if not is_point:  # Axes of other units have no common scale.
            heights = [0.6] * len(_VIEWS)
        fig = new_figure(_WIDTH, _HEIGHT + _PANEL_WIDTH * sum(heights))
        panels = fig.subplots(2, 1, sharex=True, height_ratios=heights)
        for axes, (title, right, up) in zip(panels, _VIEWS, strict=True):
            for rows, (name, which, colour, marker, size) in zip(members, _KINDS, strict=True):
                is_mistake = size > _KINDS[0][-1]
                share = 100 * rows.sum() / max(totals[which], 1)
                axes.scatter(
                    goals[rows, right],
                    goals[rows, up],
                    s=size,
                    marker=marker,
                    color=colour,
                    alpha=1.0 if is_mistake else 0.55,
                    edgecolors="white",
                    linewidths=0.5 if is_mistake else 0.2,
                    zorder=4 if is_mistake else 3,
                    rasterized=True,
                    label=f"{name}: {rows.sum()} of {totals[which]}, {share:.1f} %",
                )
            if is_point:
                axes.set_aspect("equal")
                axes.set_title(title)
            axes.set_ylabel(labels[up])
            axes.grid(color="#eceef0", linewidth=0.7)
            axes.set_axisbelow(True)
        panels[-1].invert_xaxis()
        panels[-1].set_xlabel(labels[1])
        handles, kinds = panels[0].get_legend_handles_labels()
        fig.legend(handles, kinds, loc="outside lower center", ncols=2)
    return fig
