"""Γ over the time of a run, with stills of the robot; the monitor's levels over that of a log."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drake_safety.evaluation import figure_style as style
from drake_safety.learning.beliefs import SAFE, UNCERTAINTY, UNSAFE
from drake_safety.learning.change_detector import Alarm
from drake_safety.plants.balls import Throw
from drake_safety.plants.pushes import Push

_CURVE_HEIGHT, _BELIEF_HEIGHT, _MARGINS_HEIGHT = 1.6, 0.8, 1.2  # All sizes are in inches.
_MAX_STILL_HEIGHT, _STILL_TITLE_HEIGHT, _AXIS_LABEL_HEIGHT = 2.6, 0.35, 0.6
_LABEL_ROW_HEIGHT, _NUM_LABEL_ROWS = 0.2, 8  # Rows of names above the curve.
_NUM_LEVELS, _MOST_POINTS = 4, 4000  # Curves of levels, and points of each.
_Style = Mapping[str, Any]
_BESIDE: _Style = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)}
_LEGEND: _Style = {**_BESIDE, "handlelength": 1.4, "borderaxespad": 0.3}


class _Event(NamedTuple):
    """A named instant."""

    time_s: float
    words: str
    colour: str


def timeline_figure(
    time_s: np.ndarray,
    probability: np.ndarray,
    threshold: float,
    *,
    throws: Sequence[Throw] = (),
    pushes: Sequence[Push] = (),
    trigger_times_s: Sequence[float] = (),
    trigger_label: str = "trigger",
    leave_time_s: float = math.inf,
    recovery_intervals_s: Sequence[tuple[float, float]] = (),
    alarm_intervals_s: Sequence[tuple[float, float]] = (),
    stills: Sequence[tuple[float, np.ndarray]] = (),
    belief: np.ndarray | None = None,
    margins: np.ndarray | None = None,
    constraint_names: Sequence[str] = (),
    angular_constraints: Sequence[str] = (),
) -> Figure:
    """Plots the probability (N,) over time (N,), with names of events.

    Above the curve are stills, times [s] and RGB images (height, width, 3), and below it the belief
    (N, 3) and the margins [m, rad], (N, n_c).
    """
    unsafe = style.UNSAFE_COLOUR
    events = []
    for ball in throws:
        words = f"ball of {ball.mass_kg:.1f} kg, {ball.speed_m_s:.1f} m/s"
        events.append(_Event(ball.time_s, words, style.BALL_COLOUR))
    for push in pushes:
        words = f"push of {push.strength_n:.0f} N for {push.duration_s:g} s"
        events.append(_Event(push.time_s, words, style.BALL_COLOUR))
    events += [_Event(at_s, trigger_label, unsafe) for at_s in trigger_times_s]
    if math.isfinite(leave_time_s):
        events.append(_Event(leave_time_s, "leaves the safe set", style.INK))
    events += [_Event(s, "recovery", style.RECOVERY_COLOUR) for s, _ in recovery_intervals_s]
    events += [_Event(start, "monitor's alarm", unsafe) for start, _ in alarm_intervals_s]
    heights = [_CURVE_HEIGHT + _LABEL_ROW_HEIGHT * min(len(events), _NUM_LABEL_ROWS)]
    heights += [_BELIEF_HEIGHT] * (belief is not None) + [_MARGINS_HEIGHT] * (margins is not None)
    with style.drawing_style():
        fig, pictures, panels = _lay_out(heights, [image for _, image in stills])
        curve_axes, *others = panels
        curve_axes.set_xlim(time_s[0], time_s[-1])
        style.draw_threshold(curve_axes, threshold, unsafe)
        curve_axes.step(time_s, probability, where="post", color=style.SAFE_COLOUR, linewidth=2.0)
        curve_axes.set(yticks=[0.0, 0.5, 1.0], ylabel="probability")
        if belief is not None:
            _draw_belief(others.pop(0), time_s, belief)
        if margins is not None:
            _draw_margins(others.pop(0), time_s, margins, constraint_names, angular_constraints)
        for panel in panels[1:]:
            for event in events:
                panel.axvline(event.time_s, color=event.colour, linewidth=0.9)
        for start, end in recovery_intervals_s:
            _span(curve_axes, start, end, style.RECOVERY_COLOUR)
        for start, end in alarm_intervals_s:
            _span(curve_axes, start, end, unsafe)
        _write_names(curve_axes, events, (-0.02, 1.05))
        for axes, (at_s, image) in zip(pictures, stills, strict=True):
            axes.imshow(image, interpolation="antialiased")
            axes.set_axis_off()
            axes.set_title(f"{at_s:.2f} s", fontsize=10, pad=4)
        panels[-1].set_xlabel("time [s]")
        curve_axes.figure.align_ylabels(panels)
    return fig


def levels_figure(
    time_s: np.ndarray, levels: np.ndarray, names: list[str], alarms: list[Alarm], limit: float
) -> Figure:
    """Plots the largest levels (N, n_w) of the states that a monitor watches, and its alarms."""
    # A long log is reduced to the largest of successive rows.
    firsts = np.arange(0, len(time_s), max(1, len(time_s) // _MOST_POINTS))
    peaks, levels = levels.max(axis=0), np.maximum.reduceat(levels, firsts)
    events = [_Event(float(time_s[one.begin]), one.cause, style.UNSAFE_COLOUR) for one in alarms]
    height = _CURVE_HEIGHT + _LABEL_ROW_HEIGHT * min(len(events), _NUM_LABEL_ROWS)
    with style.drawing_style():
        fig, _, (axes,) = _lay_out([height], [])
        axes.set(xlim=(time_s[0], time_s[-1]), xlabel="time [s]", ylabel="level")
        for i, state in enumerate(np.argsort(peaks)[: -1 - _NUM_LEVELS : -1].tolist()):
            line: _Style = {"color": style.SERIES_COLOURS[2 + i], "linewidth": 1.5}
            dashes, name = style.SERIES_DASHES[i], names[state]
            axes.plot(time_s[firsts], levels[:, state], linestyle=dashes, label=name, **line)
        if math.isfinite(limit):
            axes.axhline(limit, color=style.UNSAFE_COLOUR, linestyle="--", linewidth=1.2)
        for one in alarms:
            _span(axes, time_s[one.begin], time_s[one.end - 1], style.UNSAFE_COLOUR)
        _write_names(axes, events, (0.0, 1.05 * max(1.0, float(peaks.max()))))
        axes.legend(**_LEGEND)
    return fig


def _lay_out(
    heights: Sequence[float], images: Sequence[np.ndarray]
) -> tuple[Figure, list[Axes], list[Axes]]:
    """Lays out a strip of images, if any, above panels of some heights [inches]."""
    height, strip = sum(heights), 0.0
    if images:
        aspect = max(image.shape[0] / image.shape[1] for image in images)
        strip = (
            min(aspect * style.PAGE_WIDTH / len(images), _MAX_STILL_HEIGHT) + _STILL_TITLE_HEIGHT
        )
    fig = style.new_figure(style.PAGE_WIDTH, height + strip + _AXIS_LABEL_HEIGHT)
    lower: Any = fig
    pictures: list[Axes] = []
    if images:
        halves: Any = fig.subfigures(2, 1, height_ratios=[strip, height])
        upper, lower = halves
        pictures = upper.subplots(1, len(images), squeeze=False)[0].tolist()
    panels = lower.subplots(len(heights), squeeze=False, sharex=True, height_ratios=heights)
    return fig, pictures, panels[:, 0].tolist()


def _draw_belief(axes: Axes, time_s: np.ndarray, belief: np.ndarray) -> None:
    masses = belief[:, [SAFE, UNCERTAINTY, UNSAFE]].T
    colours = [style.SAFE_COLOUR, style.UNKNOWN_COLOUR, style.UNSAFE_COLOUR]
    look: _Style = {"labels": ["safe", "don't know", "unsafe"], "colors": colours}
    axes.stackplot(time_s, *masses, **look, step="post", linewidth=0)
    axes.set(ylim=(0.0, 1.0), yticks=[0.0, 1.0], ylabel="belief")
    # The legend lists the layers from the top.
    axes.legend(**_LEGEND, reverse=True)


def _draw_margins(
    axes: Axes,
    time_s: np.ndarray,
    margins: np.ndarray,
    names: Sequence[str],
    angular: Sequence[str],
) -> None:
    axes.axhline(0.0, color=style.FAINT_INK, linewidth=0.8)
    # The first two colours mean safe and unsafe.
    colours = style.SERIES_COLOURS[2:] + style.SERIES_COLOURS[:2]
    axes.set_prop_cycle(color=colours, linestyle=style.SERIES_DASHES, linewidth=[1.5] * 6)
    for name, values in zip(names, margins.T, strict=True):
        is_angle = name in angular
        shown = np.degrees(values) if is_angle else 100.0 * values
        axes.plot(time_s, shown, label=style.spoken(name) + " [°]" * is_angle)
    low, high = axes.get_ylim()
    low = min(low, -0.12 * high)
    axes.axhspan(low, 0.0, color=style.UNSAFE_COLOUR, alpha=0.08, linewidth=0)
    axes.set(ylim=(low, high), ylabel="margin [cm]")
    axes.legend(**_LEGEND)


def _span(axes: Axes, start_s: float, end_s: float, colour: str) -> None:
    axes.axvspan(start_s, end_s, color=colour, alpha=0.14, linewidth=0, zorder=0)


def _write_names(axes: Axes, events: Sequence[_Event], ends: tuple[float, float]) -> None:
    """Writes names in rows above an axis, the earliest on top: no line crosses another name."""
    row_height = (ends[1] - ends[0]) * _LABEL_ROW_HEIGHT / _CURVE_HEIGHT
    top = ends[1] + row_height * min(len(events), _NUM_LABEL_ROWS)
    axes.set_ylim(ends[0], top)
    axes.spines["left"].set_bounds(ends[0], ends[1])
    look: dict[str, Any] = {"xytext": (6, 0), "textcoords": "offset points", "va": "center"}
    for i, event in enumerate(sorted(events, key=lambda one: one.time_s)):
        height = top - (i % _NUM_LABEL_ROWS + 0.5) * row_height
        axes.vlines(event.time_s, ends[0], height, color=event.colour, linewidth=0.9)
        axes.plot(event.time_s, height, "o", color=event.colour, markersize=3.5)
        place = (event.time_s, height)
        axes.annotate(event.words, place, color=event.colour, fontsize=9, zorder=6, **look)
