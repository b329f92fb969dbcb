"""The tables of an evaluation: who judges how well, and what becomes of it."""

from __future__ import annotations

import re
from collections.abc import Sequence

from drake_safety.evaluation.figure_style import spoken
from drake_safety.evaluation.metrics import Figure
from drake_safety.evaluation.report.results import Results
from drake_safety.evaluation.report.tables import Column, Row, Table

LABELS = {
    "mlp": "MLP",
    "reachability": "inverse kinematics",
    "sharpened_literal_0.6": "sharpened, literal Γ",
    "paper_literal_0.6": "paper, literal Γ",
    "sharpened_literal": "sharpened, literal Γ",
    "sharpened_calibrated": "sharpened, by its heads",
    "paper_literal": "paper, literal Γ",
    "capture_point_margin": "capture point's margin",
    "support_margin": "support polygon's margin",
    "smallest_margin": "smallest margin (true state)",
}
_AUC = Column(
    key="auc",
    title="AUC",
    meaning="The probability that of one safe and one unsafe motion, drawn at random, the unsafe "
    "one gets the worse score: 1 is perfect, 0.5 is guessing. It needs no threshold.",
    better=1,
)
_SAFE_RECALL = Column(
    key="safe_recall",
    title="safe recall",
    meaning="Of what in truth stays safe, the share that is judged safe. What is missing to 1 "
    "are false alarms.",
    better=1,
)
_UNSAFE_RECALL = Column(
    key="unsafe_recall",
    title="unsafe recall",
    meaning="Of what in truth becomes unsafe, the share that is judged unsafe. What is missing "
    "to 1 are misses, the dangerous kind of error.",
    better=1,
)
_BRIER = Column(
    key="brier",
    title="Brier",
    meaning="The mean squared distance between the stated probability and what came of it: 0 is "
    "perfect, 0.25 is what always saying one half gets.",
    better=-1,
)
_THRESHOLD = Column(
    key="threshold",
    title="threshold",
    meaning="Below it a motion is refused, or a recovery triggered.",
    unit="=",
)
_TRIGGER_COLUMNS = (
    Column(key="threshold", title="threshold", meaning=_THRESHOLD.meaning, unit="=", digits=2),
    Column(
        key="falls_with_recovery",
        title="falls",
        meaning="Of all throws, those that end in a fall although the recovery may step in.",
        unit="%",
        better=-1,
        digits=1,
    ),
    Column(
        key="false_triggers",
        title="false triggers",
        meaning="Of the throws that balancing alone survives inside the safe set, those in which "
        "the robot steps all the same.",
        unit="%",
        better=-1,
        digits=1,
    ),
    Column(
        key="falls_missed",
        title="falls missed",
        meaning="Of the throws that fall without recovery, those without a trigger before the "
        "fall.",
        unit="of",
        better=-1,
    ),
    Column(
        key="trigger_after_impact_s",
        title="after impact",
        meaning="Median time from the ball's touch to the trigger.",
        unit="ms",
        digits=0,
    ),
    Column(
        key="trigger_before_fall_s",
        title="before the fall",
        meaning="Median time from the trigger to the fall that would have come.",
        unit="s",
        digits=2,
    ),
)
_ALARM_COLUMNS = (
    Column(
        key="detected",
        title="noticed in time",
        meaning="Of the motions in which a push drives the robot out of its safe set, those in "
        "which the alarm comes after the push and before that.",
        unit="%",
        better=1,
        digits=1,
    ),
    Column(
        key="lead_to_leaving_s",
        title="before leaving",
        meaning="Median time from the alarm until the robot leaves the safe set; an alarm that "
        "never comes counts as later than any other.",
        unit="s",
        better=1,
        digits=2,
    ),
    Column(
        key="falls_detected",
        title="falls noticed",
        meaning="Of the motions that end in a fall, those with an alarm before it.",
        unit="%",
        better=1,
        digits=1,
    ),
    Column(
        key="lead_to_fall_s",
        title="before the fall",
        meaning="Median time from the alarm to the fall.",
        unit="s",
        better=1,
        digits=2,
    ),
    Column(
        key="false_alarms_per_hour",
        title="false alarms per hour",
        meaning="Alarms in motions that stay in the safe set, most of them pushed ones, per hour "
        "of such motion; at most one a motion.",
        unit="/h",
        better=-1,
        digits=0,
    ),
    Column(
        key="undisturbed_false_alarms_per_hour",
        title="undisturbed",
        meaning="Alarms while nobody has pushed yet, per hour of such motion.",
        unit="/h",
        better=-1,
        digits=0,
    ),
    Column(
        key="auc",
        title="AUC",
        meaning="The probability that the lowest value in a motion that leaves the safe set is "
        "below that in one that stays: 1 is perfect, 0.5 is guessing. It needs no threshold.",
        better=1,
    ),
)
_SET_TITLES = {
    "plans": "all targets",
    "plans.fair": "fair targets",
    "plans.other_hand": "the other hand",
    "plans.other_hand.fair": "the other hand, fair",
}


