"""``python -m studies rapt``: the change detector on the recordings of RAPT (arXiv 2602.01515).

An episode is called anomalous if its largest level exceeds a limit. At most 0.5 % of the episodes
of `calibration` exceed it. RAPT takes its limit from the nominal episodes of `test` instead, so the
table has both rates. Their intervals take the limit as given.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from drake_safety.cli.console import console, open_stages, say
from drake_safety.evaluation.figure_style import spoken
from drake_safety.evaluation.metrics import Estimate, auc, proportion
from drake_safety.evaluation.tables import Column, Row, Table
from drake_safety.files.progress import stage_of
from drake_safety.files.reading import reading
from drake_safety.learning.change_detector import ChangeDetector
from drake_safety.learning.segments import Episode, Episodes, EpisodesInfo
from studies.alarms import equal_share_threshold

FALSE_POSITIVES = 0.005  # Largest share of nominal episodes above a limit.
STEP_S = 0.02
ALL, NOMINAL = "all anomalies", "nominal"
LAYOUT = (
    "DIR/TASK/{train,calibration,test}.npz with dim_names (n,) and, for each sequence, seq_00000 "
    "(T, n) and act_00000 (T, m); test also with labels (N,) and fault (N,)"
)
# True-positive rate and AUROC by task; the paper's AUROC is that of all its tasks.
_PUBLISHED = {
    "g1_velocity": {"paper": (0.74, 0.92), "dataset's card": (0.704, 0.911)},
    "g1_mimic_dance102": {"paper": (0.67, 0.92), "dataset's card": (0.695, 0.910)},
    "g1_mimic_gangnam": {"paper": (0.75, 0.92), "dataset's card": (0.631, 0.909)},
}
_COLUMNS = (
    Column("found", "anomalous by the limit of calibration", "%", digits=1),
    Column("found_as_rapt", "by the limit of test", "%", digits=1),
    Column("auc", "AUROC"),
)


class Recordings(NamedTuple):
    """A split of N sequences."""

    names: list[str]  # Names of the n observations.
    actions: list[str]  # Names of the m actions.
    sequences: list[np.ndarray]  # Observations and actions, (T, n + m), a row every 0.02 s.
    kinds: np.ndarray  # Each sequence's anomaly, or `NOMINAL`, (N,).


def rapt(
    data: Annotated[Path, typer.Option(help="Folder of the dataset.", file_okay=False)],
    task: Annotated[str, typer.Option(help="Folder of a task in it.")] = "g1_velocity",
) -> None:
    """Judge the change detector on RAPT's recordings, beside RAPT's published figures."""
    train, calibration, test = (
        read(data / task / f"{split}.npz") for split in ("train", "calibration", "test")
    )
    for other in (calibration, test):
        differing = set(other.names + other.actions) ^ set(train.names + train.actions)
        if other[:2] != train[:2]:
            where = f"splits of {data / task} differ in names or order of columns"
            raise ValueError(f"rapt: {where}; in some only: {sorted(differing)[:6]}")
    with open_stages() as stages:
        detector = learned(train, stage_of(stages, "learning"))
        others, levels = (
            np.array([detector.watch([rows])[0].max() for rows in one.sequences])
            for one in (calibration, test)
        )
    limit = -equal_share_threshold(-others, FALSE_POSITIVES)
    say(detector.describe())
    say(f"limit: level {limit:.3g}, from {len(others)} nominal episodes")
    found = judged(levels, test.kinds, limit)
    for who, figures in _PUBLISHED.get(task, {}).items():
        values = (Estimate(value, np.nan, np.nan, 0) for value in figures)
        found[f"RAPT, {who}"] = dict(zip(("found_as_rapt", "auc"), values, strict=True))
    rows = [Row(k, spoken(k), [one.get(c.key) for c in _COLUMNS]) for k, one in found.items()]
    console.print(Table(corner=task, columns=_COLUMNS, rows=rows).to_rich())


def read(file: Path) -> Recordings:
    """Reads the split in a file DIR/TASK/SPLIT.npz."""
    if not file.is_file():
        root = file.parents[1]
        paths = [*root.glob("*.npz"), *root.glob("*/*.npz")]
        there = sorted(path.relative_to(root).as_posix() for path in paths) or "no .npz file"
        raise ValueError(f"rapt: there is no {file}; {root} has {there}; expected {LAYOUT}")
    with reading(file, "recordings", Exception), np.load(file, allow_pickle=False) as arrays:
        keys = sorted(key for key in arrays if key.startswith("seq_")) or ["seq_00000"]
        pairs = {key: key.replace("seq_", "act_") for key in keys}
        labelled = ["labels", "fault"] if file.stem == "test" else []
        wanted = ["dim_names", *labelled, *keys, *pairs.values()]
        if missing := [key for key in wanted if key not in arrays]:
            text = f"no array '{missing[0]}', but {arrays.files[:6]}"
            raise ValueError(f"{text}; expected {LAYOUT}")
        names, sequences = arrays["dim_names"].astype(str).tolist(), []
        actions = [f"action {i}" for i in range(arrays[pairs[keys[0]]].shape[-1])]
        for pair in pairs.items():
            both = [arrays[key] for key in pair]
            shapes = [one.shape for one in both]
            expected = [(len(both[0]), len(columns)) for columns in (names, actions)]
            if shapes != expected:
                raise ValueError(f"{pair} have shapes {shapes}, expected {expected}")
            sequences.append(np.concatenate(both, axis=1, dtype=np.float32))
        kinds = np.full(len(keys), NOMINAL)
        if labelled:
            kinds = np.where(arrays["labels"] > 0, arrays["fault"].astype(str), NOMINAL)
    if len(kinds) != len(keys):
        raise ValueError(f"recordings '{file}': {len(kinds)} labels, of {len(keys)} sequences")
    return Recordings(names, actions, sequences, kinds)


def learned(nominal: Recordings, progress: Callable[[float], None]) -> ChangeDetector:
    """A detector that predicts all observations, by themselves and the actions."""
    fields: dict[str, Any] = dict.fromkeys(("scenario", "scenario_hash", "variation"), "rapt")
    fields |= {"seed": 0, "step_s": STEP_S, "horizon": 1, "versions": {}, "constraint_names": []}
    fields |= {"state_names": nominal.names, "feature_names": nominal.actions}
    info, n = EpisodesInfo(**fields, output_names=[]), len(nominal.names)
    episodes = []
    for index, rows in enumerate(nominal.sequences):
        arrays: dict[str, Any] = dict.fromkeys(info.widths, rows[:, :0])
        arrays |= {"state": rows[:, :n], "true_state": rows[:, :n], "features": rows[:, n:]}
        arrays |= {"time_s": STEP_S * np.arange(len(rows))}
        episodes.append(Episode(index=index, is_safe=True, cause="", **arrays))
    return ChangeDetector.fit(Episodes(info, episodes), progress)


def judged(level: np.ndarray, kinds: np.ndarray, limit: float) -> dict[str, dict[str, Estimate]]:
    """By kind: the share above the limit, that at RAPT's, and AUROC, of largest levels (N,)."""
    is_nominal = kinds == NOMINAL
    own = -equal_share_threshold(-level[is_nominal], FALSE_POSITIVES)
    found: dict[str, dict[str, Estimate]] = {}
    for kind in (ALL, *np.unique(kinds[~is_nominal]).tolist(), NOMINAL):
        is_kind = ~is_nominal if kind == ALL else kinds == kind
        found[kind] = {
            metric: proportion(int((level[is_kind] > one).sum()), int(is_kind.sum()))
            for metric, one in {"found": limit, "found_as_rapt": own}.items()
        }
        if kind != NOMINAL:
            both = is_kind | is_nominal
            found[kind]["auc"] = auc(level[both], is_kind[both], np.flatnonzero(both))
    return found
