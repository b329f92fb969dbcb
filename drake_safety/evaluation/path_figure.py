"""The path of a motion through the embedding space, beside the probability over time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from drake_safety.evaluation.embedding_figure import draw_values
from drake_safety.evaluation.figure_style import INK, draw_threshold, drawing_style, new_figure
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
    cells = assessment.beliefs_[0]
    is_empty = cells[:, UNCERTAINTY] >= 1.0
    with drawing_style():
        fig = new_figure(12.0, 5.0)
        left, right = fig.subplots(1, 2, width_ratios=(1.0, 1.25))
        label = "safe share of a cell's belief"
        draw_values(fig, left, assessment.grid_, safe_share(cells), is_empty, label)
        left.plot(*points.T, color="white", linewidth=2.0, alpha=0.6)
        left.plot(*points.T, color=INK, linewidth=0.7, alpha=0.7)
        left.set(title="Path through the embedding space", xlabel="hatched: don't know")
        right.plot(time_s, probability, color=INK, linewidth=1.4)
        draw_threshold(right, threshold, INK)
        right.set(title="Probability over time", xlabel="time [s]", ylim=(-0.04, 1.2))
        ordered = sorted(events.items(), key=lambda event: event[1])
        box = {"boxstyle": "circle,pad=0.2", "fc": "white", "ec": INK, "lw": 0.8}
        number_style: dict[str, Any] = {"fontsize": 8, "ha": "center", "va": "center", "bbox": box}
        line = {"arrowstyle": "-", "color": INK, "linewidth": 0.8}
        for number, (_, at_s) in enumerate(ordered, start=1):
            point = points[min(int(np.searchsorted(time_s, at_s)), len(time_s) - 1)]
            # Around the path, as events may be close together.
            angle = math.radians(120.0 - 75.0 * (number - 1))
            beside: dict[str, Any] = {"textcoords": "offset points", "arrowprops": line}
            beside["xytext"] = 42.0 * math.cos(angle), 42.0 * math.sin(angle)
            left.annotate(f"{number}", point, **beside, **number_style)
            left.plot(*point, "o", color=INK, markersize=4)
            right.axvline(at_s, color=INK, linewidth=0.6, alpha=0.5)
            # Alternating heights, as events may be close together.
            right.annotate(f"{number}", (at_s, 1.06 + 0.08 * (number % 2)), **number_style)
        words = [f"{number} {name}" for number, (name, _) in enumerate(ordered, start=1)]
        right.set_xlabel(f"time [s]\n{', '.join(words)}")
    return fig
