"""Values with their intervals by method, for any rows of the table of results."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from drake_safety.evaluation import figure_style as style
from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.results import Key

_MARKS = "osD^vP"


def interval_figure(estimates: Mapping[Key, Estimate]) -> Figure:
    """Plots a panel for each metric: methods below each other, sets side by side in colours."""
    sets, methods, metrics = ([*dict.fromkeys(names)] for names in zip(*estimates, strict=True))
    with style.drawing_style():
        height = 1.1 + 0.13 * len(methods) * (1 + len(sets))
        fig = style.new_figure(2.2 + 2.6 * len(metrics), height)
        panels = np.atleast_1d(fig.subplots(1, len(metrics), sharey=True))
        for axes, metric in zip(panels, metrics, strict=True):
            for i, name in enumerate(sets):
                keys = [key for key in estimates if (key[0], key[2]) == (name, metric)]
                shown = [estimates[key] for key in keys]
                # NaN ends, as of a value without interval, draw no bar.
                ends = np.array([[one.value, one.low, one.high] for one in shown])
                value, low, high = ends.reshape(-1, 3).T
                places = [methods.index(method) for _, method, _ in keys]
                axes.errorbar(
                    value,
                    np.array(places) + 0.7 * ((i + 0.5) / len(sets) - 0.5),
                    xerr=np.maximum([value - low, high - value], 0.0),
                    fmt=_MARKS[i % len(_MARKS)],
                    color=style.SERIES_COLOURS[i % len(style.SERIES_COLOURS)],
                    markersize=5.0,
                    capsize=2.5,
                    label=style.spoken(name).replace(".", ", "),
                )
            axes.set_title(style.label_of(metric))
            axes.grid(axis="x", color=style.FAINT_INK, alpha=0.25)
        panels[0].set_yticks(range(len(methods)), [style.label_of(method) for method in methods])
        panels[0].set_ylim(len(methods) - 0.5, -0.5)
        if len(sets) > 1:
            handles = panels[0].get_legend_handles_labels()
            fig.legend(*handles, loc="outside lower center", ncols=len(sets))
    return fig
