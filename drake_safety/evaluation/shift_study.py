"""Γ and its monitor under shifts: "don't know", rows sure and wrong (confident errors), alarms."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from drake_safety.evaluation import metrics
from drake_safety.evaluation.figure_style import spoken
from drake_safety.evaluation.metrics import Bootstrap, Estimate, mean, proportion, quantile
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.evaluation.tables import Column, Row, Table
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.calibration import MOTION, PLAN
from drake_safety.learning.causes import is_outside
from drake_safety.learning.change_detector import ChangeDetector, rows_of, usual_rows
from drake_safety.learning.segments import DIVERGED, Episode, Episodes
from drake_safety.robots.family import FAMILY
from drake_safety.simulation.rollouts import run_motion, worker_loop
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import map_items

SEEN = ("state", "desired_preview", "features")  # Ports that assessor and monitor read.
CONFIDENT = 0.9  # Least safety probability of a confident verdict.
BOOTSTRAP = Bootstrap(num_resamples=200)
SPANS_S = (10.0, 60.0)  # Times since a change over which confident errors are counted.
_FIRST_S = 12.0  # First part of each motion; only motions without an alarm continue.
_UNKNOWN = Column("unknown", "don't know", "=%", digits=1)
_ERROR = Column("confident_error", "sure and wrong", "=%", digits=1)
_AUC = Column("auc", "AUC", "=")
_COLUMNS = (
    ("", Column("unsafe", "unsafe", "=%", digits=1)),
    *(("gamma", one) for one in (_UNKNOWN, _ERROR, _AUC)),
    ("gamma", Column("missed_motion", "alarm missed", "=%", digits=1)),
    ("gamma", Column("missed_motion.family", "family's missed", "=%", digits=1)),
    ("paper", Column("unknown", "paper: don't know", "=%", digits=1)),
    *(("paper", one) for one in (_ERROR, _AUC)),
    ("monitor", Column("alarmed", "alarms", "=%", digits=0)),
    ("monitor", Column("delay_s", "after", "s", digits=1)),
    ("monitor", Column("delay_95_s", "95 %", "s", digits=1)),
    ("monitor", Column("confident_error_10s", "sure and wrong, 10 s with monitor", "=%", digits=1)),
    ("monitor", Column("confident_error_60s", "60 s", "=%", digits=1)),
)  # By method.
_MEANING = (
    "Shares of rows; sure and wrong: called safe with at least 0.9 in motions that end unsafely. "
    'AUC: of all rows, "don\'t know" the least safe. With monitor, motions follow each other, and '
    'rows after its alarm count as "don\'t know". Intervals are in shifts.json.'
)


def safety_probability(
    assessment: SafetyAssessment, episode: Episode, rows: np.ndarray | slice
) -> np.ndarray:
    """Γ of N rows as :class:`SafetyAssessor` computes it, (N,); NaN for "don't know"."""
    inputs = (getattr(episode, name)[rows] for name in SEEN)
    probability = assessment_scorer("gamma", assessment).probability(*inputs)
    is_unsafe = is_outside(episode.margins[rows]) & ~np.isnan(probability)
    return np.where(is_unsafe, 0.0, probability)


def shift_estimates(
    assessments: Mapping[str, SafetyAssessment], episodes: Episodes
) -> dict[tuple[str, str], Estimate]:
    """Shares of rows sure and wrong and "don't know", and the AUC, by name of Γ and metric.

    "missed_KEY" is the share of unsafe episodes that the thresholds of a calibration call safe.
    """
    kept = [one for one in episodes if one.cause != DIVERGED]
    motion = np.repeat(np.arange(len(kept)), [len(one.state) - one.first_step for one in kept])
    is_unsafe = np.array([not one.is_safe for one in kept])
    estimates = {("", "unsafe"): proportion(int(is_unsafe.sum()), len(is_unsafe))}
    for name, gamma in assessments.items():
        rows = [safety_probability(gamma, one, slice(one.first_step, None)) for one in kept]
        probability = np.concatenate(rows)
        is_wrong = (probability >= CONFIDENT) & is_unsafe[motion]
        estimates[name, "confident_error"] = mean(is_wrong, motion, bootstrap=BOOTSTRAP)
        estimates[name, "unknown"] = mean(np.isnan(probability), motion, bootstrap=BOOTSTRAP)
        # The last row of an unsafe episode is outside the safe set.
        inside = [one[: max(len(one) - 1, 1)] for one in rows]
        least = {PLAN: [one[0] for one in rows], MOTION: [one.min() for one in inside]}
        for key, one in gamma.calibrations_.items() if is_unsafe.any() else ():
            is_missed = (np.array(least[one.kind]) >= one.threshold)[is_unsafe]  # False for NaN.
            estimates[name, f"missed_{key}"] = proportion(int(is_missed.sum()), len(is_missed))
        if 0 < is_unsafe.sum() < len(is_unsafe):
            score = 1.0 - np.nan_to_num(probability)
            estimates[name, "auc"] = metrics.auc(score, is_unsafe[motion], motion)
    return estimates


def run_monitored(
    scenario: Scenario,
    variation: str,
    num_motions: int,
    seed: int,
    detector: ChangeDetector,
    *,
    options: Mapping[str, Any],
    num_workers: int | None = None,
) -> list[Episode]:
    """Simulates undisturbed motions of a plant; a motion without an alarm lasts a minute."""
    make = worker_loop(scenario, variation, **options)

    def simulated(indices: list[int], until_s: float) -> dict[int, Episode]:
        run = partial(run_motion, seed=seed, until_s=until_s, with_features=True)
        motions = map_items(run, indices, make=make, num_workers=num_workers, batch_size=1)
        return {one.index: one for one in motions}

    motions = simulated([*range(num_motions)], _FIRST_S)
    safe = {i: rows_of(one) for i, one in motions.items() if one.is_safe}
    quiet = [i for i, rows in safe.items() if not detector.watch([rows])[1]]
    motions |= simulated(quiet, max(SPANS_S))
    return [motions[i] for i in sorted(motions) if motions[i].cause != DIVERGED]


class Minute(NamedTuple):
    """Times in a minute that begins with a motion and continues with the next; infinite: never."""

    alarm_s: float
    error_s: list[float]  # Confident errors in the first 10 s and 60 s, outside alarms.


def monitored(motions: Sequence[Episode], assessment: SafetyAssessment) -> list[Minute]:
    """Judges the minute that begins with each motion, by the monitor and Γ."""
    detector = assessment.detector_
    rows = [rows_of(one) for one in motions]
    info = assessment.info_
    every = max(1, round(info.step_s / detector.step_s))
    horizon = round(info.num_steps * info.step_s / detector.step_s)
    wrong_rows = []
    for one in motions:
        # Rows within an episode's duration of leaving the safe set; none of a motion that stays.
        last = np.arange(0, len(one.time_s), every)
        last = last[(len(one.time_s) - 1 - last <= horizon) & (not one.is_safe)]
        wrong_rows.append(last[safety_probability(assessment, one, last) >= CONFIDENT])
    most = round(max(SPANS_S) / detector.step_s)
    minutes = []
    for start in range(len(motions)):
        order = np.roll(np.arange(len(motions)), -start).tolist()
        begin = np.cumsum([0, *(len(rows[i]) for i in order)])
        order = order[: np.searchsorted(begin[1:], most) + 1]
        _, alarms = detector.watch([rows[i] for i in order])
        is_alarm = np.zeros(begin[len(order)], dtype=bool)
        for alarm in alarms:
            is_alarm[alarm.begin : alarm.end] = True
        wrong = np.concatenate([begin[k] + wrong_rows[i] for k, i in enumerate(order)])
        wrong_s = detector.step_s * wrong[~is_alarm[wrong]]
        error_s = [every * detector.step_s * (wrong_s < span).sum() for span in SPANS_S]
        first = min((one.begin for one in alarms), default=most)
        minutes.append(Minute(first * detector.step_s if first < most else np.inf, error_s))
    return minutes


def monitor_estimates(minutes: Sequence[Minute]) -> dict[str, Estimate]:
    """Alarms, their delay, and shares of Γ's confident errors outside alarms since a change."""
    delay_s = np.array([one.alarm_s for one in minutes])
    estimates = {
        "alarmed": proportion(int(np.isfinite(delay_s).sum()), len(delay_s)),
        "delay_s": quantile(delay_s, 0.5, bootstrap=BOOTSTRAP),
        "delay_95_s": quantile(delay_s, 0.95, bootstrap=BOOTSTRAP),
    }
    shares = np.array([one.error_s for one in minutes]) / SPANS_S
    for span_s, share in zip(SPANS_S, shares.T, strict=True):
        error = mean(share, np.arange(len(minutes)), bootstrap=BOOTSTRAP)
        estimates[f"confident_error_{span_s:g}s"] = error
    return estimates


