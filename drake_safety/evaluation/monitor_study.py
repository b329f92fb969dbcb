"""The change monitor on undisturbed motion: its alarms, and what Γ says until then.

A row is sure and wrong where Γ is confident in a motion that leaves the safe set within an
episode's duration, and there is no alarm: rows during one are "don't know", as with ``on_alarm:
unknown``. Motions follow each other: when one leaves the safe set, the robot begins anew and the
charts go on, as on a robot that is put on its feet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from drake_safety.evaluation.metrics import Estimate, mean, proportion, quantile, rate_per_hour
from drake_safety.evaluation.shift_study import BOOTSTRAP, CONFIDENT, Judge
from drake_safety.learning import causes
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.calibration import Calibration
from drake_safety.learning.change_detector import ChangeDetector, rows_of, usual_rows
from drake_safety.learning.segments import DIVERGED, Episode, Episodes
from drake_safety.simulation.rollouts import run_motion, worker_loop
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import map_items

SPANS_S = (10.0, 60.0)
"""Times since a change over which confident errors are counted [s]."""
_FIRST_S = 12.0  # Simulated of each motion; only those without an alarm go on.


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
    make = worker_loop(scenario, variation, **(options or {}))

    def simulated(indices: list[int], until_s: float) -> dict[int, Episode]:
        run = partial(make.run, run_motion, seed=seed, until_s=until_s, with_features=True)
        found = map_items(run, indices, num_workers=num_workers, batch_size=1)
        return {one.index: one for one in found}

    motions = simulated([*range(num_motions)], _FIRST_S)
    quiet = [
        i for i, one in motions.items() if one.is_safe and not detector.watch([rows_of(one)])[1]
    ]
    motions |= simulated(quiet, max(SPANS_S))
    return [motions[i] for i in sorted(motions) if motions[i].cause != DIVERGED]


def monitored(
    motions: Sequence[Episode], assessment: SafetyAssessment, judge: Judge
) -> dict[str, np.ndarray]:
    """What happens in the minute that begins with each of M motions and goes on with those after.

    Returns:
        "alarm_s", the time of the first alarm, "leave_s", that of first leaving the safe set, both
        infinite without one, (M,) [s]; the durations of confident errors in the first 10 s and
        60 s, "error_s" outside alarms and "silent_error_s" without a monitor, (M, 2) [s]; "least",
        the least probability in the last episode's duration of a motion that leaves the safe set,
        NaN for others, (M,).
    """
    detector, info = assessment.detector_, assessment.info_
    every = max(1, round(info.step_s / detector.step_s))
    horizon = round(info.num_steps * info.step_s / detector.step_s)
    rows = [rows_of(one) for one in motions]
    judged = [_sure_and_wrong(one, judge, every, horizon) for one in motions]
    most = round(max(SPANS_S) / detector.step_s)
    found: dict[str, Any] = {n: [] for n in ("alarm_s", "leave_s", "error_s", "silent_error_s")}
    for start in range(len(motions)):
        order = np.roll(np.arange(len(motions)), -start).tolist()
        begin = np.cumsum([0, *(len(rows[i]) for i in order)])
        order = order[: np.searchsorted(begin[1:], most) + 1]
        _, alarms = detector.watch([rows[i] for i in order])
        is_alarm = np.zeros(begin[len(order)], dtype=bool)
        for alarm in alarms:
            is_alarm[alarm.begin : alarm.end] = True
        wrong = np.concatenate([begin[k] + judged[i][0] for k, i in enumerate(order)])
        leaves = [begin[k + 1] for k, i in enumerate(order) if not motions[i].is_safe]
        for name, at in (("alarm_s", [one.begin for one in alarms]), ("leave_s", leaves)):
            row = min(at, default=most)
            found[name].append(row * detector.step_s if row < most else np.inf)
        for name, errors in (("error_s", wrong[~is_alarm[wrong]]), ("silent_error_s", wrong)):
            times = detector.step_s * errors
            found[name].append([every * detector.step_s * (times < span).sum() for span in SPANS_S])
    found["least"] = [least for _, least in judged]
    return {name: np.array(values) for name, values in found.items()}


def _sure_and_wrong(
    motion: Episode, judge: Judge, every: int, horizon: int
) -> tuple[np.ndarray, float]:
    """Rows that are sure and wrong, and the least probability of judged rows that can be wrong."""
    rows = np.arange(0, len(motion.time_s), every)
    if motion.is_safe:
        return rows[:0], np.nan
    rows = rows[len(motion.time_s) - 1 - rows <= horizon]
    is_outside = causes.is_outside(motion.margins[rows])
    seen = motion.state[rows], motion.desired_preview[rows], motion.features[rows]
    probability = np.nan_to_num(judge(*seen, is_outside))
    return rows[probability >= CONFIDENT], float(min(probability[~is_outside], default=0.0))


def monitor_estimates(
    found: Mapping[str, np.ndarray], promise: Calibration | None = None
) -> dict[str, Estimate]:
    """Alarms, their delay, motions that leave the safe set, and Γ's confident errors.

    Args:
        found: What `monitored` returns.
        promise: A promise for motions, if there is one. Of the motions that leave the safe set,
            "silent_missed" are those whose probability is never below its threshold; "missed" are
            those without an alarm until then.
    """
    each, delay = np.arange(len(found["alarm_s"])), found["alarm_s"]
    estimates = {
        "monitor.alarmed": proportion(int(np.isfinite(delay).sum()), len(delay)),
        "monitor.leaves": proportion(int(np.isfinite(found["leave_s"]).sum()), len(delay)),
        "monitor.delay_s": quantile(delay, 0.5, bootstrap=BOOTSTRAP),
        "monitor.delay_95_s": quantile(delay, 0.95, bootstrap=BOOTSTRAP),
    }
    for i, span in enumerate(SPANS_S):
        for name in ("", "silent_"):
            share = mean(found[f"{name}error_s"][:, i] / span, each, bootstrap=BOOTSTRAP)
            estimates[f"monitor.{name}confident_error_{span:g}s"] = share
    unsafe = int(np.isfinite(found["least"]).sum())
    if promise is not None and unsafe:
        is_missed = found["least"] >= promise.threshold
        missed = {"silent_missed": is_missed, "missed": is_missed & (delay > found["leave_s"])}
        for name, of in missed.items():
            estimates[f"monitor.{name}"] = proportion(int(of.sum()), unsafe)
    return estimates


def false_alarms(motions: Episodes, detector: ChangeDetector) -> Estimate:
    """False alarms per hour on motions of the nominal plant, each judged anew.

    Rows shortly before leaving the safe set do not count.
    """
    rows = [one for one in usual_rows(motions) if len(one)]
    count = sum(len(detector.watch([one])[1]) for one in rows)
    return rate_per_hour(count, sum(map(len, rows)) * detector.step_s, len(rows))
