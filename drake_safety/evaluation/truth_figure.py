"""Γ of the first rows of episodes over two state variables, beside the simulated outcomes."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from drake_safety.evaluation.embedding_figure import add_colour_bar, safety_colours
from drake_safety.evaluation.figure_style import FAINT_INK, INK, drawing_style, new_figure, spoken
from drake_safety.evaluation.metrics import area_under_curve
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import check_unused
from drake_safety.learning.segments import DIVERGED, Episodes

_OUTSIDE_COLOUR = "#6b7178"
_UNKNOWN, _OUTSIDE = "Γ: don't know", "outside the safe set"
_DOT = 26.0  # Area of a start's mark [points²].


def truth_figure(
    assessment: SafetyAssessment,
    episodes: Episodes,
    x: str,
    y: str,
    *,
    labels: tuple[str, str] | None = None,
) -> Figure:
    """Plots the probability of the episodes' starts and, beside it, whether they stayed safe.

    A start is the episode's row `first_step`. Starts on a full grid of the two variables are drawn
    as cells, with the boundary of the outcomes in both panels; others as points, whatever their
    other state variables are. The AUC is over starts inside the safe set; "don't know" counts as
    unsafe. Diverged episodes are left out.

    Args:
        episodes: Episodes that it has not used.
        x: Name of the state variable on the horizontal axis, of `episodes.info.state_names`.
        labels: Labels of the two axes, such as "tilt [rad]"; the names by default.
    """
    names = episodes.info.state_names
    for name in (x, y):
        if name not in names:
            raise ValueError(f"truth_figure: no state variable '{name}'; it has {names}")
    check_unused(assessment.used_, [episodes.info.seed], "truth_figure: the assessment")
    starts = [episode for episode in episodes if episode.cause != DIVERGED]
    # An episode that begins outside the safe set ends with the row that it begins with.
    inside = np.array([one.is_safe or one.num_steps > one.first_step for one in starts])
    if not inside.any():
        raise ValueError(
            f"truth_figure: none of {len(episodes)} episodes starts inside the safe set and ends"
        )

    def first(array: str) -> np.ndarray:
        return np.array([getattr(episode, array)[episode.first_step] for episode in starts])

    scorer = assessment_scorer("Γ", assessment)
    state = first("true_state" if scorer.uses_true_state else "state")
    gamma = scorer.probability(state, first("desired_preview"), first("features"))
    is_safe = np.array([episode.is_safe for episode in starts])
    area = area_under_curve(1.0 - np.nan_to_num(gamma)[inside], ~is_safe[inside])
    points = first("true_state")[:, [names.index(x), names.index(y)]]
    titles = (
        "Starts by probability" + ("" if np.isnan(area) else f", AUC {area:.3f}"),
        f"Simulated: {100 * is_safe[inside].mean():.0f} % of {inside.sum()} stay safe",
    )
    with drawing_style():
        fig = new_figure(9.0, 4.6)
        both = fig.subplots(1, 2, sharex=True, sharey=True)
        grid, legend = _grid_order(points), list[Artist]()
        for axes, title, value in zip(both, titles, (gamma, is_safe.astype(float)), strict=True):
            if grid is None:
                shade, marks = _draw_points(axes, points, value, ~inside)
            else:
                shade, marks = _draw_cells(axes, points, value, ~inside, is_safe, grid)
            axes.set(title=title, xlabel=spoken(x) if labels is None else labels[0])
            legend = legend or marks  # The left panel has more to explain.
        both[0].set_ylabel(spoken(y) if labels is None else labels[1])
        if legend:
            fig.legend(handles=legend, loc="outside lower center", ncols=3)
        add_colour_bar(fig, both, shade, "probability of safety")
    return fig


def _grid_order(points: np.ndarray) -> np.ndarray | None:
    """Indices of the points (N, 2) on a full grid, (n_y, n_x); None if they are not on one."""
    # Starts that are set exactly may differ by rounding.
    scale = np.maximum(np.ptp(points, axis=0), 1e-12)
    rounded = np.round(points / scale, 6)
    full = np.meshgrid(*map(np.unique, rounded.T))
    order = np.lexsort(rounded.T)
    is_full = np.array_equal(rounded[order], np.dstack(full).reshape(-1, 2))
    return order.reshape(full[0].shape) if is_full and min(full[0].shape) > 1 else None


def _draw_points(
    axes: Axes, points: np.ndarray, value: np.ndarray, is_outside: np.ndarray
) -> tuple[ScalarMappable, list[Artist]]:
    """Draws coloured, hollow (NaN) or grey (outside) starts; returns colours and legend."""
    x, y = points.T
    hollow, rows = np.isnan(value) & ~is_outside, ~np.isnan(value) & ~is_outside
    ring: dict[str, Any] = {"facecolors": "white", "edgecolors": INK, "linewidths": 0.6}
    cross: dict[str, Any] = {"color": _OUTSIDE_COLOUR, "marker": "x", "label": _OUTSIDE}
    marks = {
        axes.scatter(x[hollow], y[hollow], s=_DOT, label=_UNKNOWN, **ring): hollow,
        axes.scatter(x[is_outside], y[is_outside], s=0.6 * _DOT, **cross): is_outside,
    }
    edge: dict[str, Any] = {"linewidths": 0.3, "edgecolors": FAINT_INK, "rasterized": True}
    shade: dict[str, Any] = {"cmap": safety_colours(), "vmin": 0.0, "vmax": 1.0}
    dots = axes.scatter(x[rows], y[rows], c=value[rows], s=_DOT, **edge, **shade)
    return dots, [mark for mark, chosen in marks.items() if chosen.any()]


def _draw_cells(
    axes: Axes,
    points: np.ndarray,
    value: np.ndarray,
    is_outside: np.ndarray,
    is_safe: np.ndarray,
    grid: np.ndarray,
) -> tuple[ScalarMappable, list[Artist]]:
    """Draws a cell for each start on a grid: coloured, hatched ("don't know") or grey (outside)."""
    place = points[grid[0], 0], points[grid[:, 0], 1]
    hatched: dict[str, Any] = {"facecolor": "white", "edgecolor": FAINT_INK, "hatch": "////"}
    axes.patch.set(**hatched)
    marks: list[Artist] = []
    if np.isnan(value[~is_outside]).any():
        marks.append(Patch(label=_UNKNOWN, **hatched))
    if is_outside.any():
        marks.append(Patch(label=_OUTSIDE, color=_OUTSIDE_COLOUR))
    style: dict[str, Any] = {"shading": "nearest", "rasterized": True, "vmin": 0.0, "vmax": 1.0}
    inside = np.where(is_outside, np.nan, value)[grid]
    image = axes.pcolormesh(*place, inside, cmap=safety_colours(), **style)
    outside = np.where(is_outside, 1.0, np.nan)[grid]
    axes.pcolormesh(*place, outside, cmap=ListedColormap([_OUTSIDE_COLOUR]), **style)
    truth = np.ma.masked_array(is_safe[grid].astype(float), is_outside[grid])
    if np.ptp(truth) > 0:
        # A white edge separates the line from the cells below.
        for colour, width in (("white", 3.4), (INK, 1.6)):
            axes.contour(*place, truth, levels=[0.5], colors=[colour], linewidths=width)
        marks.append(Line2D([], [], color=INK, linewidth=1.6, label="boundary by simulation"))
    return image, marks
