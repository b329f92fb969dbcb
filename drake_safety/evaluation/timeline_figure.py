"""Γ over the time of a run, with stills of the robot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_safety.evaluation.figure_style import (
    BALL_COLOUR,
    FAINT_INK,
    INK,
    RECOVERY_COLOUR,
    SAFE_COLOUR,
    SERIES_COLOURS,
    SERIES_DASHES,
    UNKNOWN_COLOUR,
    UNSAFE_COLOUR,
    drawing_style,
    new_figure,
    spoken,
)
from drake_safety.learning.beliefs import SAFE, UNCERTAINTY

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import GridSpecBase

    from drake_safety.plants.balls import Throw
    from drake_safety.plants.pushes import Push

_WIDTH = 12.0  # All sizes are in inches.
_GAMMA_HEIGHT, _BELIEF_HEIGHT, _MARGINS_HEIGHT = 2.4, 1.0, 1.3
_MAX_STILL_HEIGHT, _STILL_TITLE_HEIGHT = 2.6, 0.35
_AXIS_LABEL_HEIGHT = 0.6
_BALL_HEIGHT = 0.3  # Position of a ball on the axis of Γ.
_LETTERS = "abcdefghijklmnopqrstuvwxyz"


def timeline_figure(
    time_s: np.ndarray,
    gamma: np.ndarray,
    threshold: float,
    *,
    quantity: str = "Γ",
    throws: Sequence[Throw] = (),
    pushes: Sequence[Push] = (),
    trigger_times_s: Sequence[float] = (),
    trigger_label: str = "trigger",
    leave_time_s: float = math.inf,
    recovery_intervals_s: Sequence[tuple[float, float]] = (),
    stills: Sequence[tuple[float, np.ndarray]] = (),
    belief: np.ndarray | None = None,
    margins: np.ndarray | None = None,
    constraint_names: Sequence[str] = (),
    angular_constraints: Sequence[str] = (),
) -> Figure:
    """Plots Γ over time, with stills of the robot.

    Args:
        time_s: Instants [s], (N,).
        gamma: Γ, held until the next instant, (N,).
        threshold: Threshold on Γ of triggers or alarms.
        quantity: Which Γ, as in `quantities.GAMMA`.
        throws: Balls, marked at the time of impact.
        pushes: Pushes, marked for their duration.
        trigger_times_s: Times of triggers or alarms [s].
        trigger_label: Label of these.
        leave_time_s: Time at which the robot leaves the safe set [s]; infinite for never.
        recovery_intervals_s: (start, end) of each recovery [s].
        stills: (time [s], RGB image (height, width, 3)), each joined to its instant on the curve.
        belief: Masses (safe, unsafe, unknown), (N, 3); drawn stacked below.
        margins: Signed margins [m, rad], (N, n_c); drawn at the bottom.
        constraint_names: Names of the columns of `margins`.
        angular_constraints: Constraints whose margins are angles.

    Raises:
        ValueError: Arrays have different lengths, the number of names is not that of margins, or
            a still is outside the time range.
    """
    time_s, gamma = np.asarray(time_s, dtype=float), np.asarray(gamma, dtype=float)
    for name, values in (("gamma", gamma), ("belief", belief), ("margins", margins)):
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
    heights = [_GAMMA_HEIGHT]
    if belief is not None:
        heights.append(_BELIEF_HEIGHT)
    if margins is not None:
        heights.append(_MARGINS_HEIGHT)
    with drawing_style():
        fig, pictures, panels = _lay_out(heights, [image for _, image in stills])
        gamma_axes, *others = panels
        _draw_gamma(gamma_axes, time_s, gamma, threshold)
        gamma_axes.set_ylabel(quantity)
        remaining = iter(others)
        if belief is not None:
            _draw_belief(next(remaining), time_s, belief)
        if margins is not None:
            _draw_margins(next(remaining), time_s, margins, constraint_names, angular_constraints)
        for panel in panels:
            _mark_instants(panel, throws, pushes, trigger_times_s, leave_time_s)
        for interval in recovery_intervals_s:
            _annotate_recovery(gamma_axes, interval)
        for throw in throws:
            _annotate_throw(gamma_axes, time_s, throw)
        for push in pushes:
            _annotate_push(gamma_axes, time_s, push)
        for instant in trigger_times_s:
            _annotate_trigger(gamma_axes, time_s, (instant, threshold), trigger_label)
        if math.isfinite(leave_time_s):
            _annotate_leaving(gamma_axes, time_s, leave_time_s)
        for axes, letter, (instant, image) in zip(pictures, _LETTERS, stills, strict=False):
            _draw_still(axes, image, f"({letter})  {instant:.2f} s")
            row = max(int(np.searchsorted(time_s, instant + 1e-9, side="right")) - 1, 0)
            height = gamma[row] if np.isfinite(gamma[row]) else 0.0
            _join(fig, axes, gamma_axes, (instant, height))
        for panel in panels[:-1]:
            panel.tick_params(labelbottom=False)
        panels[-1].set_xlabel("time [s]")
        gamma_axes.set_xlim(time_s[0], time_s[-1])
        fig.align_ylabels(panels)
    return fig


def _lay_out(
    heights: Sequence[float], images: Sequence[np.ndarray]
) -> tuple[Figure, list[Axes], list[Axes]]:
    """Lays out a strip of images, if any, above panels with a common time axis.

    Args:
        heights: Heights of the panels [inches], from the top.
        images: The images, (height, width, 3) each.

    Returns:
        The figure, the axes of the images, and the axes of the panels.
    """
    pictures: list[Axes] = []
    if images:
        aspect = max(image.shape[0] / image.shape[1] for image in images)
        strip_height = min(aspect * _WIDTH / len(images), _MAX_STILL_HEIGHT) + _STILL_TITLE_HEIGHT
        fig = new_figure(_WIDTH, sum(heights) + strip_height + _AXIS_LABEL_HEIGHT)
        halves = fig.add_gridspec(2, 1, height_ratios=[strip_height, sum(heights)], hspace=0.08)
        strip = halves[0, 0].subgridspec(1, len(images), wspace=0.03)
        pictures = [fig.add_subplot(strip[0, i]) for i in range(len(images))]
        rows: GridSpecBase = halves[1, 0].subgridspec(len(heights), 1, height_ratios=heights)
    else:
        fig = new_figure(_WIDTH, sum(heights) + _AXIS_LABEL_HEIGHT)
        rows = fig.add_gridspec(len(heights), 1, height_ratios=heights)
    panels: list[Axes] = []
    for i in range(len(heights)):
        panels.append(fig.add_subplot(rows[i, 0], sharex=panels[0] if panels else None))
    return fig, pictures, panels


def _draw_gamma(axes: Axes, time_s: np.ndarray, gamma: np.ndarray, threshold: float) -> None:
    axes.axhline(threshold, color=UNSAFE_COLOUR, linestyle=(0, (4, 3)), linewidth=1.2)
    axes.annotate(
        f"threshold {threshold:.3g}",
        (1.0, threshold),
        xycoords=("axes fraction", "data"),
        xytext=(-4, 3),
        textcoords="offset points",
        ha="right",
        color=UNSAFE_COLOUR,
        fontsize=9,
    )
    axes.step(time_s, gamma, where="post", color=SAFE_COLOUR, linewidth=2.0)
    axes.set_ylim(-0.02, 1.05)
    axes.set_yticks([0.0, 0.5, 1.0])


def _draw_belief(axes: Axes, time_s: np.ndarray, belief: np.ndarray) -> None:
    safe = belief[:, SAFE]
    safe_or_unknown = safe + belief[:, UNCERTAINTY]
    layers = (
        ("safe", np.zeros_like(safe), safe, SAFE_COLOUR),
        ("unknown", safe, safe_or_unknown, UNKNOWN_COLOUR),
        ("unsafe", safe_or_unknown, np.ones_like(safe), UNSAFE_COLOUR),
    )
    for name, lower, upper, colour in layers:
        axes.fill_between(time_s, lower, upper, step="post", color=colour, linewidth=0, label=name)
    axes.set(ylim=(0.0, 1.0), yticks=[0.0, 1.0], ylabel="belief")
    # The legend lists the layers from the top.
    handles, labels = axes.get_legend_handles_labels()
    _add_legend_on_the_right(axes, handles[::-1], labels[::-1])


def _draw_margins(
    axes: Axes,
    time_s: np.ndarray,
    margins: np.ndarray,
    names: Sequence[str],
    angular: Sequence[str],
) -> None:
    axes.axhline(0.0, color=FAINT_INK, linewidth=0.8)
    for i, name in enumerate(names):
        is_angle = name in angular
        axes.plot(
            time_s,
            np.degrees(margins[:, i]) if is_angle else 100.0 * margins[:, i],
            # The first two colours are those of safe and unsafe.
            color=SERIES_COLOURS[(2 + i) % len(SERIES_COLOURS)],
            linestyle=SERIES_DASHES[i % len(SERIES_DASHES)],
            linewidth=1.5,
            label=f"{spoken(name)} [°]" if is_angle else spoken(name),
        )
    low, high = axes.get_ylim()
    low = min(low, -0.12 * high)
    axes.axhspan(low, 0.0, color=UNSAFE_COLOUR, alpha=0.08, linewidth=0)
    axes.set(ylim=(low, high), ylabel="margin [cm]")
    _add_legend_on_the_right(axes, *axes.get_legend_handles_labels())


def _add_legend_on_the_right(axes: Axes, handles: Sequence[Any], labels: Sequence[str]) -> None:
    axes.legend(
        handles,
        labels,
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
        handlelength=1.4,
        borderaxespad=0.3,
    )


def _mark_instants(
    axes: Axes,
    throws: Sequence[Throw],
    pushes: Sequence[Push],
    trigger_times_s: Sequence[float],
    leave_time_s: float,
) -> None:
    for throw in throws:
        axes.axvline(throw.time_s, color=INK, linewidth=1.0, linestyle=(0, (1, 2)))
    for push in pushes:
        axes.axvspan(
            push.time_s,
            push.time_s + push.duration_s,
            color=BALL_COLOUR,
            alpha=0.25,
            linewidth=0,
            zorder=0,
        )
    for instant in trigger_times_s:
        axes.axvline(instant, color=UNSAFE_COLOUR, linewidth=1.2)
    if math.isfinite(leave_time_s):
        axes.axvline(leave_time_s, color=INK, linewidth=1.2, linestyle=(0, (4, 2)))


def _annotate_recovery(axes: Axes, interval_s: tuple[float, float]) -> None:
    start, end = interval_s
    axes.axvspan(start, end, color=RECOVERY_COLOUR, alpha=0.14, linewidth=0, zorder=0)
    # Lines to stills lead up and to the right from Γ at the trigger.
    axes.annotate(
        "recovery steps",
        (end, 0.2),
        xytext=(-6, 0),
        textcoords="offset points",
        ha="right",
        color=RECOVERY_COLOUR,
        fontsize=9,
    )


def _annotate_throw(axes: Axes, time_s: np.ndarray, throw: Throw) -> None:
    axes.plot(
        throw.time_s, _BALL_HEIGHT, "o", color=BALL_COLOUR, markersize=9, clip_on=False, zorder=5
    )
    words = f"{throw.mass_kg:.1f} kg, {throw.speed_m_s:.1f} m/s"
    _write_before(axes, time_s, throw.time_s, words)


def _annotate_push(axes: Axes, time_s: np.ndarray, push: Push) -> None:
    words = f"push of {push.strength_n:.0f} N for {push.duration_s:g} s"
    _write_before(axes, time_s, push.time_s, words)


def _write_before(axes: Axes, time_s: np.ndarray, instant_s: float, words: str) -> None:
    # Left of the instant, if there is room.
    is_early = instant_s - time_s[0] < 0.15 * (time_s[-1] - time_s[0])
    axes.annotate(
        words,
        (instant_s, _BALL_HEIGHT),
        xytext=(8 if is_early else -8, 0),
        textcoords="offset points",
        ha="left" if is_early else "right",
        va="center",
        fontsize=9,
    )


def _annotate_trigger(
    axes: Axes, time_s: np.ndarray, place: tuple[float, float], words: str
) -> None:
    axes.plot(*place, "v", color=UNSAFE_COLOUR, markersize=8, zorder=5)
    _write_after(axes, time_s, (place[0], 0.75), words, UNSAFE_COLOUR)


def _annotate_leaving(axes: Axes, time_s: np.ndarray, instant_s: float) -> None:
    _write_after(axes, time_s, (instant_s, 0.15), "leaves the safe set", INK)


def _write_after(
    axes: Axes, time_s: np.ndarray, place: tuple[float, float], words: str, colour: str
) -> None:
    # Right of the instant, if there is room.
    is_late = time_s[-1] - place[0] < 0.15 * (time_s[-1] - time_s[0])
    axes.annotate(
        words,
        place,
        xytext=(-5 if is_late else 5, 0),
        textcoords="offset points",
        ha="right" if is_late else "left",
        color=colour,
        fontsize=9,
    )


def _draw_still(axes: Axes, image: np.ndarray, title: str) -> None:
    axes.imshow(image, interpolation="antialiased")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.set_title(title, fontsize=10, pad=4)


def _join(fig: Figure, picture: Axes, gamma_axes: Axes, point: tuple[float, float]) -> None:
    """Draws a line from the lower edge of an image to its point on the curve of Γ."""
    from matplotlib.patches import ConnectionPatch

    line = ConnectionPatch(
        xyA=(0.5, 0.0),
        coordsA=picture.transAxes,
        xyB=point,
        coordsB=gamma_axes.transData,
        color=FAINT_INK,
        linewidth=0.9,
    )
    line.set_in_layout(False)
    fig.add_artist(line)
    gamma_axes.plot(*point, "o", color="white", markeredgecolor=INK, markersize=6, zorder=6)
