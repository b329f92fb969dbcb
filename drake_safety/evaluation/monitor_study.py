"""The change monitor on undisturbed motion: its alarms, and what Γ says until then.

A row is sure and wrong where Γ is confident in a motion that leaves the safe set within an
episode's duration. Rows since an alarm are "don't know". Motions follow each other: when one leaves
the safe set, the robot begins anew and the charts go on, as on a robot that is put on its feet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from drake_safety.evaluation.metrics import Estimate, proportion, rate_per_hour
from drake_safety.evaluation.shift_study import BOOTSTRAP, CONFIDENT, Judge, mean_over
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.change_detector import ChangeDetector, rows_of, usual_rows
from drake_safety.learning.segments import DIVERGED, Episode, Episodes
from drake_safety.simulation.rollouts import motion_batch
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import run_batches

SPANS_S = (10.0, 60.0)
"""Times since a change over which confident errors are counted [s]."""
_FIRST_S = 12.0  # Simulated of each motion; only those without an alarm go on.


@dataclass(frozen=True, kw_only=True)
class Sequence60:
    """One minute since a change.

    Attributes:
        alarm_s: Time of the first alarm [s]; infinite without one.
        leave_s: Time at which it first left the safe set [s]; infinite if it did not.
        error_s: Times of rows that are sure and wrong, before the alarm [s].
    """

    alarm_s: float
    leave_s: float
    error_s: np.ndarray


def run_monitored(
    scenario: Scenario,
    variation: str,
    num_motions: int,
    seed: int,
    detector: ChangeDetector,
    *,
    options: Mapping[str, Any] | None = None,
    num_workers: int | None = None,
) -> list[Episode]:
    """Simulates undisturbed motions of a plant; those without an alarm last a minute."""

    def simulated(indices: list[int], until_s: float) -> dict[int, Episode]:
        simulate = partial(
            motion_batch,
            scenario,
            variation,
            dict(options or {}),
            seed,
            until_s=until_s,
            with_features=True,
        )
        found = run_batches(simulate, indices, num_workers=num_workers, batch_size=1)
        return {one.index: one for one in found}

    motions = simulated([*range(num_motions)], _FIRST_S)
    quiet = [
        i
        for i, one in motions.items()
        if one.is_safe and not _alarms([rows_of(one)], detector).any()
    ]
    motions |= simulated(quiet, max(SPANS_S))
    return [motions[i] for i in sorted(motions) if motions[i].cause != DIVERGED]


def _alarms(rows: Sequence[np.ndarray], detector: ChangeDetector) -> np.ndarray:
    levels = detector.levels_of(rows).max(axis=1)
    return levels > detector.alarm_level


def sequences(
    motions: Sequence[Episode], assessment: SafetyAssessment, judge: Judge
) -> list[Sequence60]:
    """A sequence begins with each of the motions and goes on with those after it."""
    detector = assessment.detector_
    every = max(1, round(assessment.info_.step_s / detector.step_s))
    horizon = round(assessment.info_.num_steps * assessment.info_.step_s / detector.step_s)
    rows = [rows_of(one) for one in motions]
    wrong = []
    for one in motions:
        kept = np.arange(0, len(one.time_s), every)
        found = judge(
            one.state[kept],
            one.desired_preview[kept],
            one.features[kept],
            np.any(one.margins[kept] < 0.0, axis=1),
        )
        is_sure = (found.probability >= CONFIDENT) & ~found.is_unknown
        ends = len(one.time_s) - 1 - kept <= horizon
        wrong.append(one.time_s[kept[is_sure & ends & (not one.is_safe)]])
    result = []
    most = round(max(SPANS_S) / detector.step_s)
    for start in range(len(motions)):
        order, length = [], 0
        for i in (start + np.arange(len(motions))) % len(motions):
            order.append(int(i))
            length += len(rows[i])
            if length >= most:
                break
        alarms = _alarms([rows[i] for i in order], detector)[:most]
        alarm_s = float(np.argmax(alarms)) * detector.step_s if alarms.any() else np.inf
        begin = detector.step_s * np.cumsum([0, *(len(rows[i]) for i in order)])
        errors = np.concatenate([begin[k] + wrong[i] for k, i in enumerate(order)])
        leaves = [begin[k + 1] for k, i in enumerate(order) if not motions[i].is_safe]
        result.append(
            Sequence60(
                alarm_s=alarm_s,
                leave_s=min(leaves, default=np.inf),
                error_s=errors[errors < alarm_s],
            )
        )
    return result


def monitor_estimates(found: Sequence[Sequence60], step_s: float) -> dict[str, Estimate]:
    """Alarms, their delay, motions that leave the safe set, and Γ's confident errors until then.

    Args:
        step_s: Time between two judged rows [s].
    """
    each = np.arange(len(found))
    delay = np.array([one.alarm_s for one in found])
    estimates = {
        "monitor.alarmed": proportion(int(np.isfinite(delay).sum()), len(delay)),
        "monitor.leaves": proportion(sum(one.leave_s <= max(SPANS_S) for one in found), len(found)),
        "monitor.delay_s": quantile(delay, 0.5),
        "monitor.delay_95_s": quantile(delay, 0.95),
    }
    for span in SPANS_S:
        share = np.array([(one.error_s < span).sum() * step_s / span for one in found])
        estimates[f"monitor.confident_error_{span:g}s"] = mean_over(share, each)
    return estimates


def quantile(values: np.ndarray, share: float) -> Estimate:
    """A quantile of values, some infinite, with its interval."""

    def of(drawn: np.ndarray) -> float:
        return float(np.sort(drawn)[min(int(share * len(drawn)), len(drawn) - 1)])

    rng = np.random.default_rng(0)
    drawn = [
        of(values[rng.integers(len(values), size=len(values))])
        for _ in range(BOOTSTRAP.num_resamples)
    ]
    low, high = np.quantile(drawn, BOOTSTRAP.quantiles, method="nearest")
    return Estimate(of(values), float(low), float(high), len(values))


def false_alarms(motions: Episodes, detector: ChangeDetector) -> Estimate:
    """False alarms per hour on motions of the nominal plant, each judged anew.

    An alarm that goes on is one. Rows shortly before leaving the safe set do not count.
    """
    found = [_alarms([rows], detector) for rows in usual_rows(motions)]
    duration_s = detector.step_s * sum(map(len, found))
    return rate_per_hour(sum(bool(one.any()) for one in found), duration_s, len(motions))
