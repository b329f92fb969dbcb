"""Plots of adaptation: the map before and after, the discrepancy, and the gain of feedback."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.evaluation.embedding_figure import (
    add_colour_bar,
    draw_cells,
    draw_grid,
    safety_colours,
)
from drake_safety.evaluation.figure_style import (
    FAINT_INK,
    INK,
    SAFE_COLOUR,
    SERIES_COLOURS,
    UNSAFE_COLOUR,
    drawing_style,
    new_figure,
)
from drake_safety.learning.beliefs import SAFE, UNCERTAINTY, UNSAFE
from drake_safety.learning.discrepancy import DiscrepancyFunction

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from drake_safety.learning.assessment import SafetyAssessment
    from drake_safety.learning.feedback import FeedbackSegments, FeedbackSet
    from studies.adaptation_study import AdaptationStudy

_NUM_MARKED = 3


def adaptation_figure(
    prior: SafetyAssessment,
    feedback: Sequence[FeedbackSet],
    *,
    updates: Sequence[int] = (1, 4),
    method: str | None = None,
) -> Figure:
    """Plots the map before feedback and after some updates: feedback, discrepancy, beliefs.

    The upper row shows the beliefs of the cells, the lower one the feedback in the embedding and
    the discrepancy function after each update. The cells that changed most are marked, with their
    feedback. It shows the first map of an ensemble.

    Args:
        prior: The assessment before any feedback.
        feedback: Feedback sets, in order.
        updates: Numbers of the updates, of `update_interval` sets each; those without enough
            feedback are left out.
        method: Method of adaptation, see `SafetyAssessment.adapt`.

    Raises:
        ValueError: There is too little feedback for the first update.
    """
    interval = prior.parameters.adaptation.update_interval
    stages = [update * interval for update in updates if update * interval <= len(feedback)]
    if not stages:
        raise ValueError(
            f"adaptation_figure: {len(feedback)} feedback sets are fewer than the "
            f"{updates[0] * interval} of update {updates[0]}"
        )
    with drawing_style():
        fig = new_figure(4.6 * (1 + len(stages)), 8.6)
        axes = fig.subplots(2, 1 + len(stages))
        shares = _safe_share(prior.beliefs_[0])
        is_empty = prior.beliefs_[0][:, UNCERTAINTY] >= 1.0
        _draw_share(fig, axes[0, 0], prior, shares, is_empty, "Safe share before any feedback")
        segments = prior.feedback_segments(feedback[: stages[-1]])
        _draw_feedback(fig, axes[1, 0], prior, segments, stages[-1])
        for column, (update, size) in enumerate(zip(updates, stages, strict=False), start=1):
            adapted = prior.adapt(feedback[:size], method=method)
            after = _safe_share(adapted.beliefs_[0])
            title = f"After update {update}: {size} feedback sets"
            is_empty = adapted.beliefs_[0][:, UNCERTAINTY] >= 1.0
            _draw_share(fig, axes[0, column], prior, after, is_empty, title)
            seen = prior.feedback_segments(feedback[:size])
            _mark_changes(axes[0, column], prior, shares, after, seen)
            _draw_discrepancy(fig, axes[1, column], prior, seen)
        for one in axes.ravel():
            half = prior.grid_.half_width
            one.set(xlim=(-half, half), ylim=(-half, half), xticks=[], yticks=[], aspect="equal")
    return fig


def _safe_share(cells: np.ndarray) -> np.ndarray:
    known = cells[:, SAFE] + cells[:, UNSAFE]
    return np.divide(cells[:, SAFE], known, out=np.zeros_like(known), where=known > 0.0)


def _points(prior: SafetyAssessment, segments: FeedbackSegments) -> np.ndarray:
    return prior.predict(segments.state, segments.desired_preview, segments.features).embedding


def _draw_share(
    fig: Figure,
    axes: Axes,
    prior: SafetyAssessment,
    shares: np.ndarray,
    is_empty: np.ndarray,
    title: str,
) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    shade = ScalarMappable(Normalize(0.0, 1.0), safety_colours())
    draw_cells(axes, prior.grid_, shade.to_rgba(shares), is_empty)
    axes.set_title(title)
    add_colour_bar(fig, axes, shade, "safe share")


def _draw_feedback(
    fig: Figure, axes: Axes, prior: SafetyAssessment, segments: FeedbackSegments, num_sets: int
) -> None:
    points = _points(prior, segments)
    difference = segments.score - segments.nominal_score
    draw_grid(axes, prior.grid_)
    kinds = (
        (np.abs(difference) < 0.25, "#c9ccd1", "ends as its twin"),
        (difference >= 0.25, UNSAFE_COLOUR, "less safe than its twin"),
        (difference <= -0.25, SAFE_COLOUR, "safer than its twin"),
    )
    for rows, colour, label in kinds:
        axes.scatter(points[rows, 0], points[rows, 1], s=6.0, c=colour, linewidths=0.0, label=label)
    axes.set_title(f"Feedback: {num_sets} actual episodes")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.01), fontsize=8, markerscale=2.0)


def _draw_discrepancy(
    fig: Figure, axes: Axes, prior: SafetyAssessment, segments: FeedbackSegments
) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    difference = np.abs(segments.score - segments.nominal_score)
    discrepancy = DiscrepancyFunction().fit(_points(prior, segments), difference)
    mean, deviation = discrepancy.predict(prior.grid_.centres)
    gate = prior.parameters.adaptation.gate
    ramp = LinearSegmentedColormap.from_list("discrepancy", ["#fbfbfc", "#e0a3b8", "#7a1742"])
    shade = ScalarMappable(Normalize(0.0, 1.0), ramp)
    draw_cells(axes, prior.grid_, shade.to_rgba(mean), deviation > gate)
    axes.set_title("Discrepancy m(y)")
    axes.set_xlabel(f"hatched: σ > {gate:g}, not used")
    add_colour_bar(fig, axes, shade, "|λ actual - λ nominal|")


def _mark_changes(
    axes: Axes,
    prior: SafetyAssessment,
    before: np.ndarray,
    after: np.ndarray,
    segments: FeedbackSegments,
) -> None:
    """Outlines the cells that changed most, with their change and feedback."""
    from matplotlib.patches import Rectangle

    grid = prior.grid_
    cells = grid.locate(_points(prior, segments))
    change = np.where(
        np.isin(np.arange(len(before)), cells[cells >= 0]), np.abs(after - before), -1.0
    )
    lines = []
    for number, cell in enumerate(np.argsort(-change)[:_NUM_MARKED], start=1):
        if change[cell] <= 1e-6:
            break
        corner = grid.centres[cell] - 0.5 * grid.cell_length
        axes.add_patch(
            Rectangle(
                (corner[0], corner[1]),
                grid.cell_length,
                grid.cell_length,
                fill=False,
                edgecolor="#d6248a",
                linewidth=2.0,
            )
        )
        axes.annotate(
            str(number),
            (grid.centres[cell, 0], grid.centres[cell, 1]),
            ha="center",
            va="center_baseline",
            color=INK,
            fontsize=8,
        )
        here = cells == cell
        unsafe, twins = segments.is_unsafe[here].sum(), segments.nominal_is_unsafe[here].sum()
        lines.append(
            f"{number}: {before[cell]:.2f} → {after[cell]:.2f}; unsafe {unsafe} of {here.sum()} "
            f"segments, twins {twins}"
        )
    axes.set_xlabel("\n".join(lines) or "nothing changed", fontsize=7.5, color=INK)


def study_figure(studies: Mapping[str, AdaptationStudy], *, published: str) -> Figure:
    """Plots Brier score, AUC and unsafe recall over the number of feedback sets.

    Args:
        studies: Studies by name, such as that of a mode.
        published: Key of the form of Γ, see `adaptation_study.PUBLISHED`.
    """
    panels = (
        ("brier", "Brier score"),
        ("auc", "area under the ROC curve"),
        ("unsafe_recall", "unsafe recall"),
    )
    with drawing_style():
        fig = new_figure(14.0, 4.2)
        for axes, (metric, label) in zip(fig.subplots(1, len(panels)), panels, strict=True):
            for colour, (name, found) in zip(SERIES_COLOURS, studies.items(), strict=False):
                _draw_study(axes, found, name, colour, f"{published}.{metric}")
            axes.set(xlabel="feedback sets", title=label)
        axes.legend(loc="best")
    return fig


def _draw_study(axes: Axes, found: AdaptationStudy, name: str, colour: str, key: str) -> None:
    estimates = found.estimates
    sizes = [0, *found.sizes]
    adapted = [estimates[f"prior.{key}"], *(estimates[f"adapted.{n}.{key}"] for n in found.sizes)]
    axes.plot(sizes, [f.value for f in adapted], "o-", color=colour, label=f"{name}, adapted")
    axes.fill_between(
        sizes, [f.low for f in adapted], [f.high for f in adapted], color=colour, alpha=0.18
    )
    scratch = [n for n in found.sizes if f"scratch.{n}.{key}" in estimates]
    if scratch:
        values = [estimates[f"scratch.{n}.{key}"].value for n in scratch]
        axes.plot(scratch, values, "s:", color=colour, label=f"{name}, from scratch")
    if f"oracle.{key}" in estimates:
        axes.axhline(
            estimates[f"oracle.{key}"].value, color=colour, linestyle="--", label=f"{name}, oracle"
        )
    axes.grid(color=FAINT_INK, alpha=0.2)
