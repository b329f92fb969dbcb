"""Alarms on pushed motions: receiver operating characteristic and lead times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.evaluation.figure_style import FAINT_INK, drawing_style, new_figure, spoken
from drake_safety.evaluation.monitoring_study import MonitoringStudy
from drake_safety.evaluation.roc_figure import draw_roc, series_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LATEST_S = -0.3  # Alarms this late are still drawn.


def monitoring_figure(study: MonitoringStudy, names: Sequence[str] | None = None) -> Figure:
    """Plots the alarms of a study.

    Left: detection rate against the share of motions with a false alarm, for every threshold; a dot
    marks the chosen one. Right: share of motions detected by each lead time, at that threshold.

    Args:
        study: The study.
        names: Alarms to show; all by default.
    """
    names = list(study.thresholds) if names is None else list(names)
    label = study.is_unsafe
    longest = max(
        (lead[np.isfinite(lead)].max(initial=0.0) for lead in study.lead_s.values()), default=0.0
    )
    with drawing_style():
        fig = new_figure(11.5, 5.2)
        roc, lead_axes = fig.subplots(1, 2)
        for i, name in enumerate(names):
            score = study.unsafe_score[name]
            style = series_style(i) | {"linewidth": 2.4 if i == 0 else 1.5, "zorder": 4 - (i > 0)}
            text = f"{spoken(name)}   {study.estimates[f'monitoring.{name}.auc'].value:.3f}"
            draw_roc(roc, score, label, text, -study.thresholds[name], **style)
            lead_s = np.sort(study.lead_s[name])
            if lead_s.size:
                shown = np.concatenate([[longest], lead_s[::-1]])
                detected = np.arange(len(shown)) / lead_s.size
                is_shown = shown >= _LATEST_S
                shown, detected = shown[is_shown], detected[is_shown]
                lead_axes.step(
                    np.append(shown, _LATEST_S),
                    np.append(detected, detected[-1]),
                    where="post",
                    **style,
                )
        roc.set(xlim=(0, 1), ylim=(0, 1.005))
        roc.set_xlabel("share of safe motions with a false alarm")
        roc.set_ylabel("detection rate")
        roc.set_title("At every threshold")
        roc.legend(loc="lower right", title="area under the curve", alignment="left")
        lead_axes.axvline(0.0, color=FAINT_INK, linewidth=0.8)
        lead_axes.set(xlim=(max(longest, 0.1), _LATEST_S), ylim=(0, 1.005))
        lead_axes.set_xlabel("lead time until the robot leaves the safe set [s]")
        lead_axes.set_ylabel("detection rate")
        lead_axes.set_title("At the chosen thresholds")
        for axes in (roc, lead_axes):
            axes.grid(color="#eceef0", linewidth=0.7)
    return fig
