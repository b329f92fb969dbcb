"""Plot of Γ as colour, with the boundaries of the true safe set and of Γ's threshold."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.evaluation.figure_style import (
    INK,
    SAFE_COLOUR,
    UNSAFE_COLOUR,
    drawing_style,
    new_figure,
)
from studies.known_truth import Agreement, KnownTruth, is_confidently_wrong

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def known_truth_figure(
    panels: Sequence[tuple[KnownTruth, np.ndarray, Agreement]], title: str
) -> Figure:
    """Plots one panel per plane.

    Args:
        panels: The truth, Γ at its points (n, n), and their agreement.
        title: Title of the figure.
    """
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.lines import Line2D

    colours = LinearSegmentedColormap.from_list("safety", [UNSAFE_COLOUR, "white", SAFE_COLOUR])
    with drawing_style():
        fig = new_figure(max(3.8 * len(panels) + 1.0, 6.4), 4.6)
        fig.suptitle(title, x=0.02, ha="left", fontsize=12, fontweight="bold", color=INK)
        all_axes = fig.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (truth, probability, found) in zip(all_axes, panels, strict=True):
            x, y = truth.points[:, 0, 0], truth.points[0, :, 1]
            image = axes.pcolormesh(
                x, y, probability.T, cmap=colours, vmin=0.0, vmax=1.0, shading="nearest", alpha=0.6
            )
            if truth.is_safe.any() and not truth.is_safe.all():
                axes.contour(x, y, truth.is_safe.T, levels=[0.5], colors=[INK], linewidths=2.0)
            if probability.min() < found.threshold < probability.max():
                axes.contour(
                    x,
                    y,
                    probability.T,
                    levels=[found.threshold],
                    colors=[SAFE_COLOUR],
                    linewidths=1.6,
                    linestyles="--",
                )
            wrong = is_confidently_wrong(truth.is_safe, probability)
            axes.plot(*truth.points[wrong].T, "x", color=INK, markersize=5)
            axes.set_xlabel(truth.axes[0])
            axes.set_title(
                f"{truth.plane}\nIoU {found.intersection_over_union:.3f}, band "
                f"{100 * found.band:.1f} %",
                fontsize=10,
            )
        all_axes[0].set_ylabel(panels[0][0].axes[1])
        fig.colorbar(image, ax=list(all_axes), label="safe share", fraction=0.03)
        handles = [
            Line2D([], [], color=INK, lw=2.0, label="true safe set, simulated"),
            Line2D(
                [],
                [],
                color=SAFE_COLOUR,
                lw=1.6,
                ls="--",
                label=f"safe share = {panels[0][2].threshold:g}",
            ),
            Line2D([], [], color=INK, marker="x", ls="", label="confident and wrong"),
        ]
        fig.legend(handles=handles, loc="outside lower center", ncols=3)
    return fig
