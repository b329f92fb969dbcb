"""Tables of results in README and docs, generated from stored evaluations.

The text between ``<!-- results: NAME -->``, or ``<!-- summary: NAME -->``, and ``<!-- end -->`` is
generated from ``docs/results/NAME.json`` alone.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from drake_safety.cli.training_folder import MODES
from drake_safety.evaluation.figure_style import label_of
from drake_safety.evaluation.plan_study import SAFE_RECALL, UNSAFE_RECALL
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.tables import Column, Table, rows_of
from drake_safety.evaluation.verdict_tables import INPUTS, TARGETS, set_title, verdict_table
from studies.shift_table import shifts_text
from studies.walking_table import walking_text

RESULTS_FOLDER = Path("docs/results")
_BLOCK = re.compile(
    r"(?P<start><!-- (?P<kind>results|summary|readings|converged|shifts|walking): "
    r"(?P<name>[\w-]+) -->\n).*?"
    r"(?P<end><!-- end -->)",
    re.DOTALL,
)
_OPEN = re.compile(r"<!-- (?:results|summary|readings|converged|shifts|walking): ([\w-]+) -->")
_PERCENT = Column("", "", "%", digits=1)
_SHARE = Column("", "")
_RECALLS = ("safe_recall", "unsafe_recall", "auc")


def rewrite_readme(path: Path, folder: Path = RESULTS_FOLDER) -> list[str]:
    """Rewrites every block of results in a Markdown file.

    Args:
        path: The file.
        folder: Folder of the stored results.

    Returns:
        The names of its results.

    Raises:
        ValueError: It has no block, a block does not end, or results are missing.
    """
    text = path.read_text(encoding="utf-8")
    names = [match["name"] for match in _BLOCK.finditer(text)]
    if not names:
        raise ValueError(
            f"{path} has no block of results: put <!-- results: NAME --> and <!-- end --> where "
            f"those of {RESULTS_FOLDER}/NAME.json belong"
        )
    generated = generate(text, folder)
    if generated != text:
        path.write_text(generated, encoding="utf-8")
    return names


def generate(text: str, folder: Path) -> str:
    """Replaces every block of results in a text by the stored ones.

    Args:
        text: The Markdown.
        folder: Folder of the stored results.

    Raises:
        ValueError: A block does not end, or results are missing.
    """
    blocks = [match["name"] for match in _BLOCK.finditer(text)]
    if blocks != (opened := _OPEN.findall(text)):
        raise ValueError(
            f"README: results begin for {opened}, but <!-- end --> comes only after {blocks}"
        )

    def block(match: re.Match[str]) -> str:
        file = folder / f"{match['name']}.json"
        if not file.is_file():
            there = sorted(path.stem for path in folder.glob("*.json"))
            raise ValueError(
                f"README: there are no results '{match['name']}' in {folder}; there are {there}: "
                "`python -m studies store RUN` writes them"
            )
        return f"{match['start']}{_MAKE[match['kind']](Results.read(file))}\n{match['end']}"

    return _BLOCK.sub(block, text)


def results_text(results: Results) -> str:
    """Commands, counts and tables of an evaluation, as Markdown."""
    parts = [_commands(results), _counts(results)]
    if results.has("plans."):
        parts += _targets(results)
    else:
        parts += _moments(results)
    if results.has("throws."):
        parts += _throws(results)
    return "\n\n".join(part for part in parts if part)


def summary_text(results: Results) -> str:
    """Counts and the main table of an evaluation, as Markdown."""
    if results.has("plans."):
        sets = {f"{prefix}.sharpened": set_title(prefix) for prefix in _plan_sets(results)[1:]}
        methods = ("paper", "gradient_boosting", "mlp", "reachability", "reachability_free")
        names = {
            "plans.sharpened": "`sharpened`",
            **{prefix: f"`sharpened`, {title}" for prefix, title in sets.items()},
            **{f"plans.{method}": _named(method) for method in methods},
        }
        own = {
            "converged.first.literal": "`paper`, b_safe < 0.6",
            "converged.fair.literal": "`paper`, b_safe < 0.6, fair targets",
            "converged.first.converged": "`paper`, b_safe < 0.6 after adaptation",
            "converged.fair.converged": "`paper`, b_safe < 0.6 after adaptation, fair targets",
        }
        names |= {prefix: name for prefix, name in own.items() if results.has(prefix)}
        table = _rows(results, "all targets", names)
        printed = f"*{SAFE_RECALL:.3f}* | *{UNSAFE_RECALL:.3f}*"
        return f"{_counts(results)}\n\n{table}\n| *the paper's own* | {printed} | |"
    columns = {
        "every segment, AUC": ("segments.{}.auc", _SHARE),
        "first row, AUC": ("episodes.{}.auc", _SHARE),
        "falls with recovery": ("throws.{}.falls_with_recovery", _PERCENT),
        "false triggers": ("throws.{}.false_triggers", _PERCENT),
    }
    lines = [f"| | {' | '.join(columns)} |", "|---|" + "---|" * len(columns)]
    for method in ("sharpened", "paper", "gradient_boosting", "mlp"):
        cells = []
        for key, column in columns.values():
            wanted = (key.format(method), key.format(f"{method}_literal_0.6"))
            found = next((results[one] for one in wanted if one in results), None)
            cells.append("" if found is None else column.text(found))
        if any(cells):
            lines.append(f"| {_named(method)} | {' | '.join(cells)} |")
    adapted = (
        "converged.segments.converged.auc",
        "converged.first.converged.auc",
        "converged.throws.converged.falls_with_recovery",
        "converged.throws.converged.false_triggers",
    )
    if all(key in results for key in adapted):
        formats = [column for _, column in columns.values()]
        cells = [column.text(results[key]) for key, column in zip(adapted, formats, strict=True)]
        lines.append(f"| `paper`, b_safe < 0.6 after adaptation | {' | '.join(cells)} |")
    parts = [_counts(results), "\n".join(lines)]
    if "throws.falls_without_recovery" in results:
        alone = results["throws.falls_without_recovery"]
        parts.insert(1, f"Of {alone.n} fresh throws {_PERCENT.text(alone)} fall without recovery.")
    return "\n\n".join(parts)


def readings_text(results: Results) -> str:
    """Table of the readings of the paper, as Markdown."""
    entries = results.entries.get("readings")
    if entries is None:
        return "Not measured yet."
    columns = {
        "every segment, AUC": ("segments.normalized.auc", _SHARE),
        "k = 0, AUC": ("first.normalized.auc", _SHARE),
        "safe recall": ("first.normalized.safe_recall", _SHARE),
        "unsafe recall": ("first.normalized.unsafe_recall", _SHARE),
        "at 0.6, safe": ("first.converged.safe_recall", _SHARE),
        "at 0.6, unsafe": ("first.converged.unsafe_recall", _SHARE),
    }
    lines = [f"| reading | {' | '.join(columns)} |", "|---|" + "---|" * len(columns)]
    for position, name in enumerate(entries["names"]):
        cells = [
            column.text(results[f"readings.{position}.{key}"]) for key, column in columns.values()
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    n = results["readings.0.first.normalized.auc"].n
    counts = (
        f"Each is learned from {entries['training_episodes']} episodes and judged on {n} fresh "
        f"ones of seed {entries['seed']}."
    )
    return "\n\n".join([f"```sh\n{entries['command']}\n```", counts, "\n".join(lines)])


def converged_text(results: Results) -> str:
    """Tables of the paper's mode before and after its adaptation, as Markdown."""
    entries, estimates = results.entries["converged"], results
    rules = {
        "literal": "b_safe < 0.6, before adaptation",
        "converged": "b_safe < 0.6, after adaptation",
        "normalized": "safe share, balanced threshold",
        "conformal": "safe share, promised miss rate 1 %",
    }
    sets = {"segments": "every segment", "first": "k = 0", "fair": "k = 0, fair targets"}
    lines = ["| | threshold | safe recall | unsafe recall | AUC |", "|---|---|---|---|---|"]
    for kind, place in sets.items():
        for rule, name in rules.items():
            prefix = f"converged.{kind}.{rule}"
            if f"{prefix}.auc" in estimates:
                cells = [f"{estimates[f'{prefix}.threshold'].value:.2f}"]
                cells += [
                    _SHARE.text(estimates[f"{prefix}.{key}"])
                    for key in ("safe_recall", "unsafe_recall", "auc")
                ]
                lines.append(f"| {place}: {name} | {' | '.join(cells)} |")
    parts = [
        f"```sh\n{entries['command']}\n```",
        f"Learned from {entries['training_episodes']} episodes; {entries['feedback_episodes']} "
        "other nominal episodes are the feedback and choose the thresholds.",
        "\n".join(lines),
    ]
    brier = [
        _SHARE.text(estimates[key])
        for rule in ("normalized", "adapted", "discrepancy")
        if (key := f"converged.segments.{rule}.brier") in estimates
    ]
    if len(brier) == 3:
        before, after, prior_alone = brier
        parts.append(
            f"Brier score of the safe share on every segment, without a gap: {before} before "
            f"adaptation, {after} after it, {prior_alone} if feedback updates the prior alone, "
            "without feedback beliefs."
        )
    if results.has("converged.throws."):
        columns = {"falls with recovery": "falls_with_recovery", "false triggers": "false_triggers"}
        lines = [f"| throws, b_safe < 0.6 | {' | '.join(columns)} |", "|---|---|---|"]
        for rule, name in {"before": "before adaptation", "converged": "after adaptation"}.items():
            found = (estimates[f"converged.throws.{rule}.{key}"] for key in columns.values())
            lines.append(f"| {name} | {' | '.join(map(_PERCENT.text, found))} |")
        alone = estimates["converged.throws.falls_without_recovery"]
        parts.append(
            f"{alone.n} throws at the actual plant, after {entries['feedback_pairs']} pairs of it; "
            f"{_PERCENT.text(alone)} fall without recovery."
        )
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


