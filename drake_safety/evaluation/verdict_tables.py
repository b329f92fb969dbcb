"""The tables of an evaluation: which metrics each judged set shows, under which heading."""

from collections.abc import Sequence

from drake_safety.evaluation.figure_style import label_of
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
_JUDGED = (_AUC, *_RECALLS, _BRIER)
_CALIBRATIONS = (
    Column("promised_miss_rate", "promised miss rate", "=%", digits=1),
    Column("miss_rate", "miss rate", "%", digits=1),
    Column("unsafe_unknown", "unsafe: don't know", "%", digits=1),
    Column("safe_recall", "safe recall", "%", digits=1),
    Column("safe_unknown", "safe: don't know", "%", digits=1),
    Column("false_alarm_rate", "false-alarm rate", "%", digits=1),
)
_CALIBRATION = "Stored calibrations on fresh motions"
_RATES = "Promised and observed rates of the thresholds of the probability."

# By set: title, explanation and columns of its table.
_KINDS: dict[str, tuple[str, str, Sequence[Column]]] = {
    "segments": (
        "Every segment of the motion",
        f"Does a motion stay safe from a segment to its end? {_SCORES} Recalls are at the "
        f"threshold of best balanced accuracy on other motions. {INPUTS}",
        _JUDGED,
    ),
    "episodes": (
        "Before the motion starts",
        "The same for the first segment of each motion (k = 0).",
        _JUDGED,
    ),
    "throws": (
        "Triggers of recovery: balls thrown at the robot",
        "Balls are thrown at the robot; each method triggers recovery steps.",
        (
            Column("threshold", "threshold", "=", digits=2),
            Column("falls_with_recovery", "falls", "%", -1, 1),
            Column("false_triggers", "false triggers", "%", -1, 1),
            Column("falls_missed", "falls missed", "of", -1),
            Column("trigger_after_impact_s", "after impact", "ms", digits=0),
            Column("trigger_before_fall_s", "lead time to the fall", "s", digits=2),
        ),
    ),
    "plans": (
        "Targets before the motion starts: all targets",
        "Each target is classified at k = 0; the simulated motion towards it is the reference. "
        f"{_SCORES} {INPUTS}",
        (*_RECALLS, _AUC, _BRIER, Column("threshold", "threshold", "=")),
    ),
    **{
        f"calibration.{kind}{plants}": (f"{_CALIBRATION}: {when}{over}", _RATES, _CALIBRATIONS)
        for plants, over in (("", ""), (".family", ", over the family"))
        for kind, when in (("plan", "before the motion"), ("motion", "during the motion"))
    },
}
"""By judged set."""


def verdict_table(results: Results, set: str, *, corner: str = "method") -> Table:
    """The table of a judged set: a row for each method that has the second column of its kind."""
    title, meaning, columns = _KINDS[set]
    methods = [key[1] for key in results if (key[0], key[2]) == (set, columns[1].key) and key[1]]
    if methods and (first := results.get((set, methods[0], "auc"))):
        meaning += f" Evaluated on {first.n} fresh motions."
    if alone := results.get((set, "", "falls_without_recovery")):
        end = f"{_SHARE.text(alone)} end in a fall without recovery."
        meaning += f" Of {alone.n} fresh throws, {end}"
    labels = {(set, method): label_of(method) for method in methods}
    rows = rows_of(results, labels, columns)
    return Table(corner=corner, columns=columns, rows=rows, title=title, meaning=meaning)


def verdict_tables(results: Results) -> list[Table]:
    """The tables of all judged sets, and of the outcomes of plans."""
    sets = dict.fromkeys(set for set, _, _ in results if set in _KINDS)
    tables = [verdict_table(results, set) for set in sets]
    outcomes = [metric for set, method, metric in results if (set, method) == ("plans", "outcomes")]
    columns = [Column(name, label_of(name), "%", digits=1) for name in outcomes]
    rows = rows_of(results, {("plans", "outcomes"): "all targets"}, columns)
    title = "Outcomes of the motions: safe, or the violated constraint"
    tables.append(Table(corner="targets", columns=columns, rows=rows, title=title))
    return [table for table in tables if table.rows]
