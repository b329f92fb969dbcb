"""Plot of a map before and after feedback, with the discrepancy function."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from drake_safety.evaluation.embedding_figure import draw_grid, draw_values
from drake_safety.evaluation.figure_style import (
    INK,
    SAFE_COLOUR,
    UNSAFE_COLOUR,
    drawing_style,
    new_figure,
)
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.beliefs import UNCERTAINTY, safe_share
from drake_safety.learning.discrepancy import DiscrepancyFunction
from drake_safety.learning.feedback import EpisodePair, FeedbackSegments, feedback_segments

_NUM_MARKED = 3


def adaptation_figure(
    prior: SafetyAssessment, feedback: Sequence[EpisodePair], *, updates: Sequence[int] = (1, 4)
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

    Raises:
        ValueError: There is too little feedback for the first update.
    """
    settings = prior.parameters.adaptation
    interval = settings.update_interval
    stages = [update * interval for update in updates if update * interval <= len(feedback)]
    if not stages:
        raise ValueError(
            f"adaptation_figure: {len(feedback)} pairs of episodes are fewer than the "
            f"{updates[0] * interval} of update {updates[0]}"
        )
    ramp = LinearSegmentedColormap.from_list("discrepancy", ["#fbfbfc", "#e0a3b8", "#7a1742"])

    def draw_beliefs(axes: Axes, one: SafetyAssessment, title: str) -> np.ndarray:
        cells = one.beliefs_[0]
        share, is_empty = safe_share(cells), cells[:, UNCERTAINTY] >= 1.0
        draw_values(fig, axes, prior.grid_, share, is_empty, "safe share")
        axes.set_title(title)
        return share

    with drawing_style():
        fig = new_figure(4.6 * (1 + len(stages)), 8.6)
        panels = fig.subplots(2, 1 + len(stages))
        before = draw_beliefs(panels[0, 0], prior, "Safe share before any feedback")
        _draw_feedback(panels[1, 0], prior, feedback[: stages[-1]])
        for (upper, lower), update, size in zip(panels.T[1:], updates, stages, strict=False):
            adapted = prior.adapt(feedback[:size])
            after = draw_beliefs(upper, adapted, f"After update {update}: {size} pairs of episodes")
            segments = feedback_segments(feedback[:size], prior.parameters)
            points = _points(prior, segments)
            _mark_changes(upper, prior, after - before, before, segments, points)
            difference = np.abs(segments.score - segments.nominal_score)
            mean, deviation = (
                DiscrepancyFunction().fit(points, difference).predict(prior.grid_.centres)
            )
            is_unused, label = deviation > settings.gate, "|λ actual - λ nominal|"
            draw_values(fig, lower, prior.grid_, mean, is_unused, label, ramp=ramp)
            lower.set(title="Discrepancy m(y)", xlabel=f"hatched: σ > {settings.gate:g}, not used")
    return fig


def _points(prior: SafetyAssessment, segments: FeedbackSegments) -> np.ndarray:
    return prior.predict(segments.state, segments.desired_preview, segments.features).embedding


def _draw_feedback(axes: Axes, prior: SafetyAssessment, feedback: Sequence[EpisodePair]) -> None:
    segments = feedback_segments(feedback, prior.parameters)
    points = _points(prior, segments)
    difference = segments.score - segments.nominal_score
    draw_grid(axes, prior.grid_)
    for rows, colour, label in (
        (np.abs(difference) < 0.25, "#c9ccd1", "ends as its twin"),
        (difference >= 0.25, UNSAFE_COLOUR, "less safe than its twin"),
        (difference <= -0.25, SAFE_COLOUR, "safer than its twin"),
    ):
        axes.scatter(points[rows, 0], points[rows, 1], s=6.0, c=colour, linewidths=0.0, label=label)
    axes.set_title(f"Feedback: {len(feedback)} actual episodes")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.01), fontsize=8, markerscale=2.0)


def _mark_changes(
    axes: Axes,
    prior: SafetyAssessment,
    change: np.ndarray,
    before: np.ndarray,
    segments: FeedbackSegments,
    points: np.ndarray,
) -> None:
    """Outlines the cells with feedback that changed most, and tells of it."""
    grid = prior.grid_
    cells = grid.locate(points)
    size = np.where(np.isin(np.arange(len(change)), cells[cells >= 0]), np.abs(change), 0.0)
    lines = []
    for number, cell in enumerate(np.argsort(-size)[:_NUM_MARKED], start=1):
        if size[cell] <= 1e-6:
            break
        corner, length = grid.centres[cell] - 0.5 * grid.cell_length, grid.cell_length
        axes.add_patch(
            Rectangle(tuple(corner), length, length, fill=False, edgecolor="#d6248a", linewidth=2.0)
        )
        x, y = grid.centres[cell]
        axes.text(x, y, f"{number}", ha="center", va="center_baseline", fontsize=8)
        here = cells == cell
        unsafe, twins = segments.is_unsafe[here].sum(), segments.nominal_is_unsafe[here].sum()
        lines.append(
            f"{number}: {before[cell]:.2f} → {before[cell] + change[cell]:.2f}; unsafe {unsafe} of "
            f"{here.sum()} segments, twins {twins}"
        )
    axes.set_xlabel("\n".join(lines) or "nothing changed", fontsize=7.5, color=INK)
