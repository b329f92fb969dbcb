"""The map of an assessment: embedded segments, beliefs of the cells, and causes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from drake_safety.evaluation import figure_style as style
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import SAFE, UNCERTAINTY, UNSAFE
from drake_safety.learning.grid import Grid
from drake_safety.learning.segments import Episodes, split

_MAX_POINTS = 12000
_BAR: dict[str, Any] = {"shrink": 0.8, "pad": 0.02}
_LEAST_CAUSE = 0.05
_PALE = ("#f0b48f", "#f2efe9", "#a3c4e2")
_SAFETY = LinearSegmentedColormap.from_list(
    "safety", ["#9c3209", style.UNSAFE_COLOUR, *_PALE, style.SAFE_COLOUR, "#1b4a80"]
)  # From unsafe (0) through a pale middle to safe (1).


def embedding_figure(assessment: SafetyAssessment, episodes: Episodes) -> Figure:
    """Plots the first map: segments, beliefs of the cells, and causes if two have 5 % or more."""
    cells, grid = assessment.beliefs_[0], assessment.grid_
    training = assessment.training_
    if training.count is None:  # No segment was left out.
        inside = grid.locate(training.points[0])
        count = np.bincount(inside[inside >= 0], minlength=grid.num_cells)
    else:
        count = training.count[0]
    unsafe = (count[:, None] * cells[:, 3:]).sum(axis=0)  # By cause; see `learning.beliefs`.
    has_causes = (unsafe >= _LEAST_CAUSE * unsafe.sum()).sum() > 1
    with style.drawing_style():
        fig = style.new_figure(14.0 if has_causes else 9.4, 4.6)
        left, middle, *others = fig.subplots(1, 2 + has_causes)
        _draw_segments(fig, left, assessment, episodes)
        most = max(1.0 - assessment.parameters.initial_uncertainty, cells[:, SAFE].max())
        is_empty = cells[:, UNCERTAINTY] >= 1.0
        colours = draw_values(fig, middle, grid, cells[:, SAFE], is_empty, "belief: safe", most)
        is_bright = colours[:, :3] @ [0.299, 0.587, 0.114] > 0.6
        ink = np.where(is_empty, style.FAINT_INK, np.where(is_bright, style.INK, "white"))
        place: dict[str, Any] = {"ha": "center", "va": "center_baseline", "fontsize": 6.5}
        for i in np.flatnonzero(count):
            text = f"{count[i]}" if count[i] < 1000 else f"{count[i] / 1000:.1f}k"
            middle.text(*grid.centres[i], text, color=ink[i], **place)
        middle.set_title("Belief of each cell: safe")
        middle.set_xlabel("numbers: training segments; hatched: don't know")
        for last in others:
            _draw_causes(last, grid, cells, assessment.info_.constraint_names)
    return fig


def draw_values(
    fig: Figure,
    axes: Axes,
    grid: Grid,
    value: np.ndarray,
    is_empty: np.ndarray,
    label: str,
    most: float = 1.0,
) -> np.ndarray:
    """Draws cells coloured by a value (R*R,), with a colour bar; returns the colours (R*R, 4)."""
    shade = ScalarMappable(Normalize(0.0, most), _SAFETY)
    colours = shade.to_rgba(value)
    _draw_cells(axes, grid, colours, is_empty)
    fig.colorbar(shade, ax=axes, label=label, **_BAR).outline.set_visible(False)
    return colours


def _draw_segments(fig: Figure, axes: Axes, gamma: SafetyAssessment, episodes: Episodes) -> None:
    parameters = gamma.parameters
    segments = split(episodes, stride=max(parameters.horizon // 2, 1), discount=parameters.discount)
    # Drawn in random order, so that neither class hides the other.
    segments = segments.take(np.random.default_rng(0).permutation(len(segments))[:_MAX_POINTS])
    result = gamma.predict(segments.state, segments.desired_preview, segments.features)
    _draw_grid(axes, gamma.grid_)
    shade = ScalarMappable(Normalize(0.0, 1.0), _SAFETY.reversed())
    dots: dict[str, Any] = {"s": 5.0, "linewidths": 0.0, "alpha": 0.85, "rasterized": True}
    x, y = result.embedding.T
    axes.scatter(x, y, c=segments.score, cmap=shade.cmap, vmin=0.0, vmax=1.0, **dots)
    axes.set_title("Segments in the embedding")
    axes.set_xlabel(f"{len(segments)} segments of {len(episodes)} episodes")
    fig.colorbar(shade, ax=axes, label="unsafety score λ", **_BAR).outline.set_visible(False)


def _draw_causes(axes: Axes, grid: Grid, cells: np.ndarray, names: Sequence[str]) -> None:
    # The first colour of the series is that of safe.
    series = [*map(to_rgb, style.SERIES_COLOURS)]
    palette = np.array([series[(1 + i) % len(series)] for i in range(len(names))])
    cause = cells[:, 3:].argmax(axis=1)
    is_empty = cells[:, UNCERTAINTY] >= 1.0
    # From white, nothing unsafe, to the colour of the cause, all that is known unsafe.
    depth = (cells[:, UNSAFE] / np.where(is_empty, 1.0, 1.0 - cells[:, UNCERTAINTY]))[:, None]
    colours = np.column_stack([1.0 - depth * (1.0 - palette[cause]), np.ones(len(cells))])
    colours[:, :3] *= 0.97
    _draw_cells(axes, grid, colours, is_empty)
    axes.set_title("Most likely cause")
    handles = [Patch(color=palette[i], label=style.spoken(n)) for i, n in enumerate(names)]
    look: dict[str, Any] = {"bbox_to_anchor": (1.0, 0.5), "handlelength": 1.0, "handleheight": 1.0}
    axes.legend(handles=handles, title="pale: unlikely", loc="center left", **look)


def _draw_grid(axes: Axes, grid: Grid) -> None:
    """Draws the lines between the cells, and fits the axes to them."""
    half = grid.half_width
    edges = np.linspace(-half, half, grid.resolution + 1)
    for draw in (axes.vlines, axes.hlines):
        draw(edges, -half, half, color="#e3e5e8", linewidth=0.6, zorder=0)
    axes.set(xlim=(-half, half), ylim=(-half, half), xticks=[], yticks=[], aspect="equal")


def _draw_cells(axes: Axes, grid: Grid, colours: np.ndarray, is_empty: np.ndarray) -> None:
    """Draws squares of given colours, RGBA (R*R, 4); empty ones, (R*R,), are hatched."""
    corners = grid.centres - 0.5 * grid.cell_length
    squares = np.array([Rectangle(xy, grid.cell_length, grid.cell_length) for xy in corners])
    hollow, filled = squares[is_empty], squares[~is_empty]
    axes.add_collection(PatchCollection(hollow, fc="#f1f2f4", ec="#dadde1", lw=0.5, hatch="////"))
    axes.add_collection(PatchCollection(filled, fc=colours[~is_empty], ec="white", lw=0.8))
    _draw_grid(axes, grid)
    axes.set_xlabel(f"{len(filled)} of {grid.num_cells} cells hold a belief")
