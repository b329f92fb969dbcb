"""Falls that alarms announce, over all thresholds: at equal cost, and as curves.

An alarm announces a fall if its value falls below the threshold between the push and `EARLY_S`
before the fall. The cost of a threshold is the share of other pushed motions that have an alarm, or
the false alarms an hour on undisturbed motion. Methods are compared at the same cost.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drake_safety.evaluation import figure_style as style
from drake_safety.evaluation.metrics import Bootstrap, Estimate, rate_per_hour
from drake_safety.evaluation.results import Key
from drake_safety.simulation.motion import Motion
from studies.alarms import Alarm, equal_share_threshold

EARLY_S = 0.2
"""Time before a fall that an alarm should leave [s]."""
SHARES = (0.05, 0.1, 0.2, 0.34, 0.5)
"""Shares of other motions with an alarm, at which alarms are compared."""
COSTS = {
    "without_leaving": "never leave the safe set",
    "without_fall": "do not fall",
}
"""Other motions by key, and their description."""
_JUDGED = "without_leaving"  # Cost of the rows; the figure has all.
_LABELS = {"sharpened": "Γ", "fall": "probability of a fall"}
_BOOTSTRAP = Bootstrap()
_SLACK_S = 1e-9
_MOST_SHARE, _MOST_RATE = 0.6, 100.0  # Ends of the figure's axes; the rate an hour.


@dataclass(frozen=True, kw_only=True, eq=False)
class Watched:
    """An alarm's values in N pushed and in some undisturbed motions.

    Attributes:
        is_fall: Pushed motions with a fall, (N,).
        others: Pushed motions that should have no alarm, (N,), by key of `COSTS`.
        warning: Lowest value from the push until `EARLY_S` before the fall, (N,); infinite without
            a fall, and of one that comes earlier.
        lowest: Lowest value of each pushed motion, (N,).
        rows: Values of the rows of all undisturbed motions, sorted, (M,).
        pairs: The larger of each value and its predecessor, sorted, (M,).
        undisturbed_s: Duration of these motions [s].
        num_undisturbed: Their number.
    """

    is_fall: np.ndarray
    others: Mapping[str, np.ndarray]
    warning: np.ndarray
    lowest: np.ndarray
    rows: np.ndarray
    pairs: np.ndarray
    undisturbed_s: float
    num_undisturbed: int

    @classmethod
    def of(cls, alarm: Alarm, pushed: Sequence[Motion], undisturbed: Sequence[Motion]) -> Watched:
        """Returns an alarm's values."""
        warning, lowest = [], []
        for motion in pushed:
            value, time_s = _values(alarm, motion), motion.time_s
            is_in_time = time_s >= motion.push_time_s - _SLACK_S
            is_in_time &= time_s <= motion.fall_time_s - EARLY_S + _SLACK_S
            is_in_time &= motion.has_fallen
            warning.append(value[is_in_time].min(initial=math.inf))
            lowest.append(value.min())
        quiet = [_values(alarm, motion) for motion in undisturbed]
        before = [np.concatenate([[math.inf], value[:-1]]) for value in quiet]
        rows = np.concatenate([*quiet, np.zeros(0)])
        return cls(
            is_fall=np.array([motion.has_fallen for motion in pushed], dtype=bool),
            others={
                "without_leaving": np.array([not motion.has_left for motion in pushed], dtype=bool),
                "without_fall": np.array([not motion.has_fallen for motion in pushed], dtype=bool),
            },
            warning=np.array(warning),
            lowest=np.array(lowest),
            rows=np.sort(rows),
            pairs=np.sort(np.maximum(rows, np.concatenate([*before, np.zeros(0)]))),
            undisturbed_s=sum(float(motion.time_s[-1]) for motion in undisturbed),
            num_undisturbed=len(undisturbed),
        )

    def announced(self, cost: str, share: float) -> Callable[[np.ndarray], float]:
        """The share of falls announced if at most a share of the others has an alarm.

        Returns:
            A function of the weights of the pushed motions, (N,); NaN without falls or others.
        """
        falls, others = np.flatnonzero(self.is_fall), np.flatnonzero(self.others[cost])
        others = others[np.argsort(self.lowest[others])]
        # The others with an alarm at the lowest threshold that announces a fall.
        count = np.searchsorted(self.lowest[others], self.warning[falls], side="right")
        is_possible = self.warning[falls] < math.inf

        def statistic(weight: np.ndarray) -> float:
            alarmed = np.concatenate([[0.0], np.cumsum(weight[others])])
            total = weight[falls].sum()
            if total == 0.0 or alarmed[-1] == 0.0:
                return math.nan
            is_announced = is_possible & (alarmed[count] <= share * alarmed[-1] + 1e-9)
            return float(weight[falls] @ is_announced / total)

        return statistic

    def threshold(self, cost: str, share: float) -> float:
        """The highest threshold with which at most a share of the others has an alarm."""
        return equal_share_threshold(self.lowest[self.others[cost]], share)

    def num_false_alarms(self, threshold: np.ndarray | float, side: str = "left") -> np.ndarray:
        """Number of false alarms on undisturbed motion at thresholds, (...).

        An alarm is a row below a threshold, with side "right" not above it, after one that is not.
        """
        below, still = (np.searchsorted(one, threshold, side) for one in (self.rows, self.pairs))  # type: ignore[call-overload]
        return np.asarray(below - still)

    def share_costs(self, cost: str) -> np.ndarray:
        """The least share of others with an alarm that announces 1, 2, … falls, (num_falls,)."""
        warning, lowest = np.sort(self.warning[self.is_fall]), self.lowest[self.others[cost]]
        share = np.searchsorted(np.sort(lowest), warning, side="right") / max(len(lowest), 1)
        return np.where(warning < math.inf, share, math.inf)

    def rate_costs(self) -> np.ndarray:
        """The least false alarms an hour that announce 1, 2, … falls, (num_falls,)."""
        warning = np.sort(self.warning[self.is_fall])
        count = self.num_false_alarms(warning, "right")
        # A threshold among most values has fewer, longer alarms.
        rate = np.maximum.accumulate(count) / (self.undisturbed_s / 3600.0)
        return np.where(warning < math.inf, rate, math.inf)


