"""The map of an assessment: embedded segments, beliefs of the cells, and causes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from drake_safety.evaluation import figure_style as style
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import SAFE, UNCERTAINTY, UNSAFE
from drake_safety.learning.grid import Grid
from drake_safety.learning.segments import Episodes, split

_MAX_POINTS = 12000


def embedding_figure(assessment: SafetyAssessment, episodes: Episodes) -> Figure:
    """Plots the map: segments in the embedding, beliefs of the cells, and causes.

    It shows the first map of an ensemble. The episodes should not be those of the training.
    """
    cells, grid = assessment.beliefs_[0], assessment.grid_
    count = assessment.training_.counts(grid)[0]
    with style.drawing_style():
        fig = style.new_figure(14.0, 4.6)
        left, middle, last = fig.subplots(1, 3)
        _draw_segments(fig, left, assessment, episodes)
        safe, is_empty = cells[:, SAFE], cells[:, UNCERTAINTY] >= 1.0
        most = max(1.0 - assessment.parameters.initial_uncertainty, safe.max())
        draw_safety(fig, middle, grid, safe, is_empty, count, label="belief: safe", most=most)
        middle.set_title("Belief of each cell: safe")
        _draw_causes(fig, last, grid, cells, assessment.info_.constraint_names)
        for axes in (left, middle, last):
            half = grid.half_width
            axes.set(xlim=(-half, half), ylim=(-half, half), xticks=[], yticks=[], aspect="equal")
    return fig


def _draw_segments(
    fig: Figure, axes: Axes, assessment: SafetyAssessment, episodes: Episodes
) -> None:
    parameters = assessment.parameters
    segments = split(episodes, stride=max(parameters.horizon // 2, 1), discount=parameters.discount)
    # Drawn in random order, so that neither class hides the other.
    order = np.random.default_rng(0).permutation(len(segments))[:_MAX_POINTS]
    segments = segments.take(order)
    found = assessment.predict(segments.state, segments.desired_preview, segments.features)
    draw_grid(axes, assessment.grid_)
    x, y = found.embedding.T
    dots = axes.scatter(
        x,
        y,
        c=segments.score,
        cmap=safety_colours().reversed(),
        vmin=0.0,
        vmax=1.0,
        s=5.0,
        linewidths=0.0,
        alpha=0.85,
        rasterized=True,
    )
    axes.set_title("Segments in the embedding")
    axes.set_xlabel(f"{len(segments)} segments of {len(episodes)} episodes")
    bar = add_colour_bar(fig, axes, dots, "unsafety score λ")
    if bar.solids is not None:
        bar.solids.set_alpha(1.0)


def draw_safety(
    fig: Figure,
    axes: Axes,
    grid: Grid,
    safe: np.ndarray,
    is_empty: np.ndarray,
    count: np.ndarray,
    *,
    label: str,
    most: float = 1.0,
) -> None:
    """Draws cells coloured by safety (R*R,), with their numbers of training segments (R*R,)."""
    shade = ScalarMappable(Normalize(0.0, most), safety_colours())
    colours = shade.to_rgba(safe)
    draw_cells(axes, grid, colours, is_empty)
    brightness = colours[:, :3] @ [0.299, 0.587, 0.114]
    ink = np.where(is_empty, style.FAINT_INK, np.where(brightness > 0.6, style.INK, "white"))
    place: dict[str, Any] = {"ha": "center", "va": "center_baseline", "fontsize": 6.5}
    for i in np.flatnonzero(count):
        x, y = grid.centres[i]
        axes.text(x, y, _short(count[i]), color=ink[i], **place)
    axes.set_xlabel("numbers: training segments; hatched: don't know")
    add_colour_bar(fig, axes, shade, label)


def _draw_causes(
    fig: Figure, axes: Axes, grid: Grid, cells: np.ndarray, names: Sequence[str]
) -> None:
    # The first colour of the series is that of safe.
    series = [*map(to_rgb, style.SERIES_COLOURS)]
    palette = np.array([series[(1 + i) % len(series)] for i in range(len(names))])
    cause = cells[:, 3:].argmax(axis=1)  # See `learning.beliefs`.
    is_empty = cells[:, UNCERTAINTY] >= 1.0
    # From white, nothing unsafe, to the colour of the cause, all that is known unsafe.
    depth = (cells[:, UNSAFE] / np.where(is_empty, 1.0, 1.0 - cells[:, UNCERTAINTY]))[:, None]
    colours = np.column_stack([1.0 - depth * (1.0 - palette[cause]), np.ones(len(cells))])
    colours[:, :3] *= 0.97
    draw_cells(axes, grid, colours, is_empty)
    axes.set_title("Most likely cause")
    axes.legend(
        handles=[Patch(color=palette[i], label=style.spoken(n)) for i, n in enumerate(names)],
        title="pale: unlikely",
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
        handlelength=1.0,
        handleheight=1.0,
    )


def draw_grid(axes: Axes, grid: Grid) -> None:
    """Draws the lines between the cells."""
    edges = np.linspace(-grid.half_width, grid.half_width, grid.resolution + 1)
    axes.vlines(edges, edges[0], edges[-1], color="#e3e5e8", linewidth=0.6, zorder=0)
    axes.hlines(edges, edges[0], edges[-1], color="#e3e5e8", linewidth=0.6, zorder=0)


def draw_cells(axes: Axes, grid: Grid, colours: np.ndarray, is_empty: np.ndarray) -> None:
    """Draws squares of given colours, RGBA (R*R, 4); empty ones, (R*R,), are hatched."""
    corners = grid.centres - 0.5 * grid.cell_length
    squares = [Rectangle((x, y), grid.cell_length, grid.cell_length) for x, y in corners]
    filled = [square for square, empty in zip(squares, is_empty, strict=True) if not empty]
    hollow = [square for square, empty in zip(squares, is_empty, strict=True) if empty]
    axes.add_collection(PatchCollection(hollow, fc="#f1f2f4", ec="#dadde1", lw=0.5, hatch="////"))
    axes.add_collection(PatchCollection(filled, fc=colours[~is_empty], ec="white", lw=0.8))
    axes.set_xlabel(f"{len(filled)} of {grid.num_cells} cells hold a belief")


def safety_colours() -> Colormap:
    """Colour map from unsafe (0) through a pale middle to safe (1)."""
    pale = ("#f0b48f", "#f2efe9", "#a3c4e2")
    stops = ["#9c3209", style.UNSAFE_COLOUR, *pale, style.SAFE_COLOUR, "#1b4a80"]
    return LinearSegmentedColormap.from_list("safety", stops)


def add_colour_bar(fig: Figure, axes: Axes, shade: ScalarMappable, label: str) -> Colorbar:
    """Adds a colour bar beside a panel."""
    bar = fig.colorbar(shade, ax=axes, shrink=0.8, pad=0.02, label=label)
    bar.outline.set_visible(False)
    return bar


def _short(count: int) -> str:
    """A count in at most four characters: 12345 → 12k."""
    if count < 1000:
        return str(count)
    return f"{count / 1000:.1f}k" if count < 9950 else f"{count / 1000:.0f}k"