def label_of(key: str) -> str:
    """How a judge is called in tables."""
    return LABELS.get(key, spoken(key))


def verdict_tables(results: Results) -> list[Table]:
    """Every table that the results have figures for, in the order in which one reads them."""
    tables = [
        _judges(
            results,
            "segments",
            "Every moment of the motion",
            "Each moment of fresh motions is judged by what follows it: does this motion stay "
            "safe to its end?",
            (_AUC, _SAFE_RECALL, _UNSAFE_RECALL, _BRIER),
        ),
        _judges(
            results,
            "episodes",
            "Before the motion starts",
            "The same question, asked once a motion, at its very first moment (k = 0).",
            (_AUC, _SAFE_RECALL, _UNSAFE_RECALL, _BRIER),
        ),
        _triggers(results),
        alarm_table(results),
        *(
            _judges(
                results,
                prefix,
                f"Targets judged before anything moves: {set_title(prefix)}",
                "Each target is judged at k = 0, then the motion towards it is simulated to see "
                "who was right.",
                (_SAFE_RECALL, _UNSAFE_RECALL, _AUC, _BRIER, _THRESHOLD),
            )
            for prefix in plan_sets(results)
        ),
        _outcomes(results),
        _causes(results),
        _learning_curve(results),
    ]
    return [table for table in tables if table is not None and table.rows]


def plan_sets(results: Results) -> list[str]:
    """Prefixes of the sets of targets that were judged, all of them first."""
    found = [
        key.removesuffix(".outcomes.safe")
        for key, figure in results.figures.items()
        if key.endswith(".outcomes.safe") and figure.n
    ]
    return sorted(found, key=lambda prefix: (prefix.count("."), prefix))


def set_title(prefix: str) -> str:
    """How a set of targets is called."""
    return _SET_TITLES.get(prefix, spoken(prefix.partition(".")[2] or prefix).replace(".", ", "))


def one_judge_on_sets(results: Results, judge: str = "sharpened") -> Table:
    """One judge on every set of targets: the set is the row."""
    columns = (_SAFE_RECALL, _UNSAFE_RECALL, _AUC)
    rows = [
        Row(
            key=prefix,
            label=set_title(prefix),
            figures=_row(results, f"{prefix}.{judge}", columns),
        )
        for prefix in plan_sets(results)
    ]
    return Table(
        key=f"{judge}_on_sets",
        title=f"`{judge}` on each set of targets",
        meaning="",
        corner=f"`{judge}` on",
        columns=columns,
        rows=rows,
    )


def other_figures(results: Results, prefix: str) -> list[Table]:
    """Figures of a kind that no other table knows, each in a row of its own.

    Args:
        results: The results.
        prefix: First part of the keys; what follows it groups them.
    """
    column = Column(key="value", title="value", meaning="As the evaluation wrote it.")
    groups: dict[str, list[Row]] = {}
    for key, figure in results.figures.items():
        first, *rest = key.split(".")
        if first != prefix or not rest:
            continue
        group = rest[0] if len(rest) > 1 else ""
        name = ".".join(rest[1:] if len(rest) > 1 else rest)
        groups.setdefault(group, []).append(
            Row(key=key, label=spoken(name).replace(".", " · "), figures=[figure])
        )
    return [
        Table(
            key=f"{prefix}_{group}" if group else prefix,
            title=spoken(group or prefix),
            meaning="",
            corner="figure",
            columns=[column],
            rows=rows,
        )
        for group, rows in groups.items()
    ]


def _row(results: Results, prefix: str, columns: Sequence[Column]) -> list[Figure | None]:
    return [results.figures.get(f"{prefix}.{column.key}") for column in columns]


def _judges(
    results: Results, prefix: str, title: str, meaning: str, columns: Sequence[Column]
) -> Table | None:
    pattern = re.compile(rf"{re.escape(prefix)}\.([^.]+)\.safe_recall")
    names = [match[1] for key in results.figures if (match := pattern.fullmatch(key))]
    rows = [
        Row(key=name, label=label_of(name), figures=_row(results, f"{prefix}.{name}", columns))
        for name in names
    ]
    first = results.figures.get(f"{prefix}.outcomes.safe") or results.figures.get(
        f"{prefix}.{names[0]}.auc" if names else ""
    )
    count = f" Judged on {first.n} fresh motions." if first else ""
    return Table(
        key=prefix.replace(".", "_"),
        title=title,
        meaning=meaning + count,
        corner="who judges",
        columns=columns,
        rows=rows,
    )


