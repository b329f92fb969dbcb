"""Sections of the report on studies that stand by themselves: planning with Γ, and ablations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from drake_safety.evaluation.ablation import BASELINE
from drake_safety.evaluation.ablation_figure import ablation_figure
from drake_safety.evaluation.ablation_study import AblationFile, AblationRow
from drake_safety.evaluation.figure_style import spoken
from drake_safety.evaluation.metrics import Figure
from drake_safety.evaluation.planning_figure import planning_figure
from drake_safety.evaluation.planning_study import PLANS
from drake_safety.evaluation.report.results import Results, as_figure, is_figure
from drake_safety.evaluation.report.tables import Column, Row, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

_SHARE = Column(
    key="share",
    title="share",
    meaning="Of the starts. Each candidate plan of each start was simulated.",
    unit="%",
    digits=1,
)
_NUMBER = Column(key="number", title="starts", meaning="How many starts the share is of.", unit="n")
_PLANNING_ROWS = {
    **{key: f"safe: {name}" for key, name in PLANS.items()},
    "accepted": "Γ accepts a plan",
    "gain": "Γ's way from default to hindsight",
}
_ABLATION_COLUMNS = (
    Column(
        key="auc",
        title="AUC",
        meaning="Of every moment, by b_safe / (1 − μ): 1 is perfect, 0.5 is guessing.",
        better=1,
    ),
    Column(
        key="auc_gain",
        title="over the baseline",
        meaning="By how much the AUC exceeds the baseline's on the same motions, resampled in "
        "pairs: where the interval includes zero the difference may be chance.",
        better=1,
    ),
    Column(key="safe_recall", title="safe recall", meaning="Of what stays safe.", better=1),
    Column(key="unsafe_recall", title="unsafe recall", meaning="Of what becomes unsafe.", better=1),
    Column(key="brier", title="Brier", meaning="Mean squared error; 0 is perfect.", better=-1),
    Column(key="calibrated_auc", title="AUC by the heads", meaning="Without the grid.", better=1),
    Column(key="k0.auc", title="AUC, k = 0", meaning="Before the motion starts.", better=1),
    Column(
        key="k0.auc_gain",
        title="over the baseline, k = 0",
        meaning="Likewise, before the motion starts.",
        better=1,
    ),
)


@dataclass(frozen=True, kw_only=True)
class Study:
    """A section of its own.

    Attributes:
        key: Its name among files, and of its place on the page.
        title: Its heading.
        meaning: What was asked.
        verdict: In a sentence of plain language, what came out and who wins.
        command: What made it.
        tables: Its tables.
        picture: Its figure.
        notes: What else is to be known.
    """

    key: str
    title: str
    meaning: str
    verdict: str
    command: str
    tables: Sequence[Table]
    picture: Picture
    notes: Sequence[str] = field(default_factory=list)


def planning_section(results: Results) -> Study:
    """What choosing plans by Γ is worth.

    Args:
        results: What `plan-study` wrote.
    """
    figures = {
        key.removeprefix("planning."): figure
        for key, figure in results.figures.items()
        if key.startswith("planning.")
    }
    table = Table(
        key="planning",
        title="Who takes the plan",
        meaning="",
        corner="plan",
        columns=(_SHARE, _NUMBER),
        rows=[
            Row(key=key, label=label, figures=[figures[key], _counted(figures[key])])
            for key, label in _PLANNING_ROWS.items()
            if key in figures
        ],
    )
    candidates = results.entries.get("candidates", "?")
    return Study(
        key="planning",
        title="Choosing plans",
        meaning=f"From each of {_number(figures)} fresh starts {candidates} plans were simulated: "
        "the default plan, and others that would do. Before anything moved Γ chose the one that it "
        "takes to be safest. The best in hindsight is what nobody can know beforehand: safe where "
        "any of the plans is.",
        verdict=planning_verdict(figures),
        command=str(results.entries.get("command", "")),
        tables=[table],
        picture=planning_figure(figures),
    )


def planning_verdict(figures: Mapping[str, Figure]) -> str:
    """Who wins, in a sentence.

    Args:
        figures: Those of a :class:`~drake_safety.evaluation.planning_study.PlanningStudy`.
    """
    default, chosen, gain = (figures.get(key) for key in ("default", "chosen", "gain"))
    if default is None or chosen is None or gain is None:
        return "The study's figures are incomplete: make it again."
    shares = (
        f"{_percent(chosen)} of the starts stay safe with the plan that Γ chooses and "
        f"{_percent(default)} with the default plan"
    )
    if not math.isfinite(gain.value):
        return (
            f"Nobody wins: {shares}, and no other candidate would have saved a start that the "
            "default plan loses."
        )
    way = f"{_percent(gain, 0)} of the way to the best plan in hindsight"
    if gain.low > 0.0:
        return f"Γ wins: {shares}, which is {way}."
    if gain.high < 0.0:
        return f"The default plan wins: {shares}; choosing by Γ leads away from the best plan."
    return f"Nobody wins beyond chance: {shares}, {way}, an interval that includes zero."


def ablation_section(file: AblationFile) -> Study:
    """What each choice in learning Γ is worth.

    Args:
        file: What `ablate` wrote.
    """
    rows, entries = list(file.rows.values()), file.entries
    is_quick = file.path.stem.endswith("_quick")
    baseline = file.rows[BASELINE].figures
    count = baseline["k0.auc"].n if "k0.auc" in baseline else baseline["auc"].n
    table = Table(
        key="ablation",
        title="One choice made otherwise at a time",
        meaning="",
        corner="variant",
        columns=_ABLATION_COLUMNS,
        rows=[
            Row(
                key=row.name,
                label=_spoken_name(row),
                figures=[row.figures.get(column.key) for column in _ABLATION_COLUMNS],
            )
            for row in rows
        ],
    )
    notes = [f"Left out, {what}: {why}." for what, why in _items(entries.get("left_out"))]
    if is_quick:
        notes.insert(
            0, "Made in a hurry, with --quick: short training, few episodes; not to be quoted."
        )
    return Study(
        key="ablation",
        title="What each choice is worth",
        meaning="Γ was learned anew from the same episodes with one choice made otherwise at a "
        f"time, and judged on the same {count} fresh motions.",
        verdict=ablation_verdict(rows),
        command=str(entries.get("command", "")),
        tables=[table, *_counting_tables(_items(entries.get("n_f")))],
        picture=ablation_figure(rows),
        notes=notes,
    )


def ablation_verdict(rows: Sequence[AblationRow]) -> str:
    """Which variants the baseline beats, and which beat it, in a sentence.

    Args:
        rows: Of an ablation; the baseline's own is left out.
    """
    ahead, behind, num_open = [], [], 0
    for row in rows:
        gain = row.figures.get("auc_gain")
        if row.name == BASELINE or gain is None:
            continue
        if gain.low > 0.0:
            ahead.append(row)
        elif gain.high < 0.0:
            behind.append(row)
        else:
            num_open += 1
    total = len(ahead) + len(behind) + num_open
    if not total:
        return "There is nothing yet to compare the baseline with."

    def named(which: list[AblationRow]) -> str:
        best_first = sorted(which, key=lambda row: -row.figures["auc_gain"].value)
        return ", ".join(
            f"{_spoken_name(row)} ({row.figures['auc_gain'].value:+.3f})" for row in best_first
        )

    winner = f"No variant beats the baseline's AUC beyond chance ({total} tried)"
    if ahead:
        winner = f"{len(ahead)} of {total} variants beat the baseline's AUC: {named(ahead)}"
    loser = "it beats none of them"
    if behind:
        loser = f"it beats {len(behind)}: {named(behind)}"
    return f"{winner}; {loser}; for {num_open} the interval of the difference includes zero."


def _counting_tables(found: Sequence[tuple[str, Any]]) -> list[Table]:
    """What n_f counts in the paper's adaptation, a table a plant and mode."""
    columns = [c for c in _ABLATION_COLUMNS if not c.key.startswith(("k0.", "calibrated"))]
    tables = []
    for place, judged in found:
        rows = [
            Row(
                key=who,
                label=spoken(who),
                figures=[
                    as_figure(figures[c.key]) if is_figure(figures.get(c.key)) else None
                    for c in columns
                ],
            )
            for who, figures in _items(judged)
        ]
        variation, _, mode = place.rpartition(".")
        tables.append(
            Table(
                key=f"ablation_n_f_{variation}_{mode}",
                title=f"What n_f counts: {mode}, adapted to “{variation}”",
                meaning="The paper's adaptation, with n_f the samples of a cell or all feedback; "
                "“over the baseline” is over the assessment before feedback.",
                corner="n_f",
                columns=columns,
                rows=rows,
            )
        )
    return tables


def _items(mapping: Any) -> list[tuple[str, Any]]:
    return list(mapping.items()) if isinstance(mapping, Mapping) else []


def _spoken_name(row: AblationRow) -> str:
    return spoken(row.name).replace("=", " = ")


def _counted(figure: Figure) -> Figure:
    return Figure(float(figure.n), math.nan, math.nan, figure.n)


def _number(figures: Mapping[str, Figure]) -> int:
    return max((figure.n for figure in figures.values()), default=0)


def _percent(figure: Figure, digits: int = 1) -> str:
    value, low, high = (100.0 * x for x in (figure.value, figure.low, figure.high))
    return f"{value:.{digits}f} % ({low:.{digits}f}–{high:.{digits}f})"
