"""The tables of an evaluation: who judges how well, and what becomes of it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.resources import files

import yaml

from drake_safety.evaluation.figure_style import spoken
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
    "by_cause_probability": "all, by mass alone",
    "right_cause": "all",
    **{
        f"{mode}.{kind}": f"{mode}, {row}"
        for mode in ("sharpened", "paper")
        for kind, row in (("plan", "first row"), ("motion", "worst row"))
    },
}
INPUTS = (
    "Inputs differ: sharpened and the direct classifiers see the plan to its end, through its "
    "features; paper sees the next H steps of it and no features."
)
"""What is said beside every table that compares them."""
_SHARE = Column(key="", title="", meaning="", unit="%", digits=1)
_SET_TITLES = {
    "plans": "all targets",
    "plans.fair": "fair targets",
    "plans.other_hand": "the other hand",
    "plans.other_hand.fair": "the other hand, fair",
}
_OTHER_HAND = "plans.other_hand"


@cache
def columns_of(table: str) -> tuple[Column, ...]:
    """The columns of a kind of table, from ``columns.yaml``."""
    text = (files(__package__) / "columns.yaml").read_text(encoding="utf-8")
    return tuple(Column(**fields) for fields in yaml.safe_load(text)[table])


def label_of(key: str) -> str:
    """How a judge is called in tables."""
    return LABELS.get(key, spoken(key))


def verdict_tables(results: Results) -> list[Table]:
    """Every table that the results have estimates for, in the order in which one reads them."""
    judged = columns_of("judged")
    tables = [
        _by_judge(
            results,
            "segments",
            "Every moment of the motion",
            "Each moment of fresh motions is judged by what follows it: does this motion stay "
            f"safe to its end? {INPUTS}",
            judged,
        ),
        _by_judge(
            results,
            "episodes",
            "Before the motion starts",
            "The same question, asked once a motion, at its very first moment (k = 0).",
            judged,
        ),
        _triggers(results),
        alarm_table(results),
        *(
            _by_judge(
                results,
                prefix,
                f"Targets judged before anything moves: {set_title(prefix)}",
                "Each target is judged at k = 0, then the motion towards it is simulated to see "
                f"who was right. {INPUTS}",
                columns_of("targets"),
            )
            for prefix in plan_sets(results)
        ),
        _by_judge(
            results,
            _OTHER_HAND,
            "Lost from the trained hand to the other [points]",
            "The same targets, mirrored.",
            columns_of("losses"),
            key="losses",
        ),
        _outcomes(results),
        _causes(results),
        _by_judge(
            results,
            "calibration",
            "Stored calibrations on fresh motions",
            "Thresholds that were calibrated beforehand: is the promise kept, and at what price?",
            columns_of("calibrations"),
            key="calibrations",
        ),
    ]
    return [table for table in tables if table.rows]


def plan_sets(results: Results) -> list[str]:
    """Prefixes of the sets of targets that were judged, all of them first."""
    found = [
        key.removesuffix(".outcomes.safe")
        for key, estimate in results.estimates.items()
        if key.endswith(".outcomes.safe") and estimate.n
    ]
    return sorted(found, key=lambda prefix: (prefix.count("."), prefix))


def set_title(prefix: str) -> str:
    """How a set of targets is called."""
    return _SET_TITLES.get(prefix, spoken(prefix.partition(".")[2] or prefix).replace(".", ", "))


def other_tables(results: Results, prefix: str) -> list[Table]:
    """Figures of a kind that no other table knows, each in a row of its own.

    Args:
        results: The results.
        prefix: First part of the keys; what follows it groups them.
    """
    column = Column(key="value", title="value", meaning="As the evaluation wrote it.")
    groups: dict[str, list[Row]] = {}
    for key, estimate in results.estimates.items():
        first, *rest = key.split(".")
        if first != prefix or not rest:
            continue
        group = rest[0] if len(rest) > 1 else ""
        name = ".".join(rest[1:] if len(rest) > 1 else rest)
        groups.setdefault(group, []).append(
            Row(key=key, label=spoken(name).replace(".", " · "), estimates=[estimate])
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


def estimate_rows(
    results: Results, prefixes: Mapping[str, str], columns: Sequence[Column]
) -> list[Row]:
    """A row a prefix of estimates' keys; those without any estimate are left out.

    Args:
        results: The results.
        prefixes: By prefix, what the row is called.
        columns: Which estimates.
    """
    rows = [
        Row(
            key=prefix,
            label=label,
            estimates=[results.estimates.get(f"{prefix}.{column.key}") for column in columns],
        )
        for prefix, label in prefixes.items()
    ]
    return [row for row in rows if any(row.estimates)]


def _by_judge(
    results: Results,
    prefix: str,
    title: str,
    meaning: str,
    columns: Sequence[Column],
    *,
    key: str | None = None,
    corner: str = "who judges",
) -> Table:
    """A row for each who has an estimate of the second column."""
    pattern = re.compile(rf"{re.escape(prefix)}\.(.+)\.{columns[1].key}")
    names = [match[1] for name in results.estimates if (match := pattern.fullmatch(name))]
    if prefix in plan_sets(results):
        # The names of sets go on from one another's; those of judges have no dots.
        names = [name for name in names if "." not in name]
        meaning += f" Judged on {results.estimates[f'{prefix}.outcomes.safe'].n} fresh motions."
    elif first := results.estimates.get(f"{prefix}.{names[0]}.auc" if names else ""):
        meaning += f" Judged on {first.n} fresh motions."
    rows = estimate_rows(results, {f"{prefix}.{name}": label_of(name) for name in names}, columns)
    return Table(
        key=key or prefix.replace(".", "_"),
        title=title,
        meaning=meaning,
        corner=corner,
        columns=columns,
        rows=[replace(row, key=row.key.removeprefix(f"{prefix}.")) for row in rows],
    )


def _triggers(results: Results) -> Table:
    alone = results.estimates.get("throws.falls_without_recovery")
    meaning = "Balls are thrown at the robot; whoever judges may trigger a recovery step."
    if alone is not None:
        meaning += (
            f" Of {alone.n} fresh throws, {_SHARE.text(alone)} end in a fall if the robot only "
            "balances."
        )
    title = "As an alarm: balls at the robot"
    return _by_judge(
        results, "throws", title, meaning, columns_of("triggers"), corner="who triggers"
    )


def alarm_table(results: Results) -> Table:
    """Who notices a push, how long before, and how often for nothing."""
    meaning = (
        "Everyone may give as many false alarms on other motions: thresholds are chosen for that."
    )
    refused = results.estimates.get("monitoring.motions.refused")
    if refused is not None and refused.n:
        meaning += (
            f" Of {refused.n} motions that would be safe if nobody pushed, "
            f"{_SHARE.value_text(refused)} lead to goals that sharpened refuses beforehand: they "
            "are not begun, whoever watches."
        )
    left = results.estimates.get("monitoring.motions.leave_safe_set")
    hours = results.estimates.get("monitoring.motions.safe_hours")
    if left is not None and hours is not None:
        meaning += (
            f" Of {left.n} fresh motions {_SHARE.value_text(left)} leave the safe set; the others "
            f"make {hours.value:.2f} hours."
        )
    title = "Watching while it moves: pushes"
    return _by_judge(
        results, "monitoring", title, meaning, columns_of("alarms"), corner="who watches"
    )


def _outcomes(results: Results) -> Table:
    table = _by_set(
        results,
        "outcomes",
        "What came of the motions",
        "Every target's motion is simulated; this is how they end.",
        "Share of the motions that end so: safe, or why not.",
    )
    columns = [*table.columns, *columns_of("failures")]
    return replace(table, columns=columns, rows=_set_rows(results, columns))


def _causes(results: Results) -> Table:
    return _by_set(
        results,
        "causes",
        "Was the right cause named?",
        "A refusal names the constraint that it expects to be violated.",
        "Of the rightly refused targets (of this true cause), those for which the cause that was "
        "named is the one that came true.",
    )


def _by_set(results: Results, infix: str, title: str, meaning: str, of_columns: str) -> Table:
    """A row a set of targets, a column an estimate below `infix`."""
    names = dict.fromkeys(
        match[1] for key in results.estimates if (match := re.search(rf"\.{infix}\.([^.]+)$", key))
    )
    columns = [
        Column(key=f"{infix}.{name}", title=label_of(name), meaning=of_columns, unit="%", digits=1)
        for name in names
        if any(results.estimates.get(f"{key}.{infix}.{name}") for key in plan_sets(results))
    ]
    return Table(
        key=infix,
        title=title,
        meaning=meaning,
        corner="targets",
        columns=columns,
        rows=_set_rows(results, columns),
    )


def _set_rows(results: Results, columns: Sequence[Column]) -> list[Row]:
    return estimate_rows(results, {key: set_title(key) for key in plan_sets(results)}, columns)
