"""Γ under shifts: how often it says "don't know" or is sure and wrong, and when the monitor alarms.

A row is sure and wrong (a confident error) where it is called safe with at least 0.9, with a belief
that is not "don't know", in a motion that ends unsafely. Figures "with monitor" count rows after
its alarm as "don't know": so it is with ``on_alarm: unknown``, while with ``on_alarm: report`` the
alarm changes no belief.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from drake_safety.evaluation.figure_style import spoken
from drake_safety.evaluation.interval_figure import interval_figure
from drake_safety.evaluation.metrics import Bootstrap, Estimate, auc, mean, proportion
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.evaluation.tables import Column, Table, rows_of
from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.causes import is_outside
from drake_safety.learning.segments import DIVERGED, RECORDED, Episode, Episodes

SEEN = ("state", "desired_preview", "features")
"""Output ports that are inputs of assessor and monitor."""
CONFIDENT = 0.9
"""Least safety probability of a confident verdict."""
BOOTSTRAP = Bootstrap(num_resamples=200)
_COLUMNS = (
    Column("unsafe", "unsafe", "=%", digits=1),
    Column("gamma.unknown", "don't know", "=%", digits=1),
    Column("gamma.confident_error", "sure and wrong", "=%", digits=1),
    Column("gamma.auc", "AUC", "="),
    Column("paper.unknown", "paper: don't know", "=%", digits=1),
    Column("paper.confident_error", "sure and wrong", "=%", digits=1),
    Column("paper.auc", "AUC", "="),
    Column("monitor.alarmed", "alarms", "=%", digits=0),
    Column("monitor.delay_s", "after", "s", digits=1),
    Column("monitor.delay_95_s", "95 %", "s", digits=1),
    Column("monitor.confident_error_10s", "sure and wrong, 10 s with monitor", "=%", digits=1),
    Column("monitor.confident_error_60s", "60 s", "=%", digits=1),
)
_MEANING = (
    'Shares of rows; sure and wrong: called safe with at least 0.9, not "don\'t know", in motions '
    'that end unsafely. AUC: of all rows, "don\'t know" the least safe. With monitor, motions '
    'follow each other, and rows after its alarm count as "don\'t know": with `on_alarm: report` '
    "the alarm does not do that. Intervals are in shifts.json."
)


MotionSet = tuple[str, list[Episode]]
"""Kind of a shift, "nominal", "plant" or "sensor", and motions under it."""
Judge = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Maps N states, previews, features, and whether each row is outside the safe set, to safety
probabilities (N,), NaN for "don't know"."""


def motions_of(episodes: Episodes) -> list[Episode]:
    """The rows of episodes from the first undisturbed one; those that diverged are left out."""
    motions = []
    for one in (one for one in episodes if one.cause != DIVERGED):
        rows = {name: getattr(one, name)[one.first_step :] for name in ("time_s", *RECORDED)}
        motions.append(replace(one, **rows, first_step=0))
    return motions


def assessment_judge(assessment: SafetyAssessment) -> Judge:
    """Γ as a :class:`SafetyAssessor` with the port ``margins`` computes it."""
    probability_of = assessment_scorer("gamma", assessment).probability

    def judge(*rows: np.ndarray) -> np.ndarray:
        *seen, is_outside = rows
        probability = probability_of(*seen)
        return np.where(is_outside & ~np.isnan(probability), 0.0, probability)

    return judge


class JudgedShift:
    """The verdicts of methods by name, of which "gamma" is Γ, on M motions with N rows in all.

    Attributes:
        probability: Safety probability of every row by method, NaN for "don't know", (N,).
        motion: Motion of each row, (N,).
        is_unsafe: Whether each motion ends unsafely, (M,).
    """

    def __init__(self, judges: Mapping[str, Judge], motions: Sequence[Episode]):
        rows = [np.concatenate([getattr(one, name) for one in motions]) for name in SEEN]
        rows.append(np.concatenate([is_outside(one.margins) for one in motions]))
        self.probability = {name: judge(*rows) for name, judge in judges.items()}
        self.motion = np.repeat(np.arange(len(motions)), [len(one.state) for one in motions])
        self.is_unsafe = np.array([not one.is_safe for one in motions])

    def is_wrong(self, name: str) -> np.ndarray:
        """Whether a method is sure and wrong in each row, (N,)."""
        return (self.probability[name] >= CONFIDENT) & self.is_unsafe[self.motion]


def shift_estimates(judged: JudgedShift) -> dict[str, Estimate]:
    """Shares of rows sure and wrong and "don't know", and the AUC of all rows, of each method.

    "Don't know" counts as the lowest probability. Intervals are over motions.
    """
    is_unsafe, motion = judged.is_unsafe, judged.motion
    found = {"unsafe": proportion(int(is_unsafe.sum()), len(is_unsafe))}
    for name, probability in judged.probability.items():
        found[f"{name}.confident_error"] = mean(judged.is_wrong(name), motion, bootstrap=BOOTSTRAP)
        found[f"{name}.unknown"] = mean(np.isnan(probability), motion, bootstrap=BOOTSTRAP)
        if 0 < is_unsafe.sum() < len(is_unsafe):
            score = 1.0 - np.nan_to_num(probability)
            found[f"{name}.auc"] = auc(score, is_unsafe[motion], motion)
    return found


def evaluate_shifts(
    sets: Mapping[str, MotionSet],
    judges: Mapping[str, Judge],
    progress: StageProgress,
    more: Callable[[JudgedShift], Mapping[str, Estimate]] = lambda judged: {},
) -> dict[str, Estimate]:
    """Estimates of every shift by dotted key.

    Judges are methods by name; "gamma" is Γ.
    """
    found: dict[str, Estimate] = {}
    for i, (name, (_, motions)) in enumerate(sets.items()):
        progress("shifts", i, len(sets))
        judged = JudgedShift(judges, motions)
        of = {**shift_estimates(judged), **more(judged)}
        found |= {f"shifts.{name}.{key}": estimate for key, estimate in of.items()}
    progress("shifts", len(sets), len(sets))
    return found


def shifts_tables(results: Results) -> list[Table]:
    """The table of all shifts, if there are any."""
    sets = dict.fromkeys(row.set for row in results.values() if row.set.startswith("shifts."))
    if not sets:
        return []
    false = results.get("shifts.nominal.monitor.false_alarms_per_hour")
    meaning = _MEANING
    if false is not None:
        meaning += (
            f" On {false.n} undisturbed nominal motions the monitor gives {false.value:.2f} "
            f"({false.low:.2f}–{false.high:.2f}) false alarms an hour."
        )
    labels = {name: spoken(name.removeprefix("shifts.")) for name in sets}
    columns = [one for one in _COLUMNS if any(f"{name}.{one.key}" in results for name in sets)]
    rows = rows_of(results, labels, columns)
    title = "Γ under shifts"
    return [Table(corner="shift", columns=columns, rows=rows, title=title, meaning=meaning)]


def shifts_figure(estimates: Mapping[str, Estimate]) -> Figure:
    """Plots shares of "don't know" and of rows sure and wrong, and the AUC, of all shifts."""
    results = Results(estimates)
    shown = [
        replace(row, set=row.method, method=row.set.removeprefix("shifts."))
        for metric in ("unknown", "confident_error", "auc", "confident_error_60s")
        for row in results.select(metric=metric)
    ]
    return interval_figure(shown)
