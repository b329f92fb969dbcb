"""The path of a motion through the embedding space, beside the probability over time."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from drake_safety.evaluation.embedding_figure import draw_safety
from drake_safety.evaluation.figure_style import INK, drawing_style, label_threshold, new_figure
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import UNCERTAINTY, safe_share


def path_figure(
    assessment: SafetyAssessment,
    time_s: np.ndarray,
    points: np.ndarray,
    probability: np.ndarray,
    threshold: float,
    events: Mapping[str, float],
) -> Figure:
    """Plots Ψ(x) (N, 2) over the beliefs of the cells, and the probability (N,) over time [s].

    As in the lower half of the paper's Fig. 6. It shows the first map of an ensemble. Events are
    times [s] by name, marked and numbered in both panels.
    """
    cells, grid = assessment.beliefs_[0], assessment.grid_
    is_empty = cells[:, UNCERTAINTY] >= 1.0
    with drawing_style():
        fig = new_figure(12.0, 5.0)
        left, right = fig.subplots(1, 2, width_ratios=(1.0, 1.25))
        no_count = np.zeros(grid.num_cells, dtype=int)
        label = "safe share of a cell's belief"
        draw_safety(fig, left, grid, safe_share(cells), is_empty, no_count, label=label)
        left.plot(points[:, 0], points[:, 1], color="white", linewidth=2.0, alpha=0.6)
        left.plot(points[:, 0], points[:, 1], color=INK, linewidth=0.7, alpha=0.7)
        half = grid.half_width
        left.set(xlim=(-half, half), ylim=(-half, half), xticks=[], yticks=[], aspect="equal")
        left.set(title="Path through the embedding space", xlabel="hatched: don't know")
        right.plot(time_s, probability, color=INK, linewidth=1.4)
        right.axhline(threshold, color=INK, linewidth=0.8, linestyle="--")
        label_threshold(right, threshold, INK)
        right.set(title="Probability over time", xlabel="time [s]", ylim=(-0.04, 1.2))
        ordered = sorted(events.items(), key=lambda event: event[1])
        for number, (_, at_s) in enumerate(ordered, start=1):
            row = int(np.clip(np.searchsorted(time_s, at_s), 0, len(time_s) - 1))
            box = {"boxstyle": "circle,pad=0.2", "fc": "white", "ec": INK, "lw": 0.8}
            # Around the path, as events may be close together.
            angle = math.radians(120.0 - 75.0 * (number - 1))
            left.annotate(
                f"{number}",
                points[row],
                xytext=(42.0 * math.cos(angle), 42.0 * math.sin(angle)),
                textcoords="offset points",
                fontsize=8,
                bbox=box,
                ha="center",
                va="center",
                arrowprops={"arrowstyle": "-", "color": INK, "linewidth": 0.8},
            )
            left.plot(*points[row], "o", color=INK, markersize=4)
            right.axvline(at_s, color=INK, linewidth=0.6, alpha=0.5)
            # Alternating heights, as events may be close together.
            place = (at_s, 1.06 + 0.08 * (number % 2))
            right.annotate(f"{number}", place, fontsize=8, bbox=box, ha="center", va="center")
        words = [f"{number} {name}" for number, (name, _) in enumerate(ordered, start=1)]
        right.set_xlabel(f"time [s]\n{', '.join(words)}")
    return fig
