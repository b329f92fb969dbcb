"""Rare failures beside random episodes, in one picture."""

import numpy as np
from matplotlib.figure import Figure

from drake_safety.evaluation import figure_style as style
from drake_safety.evaluation.rare_failures import RareFailures, Sample

_ACTING = ("ball ", "push ")  # Disturbances come first: they say more than the initial state.


def telling_facts(rare: RareFailures) -> list[str]:
    """The two quantities in which failures differ most from random episodes."""
    from scipy.stats import ks_2samp

    if not rare.failures:
        return []
    facts = [name for name in rare.random[0].facts if len(_distinct(rare.random, name)) > 1]
    acting = [name for name in facts if name.startswith(_ACTING)]
    apart = {
        name: ks_2samp(_values(rare.failures, name), _values(rare.random, name)).statistic
        for name in acting or facts
    }
    return sorted(apart, key=apart.__getitem__, reverse=True)[:2]


def rare_figure(rare: RareFailures, title: str) -> Figure:
    """Plots failures and random episodes over the two quantities in which they differ most."""
    names = telling_facts(rare)
    names = [names[0], names[-1]] if names else []
    with style.drawing_style():
        fig = style.new_figure(6.4, 4.8)
        axes = fig.subplots()
        x, y = (_values(rare.random, name) for name in names)
        label = f"{len(x)} random episodes"
        axes.scatter(x, y, s=10, color=style.UNKNOWN_COLOUR, linewidths=0, label=label)
        causes = dict.fromkeys(one.cause for one in rare.failures)
        for cause, colour in zip(causes, style.SERIES_COLOURS[1:], strict=False):
            own = [one for one in rare.failures if one.cause == cause]
            size = 30.0 + 400.0 * np.array([one.weight for one in own])
            x, y = (_values(own, name) for name in names)
            text = f"failures by {style.spoken(cause)}"
            axes.scatter(x, y, s=size, color=colour, alpha=0.7, linewidths=0, label=text)
        axes.set(title=title, xlabel=style.spoken(names[0]), ylabel=style.spoken(names[1]))
        text = f"rate {rare.rate.value:.1e} ({rare.rate.low:.1e} to {rare.rate.high:.1e})"
        axes.annotate(text, (0.0, 1.0), xycoords="axes fraction", va="bottom", fontsize=9)
        axes.title.set_position((0.0, 1.05))
        fig.legend(loc="outside lower center", ncols=2)
    return fig


def _values(samples: list[Sample], name: str) -> np.ndarray:
    return np.array([one.facts[name] for one in samples])


def _distinct(samples: list[Sample], name: str) -> np.ndarray:
    return np.unique(_values(samples, name).round(9))