def _values(alarm: Alarm, motion: Motion) -> np.ndarray:
    """The alarm's value of each row; NaN, "don't know", is below every threshold."""
    return np.nan_to_num(alarm.value(motion), nan=-math.inf)


def equal_cost_estimates(
    watched: Mapping[str, Sequence[Watched]], own: str, rival: str
) -> dict[Key, Estimate]:
    """Shares of falls announced at equal cost, a paired difference, and false alarms an hour.

    Intervals are over pushed motions.
    """
    estimates: dict[Key, Estimate] = {}
    for share in SHARES:
        at = f"at_{100 * share:.0f}"
        statistics = {
            name: [one.announced(_JUDGED, share) for one in seeds]
            for name, seeds in watched.items()
        }
        for name, seeds in watched.items():
            key = f"alarm.{_JUDGED}", name
            estimates[*key, f"announced_{at}"] = _over_motions(seeds[0], statistics[name])
            counts = [one.num_false_alarms(one.threshold(_JUDGED, share)) for one in seeds]
            estimates[*key, f"false_alarms_per_hour_{at}"] = rate_per_hour(
                float(np.mean(counts)), seeds[0].undisturbed_s, seeds[0].num_undisturbed
            )
        if {own, rival} <= watched.keys():
            estimates[f"alarm.{_JUDGED}", f"{own}_minus_{rival}", f"announced_{at}"] = (
                _over_motions(watched[own][0], statistics[own], statistics[rival])
            )
    return estimates


def _over_motions(
    watched: Watched,
    plus: Sequence[Callable[[np.ndarray], float]],
    minus: Sequence[Callable[[np.ndarray], float]] = (),
) -> Estimate:
    """The mean of statistics of weights less that of others, with its bootstrap interval."""

    def statistic(weight: np.ndarray) -> float:
        less = np.mean([one(weight) for one in minus]) if minus else 0.0
        return float(np.mean([one(weight) for one in plus]) - less)

    return _BOOTSTRAP.over_episodes(statistic, np.arange(len(watched.lowest)))


def alarm_figure(watched: Mapping[str, Sequence[Watched]]) -> Figure:
    """Plots falls announced over each cost: means over seeds, and each seed as a thin line."""
    grid = np.linspace(0.0, _MOST_SHARE, 601)
    any_one = next(iter(watched.values()))[0]
    with style.drawing_style():
        fig = style.new_figure(12.0, 4.6)
        *panels, last = fig.subplots(1, len(COSTS) + 1, sharey=True)
        for axes, (cost, what) in zip(panels, COSTS.items(), strict=True):
            costs = {
                name: [one.share_costs(cost) for one in seeds] for name, seeds in watched.items()
            }
            _draw(axes, costs, grid)
            axes.set_title(f"{any_one.others[cost].sum()} pushes that {what}")
            axes.set_xlabel("share of them with an alarm [%]")
            axes.set_xticks(SHARES, [f"{100 * share:.0f}" for share in SHARES])
            axes.set_xlim(0.0, _MOST_SHARE)
        rates = np.concatenate([[0.0], np.geomspace(0.01, _MOST_RATE, 600)])
        costs = {name: [one.rate_costs() for one in seeds] for name, seeds in watched.items()}
        _draw(last, costs, rates)
        last.set_xscale("symlog", linthresh=1.0)
        last.set_xlim(0.0, _MOST_RATE)
        last.set_xticks([0, 1, 10, 100], ["0", "1", "10", "100"])
        last.set_title(f"{any_one.undisturbed_s / 3600.0:.1f} h undisturbed")
        last.set_xlabel("false alarms an hour")
        num_falls = any_one.is_fall.sum()
        panels[0].set_ylabel(f"announced ≥ {EARLY_S} s ahead of {num_falls} falls [%]")
        panels[0].set_ylim(0.0, 1.02)
        panels[0].set_yticks(np.linspace(0, 1, 6), [f"{y:.0f}" for y in np.linspace(0, 100, 6)])
        fig.legend(
            *last.get_legend_handles_labels(), loc="outside lower center", ncols=len(watched)
        )
    return fig


def _draw(axes: Axes, costs: Mapping[str, Sequence[np.ndarray]], grid: np.ndarray) -> None:
    looks = zip(style.SERIES_COLOURS, style.SERIES_DASHES, strict=True)
    for (name, seeds), (colour, dashes) in zip(costs.items(), looks, strict=False):
        shares = [np.searchsorted(one, grid, side="right") / max(len(one), 1) for one in seeds]
        if len(shares) > 1:
            axes.plot(grid, np.transpose(shares), color=colour, linewidth=0.6, alpha=0.5)
        axes.plot(
            grid,
            np.mean(shares, axis=0),
            color=colour,
            linestyle=dashes,
            linewidth=2.4 if name == "sharpened" else 1.6,
            label=_LABELS.get(name, style.label_of(name)),
        )
    axes.grid(color="#eceef0", linewidth=0.7)
