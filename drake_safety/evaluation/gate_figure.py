"""The difference of two loops over the number of pairs, with its confidence sequence."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from drake_safety.evaluation import figure_style as style
from drake_safety.evaluation.loop_comparison import BETTER, NOT_WORSE, WORSE, Verdict

_COLOURS = {WORSE: style.UNSAFE_COLOUR, BETTER: style.SAFE_COLOUR, NOT_WORSE: style.SAFE_COLOUR}


def gate_figure(verdicts: Mapping[str, Verdict]) -> Figure:
    """Plots the verdict on each candidate by name, a panel each."""
    with style.drawing_style():
        fig = style.new_figure(7.5, 0.6 + 2.4 * len(verdicts))
        panels = fig.subplots(len(verdicts), 1, squeeze=False)[:, 0]
        for axes, (name, verdict) in zip(panels, verdicts.items(), strict=True):
            looks, colour = verdict.difference, _COLOURS.get(verdict.verdict, style.FAINT_INK)
            pairs, bound = [look.n for look in looks], 100.0 * verdict.worse_by
            low, mean, high = 100.0 * np.array([[x.low, x.value, x.high] for x in looks]).T
            axes.fill_between(pairs, low, high, color=colour, alpha=0.2, linewidth=0)
            axes.plot(pairs, mean, color=colour, linewidth=1.8, marker="o", markersize=2.5)
            axes.axhline(0.0, color=style.FAINT_INK, linewidth=0.8)
            style.draw_threshold(axes, bound, style.INK)
            # The first looks exclude little.
            ends = [*mean, 0.0, bound, low[-1], high[-1]]
            room = 0.4 * (max(ends) - min(ends))
            axes.set(xlim=(0, None), ylim=(min(ends) - room, max(ends) + room))
            title = f"{name}: {verdict.verdict} after {verdict.pairs} pairs"
            axes.set(title=title, ylabel="candidate − baseline\n[points]")
        panels[-1].set_xlabel("pairs of episodes")
    return fig