_MAKE = {
    "results": results_text,
    "summary": summary_text,
    "readings": readings_text,
    "converged": converged_text,
    "shifts": shifts_text,
    "walking": walking_text,
}
"""Text of each kind of block."""


def _named(method: str) -> str:
    return f"`{method}`" if method in MODES else label_of(method)


def _commands(results: Results) -> str:
    keys = ("train_command", "command", "learning_curve_command")
    lines = [results.entries.get(key) for key in keys]
    return "\n".join(["```sh", *(line for line in lines if line), "```"])


def _counts(results: Results) -> str:
    entries, estimates = results.entries, results
    judged = estimates.get("plans.outcomes.safe") or estimates.get("episodes.share_unsafe")
    words = [
        f"Trained on {entries.get('training_episodes')} episodes of seed "
        f"{entries.get('training_seed')}."
    ]
    if judged is not None:
        kind = "safe" if "plans.outcomes.safe" in estimates else "unsafe"
        words.append(
            f"Evaluated on {judged.n} fresh ones of seed {entries.get('seed')}, of which "
            f"{_PERCENT.text(judged)} are {kind}."
        )
    calibration = entries.get("calibration_episodes")
    if calibration is not None:
        words.append(f"Thresholds come from {calibration} other episodes.")
    studied = entries.get("converged")
    if studied is not None and studied["training_episodes"] != entries.get("training_episodes"):
        words.append(f"`paper` has learned from {studied['training_episodes']} episodes.")
    words.append("Intervals are 95 %.")
    if results.has("segments.paper.") or results.has("plans.paper."):
        words.append(INPUTS)
    return " ".join(words)


