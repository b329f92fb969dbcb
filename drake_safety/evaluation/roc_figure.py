"""Receiver operating characteristic of scorers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.evaluation.figure_style import (
    SERIES_COLOURS,
    SERIES_DASHES,
    drawing_style,
    label_of,
    new_figure,
)
from drake_safety.evaluation.metrics import area_under_curve

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def roc_figure(scores: Mapping[str, np.ndarray], is_unsafe: np.ndarray) -> Figure:
    """Plots the unsafe recall of scorers against the share of safe samples classified unsafe.

    Args:
        scores: Unsafe scores by scorer, (N,).
        is_unsafe: Labels, (N,).
    """
    with drawing_style():
        fig = new_figure(5.4, 5.4)
        axes = fig.subplots()
        for (name, score), colour, dashes in zip(
            scores.items(), SERIES_COLOURS, SERIES_DASHES, strict=False
        ):
            order = np.argsort(-score, kind="stable")
            # Equal scores are one point.
            ends = np.flatnonzero(np.diff(score[order], append=-np.inf))
            rates = [
                np.concatenate([[0.0], np.cumsum(members[order])[ends] / max(members.sum(), 1)])
                for members in (~is_unsafe, is_unsafe)
            ]
            label = f"{label_of(name)}   {area_under_curve(score, is_unsafe):.3f}"
            axes.plot(*rates, color=colour, linestyle=dashes, linewidth=1.8, label=label)
        axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
        axes.set(xlabel="false-alarm rate", ylabel="unsafe recall")
        axes.set_title("Receiver operating characteristic")
        axes.grid(color="#eceef0", linewidth=0.7)
        axes.legend(loc="lower right", title="area under the curve", alignment="left")
    return fig
