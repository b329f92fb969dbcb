"""Γ over the time of a run, with stills of the robot; the monitor's levels over that of a log."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from string import ascii_lowercase
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch
from matplotlib.patheffects import withStroke

from drake_safety.evaluation import figure_style as style
from drake_safety.learning.beliefs import SAFE, UNCERTAINTY, UNSAFE
from drake_safety.learning.change_detector import Alarm
from drake_safety.plants.balls import Throw
from drake_safety.plants.pushes import Push

_WIDTH = 12.0  # All sizes are in inches.
_CURVE_HEIGHT, _BELIEF_HEIGHT, _MARGINS_HEIGHT = 2.4, 1.0, 1.3
_MAX_STILL_HEIGHT, _STILL_TITLE_HEIGHT = 2.6, 0.35
_AXIS_LABEL_HEIGHT = 0.6
_LABEL_ROW_HEIGHT, _LETTER_WIDTH, _LABEL_OFFSET = 0.2, 0.066, 0.11  # Of labels above the curve.
_LOWEST, _HIGHEST = -0.02, 1.05  # Ends of the axis without labels.
_NUM_LEVELS, _MOST_POINTS = 4, 4000  # Curves of levels, and points of one.
_Style = Mapping[str, Any]
_BALL: _Style = {"linestyle": (0, (1, 2)), "linewidth": 1.0}
_TRIGGER: _Style = {"linewidth": 1.2}
_LEAVING: _Style = {"linestyle": (0, (4, 2)), "linewidth": 1.2}
_LEGEND: _Style = {
    "loc": "center left",
    "bbox_to_anchor": (1.0, 0.5),
    "handlelength": 1.4,
    "borderaxespad": 0.3,
}


@dataclass
class _Event:
    """A named instant, with the style of its line, if it has one, and the place of its name."""

    time_s: float
    words: str
    colour: str
    line: _Style | None = None
    is_ball: bool = False
    row: int = 0  # 0 at the top.
    is_left: bool = False  # Of the instant.


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
    """Plots the probability over time, with stills of the robot.

    Names of events are in rows above the curve.

    Args:
        time_s: Instants [s], (N,).
        probability: Held until the next instant, (N,).
        trigger_times_s: Times of triggers or alarms [s].
        leave_time_s: Time at which the robot leaves the safe set [s]; infinite for never.
        recovery_intervals_s: (start, end) of each recovery [s].
        alarm_intervals_s: (start, end) of each alarm of the monitor [s].
        stills: (time [s], RGB image (height, width, 3)), each joined to its instant on the curve.
        belief: Masses (safe, unsafe, unknown), (N, 3); drawn stacked below.
        margins: Signed margins [m, rad], (N, n_c); drawn at the bottom.
        angular_constraints: Constraints whose margins are angles.
    """
    time_s, probability = (np.asarray(one, dtype=float) for one in (time_s, probability))
    for name, values in (("probability", probability), ("belief", belief), ("margins", margins)):
        if values is not None and len(values) != len(time_s):
            raise ValueError(
                f"timeline_figure: {name} has {len(values)} rows, expected {len(time_s)}"
            )
    if margins is not None and margins.shape[1] != len(constraint_names):
        raise ValueError(
            f"timeline_figure: margins have {margins.shape[1]} columns, but the constraints are "
            f"{list(constraint_names)}"
        )
    for instant, _ in stills:
        if not time_s[0] - 1e-9 <= instant <= time_s[-1] + 1e-9:
            raise ValueError(
                f"timeline_figure: a still at {instant} s is outside {time_s[0]}..{time_s[-1]} s"
            )
    events = [
        _Event(one.time_s, f"{one.mass_kg:.1f} kg, {one.speed_m_s:.1f} m/s", style.INK, _BALL, True)
        for one in throws
    ]
    for push in pushes:
        words = f"push of {push.strength_n:.0f} N for {push.duration_s:g} s"
        events.append(_Event(push.time_s, words, style.INK))
    for instant in trigger_times_s:
        events.append(_Event(instant, trigger_label, style.UNSAFE_COLOUR, _TRIGGER))
    if math.isfinite(leave_time_s):
        events.append(_Event(leave_time_s, "leaves the safe set", style.INK, _LEAVING))
    for start, _ in recovery_intervals_s:
        events.append(_Event(start, "recovery", style.RECOVERY_COLOUR))
    for start, _ in alarm_intervals_s:
        events.append(_Event(start, "monitor's alarm", style.UNSAFE_COLOUR))
    heights = [_CURVE_HEIGHT + _place_names(events, time_s[0], time_s[-1])]
    if belief is not None:
        heights.append(_BELIEF_HEIGHT)
    if margins is not None:
        heights.append(_MARGINS_HEIGHT)
    with style.drawing_style():
        fig, pictures, panels = _lay_out(heights, [image for _, image in stills])
        curve_axes, *others = panels
        curve_axes.set_xlim(time_s[0], time_s[-1])
        style.draw_threshold(curve_axes, threshold, style.UNSAFE_COLOUR)
        curve_axes.step(time_s, probability, where="post", color=style.SAFE_COLOUR, linewidth=2.0)
        curve_axes.set(yticks=[0.0, 0.5, 1.0], ylabel="probability")
        if belief is not None:
            _draw_belief(others.pop(0), time_s, belief)
        if margins is not None:
            _draw_margins(others.pop(0), time_s, margins, constraint_names, angular_constraints)
        for panel in panels:
            for push in pushes:
                _span(panel, push.time_s, push.time_s + push.duration_s, style.BALL_COLOUR, 0.25)
            for event in events:
                if event.line is not None:
                    panel.axvline(event.time_s, color=event.colour, **event.line)
        for start, end in recovery_intervals_s:
            _span(curve_axes, start, end, style.RECOVERY_COLOUR, 0.14)
        for start, end in alarm_intervals_s:
            _span(curve_axes, start, end, style.UNSAFE_COLOUR, 0.14)
        for instant in trigger_times_s:
            mark: _Style = {"color": style.UNSAFE_COLOUR, "markersize": 8, "zorder": 5}
            curve_axes.plot(instant, threshold, "v", **mark)
        top = _write_names(curve_axes, events, (_LOWEST, _HIGHEST))
        for axes, letter, (instant, image) in zip(pictures, ascii_lowercase, stills, strict=False):
            axes.imshow(image, interpolation="antialiased")
            axes.set_axis_off()
            axes.set_title(f"({letter})  {instant:.2f} s", fontsize=10, pad=4)
            row = max(int(np.searchsorted(time_s, instant + 1e-9, side="right")) - 1, 0)
            height = probability[row] if np.isfinite(probability[row]) else 0.0
            _join(fig, axes, curve_axes, (instant, height), top)
        panels[-1].set_xlabel("time [s]")
        curve_axes.figure.align_ylabels(panels)
    return fig


def levels_figure(
    time_s: np.ndarray, levels: np.ndarray, names: list[str], alarms: list[Alarm], limit: float
) -> Figure:
    """Plots the largest levels (N, n_w) of the states that a monitor watches, and its alarms."""
    # Of a long log the largest of some rows.
    firsts = np.arange(0, len(time_s), max(1, len(time_s) // _MOST_POINTS))
    peaks, levels = levels.max(axis=0), np.maximum.reduceat(levels, firsts)
    events = [_Event(float(time_s[one.begin]), one.cause, style.UNSAFE_COLOUR) for one in alarms]
    heights = [_CURVE_HEIGHT + _place_names(events, time_s[0], time_s[-1])]
    with style.drawing_style():
        fig, _, (axes,) = _lay_out(heights, [])
        axes.set(xlim=(time_s[0], time_s[-1]), xlabel="time [s]", ylabel="level")
        for i, state in enumerate(np.argsort(peaks)[: -1 - _NUM_LEVELS : -1].tolist()):
            line: _Style = {"color": style.SERIES_COLOURS[2 + i], "linewidth": 1.5}
            dashes, name = style.SERIES_DASHES[i], names[state]
            axes.plot(time_s[firsts], levels[:, state], linestyle=dashes, label=name, **line)
        if math.isfinite(limit):
            axes.axhline(limit, color=style.UNSAFE_COLOUR, linestyle="--", linewidth=1.2)
        for one in alarms:
            _span(axes, time_s[one.begin], time_s[one.end - 1], style.UNSAFE_COLOUR, 0.14)
        _write_names(axes, events, (0.0, 1.05 * max(1.0, float(peaks.max()))))
        axes.legend(**_LEGEND)
    return fig


def _lay_out(
    heights: Sequence[float], images: Sequence[np.ndarray]
) -> tuple[Figure, list[Axes], list[Axes]]:
    """Lays out a strip of images, if any, above panels of some heights [inches]."""
    rows: Any = {"squeeze": False, "sharex": True, "height_ratios": heights}
    height = sum(heights)
    if not images:
        fig = style.new_figure(_WIDTH, height + _AXIS_LABEL_HEIGHT)
        return fig, [], fig.subplots(len(heights), **rows)[:, 0].tolist()
    aspect = max(image.shape[0] / image.shape[1] for image in images)
    strip = min(aspect * _WIDTH / len(images), _MAX_STILL_HEIGHT) + _STILL_TITLE_HEIGHT
    fig = style.new_figure(_WIDTH, height + strip + _AXIS_LABEL_HEIGHT)
    halves: Any = fig.subfigures(2, 1, height_ratios=[strip, height])
    upper, lower = halves
    pictures = upper.subplots(1, len(images), squeeze=False)[0].tolist()
    return fig, pictures, lower.subplots(len(heights), **rows)[:, 0].tolist()


def _draw_belief(axes: Axes, time_s: np.ndarray, belief: np.ndarray) -> None:
    axes.stackplot(
        time_s,
        *belief[:, [SAFE, UNCERTAINTY, UNSAFE]].T,
        labels=["safe", "don't know", "unsafe"],
        colors=[style.SAFE_COLOUR, style.UNKNOWN_COLOUR, style.UNSAFE_COLOUR],
        step="post",
        linewidth=0,
    )
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
    for i, name in enumerate(names):
        is_angle = name in angular
        axes.plot(
            time_s,
            np.degrees(margins[:, i]) if is_angle else 100.0 * margins[:, i],
            # The first two colours are those of safe and unsafe.
            color=style.SERIES_COLOURS[(2 + i) % len(style.SERIES_COLOURS)],
            linestyle=style.SERIES_DASHES[i % len(style.SERIES_DASHES)],
            linewidth=1.5,
            label=f"{style.spoken(name)} [°]" if is_angle else style.spoken(name),
        )
    low, high = axes.get_ylim()
    low = min(low, -0.12 * high)
    axes.axhspan(low, 0.0, color=style.UNSAFE_COLOUR, alpha=0.08, linewidth=0)
    axes.set(ylim=(low, high), ylabel="margin [cm]")
    axes.legend(**_LEGEND)


def _span(axes: Axes, start_s: float, end_s: float, colour: str, alpha: float) -> None:
    axes.axvspan(start_s, end_s, color=colour, alpha=alpha, linewidth=0, zorder=0)


def _place_names(events: Sequence[_Event], start_s: float, end_s: float) -> float:
    """Gives names rows, so that none covers another or its instant; returns the height [inches]."""
    taken: list[list[tuple[float, float]]] = []
    scale = (end_s - start_s) / (_WIDTH - 2.0)  # Seconds per inch, roughly.
    for event in events:
        length = scale * (len(event.words) * _LETTER_WIDTH + 2 * _LABEL_OFFSET)
        event.is_left = event.time_s + length > end_s
        low = event.time_s - (length if event.is_left else scale * _LABEL_OFFSET)
        high = max(low + length, event.time_s + scale * _LABEL_OFFSET)
        is_free = [not any(low < b and a < high for a, b in row) for row in (*taken, [])]
        event.row = is_free.index(True)
        taken += [[]] if event.row == len(taken) else []
        taken[event.row].append((low, high))
    return _LABEL_ROW_HEIGHT * len(taken)


def _write_names(axes: Axes, events: Sequence[_Event], ends: tuple[float, float]) -> float:
    """Writes names in rows above an axis with these ends; returns the new upper end."""
    row_height = (ends[1] - ends[0]) * _LABEL_ROW_HEIGHT / _CURVE_HEIGHT
    top = ends[1] + row_height * (max((event.row for event in events), default=-1) + 1)
    axes.set_ylim(ends[0], top)
    for event in events:
        place = (event.time_s, top - (event.row + 0.5) * row_height)
        if event.is_ball:
            axes.plot(*place, "o", color=style.BALL_COLOUR, markersize=8, clip_on=False, zorder=5)
        axes.annotate(
            event.words,
            place,
            xytext=(-7 if event.is_left else 7, 0),
            textcoords="offset points",
            ha="right" if event.is_left else "left",
            va="center",
            color=event.colour,
            fontsize=9,
            zorder=6,
            # Lines of events and stills pass behind.
            path_effects=[withStroke(linewidth=3.0, foreground="white")],
        )
    return top


def _join(
    fig: Figure, picture: Axes, curve_axes: Axes, point: tuple[float, float], top: float
) -> None:
    """Draws a line from the lower edge of an image to its instant, and down to the curve of Γ."""
    line: _Style = {"color": style.FAINT_INK, "linewidth": 0.9}
    ends = (0.5, 0.0), (point[0], top), picture.transAxes, curve_axes.transData
    above = ConnectionPatch(*ends, **line)
    above.set_in_layout(False)
    fig.add_artist(above)
    curve_axes.vlines(point[0], point[1], top, alpha=0.6, zorder=1, **line)
    ring: _Style = {"color": "white", "markeredgecolor": style.INK, "markersize": 6, "zorder": 6}
    curve_axes.plot(*point, "o", clip_on=False, **ring)
