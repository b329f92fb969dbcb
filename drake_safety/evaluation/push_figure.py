"""The pushes that robots survive, around the robot."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes

from drake_safety.evaluation import figure_style as style
from drake_safety.evaluation.push_card import PushCard


def push_figure(cards: Mapping[str, PushCard]) -> Figure:
    """Plots impulses over directions: of the first card all phases, of others the worst one.

    The angle is the force's direction: ahead is at the top, left is at the left.
    """
    first = next(iter(cards.values()))
    with style.drawing_style():
        fig = style.new_figure(7.6, 5.6)
        axes = fig.add_subplot(projection="polar")
        assert isinstance(axes, PolarAxes)
        axes.set_theta_zero_location("N")
        for colour, dash, (name, card) in zip(
            style.SERIES_COLOURS, style.SERIES_DASHES, cards.items(), strict=False
        ):
            impulses = card.grid("survived_n_s")
            has_phases, label = impulses.shape[1] > 1, f"{name}, " if len(cards) > 1 else ""
            worst = "worst phase of the gait" if has_phases else "largest survived"
            _draw(axes, impulses.min(axis=1), colour, dash, f"{label}{worst}", width=2.2)
            if card is first and has_phases:
                best, middle = impulses.max(axis=1), np.median(impulses, axis=1)
                _draw(axes, best, colour, "-", f"{label}best phase", width=0.7)
                _draw(axes, middle, colour, ":", f"{label}median phase", width=1.4)
                angles = _angles(len(best))
                low, high = _closed(impulses.min(axis=1)), _closed(best)
                axes.fill_between(angles, low, high, color=colour, alpha=0.15, linewidth=0)
        foreseen = first.grid("foreseen_n_s")
        if np.isfinite(foreseen).any():
            middle = np.median(foreseen, axis=1)
            middle[~np.isfinite(middle)] = math.nan
            text = "Γ: a failure is likelier than not"
            text += " (median phase)" * (foreseen.shape[1] > 1)
            _draw(axes, middle, style.INK, (0, (3, 2)), text, width=1.6)
        axes.set_ylim(0.0, None)
        axes.set_xticks(np.arange(8) * math.pi / 4)
        axes.set_xticklabels(["ahead", "", "left", "", "back", "", "right", ""])
        axes.tick_params(axis="y", labelsize=8, labelcolor=style.FAINT_INK)
        axes.grid(color=style.UNKNOWN_COLOUR, linewidth=0.7)
        axes.spines["polar"].set_visible(False)
        axes.set_rlabel_position(22.5)
        plan, body = first.plan, style.spoken(first.plan.body)
        axes.set_title(f"Survived pushes of {plan.duration_s:g} s on {body} [N·s]", pad=18)
        fig.legend(loc="outside lower center", ncols=2)
    return fig


def _angles(number: int) -> np.ndarray:
    return np.linspace(0.0, 2.0 * math.pi, number + 1)


def _closed(values: np.ndarray) -> np.ndarray:
    return np.append(values, values[:1])


def _draw(
    axes: PolarAxes, values: np.ndarray, colour: str, dash: Any, label: str, width: float
) -> None:
    """Draws a closed curve over directions (n,)."""
    x, y = _angles(len(values)), _closed(values)
    axes.plot(x, y, color=colour, linestyle=dash, linewidth=width, label=label)
