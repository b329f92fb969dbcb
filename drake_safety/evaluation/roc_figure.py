"""Receiver operating characteristic of scorers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_safety.evaluation.figure_style import (
    FAINT_INK,
    SERIES_COLOURS,
    SERIES_DASHES,
    drawing_style,
    label_of,
    new_figure,
)
from drake_safety.evaluation.metrics import area_under_curve

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def roc_figure(
    curves: Mapping[str, tuple[np.ndarray, np.ndarray]],
    *,
    thresholds: Mapping[str, float] | None = None,
    corner: float = 0.3,
) -> Figure:
    """Plots the unsafe recall of scorers against the share of safe samples classified unsafe.

    Args:
        curves: Per scorer, unsafe scores (N,) and labels (N,); NaN is the most unsafe.
        thresholds: Per scorer, the threshold to mark on the curve.
        corner: Share of either axis that the right panel magnifies.
    """
    thresholds = thresholds or {}
    with drawing_style():
        fig = new_figure(10.0, 5.0)
        whole, magnified = fig.subplots(1, 2)
        for i, (name, (score, label)) in enumerate(curves.items()):
            score = np.where(np.isnan(score), np.inf, np.asarray(score, dtype=float))
            words = f"{label_of(name)}   {area_under_curve(score, label):.3f}"
            for axes in (whole, magnified):
                draw_roc(axes, score, label, words, thresholds.get(name), **series_style(i))
        whole.set(xlim=(0, 1), ylim=(0, 1))
        magnified.set(xlim=(0, corner), ylim=(1.0 - corner, 1.0))
        frame = [[0, corner, corner, 0, 0], [1 - corner, 1 - corner, 1, 1, 1 - corner]]
        whole.plot(*frame, color=FAINT_INK, linewidth=0.8)
        for axes in (whole, magnified):
            axes.set_aspect("equal")
            axes.set_xlabel("false-alarm rate")
            axes.grid(color="#eceef0", linewidth=0.7)
        whole.set_ylabel("unsafe recall")
        whole.set_title("Receiver operating characteristic")
        magnified.set_title("Upper left corner")
        whole.legend(loc="lower right", title="area under the curve", alignment="left")
    return fig


def series_style(number: int) -> dict[str, Any]:
    """Style of a curve among others; dashes vary when colours repeat."""
    num_colours = len(SERIES_COLOURS)
    dashes = SERIES_DASHES[(number + number // num_colours) % len(SERIES_DASHES)]
    return {"color": SERIES_COLOURS[number % num_colours], "linestyle": dashes, "linewidth": 1.8}


def draw_roc(
    axes: Axes,
    score: np.ndarray,
    label: np.ndarray,
    words: str,
    threshold: float | None,
    **style: Any,
) -> None:
    """Draws the curve of one scorer and the point of its threshold.

    Args:
        axes: The axes.
        score: Unsafe scores, (N,).
        label: Whether each is unsafe, (N,).
        words: Legend entry.
        threshold: Threshold to mark, if any.
        **style: Style of the curve.
    """
    axes.plot(*operating_points(score, label), label=words, **style)
    if threshold is not None and label.any() and not label.all():
        is_alarm = score > threshold
        axes.plot(
            is_alarm[~label].mean(),
            is_alarm[label].mean(),
            "o",
            color=style["color"],
            markeredgecolor="white",
            markersize=8,
            clip_on=False,
            zorder=5,
        )


def operating_points(score: np.ndarray, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """False-alarm rate and unsafe recall of every threshold, from (0, 0) to (1, 1).

    Args:
        score: Unsafe scores, (N,).
        label: Whether each is unsafe, (N,).

    Returns:
        The two rates, one more than the number of distinct scores.
    """
    rank = np.unique(-score, return_inverse=True)[1]
    shares = []
    for members in (~label, label):
        hits = np.cumsum(np.bincount(rank, weights=members))
        shares.append(np.concatenate([[0.0], hits / max(hits[-1], 1.0)]))
    return shares[0], shares[1]