def _moments(results: Results) -> list[str]:
    titles = {"segments": "every segment", "episodes": "first row, k = 0"}
    parts = [
        verdict_table(results, key, corner=corner).to_markdown()
        for key, corner in titles.items()
        if results.select(set=key)
    ]
    ahead = [
        f"{_SHARE.text(results[key])} {place}"
        for kind, place in (("segments", "per segment"), ("episodes", "at k = 0"))
        if (key := f"{kind}.sharpened_minus_best_classifier.auc") in results
    ]
    if ahead:
        parts.append(f"`sharpened` minus the better classifier, AUC: {', '.join(ahead)}.")
    return parts


def _throws(results: Results) -> list[str]:
    table = verdict_table(results, "throws", corner="trigger")
    alone = results["throws.falls_without_recovery"]
    remark = (
        f"{alone.n} fresh throws (seed {int(results.entries.get('seed', 0)) + 1}); "
        f"{_PERCENT.text(alone)} fall without recovery."
    )
    return [remark, table.to_markdown(), _ahead(table), _broken(results)]


def _broken(results: Results) -> str:
    """Numbers of successful recoveries that violate a hardware limit."""
    prefix = "throws.sharpened.recoveries_with_"
    found = {
        key.removeprefix(prefix).replace("_", " "): estimate
        for key, estimate in results.items()
        if key.startswith(prefix)
    }
    if not found:
        return ""
    counts = [f"{kind} {round(estimate.value * estimate.n)}" for kind, estimate in found.items()]
    (n,) = {estimate.n for estimate in found.values()}
    violations = ", ".join(counts)
    return (
        f"Of {n} successful recoveries by `sharpened`, numbers that violate a limit: {violations}."
    )


