"""Plot of recalls over the number of training episodes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.evaluation.figure_style import (
    FAINT_INK,
    SAFE_COLOUR,
    UNSAFE_COLOUR,
    drawing_style,
    new_figure,
)
from drake_safety.evaluation.plan_study import SAFE_RECALL, UNSAFE_RECALL

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from drake_safety.evaluation.metrics import Estimate

_CURVES = (
    ("safe_recall", "safe recall", SAFE_COLOUR, "o", SAFE_RECALL),
    ("unsafe_recall", "unsafe recall", UNSAFE_COLOUR, "s", UNSAFE_RECALL),
)


def learning_curve_figure(estimates: Mapping[str, Estimate]) -> Figure:
    """Plots both recalls with intervals for all targets and the fair set, and those of the paper.

    Args:
        estimates: The result of :func:`~studies.learning_curve.learning_curve`.
    """
    from matplotlib.ticker import NullLocator

    sizes = sorted({int(key.partition(".")[0]) for key in estimates})
    lowest = min(
        estimate.low
        for key, estimate in estimates.items()
        if key.endswith("recall") and np.isfinite(estimate.low)
    )
    with drawing_style():
        fig = new_figure(10.0, 4.6)
        panels = fig.subplots(1, 2, sharey=True)
        for axes, infix, title in zip(
            panels, ("", "fair."), ("All targets", "Fair set"), strict=True
        ):
            for what, label, colour, marker, paper in _CURVES:
                found = [estimates[f"{size}.{infix}{what}"] for size in sizes]
                value, low, high = (
                    np.array([getattr(estimate, end) for estimate in found])
                    for end in ("value", "low", "high")
                )
                axes.fill_between(sizes, low, high, color=colour, alpha=0.15, linewidth=0)
                axes.plot(
                    sizes, value, color=colour, marker=marker, lw=1.8, label=label, clip_on=False
                )
                axes.axhline(paper, color=colour, lw=1.0, ls=(0, (2, 2)))
            axes.set_xscale("log", base=2)
            axes.set_xticks(sizes, [str(size) for size in sizes])
            axes.xaxis.set_minor_locator(NullLocator())
            axes.set_xlabel("training episodes")
            axes.set_title(title)
            axes.grid(color="#eceef0", linewidth=0.7)
            axes.set_axisbelow(True)
        panels[0].set_ylim(max(0.0, lowest - 0.02), 1.005)
        panels[0].set_ylabel("recall")
        panels[0].plot([], [], color=FAINT_INK, lw=1.0, ls=(0, (2, 2)), label="paper")
        panels[0].legend(loc="lower right")
    return fig
