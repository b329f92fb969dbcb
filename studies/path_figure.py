"""The path of a motion through the embedding space, beside the probability over time."""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from drake_safety.evaluation import figure_style as style
from drake_safety.evaluation.embedding_figure import draw_bar, draw_values, show_beliefs
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import UNCERTAINTY, safe_share


def path_figure(
    assessment: SafetyAssessment,
    time_s: np.ndarray,
    points: np.ndarray,
    is_known: np.ndarray,
    probability: np.ndarray,
    threshold: float,
    events: Mapping[str, float],
) -> Figure:
    """Plots Ψ(x) (N, 2) over the beliefs of the cells, and the probability (N,) over time [s].

    As in the lower half of the paper's Fig. 6. It shows the first map of an ensemble. Points where
    the belief is known, (N,), are dots; arrows join points farther apart than a cell, dotted over
    "don't know". Events are times [s] by name, marked and numbered in both panels.
    """
    grid, cells = assessment.grid_, assessment.beliefs_[0]
    is_empty = cells[:, UNCERTAINTY] >= 1.0
    known = np.flatnonzero(is_known)
    with style.drawing_style():
        fig = style.new_figure(style.PAGE_WIDTH, style.PAGE_WIDTH)
        upper, lower = fig.subplots(2, 1, height_ratios=(2.0, 1.0))
        show_beliefs(fig, [upper], grid, is_empty, room=3.4)
        draw_values(upper, grid, safe_share(cells), is_empty)
        draw_bar(fig, upper, "safe share of a cell's belief")
        upper.plot(*points[known].T, "o", color="white", mec=style.INK, mew=0.5, markersize=3.5)
        for a, b in pairwise(known.tolist()):
            if math.dist(points[a], points[b]) > grid.cell_length:
                look: dict[str, Any] = {"linestyle": "-" if b == a + 1 else (0, (1, 1.5))}
                look |= {
                    "arrowstyle": "-|>",
                    "color": style.INK,
                    "linewidth": 1.3,
                    "mutation_scale": 12,
                }
                look["connectionstyle"] = "arc3,rad=0.15"
                upper.annotate("", points[b], points[a], arrowprops=look)
        upper.set_title("Path through the embedding")
        upper.set_xlabel("hatched, and dotted arrows: don't know")
        wait: dict[str, Any] = {"step": "post", "color": style.UNKNOWN_COLOUR, "linewidth": 0}
        lower.fill_between(time_s, -0.04, 1.0, where=~np.asarray(is_known), **wait)
        lower.step(time_s, probability, where="post", color=style.SAFE_COLOUR, linewidth=2.0)
        style.draw_threshold(lower, threshold, style.UNSAFE_COLOUR)
        lower.set(title="Probability over time, grey: don't know", ylim=(-0.04, 1.22))
        lower.set_yticks([0.0, 0.5, 1.0])
        ordered = sorted(events.items(), key=lambda event: event[1])
        box = {"boxstyle": "circle,pad=0.2", "fc": "white", "ec": style.INK, "lw": 0.8}
        number_style: dict[str, Any] = {"fontsize": 9, "ha": "center", "va": "center", "bbox": box}
        line = {"arrowstyle": "-", "color": style.INK, "linewidth": 0.8}
        for number, (_, at_s) in enumerate(ordered, start=1):
            # Around the path, as events may be close together.
            angle = math.radians(150.0 - 75.0 * (number - 1))
            beside: dict[str, Any] = {"textcoords": "offset points", "arrowprops": line}
            beside["xytext"] = 38.0 * math.cos(angle), 38.0 * math.sin(angle)
            after = known[time_s[known] >= at_s - 1e-9]
            if len(after):
                upper.annotate(f"{number}", points[after[0]], **beside, **number_style)
                upper.plot(*points[after[0]], "o", color=style.INK, markersize=5)
            lower.axvline(at_s, color=style.INK, linewidth=0.6, alpha=0.5)
            # Alternating heights, as events may be close together.
            lower.annotate(f"{number}", (at_s, 1.07 + 0.09 * (number % 2)), **number_style)
        words = [f"{number} {name}" for number, (name, _) in enumerate(ordered, start=1)]
        lower.set_xlabel(f"time [s]\n{', '.join(words)}")
    return fig