def false_alarms(motions: Episodes, detector: ChangeDetector) -> Estimate:
    """False alarms per hour on undisturbed motions, not shortly before they leave the safe set."""
    rows = [one for one in usual_rows(motions) if len(one)]
    count = sum(len(detector.watch([one])[1]) for one in rows)
    return metrics.rate_per_hour(count, sum(map(len, rows)) * detector.step_s, len(rows))


def shifts_tables(results: Results) -> list[Table]:
    """The table of all shifts, if there are any."""
    sets = dict.fromkeys(set for set, _, metric in results if metric == "unsafe")
    meaning = _MEANING
    for name in ("nominal", FAMILY):
        if false := results.get((f"shifts.{name}", "monitor", "false_alarms_per_hour")):
            meaning += (
                f" On {false.n} undisturbed motions, {name}, the monitor gives {false.value:.2f} "
                f"({false.low:.2f}–{false.high:.2f}) false alarms an hour."
            )
    there = {(method, metric) for _, method, metric in results}
    shown = [(method, one) for method, one in _COLUMNS if (method, one.key) in there]
    rows, columns = [], [column for _, column in shown]
    for set in sets:
        estimates = [results.get((set, method, column.key)) for method, column in shown]
        rows.append(Row("", spoken(set.removeprefix("shifts.")), estimates))
    options = {"title": "Γ under shifts", "meaning": meaning}
    return [Table(corner="shift", columns=columns, rows=rows, **options)] if rows else []
