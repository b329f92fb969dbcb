"""Reliability diagram of Γ."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.evaluation.calibration_study import Reliability
from drake_safety.evaluation.figure_style import (
    FAINT_INK,
    SERIES_COLOURS,
    SERIES_DASHES,
    drawing_style,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def reliability_figure(curves: Mapping[str, Reliability]) -> Figure:
    """Plots the observed share of unsafe episodes over the predicted probability.

    Args:
        curves: Reliability by name.
    """
    with drawing_style():
        fig = new_figure(5.4, 6.0)
        axes = fig.subplots()
        axes.plot([0, 1], [0, 1], color=FAINT_INK, linewidth=0.8)
        for i, (name, one) in enumerate(curves.items()):
            colour = SERIES_COLOURS[i % len(SERIES_COLOURS)]
            axes.errorbar(
                one.expected,
                one.observed,
                yerr=np.clip([one.observed - one.low, one.high - one.observed], 0.0, None),
                color=colour,
                linestyle=SERIES_DASHES[i % len(SERIES_DASHES)],
                marker="o",
                markersize=5,
                linewidth=1.4,
                elinewidth=0.8,
                label=f"{name}   {one.calibration_error:.3f}",
            )
        axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
        axes.set_aspect("equal")
        axes.set_xlabel("predicted probability, 1 - probability of safety")
        axes.set_ylabel("share of unsafe episodes, 95 % intervals")
        axes.grid(color="#eceef0", linewidth=0.7)
        axes.set_title("Reliability")
        # Outside: intervals may be anywhere in the axes.
        fig.legend(
            loc="outside lower center",
            ncols=2,
            title="expected calibration error",
            alignment="left",
        )
    return fig
