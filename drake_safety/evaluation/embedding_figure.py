"""The map of an assessment: embedded segments, beliefs of the cells, and causes."""

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
from drake_safety.learning.beliefs import UNCERTAINTY, UNSAFE, safe_share
from drake_safety.learning.grid import Grid
from drake_safety.learning.segments import Episodes, split

_MAX_POINTS = 12000
_LEAST_CAUSE = 0.05
_PALE = ("#f0b48f", "#f2efe9", "#a3c4e2")
_SAFETY = LinearSegmentedColormap.from_list(
    "safety", ["#9c3209", style.UNSAFE_COLOUR, *_PALE, style.SAFE_COLOUR, "#1b4a80"]
)  # From unsafe (0) through a pale middle to safe (1).


def embedding_figure(assessment: SafetyAssessment, episodes: Episodes) -> Figure:
    """Plots the first map: segments, beliefs of the cells, and causes if two have 5 % or more."""
    cells, grid = assessment.beliefs_[0], assessment.grid_
    is_empty = cells[:, UNCERTAINTY] >= 1.0
    unsafe = cells[~is_empty, 3:].sum(axis=0)  # By cause; see `learning.beliefs`.
    has_causes = (unsafe >= _LEAST_CAUSE * unsafe.sum()).sum() > 1
    with style.drawing_style():
        fig = style.new_figure(style.PAGE_WIDTH, style.PAGE_WIDTH)
        panels = fig.subplots(1, 2 + has_causes).tolist()
        left, middle, *others = panels
        _draw_grid(left, grid)
        _draw_segments(left, assessment, episodes)
        draw_values(middle, grid, safe_share(cells), is_empty)
        middle.set_title("Beliefs of the cells")
        for last in others:
            _draw_causes(last, grid, cells, assessment.info_.constraint_names)
        label = "safe: 1 − λ of a segment, share of a cell's belief; hatched: don't know"
        draw_bar(fig, panels, label)
        show_beliefs(fig, panels, grid, is_empty, room=1.2 + 0.3 * has_causes)
    return fig


def show_beliefs(
    fig: Figure, panels: Sequence[Axes], grid: Grid, is_empty: np.ndarray, *, room: float
) -> None:
    """Limits panels side by side to the cells that are not empty, (R * R,), and a cell around them.

    The figure becomes as high as the panels, with room [inches] for all else.
    """
    shown, length = grid.centres[~is_empty], 1.5 * grid.cell_length
    ends = np.clip(
        [shown.min(axis=0) - length, shown.max(axis=0) + length], -grid.half_width, grid.half_width
    )
    (x0, y0), (x1, y1) = ends
    for axes in panels:
        axes.set(xlim=(x0, x1), ylim=(y0, y1))
    height = style.PAGE_WIDTH / len(panels) * (y1 - y0) / (x1 - x0)
    fig.set_size_inches(style.PAGE_WIDTH, height + room)


def draw_values(
    axes: Axes, grid: Grid, value: np.ndarray, is_empty: np.ndarray, most: float = 1.0
) -> None:
    """Draws cells coloured by a value (R * R,); empty cells, (R * R,), are hatched."""
    colours = ScalarMappable(Normalize(0.0, most), _SAFETY).to_rgba(value)
    _draw_cells(axes, grid, colours, is_empty)


def draw_bar(fig: Figure, axes: Axes | list[Axes], label: str, most: float = 1.0) -> None:
    """Draws the colour bar of `draw_values` below axes."""
    look: dict[str, Any] = {"location": "bottom", "aspect": 45, "shrink": 0.7, "pad": 0.03}
    bar = fig.colorbar(ScalarMappable(Normalize(0.0, most), _SAFETY), ax=axes, label=label, **look)
    bar.outline.set_visible(False)


def _draw_segments(axes: Axes, gamma: SafetyAssessment, episodes: Episodes) -> None:
    parameters = gamma.parameters
    segments = split(episodes, stride=max(parameters.horizon // 2, 1), discount=parameters.discount)
    # Drawn in random order, so that neither class hides the other.
    segments = segments.take(np.random.default_rng(0).permutation(len(segments))[:_MAX_POINTS])
    result = gamma.predict(segments.state, segments.desired_preview, segments.features)
    look: dict[str, Any] = {"cmap": _SAFETY, "vmin": 0.0, "vmax": 1.0, "alpha": 0.85}
    look |= {"s": 6.0, "linewidths": 0.0, "rasterized": True}
    x, y = result.embedding.T
    axes.scatter(x, y, c=1.0 - segments.score, **look)
    axes.set_title(f"{len(segments)} segments")


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
    axes.set_title("Likely cause, pale: safe")
    handles = [Patch(color=palette[i], label=style.spoken(n)) for i, n in enumerate(names)]
    look: dict[str, Any] = {"bbox_to_anchor": (0.5, -0.03), "handlelength": 1.0, "ncols": 2}
    axes.legend(handles=handles, loc="upper center", columnspacing=1.0, **look)


def _draw_grid(axes: Axes, grid: Grid) -> None:
    """Draws the lines between the cells."""
    half = grid.half_width
    edges = np.linspace(-half, half, grid.resolution + 1)
    for draw in (axes.vlines, axes.hlines):
        draw(edges, -half, half, color="#e3e5e8", linewidth=0.6, zorder=0)
    axes.set(xticks=[], yticks=[], aspect="equal")


def _draw_cells(axes: Axes, grid: Grid, colours: np.ndarray, is_empty: np.ndarray) -> None:
    """Draws squares of given colours, RGBA (R * R, 4); empty cells, (R * R,), are hatched."""
    corners = grid.centres - 0.5 * grid.cell_length
    squares = np.array([Rectangle(xy, grid.cell_length, grid.cell_length) for xy in corners])
    hollow, filled = squares[is_empty], squares[~is_empty]
    axes.add_collection(PatchCollection(hollow, fc="#f1f2f4", ec="#dadde1", lw=0.5, hatch="////"))
    axes.add_collection(PatchCollection(filled, fc=colours[~is_empty], ec="white", lw=0.8))
    _draw_grid(axes, grid)
