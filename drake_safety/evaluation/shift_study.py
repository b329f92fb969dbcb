"""Γ under shifts: how often it says "don't know" or is sure and wrong, and when the monitor alarms.

A row is sure and wrong (a confident error) where it is called safe with at least 0.9, with a belief
that is not "don't know", in a motion that ends unsafely. Figures "with monitor" count rows after
its alarm as "don't know": so it is with ``on_alarm: unknown``, while with ``on_alarm: report`` the
alarm changes no belief.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from drake_safety.evaluation.figure_style import spoken
from drake_safety.evaluation.interval_figure import interval_figure
from drake_safety.evaluation.metrics import Bootstrap, Estimate, auc, proportion
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.tables import Column, Table, rows_of
from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.prediction import is_unknown
from drake_safety.learning.segments import DIVERGED, Episode, Episodes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


@dataclass(kw_only=True, eq=False)
class MotionRows:
    """The inputs of one motion, in the order of time, and its outcome.

    Attributes:
        state: (N, n_s).
        desired_preview: (N, H n_z).
        features: (N, n_f).
        is_outside: Whether the state is outside the safe set, (N,).
        is_unsafe: Whether it ends unsafely.
    """

    state: np.ndarray
    desired_preview: np.ndarray
    features: np.ndarray
    is_outside: np.ndarray
    is_unsafe: bool

    @classmethod
    def of_episode(cls, episode: Episode) -> MotionRows:
        """The rows of an episode from its first undisturbed one."""
        rows = slice(episode.first_step, None)
        return cls(
            **{name: getattr(episode, name)[rows] for name in SEEN},
            is_outside=np.any(episode.margins[rows] < 0.0, axis=1),
            is_unsafe=not episode.is_safe,
        )


MotionSet = tuple[str, list[MotionRows]]
"""Kind of a shift, "nominal", "plant" or "sensor", and motions under it."""


def motions_of(episodes: Episodes) -> list[MotionRows]:
    """The motions of episodes; those that diverged are left out."""
    motions = [MotionRows.of_episode(one) for one in episodes if one.cause != DIVERGED]
    return [one for one in motions if len(one.state)]


@dataclass(kw_only=True, eq=False)
class Verdicts:
    """Verdicts of one method on N rows.

    Attributes:
        probability: Safety probability, 0 for "don't know", (N,).
        is_unknown: Whether the row is "don't know", (N,).
    """

    probability: np.ndarray
    is_unknown: np.ndarray


Judge = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], Verdicts]
"""Maps states, previews, features and whether a row is outside the safe set to verdicts."""


def assessment_judge(assessment: SafetyAssessment) -> Judge:
    """Γ as a :class:`SafetyAssessor` with the port ``margins`` gives it, without the monitor."""

    def judge(
        state: np.ndarray, preview: np.ndarray, features: np.ndarray, is_outside: np.ndarray
    ) -> Verdicts:
        found = assessment.predict(state, preview, features)
        unknown = is_unknown(found.belief, assessment.parameters.initial_uncertainty)
        return Verdicts(
            probability=np.where(is_outside, 0.0, found.probability), is_unknown=unknown
        )

    return judge


@dataclass(kw_only=True, eq=False)
class JudgedShift:
    """The verdicts of all methods on the motions of a shift.

    Attributes:
        verdicts: By method, on all rows of all motions; "gamma" is Γ.
    """

    motions: Sequence[MotionRows]
    assessment: SafetyAssessment
    verdicts: Mapping[str, Verdicts]

    @classmethod
    def judged_by(
        cls,
        judges: Mapping[str, Judge],
        motions: Sequence[MotionRows],
        assessment: SafetyAssessment,
    ) -> JudgedShift:
        """Judges all rows by every method."""
        rows = [np.concatenate([getattr(m, k) for m in motions]) for k in (*SEEN, "is_outside")]
        verdicts = {name: judge(*rows) for name, judge in judges.items()}
        return cls(motions=motions, assessment=assessment, verdicts=verdicts)

    @cached_property
    def sizes(self) -> np.ndarray:
        """Number of rows of each motion, (M,)."""
        return np.array([len(one.state) for one in self.motions])

    @cached_property
    def first(self) -> np.ndarray:
        """First row of each motion, (M,)."""
        return np.concatenate([[0], np.cumsum(self.sizes)[:-1]])

    @cached_property
    def motion(self) -> np.ndarray:
        """Motion of each row, (N,)."""
        return np.repeat(np.arange(len(self.motions)), self.sizes)

    @cached_property
    def is_unsafe(self) -> np.ndarray:
        """Whether each motion ends unsafely, (M,)."""
        return np.array([one.is_unsafe for one in self.motions])

    def is_wrong(self, name: str) -> np.ndarray:
        """Whether a method is sure and wrong in each row, (N,)."""
        one = self.verdicts[name]
        is_sure = (one.probability >= CONFIDENT) & ~one.is_unknown
        return is_sure & self.is_unsafe[self.motion]


def shift_estimates(judged: JudgedShift) -> dict[str, Estimate]:
    """Shares of rows sure and wrong and "don't know", and the AUC of all rows, of each method.

    "Don't know" counts as the lowest probability. Intervals are over motions.
    """
    is_unsafe, motion = judged.is_unsafe, judged.motion
    found = {"unsafe": proportion(int(is_unsafe.sum()), len(is_unsafe))}
    for name, verdicts in judged.verdicts.items():
        found[f"{name}.confident_error"] = mean_over(judged.is_wrong(name), motion)
        found[f"{name}.unknown"] = mean_over(verdicts.is_unknown, motion)
        if 0 < is_unsafe.sum() < len(is_unsafe):
            score = 1.0 - np.nan_to_num(verdicts.probability)
            found[f"{name}.auc"] = auc(score, is_unsafe[motion], motion)
    return found


def mean_over(values: np.ndarray, motion: np.ndarray) -> Estimate:
    """Mean of the values (N,) of rows, with its interval over their motions (N,)."""

    def mean(weight: np.ndarray) -> float:
        return float(np.average(values, weights=weight)) if weight.any() else np.nan

    return BOOTSTRAP.over_episodes(mean, motion)


def evaluate_shifts(
    sets: Mapping[str, MotionSet],
    judges: Mapping[str, Judge],
    assessment: SafetyAssessment,
    progress: StageProgress,
    more: Callable[[JudgedShift], Mapping[str, Estimate]] = lambda judged: {},
) -> dict[str, Estimate]:
    """Estimates of every shift by dotted key.

    Judges are methods by name; "gamma" is Γ.
    """
    found: dict[str, Estimate] = {}
    for i, (name, (_, motions)) in enumerate(sets.items()):
        progress("shifts", i, len(sets))
        judged = JudgedShift.judged_by(judges, motions, assessment)
        of = {**shift_estimates(judged), **more(judged)}
        found |= {f"shifts.{name}.{key}": estimate for key, estimate in of.items()}
    progress("shifts", len(sets), len(sets))
    return found


def shifts_tables(results: Results) -> list[Table]:
    """The table of all shifts."""
    sets = dict.fromkeys(row.set for row in results.values() if row.set.startswith("shifts."))
    false = results.get("shifts.nominal.monitor.false_alarms_per_hour")
    meaning = _MEANING
    if false is not None:
        meaning += (
            f" On {false.n} undisturbed nominal motions the monitor gives {false.value:.2f} "
            f"({false.low:.2f}–{false.high:.2f}) false alarms an hour."
        )
    labels = {name: spoken(name.removeprefix("shifts.")) for name in sets}
    rows = rows_of(results, labels, _COLUMNS)
    table = Table(
        corner="shift", columns=_COLUMNS, rows=rows, title="Γ under shifts", meaning=meaning
    )
    found = zip(*(row.estimates for row in rows), strict=True)
    return [table.narrow([one.key for one, of in zip(_COLUMNS, found, strict=True) if any(of)])]


def shifts_figure(estimates: Mapping[str, Estimate]) -> Figure:
    """Plots shares of "don't know" and of rows sure and wrong, and the AUC, of all shifts."""
    results = Results(estimates)
    shown = [
        replace(row, set=row.method, method=row.set.removeprefix("shifts."))
        for metric in ("unknown", "confident_error", "auc", "confident_error_60s")
        for row in results.select(metric=metric)
    ]
    return interval_figure(shown)