def _triggers(results: Results) -> Table:
    pattern = re.compile(r"throws\.(.+)\.falls_with_recovery")
    names = [match[1] for key in results.figures if (match := pattern.fullmatch(key))]
    alone = results.figures.get("throws.falls_without_recovery")
    meaning = "Balls are thrown at the robot; whoever judges may trigger a recovery step."
    if alone is not None:
        share = Column(key="", title="", meaning="", unit="%", digits=1)
        meaning += (
            f" Of {alone.n} fresh throws, {share.value_text(alone)} {share.interval_text(alone)} "
            "end in a fall if the robot only balances."
        )
    return Table(
        key="throws",
        title="As an alarm: balls at the robot",
        meaning=meaning,
        corner="who triggers",
        columns=_TRIGGER_COLUMNS,
        rows=[
            Row(
                key=name,
                label=label_of(name),
                figures=_row(results, f"throws.{name}", _TRIGGER_COLUMNS),
            )
            for name in names
        ],
    )


def alarm_table(results: Results) -> Table:
    """Who notices a push, how long before, and how often for nothing."""
    pattern = re.compile(r"monitoring\.(.+)\.lead_to_leaving_s")
    names = [match[1] for key in results.figures if (match := pattern.fullmatch(key))]
    share = Column(key="", title="", meaning="", unit="%", digits=1)
    meaning = (
        "Everyone may give as many false alarms on other motions: thresholds are chosen for that."
    )
    refused = results.figures.get("monitoring.motions.refused")
    if refused is not None and refused.n:
        meaning += (
            f" Of {refused.n} motions that would be safe if nobody pushed, "
            f"{share.value_text(refused)} lead to goals that sharpened refuses beforehand: they "
            "are not begun, whoever watches."
        )
    left = results.figures.get("monitoring.motions.leave_safe_set")
    hours = results.figures.get("monitoring.motions.safe_hours")
    if left is not None and hours is not None:
        meaning += (
            f" Of {left.n} fresh motions {share.value_text(left)} leave the safe set; the others "
            f"make {hours.value:.2f} hours."
        )
    return Table(
        key="monitoring",
        title="Watching while it moves: pushes",
        meaning=meaning,
        corner="who watches",
        columns=_ALARM_COLUMNS,
        rows=[
            Row(
                key=name,
                label=label_of(name),
                figures=_row(results, f"monitoring.{name}", _ALARM_COLUMNS),
            )
            for name in names
        ],
    )


def _shares(results: Results, infix: str, names: Sequence[str], meaning: str) -> list[Column]:
    return [
        Column(key=f"{infix}.{name}", title=spoken(name), meaning=meaning, unit="%", digits=1)
        for name in names
        if any(results.figures.get(f"{key}.{infix}.{name}") for key in plan_sets(results))
    ]


def _outcomes(results: Results) -> Table:
    names = dict.fromkeys(
        match[1] for key in results.figures if (match := re.search(r"\.outcomes\.([^.]+)$", key))
    )
    columns = _shares(
        results, "outcomes", list(names), "Share of the motions that end so: safe, or why not."
    )
    return Table(
        key="outcomes",
        title="What came of the motions",
        meaning="Every target's motion is simulated; this is how they end.",
        corner="targets",
        columns=columns,
        rows=_set_rows(results, columns),
    )


def _causes(results: Results) -> Table:
    names = dict.fromkeys(
        match[1] for key in results.figures if (match := re.search(r"\.causes\.([^.]+)$", key))
    )
    columns = _shares(
        results,
        "causes",
        [name for name in names if not name.startswith("by_")],
        "Of the rightly refused targets (of this true cause), those for which the cause that was "
        "named is the one that came true.",
    )
    return Table(
        key="causes",
        title="Was the right cause named?",
        meaning="A refusal names the constraint that it expects to be violated.",
        corner="targets",
        columns=columns,
        rows=_set_rows(results, columns),
    )


def _set_rows(results: Results, columns: Sequence[Column]) -> list[Row]:
    rows = [
        Row(key=prefix, label=set_title(prefix), figures=_row(results, prefix, columns))
        for prefix in plan_sets(results)
    ]
    return [row for row in rows if any(row.figures)]


def _learning_curve(results: Results) -> Table:
    pattern = re.compile(r"plans\.learning_curve\.(\d+)\.safe_recall")
    sizes = [match[1] for key in results.figures if (match := pattern.fullmatch(key))]
    columns = (_SAFE_RECALL, _UNSAFE_RECALL, _AUC)
    return Table(
        key="learning_curve",
        title="How many episodes does it take?",
        meaning="The same test, after learning from fewer simulated episodes.",
        corner="training episodes",
        columns=columns,
        rows=[
            Row(
                key=size,
                label=size,
                figures=_row(results, f"plans.learning_curve.{size}", columns),
            )
            for size in sorted(sizes, key=int)
        ],
    )
