"""Confident errors under shifts: by the grid alone, with novelty, and with the monitor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.evaluation.figure_style import (
    FAINT_INK,
    RECOVERY_COLOUR,
    SAFE_COLOUR,
    UNKNOWN_COLOUR,
    UNSAFE_COLOUR,
    drawing_style,
    new_figure,
)
from drake_safety.evaluation.shift_study import ShiftResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SERIES = {
    "without_novelty.confident_error": ("grid alone", UNKNOWN_COLOUR),
    "gamma.confident_error": ("with novelty", SAFE_COLOUR),
    "monitor.confident_error_60s": ("with monitor, first 60 s", RECOVERY_COLOUR),
}
_TITLES = {
    "nominal": "as in training",
    "plant": "another plant",
    "sensor": "faulty measurements",
    "plan": "starts and plans beyond the range",
    "posture": "postures beyond the range",
    "junk": "contradictions",
}
_LONGEST_S = 60.0
_GROUP_GAP = 0.5  # Between rows of different kinds, in rows.


def shifts_figure(results: Mapping[str, ShiftResult]) -> Figure:
    """Plots confident errors of every shift, and when the monitor gives an alarm.

    Args:
        results: Results by shift.
    """
    kinds = list(dict.fromkeys(result.kind for result in results.values()))
    names = sorted(results, key=lambda name: kinds.index(results[name].kind))
    groups = np.array([kinds.index(results[name].kind) for name in names])
    places = (len(names) - np.arange(len(names)) + _GROUP_GAP * (groups[-1] - groups)).astype(float)
    with drawing_style():
        fig = new_figure(10.0, 1.6 + 0.32 * len(names))
        errors, delays = fig.subplots(1, 2, sharey=True, width_ratios=[1.6, 1.0])
        for offset, (key, (label, colour)) in zip((0.26, 0.0, -0.26), _SERIES.items(), strict=True):
            found = [results[name].estimates.get(key) for name in names]
            is_there = np.array([one is not None for one in found])
            values = np.array([100.0 * one.value for one in found if one is not None])
            low = np.array([100.0 * one.low for one in found if one is not None])
            high = np.array([100.0 * one.high for one in found if one is not None])
            errors.barh(
                places[is_there] + offset,
                values,
                height=0.24,
                color=colour,
                label=label,
                xerr=np.clip([values - low, high - values], 0.0, None),
                error_kw={"elinewidth": 0.8, "ecolor": FAINT_INK},
            )
        errors.set_yticks(places, [name.replace("_", " ") for name in names])
        errors.set_ylim(0.4, places[0] + 0.6)
        errors.set_xlabel("confident errors [% of rows]")
        errors.set_title("Sure and wrong")
        for group, kind in enumerate(kinds):
            errors.text(
                0.995,
                places[groups == group].max() + 0.42,
                _TITLES.get(kind, kind),
                transform=errors.get_yaxis_transform(),
                horizontalalignment="right",
                verticalalignment="top",
                color=FAINT_INK,
                fontstyle="italic",
            )
        fig.legend(loc="outside lower left", ncols=len(_SERIES))
        errors.grid(axis="x", color="#eceef0", linewidth=0.7)
        errors.set_axisbelow(True)
        for place, name in zip(places, names, strict=True):
            _draw_delay(delays, place, results[name])
        delays.set_xscale("log")
        delays.set_xlim(0.08, 1.4 * _LONGEST_S)
        delays.set_xticks([0.1, 1.0, 10.0, _LONGEST_S], ["0.1", "1", "10", "none"])
        delays.minorticks_off()
        delays.tick_params(axis="y", length=0)
        delays.set_xlabel("alarm after [s], median to 95 %")
        delays.set_title("Noticed")
        delays.grid(axis="x", color="#eceef0", linewidth=0.7)
        delays.set_axisbelow(True)
    return fig


def _draw_delay(axes: object, place: float, result: ShiftResult) -> None:
    ends = [result.estimates.get(key) for key in ("monitor.delay_s", "monitor.delay_95_s")]
    if ends[0] is None or ends[1] is None:
        return
    median, late = (min(one.value, _LONGEST_S) for one in ends if one is not None)
    axes.plot([median, late], [place, place], color=UNSAFE_COLOUR, linewidth=1.6)  # type: ignore[attr-defined]
    axes.plot([median], [place], "o", color=UNSAFE_COLOUR, markersize=5)  # type: ignore[attr-defined]
