"""Reliability: predicted probabilities beside outcomes, and stored thresholds."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from drake_safety.evaluation import figure_style as style
from drake_safety.evaluation.metrics import Bootstrap, Estimate, proportion, share
from drake_safety.learning.calibration import SAFE, UNKNOWN, UNSAFE, Calibration

_BOOTSTRAP = Bootstrap(num_resamples=100)


def verdict_shares(
    calibration: Calibration, unsafe_score: np.ndarray, is_unsafe: np.ndarray
) -> dict[str, Estimate]:
    """Shares of the verdicts of stored thresholds on fresh episodes with scores (N,)."""
    verdict = calibration.verdicts(1.0 - unsafe_score)

    def share_of(rows: np.ndarray, expected: str) -> Estimate:
        return proportion(int(np.sum(verdict[rows] == expected)), int(rows.sum()))

    return {
        "promised_miss_rate": Estimate.exact(calibration.miss_rate, calibration.num_unsafe),
        "miss_rate": share_of(is_unsafe, SAFE),
        "unsafe_unknown": share_of(is_unsafe, UNKNOWN),
        "safe_recall": share_of(~is_unsafe, SAFE),
        "safe_unknown": share_of(~is_unsafe, UNKNOWN),
        "false_alarm_rate": share_of(~is_unsafe, UNSAFE),
    }


class Reliability(NamedTuple):
    """Predicted probabilities (B,) against observed shares, in bins of equal numbers of rows."""

    expected: np.ndarray
    observed: list[Estimate]
    error: float  # Mean distance between the two over all rows.


def reliability(
    unsafe_probability: np.ndarray, is_unsafe: np.ndarray, episode: np.ndarray, num_bins: int = 10
) -> Reliability:
    """Compares 1 - probability of rows, (N,), with outcomes of their episodes."""
    # Edges are occurring values, so that equal probabilities share a bin.
    shares = np.linspace(0, 1, num_bins + 1)[1:-1]
    edges = np.unique(np.quantile(unsafe_probability, shares, method="nearest"))
    members = np.searchsorted(edges, unsafe_probability, side="right")
    bins = [np.flatnonzero(members == i) for i in np.unique(members)]
    expected = np.array([unsafe_probability[b].mean() for b in bins])
    observed = [share(is_unsafe[b], episode[b], bootstrap=_BOOTSTRAP) for b in bins]
    distance = np.abs(expected - [one.value for one in observed])
    error = np.average(distance, weights=[len(b) for b in bins])
    return Reliability(expected, observed, float(error))


def reliability_figure(curves: Mapping[str, Reliability]) -> Figure:
    """Plots the observed share of unsafe ends over the predicted probability.

    Curves have the names "MODE, ROWS"; each mode has a panel.
    """
    modes = [*dict.fromkeys(name.partition(", ")[0] for name in curves)]
    with style.drawing_style():
        width = style.PAGE_WIDTH / 2
        fig = style.new_figure(width * len(modes), width + 1.0)
        panels = fig.subplots(1, len(modes), squeeze=False, sharey=True)[0]
        for axes, mode in zip(panels, modes, strict=True):
            axes.axline((0, 0), slope=1, color=style.FAINT_INK, linewidth=0.8)
            axes.set_prop_cycle(color=style.SERIES_COLOURS, linestyle=style.SERIES_DASHES)
            look: dict[str, Any] = {"marker": "o", "markersize": 5, "elinewidth": 0.8}
            for name, one in curves.items():
                own, _, rows = name.partition(", ")
                if own == mode:
                    value, low, high = np.array([(s.value, s.low, s.high) for s in one.observed]).T
                    interval = np.clip([value - low, high - value], 0.0, None)
                    label = f"{rows}: error {one.error:.3f}"
                    axes.errorbar(one.expected, value, yerr=interval, label=label, **look)
            axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), aspect="equal", title=mode)
            axes.set_xlabel("predicted probability of an unsafe end")
            axes.grid(color="#eceef0", linewidth=0.7)
            # Outside: intervals may be anywhere in the axes.
            axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14))
        panels[0].set_ylabel("share of unsafe ends")
    return fig