def _targets(results: Results) -> list[str]:
    table = verdict_table(results, "plans", corner=set_title("plans")).narrow(_RECALLS)
    printed = f"*{SAFE_RECALL:.3f}* | *{UNSAFE_RECALL:.3f}* | |"
    parts = [f"{table.to_markdown()}\n| *the paper's own* | {printed}", _ahead(table)]
    prefixes = _plan_sets(results)
    if len(prefixes) > 1:
        names = {f"{prefix}.sharpened": set_title(prefix) for prefix in prefixes}
        parts.append(_rows(results, "`sharpened` on", names))
    parts.append(_differences(results))
    right = results.get("plans.causes.right_cause")
    if right is not None and right.n:
        parts.append(
            f"The correct cause is named for {_PERCENT.text(right)} of the {right.n} correctly "
            "refused targets."
        )
    pattern = re.compile(r"(plans\.learning_curve\.(\d+))\.safe_recall")
    found = (pattern.fullmatch(key) for key in results)
    sizes = {match[1]: match[2] for match in found if match}
    if sizes:
        ordered = sorted(sizes, key=lambda prefix: int(sizes[prefix]))
        names = {prefix: sizes[prefix] for prefix in ordered}
        parts.append(_rows(results, "training episodes", names))
    return parts


def _rows(results: Results, corner: str, prefixes: Mapping[str, str]) -> str:
    """Recalls and AUC by prefix, as Markdown."""
    rows = rows_of(results, prefixes, TARGETS)
    return Table(corner=corner, columns=TARGETS, rows=rows).narrow(_RECALLS).to_markdown()


def _plan_sets(results: Results) -> list[str]:
    """The judged sets of plans, that of all plans first."""
    sets = [row.set for row in results.select(method="outcomes", metric="safe") if row.n]
    return sorted(sets, key=lambda name: (name.count("."), name))


def _points(loss: float) -> str:
    return f"{0.0 - 100.0 * loss:+.1f}"


def _differences(results: Results) -> str:
    """Differences of the recalls of `sharpened` between the hands."""
    lost = {
        what: results.get(f"plans.other_hand.sharpened.{what}_recall_loss")
        for what in ("safe", "unsafe")
    }
    losses = [
        f"{_points(loss.value)} ({_points(loss.high)} to {_points(loss.low)}) points of "
        f"{what} recall"
        for what, loss in lost.items()
        if loss is not None
    ]
    if not losses:
        return ""
    (n,) = {loss.n for loss in lost.values() if loss is not None}
    return (
        f"On the same {n} targets, mirrored, the other hand minus the trained one: "
        f"{', '.join(losses)}."
    )


def _ahead(table: Table) -> str:
    ahead = table.better_baselines()
    return f"Better than `sharpened`: {'; '.join(ahead)}." if ahead else ""
