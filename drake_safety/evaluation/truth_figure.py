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

from drake_safety.evaluation.embedding_figure import safety_colours
from drake_safety.evaluation.figure_style import FAINT_INK, INK, drawing_style, new_figure, spoken
from drake_safety.evaluation.metrics import area_under_curve
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import check_unused
from drake_safety.learning.segments import DIVERGED, Episodes

_OUTSIDE_COLOUR = "#6b7178"
_HATCH = "////"
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

    Raises:
        ValueError: A state variable does not exist, the assessment has used the episodes' seed, or
            no episode starts inside the safe set and has an outcome.
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
        grid = _grid_order(points)
        for axes, title, value in zip(both, titles, (gamma, is_safe.astype(float)), strict=True):
            if grid is None:
                shade = _draw_points(axes, points, value, ~inside)
            else:
                shade = _draw_cells(axes, points, value, ~inside, is_safe, grid)
            axes.set(title=title, xlabel=spoken(x) if labels is None else labels[0])
        both[0].set_ylabel(spoken(y) if labels is None else labels[1])
        _add_legend(
            fig,
            has_unknown=np.isnan(gamma[inside]).any(),
            has_outside=not inside.all(),
            is_grid=grid is not None,
            has_boundary=not np.isnan(area),
        )
        bar = fig.colorbar(shade, ax=both, shrink=0.9, pad=0.02, label="probability of safety")
        bar.outline.set_visible(False)
    return fig


def _grid_order(points: np.ndarray) -> np.ndarray | None:
    """Indices of the points (N, 2) on a full grid, (n_y, n_x); None if they are not on one."""
    # Starts that are set exactly may differ by rounding.
    scale = np.maximum(np.ptp(points, axis=0), 1e-12)
    (xs, column), (ys, row) = (
        np.unique(np.round(values, 6), return_inverse=True) for values in (points / scale).T
    )
    if len(xs) < 2 or len(ys) < 2 or len(xs) * len(ys) != len(points):
        return None
    order = np.full((len(ys), len(xs)), -1)
    order[row, column] = np.arange(len(points))
    return None if (order < 0).any() else order


def _draw_points(
    axes: Axes, points: np.ndarray, value: np.ndarray, is_outside: np.ndarray
) -> ScalarMappable:
    """Draws a point for each start: coloured, hollow (NaN, "don't know") or grey (outside)."""
    x, y = points.T
    hollow, rows = np.isnan(value) & ~is_outside, ~np.isnan(value) & ~is_outside
    axes.scatter(x[hollow], y[hollow], s=_DOT, facecolors="white", edgecolors=INK, linewidths=0.6)
    axes.scatter(x[is_outside], y[is_outside], s=0.6 * _DOT, color=_OUTSIDE_COLOUR, marker="x")
    edge: dict[str, Any] = {"linewidths": 0.3, "edgecolors": FAINT_INK, "rasterized": True}
    shade: dict[str, Any] = {"cmap": safety_colours(), "vmin": 0.0, "vmax": 1.0}
    return axes.scatter(x[rows], y[rows], c=value[rows], s=_DOT, **edge, **shade)


def _draw_cells(
    axes: Axes,
    points: np.ndarray,
    value: np.ndarray,
    is_outside: np.ndarray,
    is_safe: np.ndarray,
    grid: np.ndarray,
) -> ScalarMappable:
    """Draws a cell for each start on a grid: coloured, hatched ("don't know") or grey (outside)."""
    place = points[grid[0], 0], points[grid[:, 0], 1]
    axes.patch.set(facecolor="white", edgecolor=FAINT_INK, hatch=_HATCH)
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
    return image


def _add_legend(
    fig: Figure, *, has_unknown: bool, has_outside: bool, is_grid: bool, has_boundary: bool
) -> None:
    """Adds what the colour bar does not say, below the panels."""

    def mark(label: str, of_cell: dict[str, Any], of_point: dict[str, Any]) -> Artist:
        if is_grid:
            return Patch(label=label, **of_cell)
        return Line2D([], [], linestyle="", label=label, **of_point)

    handles: list[Artist] = []
    if has_unknown:
        cell = {"facecolor": "white", "edgecolor": FAINT_INK, "hatch": _HATCH}
        ring = {"marker": "o", "markerfacecolor": "white", "markeredgecolor": INK}
        handles.append(mark("Γ: don't know", cell, ring))
    if has_outside:
        grey = {"color": _OUTSIDE_COLOUR}
        handles.append(mark("outside the safe set", grey, {"marker": "x", **grey}))
    if is_grid and has_boundary:
        handles.append(Line2D([], [], color=INK, linewidth=1.6, label="boundary by simulation"))
    if handles:
        fig.legend(handles=handles, loc="outside lower center", ncols=3)
