"""The outcome of every throw in a polar plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_safety.evaluation.figure_style import (
    FAINT_INK,
    FALSE_ALARM_COLOUR,
    RECOVERY_COLOUR,
    SAFE_COLOUR,
    UNSAFE_COLOUR,
    drawing_style,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

OUTCOMES: dict[str, tuple[str, str]] = {
    "survived": (SAFE_COLOUR, "o"),
    "recovered": (RECOVERY_COLOUR, "^"),
    "false trigger": (FALSE_ALARM_COLOUR, "s"),
    "fell": (UNSAFE_COLOUR, "X"),
}
"""Colour and marker of each outcome of a throw."""

_FAILURES = ("fell", "false trigger")


def throws_figure(
    speed_m_s: np.ndarray,
    direction_rad: np.ndarray,
    outcomes: Mapping[str, Sequence[str]],
    *,
    mass_kg: np.ndarray | None = None,
) -> Figure:
    """Plots the outcome of every throw over the direction and speed of the ball, seen from above.

    Args:
        speed_m_s: Speeds [m/s], (N,).
        direction_rad: Directions of flight, from the robot's forward axis to its left [rad], (N,).
        outcomes: Per panel, its title and the outcome of every throw, a key of `OUTCOMES`.
        mass_kg: Masses [kg], (N,); heavier balls have larger marks.

    Raises:
        ValueError: An unknown outcome, or the number of outcomes differs from that of throws.
    """
    speed, direction = np.asarray(speed_m_s), np.asarray(direction_rad)
    for title, found in outcomes.items():
        if len(found) != len(speed):
            raise ValueError(
                f"throws_figure: '{title}' has {len(found)} outcomes for {len(speed)} throws"
            )
        unknown = sorted(set(found) - set(OUTCOMES))
        if unknown:
            raise ValueError(
                f"throws_figure: unknown outcomes {unknown}; the outcomes are {list(OUTCOMES)}"
            )
    size = np.full(len(speed), 22.0) if mass_kg is None else 8.0 * np.asarray(mass_kg)
    with drawing_style():
        fig = new_figure(4.9 * len(outcomes), 6.3)
        panels = fig.subplots(1, len(outcomes), subplot_kw={"projection": "polar"}, squeeze=False)
        for axes, (title, found) in zip(panels[0], outcomes.items(), strict=True):
            _draw_outcomes(axes, speed, direction, size, np.asarray(found))
            _dress_polar(axes, float(speed.max(initial=1.0)))
            axes.set_title(f"{title}, {len(found)} throws", pad=14)
            axes.legend(
                loc="upper center",
                bbox_to_anchor=(0.5, -0.07),
                ncols=2,
                handletextpad=0.2,
                columnspacing=1.2,
            )
        fig.supxlabel(
            "angle: direction of flight, seen from above; radius: speed of the ball",
            fontsize=9,
            color=FAINT_INK,
        )
    return fig


def _draw_outcomes(
    axes: Axes, speed: np.ndarray, direction: np.ndarray, size: np.ndarray, found: np.ndarray
) -> None:
    """Draws the marks of all throws; all arrays are (N,)."""
    for outcome, (colour, marker) in OUTCOMES.items():
        rows = found == outcome
        if rows.any():
            # Failures are few: larger marks, drawn on top.
            is_failure = outcome in _FAILURES
            axes.scatter(
                direction[rows],
                speed[rows],
                s=1.6 * size[rows] if is_failure else size[rows],
                color=colour,
                marker=marker,
                linewidths=0.4,
                edgecolors="white",
                label=f"{outcome} {rows.sum()}",
                zorder=4 if is_failure else 3,
                rasterized=True,
            )


def _dress_polar(axes: Any, fastest: float) -> None:
    axes.set_theta_zero_location("N")
    axes.set_xticks(np.arange(4) * np.pi / 2, ["forward", "left", "backward", "right"])
    axes.set_ylim(0.0, 1.05 * fastest)
    axes.set_yticks([tick for tick in (3, 6, 9, 12) if tick < 1.05 * fastest])
    axes.tick_params(axis="y", labelleft=False)
    for tick in axes.get_yticks():
        # Tick labels would lie below the marks.
        axes.text(
            np.pi / 4,
            tick,
            f"{tick:g} m/s",
            ha="center",
            va="center",
            fontsize=8,
            zorder=6,
            bbox={"boxstyle": "round,pad=0.15", "color": "white", "alpha": 0.8, "linewidth": 0},
        )
    axes.grid(color="#dfe2e5", linewidth=0.7)
    axes.spines["polar"].set_color("#dfe2e5")
    axes.set_axisbelow(True)
