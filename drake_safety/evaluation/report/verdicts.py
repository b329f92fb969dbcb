"""The tables of an evaluation."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.resources import files

import yaml

from drake_safety.evaluation.figure_style import label_of, spoken
from drake_safety.evaluation.report.results import Results
from drake_safety.evaluation.report.tables import Column, Row, Table

INPUTS = (
    "Inputs differ: sharpened and the baseline classifiers use the whole plan, through its "
    "features; paper uses its next H steps and no features."
)
"""Note beside every table that compares them."""
_SCORES = "Modes and classifiers are judged by their probability."
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


def verdict_tables(results: Results) -> list[Table]:
    """All tables for which the results have estimates, in the order of the report."""
    judged = columns_of("judged")
    tables = [
        _by_method(
            results,
            "segments",
            "Every segment of the motion",
            "Each segment of fresh motions is classified: does the motion stay safe to its end? "
            f"{_SCORES} Recalls are at the threshold of best balanced accuracy on other motions. "
            f"{INPUTS}",
            judged,
        ),
        _by_method(
            results,
            "episodes",
            "Before the motion starts",
            "The same for the first segment of each motion (k = 0).",
            judged,
        ),
        _triggers(results),
        alarm_table(results),
        *(
            _by_method(
                results,
                prefix,
                f"Targets before the motion starts: {set_title(prefix)}",
                "Each target is classified at k = 0; the simulated motion towards it is the "
                f"reference. {_SCORES} {INPUTS}",
                columns_of("targets"),
            )
            for prefix in plan_sets(results)
        ),
        _by_method(
            results,
            _OTHER_HAND,
            "Loss from the trained hand to the other [points]",
            "The same targets, mirrored.",
            columns_of("losses"),
            key="losses",
        ),
        _outcomes(results),
        _causes(results),
        _by_method(
            results,
            "calibration",
            "Stored calibrations on fresh motions",
            "Promised and observed rates of the thresholds of the probability.",
            columns_of("calibrations"),
            key="calibrations",
        ),
    ]
    return [table for table in tables if table.rows]


def plan_sets(results: Results) -> list[str]:
    """Prefixes of the evaluated sets of targets, the set of all targets first."""
    found = [
        key.removesuffix(".outcomes.safe")
        for key, estimate in results.estimates.items()
        if key.endswith(".outcomes.safe") and estimate.n
    ]
    return sorted(found, key=lambda prefix: (prefix.count("."), prefix))


def set_title(prefix: str) -> str:
    """Label of a set of targets."""
    return _SET_TITLES.get(prefix, spoken(prefix.partition(".")[2] or prefix).replace(".", ", "))


def other_tables(results: Results, prefix: str) -> list[Table]:
    """Tables of the estimates that no other table shows, one a row.

    Args:
        results: The results.
        prefix: First part of the keys; the second part groups them.
    """
    column = Column(key="value", title="value", meaning="As in evaluation.json.")
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
            corner="estimate",
            columns=[column],
            rows=rows,
        )
        for group, rows in groups.items()
    ]


def estimate_rows(
    results: Results, prefixes: Mapping[str, str], columns: Sequence[Column]
) -> list[Row]:
    """Rows of the estimates with given prefixes; rows without any estimate are left out.

    Args:
        results: The results.
        prefixes: Label of the row by prefix.
        columns: The columns.
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


def _by_method(
    results: Results,
    prefix: str,
    title: str,
    meaning: str,
    columns: Sequence[Column],
    *,
    key: str | None = None,
    corner: str = "method",
) -> Table:
    """A table with a row for each method that has an estimate of the second column."""
    pattern = re.compile(rf"{re.escape(prefix)}\.(.+)\.{columns[1].key}")
    names = [match[1] for name in results.estimates if (match := pattern.fullmatch(name))]
    if prefix in plan_sets(results):
        # Names of sets extend one another with dots; those of methods have none.
        names = [name for name in names if "." not in name]
        meaning += f" Evaluated on {results.estimates[f'{prefix}.outcomes.safe'].n} fresh motions."
    elif first := results.estimates.get(f"{prefix}.{names[0]}.auc" if names else ""):
        meaning += f" Evaluated on {first.n} fresh motions."
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
    meaning = "Balls are thrown at the robot; each method triggers recovery steps."
    if alone is not None:
        meaning += (
            f" Of {alone.n} fresh throws, {_SHARE.text(alone)} end in a fall without recovery."
        )
    title = "Triggers of recovery: balls thrown at the robot"
    return _by_method(results, "throws", title, meaning, columns_of("triggers"), corner="trigger")


def alarm_table(results: Results) -> Table:
    """Detection rate, lead time and false-alarm rate of alarms on pushed motions."""
    meaning = "Thresholds are chosen for the same share of false alarms on calibration motions."
    refused = results.estimates.get("monitoring.motions.refused")
    if refused is not None and refused.n:
        meaning += (
            f" Of {refused.n} motions that are safe without a push, "
            f"{_SHARE.value_text(refused)} are left out because sharpened refuses their goals."
        )
    left = results.estimates.get("monitoring.motions.leave_safe_set")
    hours = results.estimates.get("monitoring.motions.safe_hours")
    if left is not None and hours is not None:
        meaning += (
            f" Of {left.n} fresh motions {_SHARE.value_text(left)} leave the safe set; the others "
            f"last {hours.value:.2f} hours."
        )
    title = "Alarms on pushed motions"
    return _by_method(results, "monitoring", title, meaning, columns_of("alarms"), corner="alarm")


def _outcomes(results: Results) -> Table:
    table = _by_set(
        results,
        "outcomes",
        "Outcomes of the motions",
        "Simulated outcomes of the motions to all targets.",
        "Share of the motions with this outcome: safe, or the violated constraint.",
    )
    columns = [*table.columns, *columns_of("failures")]
    return replace(table, columns=columns, rows=_set_rows(results, columns))


def _causes(results: Results) -> Table:
    return _by_set(
        results,
        "causes",
        "Correct causes",
        "A refusal names the constraint that it expects to be violated.",
        "Of the correctly refused targets (with this simulated cause), the share whose named cause "
        "is the simulated one.",
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
