"""The tables of an evaluation: which metrics each judged set shows, under which heading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from drake_safety.evaluation.figure_style import label_of, spoken
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.tables import Column, Table, rows_of

INPUTS = (
    "Inputs differ: sharpened and the baseline classifiers use the whole plan, through its "
    "features; paper uses its next H steps and no features."
)
"""Note beside every table that compares them."""
_SCORES = "Modes and classifiers are judged by their probability."
_SHARE = Column("", "", "%", digits=1)
_AUC, _BRIER = Column("auc", "AUC", "", 1), Column("brier", "Brier", "", -1)
_RECALLS = (
    Column("safe_recall", "safe recall", "", 1),
    Column("unsafe_recall", "unsafe recall", "", 1),
)
JUDGED = (_AUC, *_RECALLS, _BRIER)
TARGETS = (*_RECALLS, _AUC, _BRIER, Column("threshold", "threshold", "="))
TRIGGERS = (
    Column("threshold", "threshold", "=", digits=2),
    Column("falls_with_recovery", "falls", "%", -1, 1),
    Column("false_triggers", "false triggers", "%", -1, 1),
    Column("falls_missed", "falls missed", "of", -1),
    Column("trigger_after_impact_s", "after impact", "ms", digits=0),
    Column("trigger_before_fall_s", "lead time to the fall", "s", digits=2),
)
CALIBRATIONS = (
    Column("promised_miss_rate", "promised miss rate", "=%", digits=1),
    Column("miss_rate", "miss rate", "%", digits=1),
    Column("unsafe_unknown", "unsafe: don't know", "%", digits=1),
    Column("safe_recall", "safe recall", "%", digits=1),
    Column("safe_unknown", "safe: don't know", "%", digits=1),
    Column("false_alarm_rate", "false-alarm rate", "%", digits=1),
)
MEANINGS = {
    "auc": "How often an unsafe motion has the higher unsafe score than a safe one; 0.5 is chance.",
    "safe_recall": "Share of the safe ones that are called safe.",
    "unsafe_recall": "Share of the unsafe ones that are called unsafe.",
    "brier": "Mean squared error of the probability; always one half has 0.25.",
    "threshold": "What is below it is refused, or triggers: stored, of the scenario or the paper, "
    "or chosen on other motions.",
    "falls_with_recovery": "Share of all throws that end in a fall with recovery.",
    "false_triggers": "Share triggered of the throws that stay safe without recovery.",
    "falls_missed": "Throws that fall without recovery and have no trigger before the fall.",
    "trigger_after_impact_s": "Median time from the impact to the trigger.",
    "trigger_before_fall_s": "Median time from the trigger to the fall without recovery.",
    "promised_miss_rate": "Share of the unsafe ones that may be called safe, as calibrated.",
    "miss_rate": "Share of the unsafe ones that are called safe.",
    "unsafe_unknown": 'Share of the unsafe ones with the verdict "don\'t know".',
    "safe_unknown": 'Share of the safe ones with the verdict "don\'t know".',
    "false_alarm_rate": "Share of the safe ones that are called unsafe.",
}
"""Definitions of the metrics."""
Kind = tuple[str, str, Sequence[Column]]
"""Title, explanation and columns of a table."""
_KINDS: dict[str, Kind] = {
    "segments": (
        "Every segment of the motion",
        "Each segment of fresh motions is classified: does the motion stay safe to its end? "
        f"{_SCORES} Recalls are at the threshold of best balanced accuracy on other motions. "
        f"{INPUTS}",
        JUDGED,
    ),
    "episodes": (
        "Before the motion starts",
        "The same for the first segment of each motion (k = 0).",
        JUDGED,
    ),
    "throws": (
        "Triggers of recovery: balls thrown at the robot",
        "Balls are thrown at the robot; each method triggers recovery steps.",
        TRIGGERS,
    ),
    "plans": (
        "Targets before the motion starts",
        "Each target is classified at k = 0; the simulated motion towards it is the reference. "
        f"{_SCORES} {INPUTS}",
        TARGETS,
    ),
    "calibration": (
        "Stored calibrations on fresh motions",
        "Promised and observed rates of the thresholds of the probability.",
        CALIBRATIONS,
    ),
}
"""By the first part of a set."""
_SET_TITLES = {
    "plans": "all targets",
    "plans.fair": "fair targets",
    "plans.other_hand": "the other hand",
    "plans.other_hand.fair": "the other hand, fair",
    "calibration.plan": "before the motion",
    "calibration.motion": "during the motion",
}


def set_title(set: str) -> str:
    """Label of a judged set."""
    return _SET_TITLES.get(set, spoken(set.partition(".")[2] or set).replace(".", ", "))


def verdict_table(
    results: Results, set: str, *, corner: str = "method", kind: Kind | None = None
) -> Table:
    """The table of a judged set: a row for each method, with the columns of its kind.

    A method without the second column, such as a difference of two methods, has no row.
    """
    title, meaning, columns = kind or _KINDS[set.partition(".")[0]]
    methods = [row.method for row in results.select(set=set, metric=columns[1].key) if row.method]
    if set in _SET_TITLES:
        title = f"{title}: {set_title(set)}"
    if first := results.get(f"{set}.{methods[0]}.auc" if methods else ""):
        meaning += f" Evaluated on {first.n} fresh motions."
    if alone := results.get(f"{set}.falls_without_recovery"):
        meaning += (
            f" Of {alone.n} fresh throws, {_SHARE.text(alone)} end in a fall without recovery."
        )
    labels = {f"{set}.{method}": label_of(method) for method in methods}
    rows = rows_of(results, labels, columns)
    rows = [replace(row, key=method) for row, method in zip(rows, methods, strict=True)]
    return Table(corner=corner, columns=columns, rows=rows, title=title, meaning=meaning)


def verdict_tables(results: Results) -> list[Table]:
    """The tables of all judged sets, and of the outcomes of plans."""
    sets = dict.fromkeys(row.set for row in results.values())
    tables = [verdict_table(results, set) for set in sets if set.partition(".")[0] in _KINDS]
    outcomes = results.select(method="outcomes")
    names = dict.fromkeys(row.metric for row in outcomes)
    columns = [Column(name, label_of(name), "%", digits=1) for name in names]
    labels = {f"{row.set}.outcomes": set_title(row.set) for row in outcomes}
    tables.append(
        Table(
            corner="targets",
            columns=columns,
            rows=rows_of(results, labels, columns),
            title="Outcomes of the motions",
            meaning="Safe, or the violated constraint.",
        )
    )
    return [table for table in tables if table.rows]
