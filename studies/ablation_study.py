"""Runs ablations; rows are stored as they finish, so that stopped ablations continue."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.evaluation.figure_style import spoken
from drake_safety.evaluation.metrics import Bootstrap, Estimate
from drake_safety.learning.assessment import AssessmentParameters
from drake_safety.simulation.worker_processes import parallel_map
from studies.ablation import (
    BASELINE,
    AblationSets,
    Variant,
    VariantScores,
    judged_segments,
    unsafe_scores,
    variant_estimates,
)

_SCHEMA = "drake_safety.ablation"


@dataclass(frozen=True, kw_only=True)
class AblationRow:
    """Results of a variant.

    Attributes:
        name: Name of the variant.
        group: The choice.
        fingerprint: Hash of everything that determines the estimates.
        estimates: By key.
    """

    name: str
    group: str
    fingerprint: str
    estimates: Mapping[str, Estimate]


@dataclass(kw_only=True)
class AblationFile:
    """Finished rows, in a JSON file that is replaced atomically.

    Attributes:
        path: The file.
        entries: Other entries, such as command and versions.
        rows: Rows by name of the variant.
    """

    path: Path
    entries: dict[str, Any] = field(default_factory=dict)
    rows: dict[str, AblationRow] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path, entries: Mapping[str, Any]) -> AblationFile:
        """Opens a new file, or that of an earlier run.

        Args:
            path: The file.
            entries: Other entries, which replace existing ones.

        Raises:
            ValueError: The file holds no ablation.
        """
        rows = cls.read(path).rows if path.is_file() else {}
        return cls(path=path, entries=dict(entries), rows=rows)

    @classmethod
    def read(cls, path: Path) -> AblationFile:
        """Reads a file.

        Raises:
            ValueError: The file holds no ablation.
            OSError: The file does not exist.
        """
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if content.pop("schema") != _SCHEMA:
                raise ValueError(f"its schema is not '{_SCHEMA}'")
            rows = {}
            for row in content.pop("rows"):
                estimates = {
                    key: Estimate.from_json(value) for key, value in row.pop("figures").items()
                }
                rows[row["name"]] = AblationRow(**row, estimates=estimates)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"{path} holds no ablation: {error!r}") from error
        return cls(path=path, entries=content, rows=rows)

    @property
    def is_whole(self) -> bool:
        """Whether the ablation is complete."""
        return "left_out" in self.entries

    def keep(self, row: AblationRow) -> None:
        """Adds a row and writes the file."""
        self.rows[row.name] = row
        self.write()

    def write(self) -> None:
        """Writes the file through a temporary one."""
        rows = [
            {key: value for key, value in vars(row).items() if key != "estimates"}
            | {"figures": {key: one.to_json() for key, one in row.estimates.items()}}
            for row in self.rows.values()
        ]
        text = json.dumps({"schema": _SCHEMA, **self.entries, "rows": rows}, indent=2)
        temporary = self.path.with_name(f".{self.path.name}.tmp")
        temporary.write_text(text + "\n", encoding="utf-8")
        temporary.replace(self.path)


def rows_to_csv(rows: Sequence[AblationRow]) -> str:
    """The rows as CSV: value, ends of the interval and n of every estimate."""
    keys = list(dict.fromkeys(key for row in rows for key in row.estimates))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    ends = ("value", "low", "high", "n")
    columns = [key if end == "value" else f"{key}.{end}" for key in keys for end in ends]
    writer.writerow(["choice", "variant", *columns])
    for row in rows:
        cells: list[Any] = [row.group, row.name]
        for key in keys:
            estimate = row.estimates.get(key)
            fields = {} if estimate is None else estimate.to_json()
            cells += ["" if fields.get(end) is None else fields[end] for end in ends]
        writer.writerow(cells)
    return out.getvalue()


def fingerprint(
    variant: Variant, base: AssessmentParameters, sets: AblationSets, version: str
) -> str:
    """Hash of everything that determines a row: variant, baseline, episodes and version."""
    described = {
        name: [one.load().info.scenario_hash, one.load().info.seed, one.count]
        for name, one in vars(sets).items()
    }
    text = json.dumps(
        [
            asdict(variant.parameters(base)),
            asdict(base),
            variant.num_episodes,
            list(variant.without),
            described,
            version,
        ],
        sort_keys=True,
    )
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def run_ablation(
    variants: Sequence[Variant],
    base: AssessmentParameters,
    sets: AblationSets,
    file: AblationFile,
    *,
    version: str,
    bootstrap: Bootstrap | None = None,
    num_workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[list[AblationRow], dict[str, str]]:
    """Trains and evaluates the variants that the file does not have.

    Scores of the baseline are stored beside the file for paired differences.

    Args:
        variants: The variants, with the baseline.
        base: Parameters of the baseline.
        sets: The episodes.
        file: File of the rows.
        version: Version of the package.
        bootstrap: Settings of the intervals.
        num_workers: Number of worker processes; one a core by default.
        progress: Called with the number done and the number wanted.

    Returns:
        The rows in the order of the variants, and the errors of failed variants.

    Raises:
        ValueError: The baseline is not among the variants, or cannot be trained.
    """
    baseline = next((one for one in variants if one.name == BASELINE), None)
    if baseline is None:
        raise ValueError(f"ablation: there is no variant '{BASELINE}' to compare with")
    marks = {one.name: fingerprint(one, base, sets, version) for one in variants}
    calibration, test = (judged_segments(s.load(), base) for s in (sets.calibration, sets.test))
    # Rows of other episodes, parameters or versions are not of this ablation.
    file.rows = {n: row for n, row in file.rows.items() if row.fingerprint == marks.get(n)}

    def is_known(variant: Variant) -> bool:
        return variant.name in file.rows

    def keep(variant: Variant, scores: VariantScores, reference: np.ndarray) -> None:
        estimates = variant_estimates(scores, reference, calibration, test, bootstrap=bootstrap)
        file.keep(
            AblationRow(
                name=variant.name,
                group=variant.group,
                fingerprint=marks[variant.name],
                estimates=estimates,
            )
        )

    done = 0

    def report(more: int) -> None:
        nonlocal done
        done += more
        if progress is not None:
            progress(done, len(variants))

    report(0)
    # The name has the fingerprint, and the file is replaced atomically: if it exists, it fits.
    kept_scores = file.path.with_name(f".{file.path.stem}-{marks[BASELINE]}.npy")
    if is_known(baseline) and kept_scores.is_file():
        reference = np.load(kept_scores, allow_pickle=False)
    else:
        own = unsafe_scores(baseline, base, sets)
        reference = own.test
        temporary = kept_scores.with_suffix(".tmp.npy")
        np.save(temporary, reference, allow_pickle=False)
        temporary.replace(kept_scores)
        keep(baseline, own, reference)
    others = [one for one in variants if one is not baseline]
    missing = [one for one in others if not is_known(one)]
    report(1 + len(others) - len(missing))
    failed: dict[str, str] = {}
    by_name = {one.name: one for one in missing}
    arguments = [(one, base, sets) for one in missing]
    for name, scores, why in parallel_map(_scores_or_why_not, arguments, num_workers):
        if scores is None:
            failed[name] = why
        else:
            keep(by_name[name], scores, reference)
        report(1)
    file.rows = {one.name: file.rows[one.name] for one in variants if is_known(one)}
    file.write()
    return list(file.rows.values()), failed


def _scores_or_why_not(
    variant: Variant, base: AssessmentParameters, sets: AblationSets
) -> tuple[str, VariantScores | None, str]:
    try:
        return variant.name, unsafe_scores(variant, base, sets), ""
    except ValueError as error:
        return variant.name, None, str(error)


def ablation_verdict(rows: Sequence[AblationRow]) -> str:
    """Names the variants that are better and worse than the baseline, in a sentence.

    Args:
        rows: Rows of an ablation.
    """
    ahead, behind, num_open = [], [], 0
    for row in rows:
        gain = row.estimates.get("auc_gain")
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
        return "There is no variant to compare with the baseline."

    def named(which: list[AblationRow]) -> str:
        best_first = sorted(which, key=lambda row: -row.estimates["auc_gain"].value)
        return ", ".join(
            f"{_spoken_name(row)} ({row.estimates['auc_gain'].value:+.3f})" for row in best_first
        )

    winner = f"No variant beats the baseline's AUC significantly ({total} tried)"
    if ahead:
        winner = f"{len(ahead)} of {total} variants beat the baseline's AUC: {named(ahead)}"
    loser = "it beats none of them"
    if behind:
        loser = f"it beats {len(behind)}: {named(behind)}"
    return f"{winner}; {loser}; for {num_open} the interval of the difference includes zero."


def _spoken_name(row: AblationRow) -> str:
    return spoken(row.name).replace("=", " = ")
