"""Falls that alarms announce at equal cost.

An alarm announces a fall if its value falls below the threshold between the push and `EARLY_S`
before the fall. The cost of a threshold is the share of the pushed motions inside the safe set that
have an alarm. Methods are compared at the same cost.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_safety.evaluation.metrics import Bootstrap, Estimate, rate_per_hour
from drake_safety.evaluation.results import Key
from drake_safety.simulation.motion import Motion
from studies.alarms import Alarm, equal_share_threshold

EARLY_S = 0.2
"""Time before a fall that an alarm should leave [s]."""
SHARES = (0.05, 0.1, 0.2, 0.34, 0.5)
"""Shares of other motions with an alarm, at which alarms are compared."""
_SET = "alarm.without_leaving"
_BOOTSTRAP = Bootstrap()
_SLACK_S = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Watched:
    """An alarm's values in N pushed and in some undisturbed motions.

    Attributes:
        is_fall: Pushed motions with a fall, (N,).
        others: Pushed motions that never leave the safe set, and should have no alarm, (N,).
        warning: Lowest value from the push until `EARLY_S` before the fall, (N,); infinite without
            a fall, and of one that comes earlier.
        lowest: Lowest value of each pushed motion, (N,).
        undisturbed: Values of the rows of each undisturbed motion.
        undisturbed_s: Duration of these motions [s].
    """

    is_fall: np.ndarray
    others: np.ndarray
    warning: np.ndarray
    lowest: np.ndarray
    undisturbed: list[np.ndarray]
    undisturbed_s: float

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
        return cls(
            is_fall=np.array([motion.has_fallen for motion in pushed], dtype=bool),
            others=np.array([not motion.has_left for motion in pushed], dtype=bool),
            warning=np.array(warning),
            lowest=np.array(lowest),
            undisturbed=[_values(alarm, motion) for motion in undisturbed],
            undisturbed_s=sum(float(motion.time_s[-1]) for motion in undisturbed),
        )

    def announced(self, share: float) -> Callable[[np.ndarray], float]:
        """The share of falls announced if at most a share of the others has an alarm.

        Returns:
            A function of the weights of the pushed motions, (N,); NaN without falls or others.
        """
        falls, others = np.flatnonzero(self.is_fall), np.flatnonzero(self.others)
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

    def threshold(self, share: float) -> float:
        """The highest threshold with which at most a share of the others has an alarm."""
        return equal_share_threshold(self.lowest[self.others], share)

    def num_false_alarms(self, threshold: float) -> int:
        """Number of rows of undisturbed motion below a threshold, each after one that is not."""
        is_below = [np.concatenate([[False], one < threshold]) for one in self.undisturbed]
        return sum(int(np.sum(one[1:] & ~one[:-1])) for one in is_below)


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
            name: [one.announced(share) for one in seeds] for name, seeds in watched.items()
        }
        for name, seeds in watched.items():
            key = _SET, name
            estimates[*key, f"announced_{at}"] = _over_motions(seeds[0], statistics[name])
            counts = [one.num_false_alarms(one.threshold(share)) for one in seeds]
            estimates[*key, f"false_alarms_per_hour_{at}"] = rate_per_hour(
                float(np.mean(counts)), seeds[0].undisturbed_s, len(seeds[0].undisturbed)
            )
        if {own, rival} <= watched.keys():
            estimates[_SET, f"{own}_minus_{rival}", f"announced_{at}"] = _over_motions(
                watched[own][0], statistics[own], statistics[rival]
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
