"""Outcomes of episodes in files, which any simulator may have written, and verdicts on them."""

import csv
import io
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_safety.evaluation.loop_comparison import Verdict, check_levels, verdict_of
from drake_safety.evaluation.outcomes import Outcome
from drake_safety.evaluation.paired_test import interim_estimate
from drake_safety.files.atomic import write_file
from drake_safety.files.reading import is_number, reading
from drake_safety.learning.seeds import GATE

FAILED = "failed"
_EPISODE = "episode"
_WORDS = {"true": 1.0, "false": 0.0}  # As pandas writes booleans.


def write_outcomes(file: Path, outcomes: Iterable[Outcome]) -> None:
    """Writes a CSV file that :func:`read_outcomes` reads."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([_EPISODE, FAILED, "time_s", "cause"])
    writer.writerows([one.episode, f"{one.value:g}", one.time_s, one.cause] for one in outcomes)
    write_file(file, text.getvalue())


def read_outcomes(path: Path, metric: str = FAILED) -> dict[str, float]:
    """Reads outcomes from 0 to 1 by episode; larger is worse.

    Args:
        path: A CSV file with the column ``episode``, or LeRobot's ``eval_info.json``.
        metric: A column: ``failed`` has 0 or 1, any other column values from 0 to 1. With
            ``COLUMN=BOUND`` an episode fails if its value exceeds the bound.
    """
    outcomes: dict[str, float] = {}
    with reading(path, "outcomes", (ValueError, csv.Error)):
        text = path.read_text(encoding="utf-8-sig")
        is_json = path.suffix == ".json"
        if is_json and metric != FAILED:
            raise ValueError(f"LeRobot's successes are the metric '{FAILED}'; got '{metric}'")
        for where, name, value in _lerobot(json.loads(text)) if is_json else _rows(text, metric):
            if not name:
                raise ValueError(f"{where}: '{_EPISODE}' is empty")
            if name in outcomes:
                raise ValueError(f"{where}: episode '{name}' stands twice")
            outcomes[name] = value
        if not outcomes:
            raise ValueError("it has no episodes")
    return outcomes


def _rows(text: str, metric: str) -> Iterator[tuple[str, str, float]]:
    """Place, episode and outcome of each row of a CSV file."""
    column, has_bound, bound = metric.partition("=")
    if has_bound and not (is_number(bound) and math.isfinite(float(bound))):
        raise ValueError(f"metric '{metric}': expected a column, or COLUMN=BOUND with a number")
    rows = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True)
    columns = rows.fieldnames or []
    if missing := [name for name in (_EPISODE, column) if columns.count(name) != 1]:
        raise ValueError(f"expected one column each of {missing}; it has {list(columns)}")
    wanted = "0 or 1" if column == FAILED else "a number" if has_bound else "0 to 1"
    for row in rows:
        where, cell = f"line {rows.line_num}", (row[column] or "").strip()
        if more := row.get(None):  # DictReader puts them there.
            raise ValueError(f"{where}: expected {len(columns)} cells; the rest is {more}")
        value = _WORDS.get(cell.lower(), float(cell) if is_number(cell) else math.nan)
        is_right = value in (0.0, 1.0) if column == FAILED else 0.0 <= value <= 1.0
        if math.isnan(value) or not (is_right or has_bound):
            raise ValueError(f"{where}: '{column}' must be {wanted}; got '{cell}'")
        outcome = float(value > float(bound)) if has_bound else value
        yield where, (row[_EPISODE] or "").strip(), outcome


def _lerobot(info: Any) -> Iterator[tuple[str, str, float]]:
    """The same of ``eval_info.json``: lists by task; of older versions a list of episodes."""
    try:
        where = "per_task" if "per_task" in info else "per_episode"
        if where == "per_task":
            tasks = [(f"{t['task_group']}/{t['task_id']}", t["metrics"]) for t in info[where]]
            pairs = [(f"{n}/{k}", x) for n, m in tasks for k, x in enumerate(m["successes"])]
        else:
            key = "episode_ix" if any(r.get("seed") is None for r in info[where]) else "seed"
            pairs = [(f"{key} {r[key]}", r["success"]) for r in info[where]]
    except (KeyError, TypeError, AttributeError) as error:
        what = "'per_task' with 'task_group', 'task_id' and 'metrics: successes', or 'per_episode'"
        raise ValueError(f"it is not an eval_info.json of LeRobot: expected {what}") from error
    for name, success in pairs:
        if success not in (0, 1):
            raise ValueError(f"episode '{name}': success must be true or false; got {success!r}")
        yield where, name, 1.0 - success


def compare_outcomes(
    baseline: Mapping[str, float],
    candidate: Mapping[str, float],
    *,
    worse_by: float = 0.02,
    alpha: float = 0.05,
    seed: int = GATE.first,
) -> Verdict:
    """Compares outcomes by episode, as `compare_loops` does at its last look.

    A single look at all episodes does not depend on their order. If all episodes differ, pairs are
    drawn by ``seed``, as many as the smaller set has: bets on independent pairs are valid too.
    """
    check_levels(worse_by, alpha)
    if (common := baseline.keys() & candidate.keys()) and (apart := baseline.keys() ^ candidate):
        raise ValueError(
            f"{len(common)} episodes are in both sets, and {len(apart)} in one, such as "
            f"'{min(apart)}': give a crashed episode the outcome 1, and other episodes other names"
        )
    names = [sorted(one, key=lambda name: (len(name), name)) for one in (baseline, candidate)]
    if not (is_paired := names[0] == names[1]):
        rng = np.random.default_rng(seed)
        names = [rng.permutation(one).tolist() for one in names]
    pairs = [
        (_outcome(one, baseline[one]), _outcome(two, candidate[two]))
        for one, two in zip(*names, strict=False)
    ]
    differences = [two.value - one.value for one, two in pairs]
    verdict = verdict_of(pairs, [interim_estimate(differences, [], alpha)], worse_by)
    return replace(verdict, is_paired=is_paired)


def _outcome(episode: str, value: float) -> Outcome:
    return Outcome(
        episode=episode, value=value, time_s=math.nan, cause="", commanded=(), belief=None
    )
