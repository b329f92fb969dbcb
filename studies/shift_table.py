"""The table of shifts in docs/shifts.md."""

from __future__ import annotations

import math

from drake_safety.evaluation.results import Results

_COLUMNS = {
    "unsafe": "unsafe",
    "without_novelty.confident_error": "CE, grid alone",
    "gamma.confident_error": "CE",
    "gamma.unknown": "DK",
    "gamma.first.confident_error": "CE at k = 0",
    "monitor.confident_error_10s": "CE, 10 s",
    "monitor.confident_error_60s": "CE, 60 s",
    "monitor.delay_s": "alarm [s]",
    "monitor.delay_95_s": "95 % [s]",
    "gradient_boosting.confident_error": "CE, boosting",
    "mlp.confident_error": "CE, MLP",
    "isolation_forest.confident_error": "CE, isolation forest",
    "deep_knn.confident_error": "CE, deep kNN",
}


def shifts_text(results: Results) -> str:
    """The command and the table of ``evaluate --shifts``, as Markdown.

    Args:
        results: Stored results with those of the shifts.
    """
    entries = results.entries["shifts"]
    kinds: dict[str, str] = entries["kinds"]
    lines = [f"```sh\n{entries['command']}\n```\n"]
    titles = {name: f"{name} ({kind})" for name, kind in kinds.items()}
    lines += shift_rows(results, titles, _COLUMNS)
    lines += _ranking(results, kinds)
    lines += _promises(results, kinds)
    false = results["shifts.nominal.monitor.false_alarms_per_hour"]
    lines.append(
        f"\nFalse alarms of the monitor: {false.value:.2f} ({false.low:.2f}–{false.high:.2f}) an "
        f"hour on {false.n} safe nominal motions."
    )
    return "\n".join(lines)


_RANKING_COLUMNS = {
    "gamma.unknown": "DK",
    "gamma.known_auc": "Γ, rows it knows",
    "gradient_boosting.known_auc": "boosting, the same rows",
    "without_novelty.auc": "Γ without novelty, all rows",
    "gradient_boosting.auc": "boosting, all rows",
    "gamma.auc": "Γ, DK a refusal",
}


def _ranking(results: Results, kinds: dict[str, str]) -> list[str]:
    """The table of AUCs: on what Γ knows, and on all rows with and without refusals."""
    names = [name for name in kinds if results.has(f"shifts.{name}.without_novelty.auc")]
    intro = (
        "\nAUC of the probability and of gradient boosting [%]: on the rows that Γ knows; on all "
        'rows, the novelty ignored; and with "don\'t know" as the lowest probability.\n'
    )
    table = shift_rows(results, dict(zip(names, names, strict=True)), _RANKING_COLUMNS)
    return [intro, *table] if names else []


_PROMISE_COLUMNS = {
    "fixed.missed": "missed",
    "fixed.accepted": "safe accepted",
    "monitor.missed": "missed before the alarm",
    "adaptive.missed": "adaptive: missed",
    "adaptive.accepted": "adaptive: safe accepted",
}


def _promises(results: Results, kinds: dict[str, str]) -> list[str]:
    """The table of a promise under shifts: plans missed and accepted."""
    names = [name for name in kinds if results.has(f"shifts.{name}.fixed.accepted")]
    intro = (
        "\nThe promise for plans: the stored threshold, and one that has followed the outcomes of "
        "the first half of a shift's unsafe motions, both on the second half; with the monitor, "
        "all motions until its alarm.\n"
    )
    table = shift_rows(results, dict(zip(names, names, strict=True)), _PROMISE_COLUMNS)
    return [intro, *table] if names else []


def shift_rows(results: Results, titles: dict[str, str], columns: dict[str, str]) -> list[str]:
    """Lines of a table: a row for each shift, the columns of which any shift has a figure.

    Args:
        results: Stored results with those of the shifts.
        titles: Title of the row by shift.
        columns: Title of the column by the last part of its keys.
    """
    shown = [key for key in columns if any(results.has(f"shifts.{s}.{key}") for s in titles)]
    lines = [
        f"| shift | {' | '.join(columns[key] for key in shown)} |",
        "|---|" + "---|" * len(shown),
    ]
    for name, title in titles.items():
        cells = [_cell(results, f"shifts.{name}.{key}") for key in shown]
        lines.append(f"| {title.replace('_', ' ')} | {' | '.join(cells)} |")
    return lines


def _cell(results: Results, key: str) -> str:
    estimate = results.get(key)
    if estimate is None:
        return ""
    if key.endswith("_s"):
        return "none" if math.isnan(estimate.value) else f"{estimate.value:.1f}"
    value, low, high = (100.0 * x for x in (estimate.value, estimate.low, estimate.high))
    return f"{value:.1f} ({low:.1f}–{high:.1f})"
