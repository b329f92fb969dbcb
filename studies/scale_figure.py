"""Plot of what learning costs over the number of segments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_safety.evaluation.figure_style import (
    FAINT_INK,
    SERIES_COLOURS,
    drawing_style,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STAGES = ("distances", "t-SNE", "training", "rest")
"""Stages of learning: those of `SafetyAssessment.fit`, the short ones together."""


def scale_figure(rows: Sequence[dict[str, Any]]) -> Figure:
    """Plots CPU time a segment by stage, and peak memory, over the number of segments.

    Args:
        rows: Rows of the study, of one mode.
    """
    from matplotlib.ticker import FuncFormatter, NullLocator

    usual = sorted((row for row in rows if not row["is_exact"]), key=lambda row: row["segments"])
    exact = sorted((row for row in rows if row["is_exact"]), key=lambda row: row["segments"])
    sizes = np.array([row["segments"] for row in usual])
    with drawing_style():
        fig = new_figure(10.0, 4.0)
        left, right = fig.subplots(1, 2)
        bottom = np.zeros(len(sizes))
        for stage, colour in zip(STAGES, SERIES_COLOURS, strict=False):
            each = np.array([1e3 * row["cpu_s"][stage] for row in usual]) / sizes
            left.fill_between(sizes, bottom, bottom + each, color=colour, alpha=0.8, label=stage)
            bottom = bottom + each
        left.set_title("CPU time a segment [ms]")
        right.plot(sizes, [row["peak_gb"] for row in usual], "o-", color=SERIES_COLOURS[0])
        right.set_title("Peak memory [GB]")
        if exact:
            at = [row["segments"] for row in exact]
            each = [1e3 * sum(row["cpu_s"].values()) / row["segments"] for row in exact]
            left.plot(at, each, "x:", color=FAINT_INK, label="exact neighbours, all stages")
        for axes in (left, right):
            axes.set_xscale("log")
            axes.set_ylim(bottom=0.0)
            axes.set_xticks(sizes, [f"{size / 1000:.0f}k" for size in sizes])
            axes.xaxis.set_minor_locator(NullLocator())
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.set_xlabel("segments")
            axes.grid(axis="y", color="#eceef0", linewidth=0.7)
            axes.set_axisbelow(True)
        fig.legend(loc="outside lower center", ncols=5)
    return fig
