"""Common parts of studies: options, fresh episodes, kept work, and files of rows.

A study gives rows of the table of results: set, method, metric and an estimate. Work that takes
long is kept in the folder of the training as it finishes: a stopped study continues.
"""

import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from drake_safety.cli.console import console, made_by, open_stages, say
from drake_safety.cli.training_folder import check_fresh, load_assessment
from drake_safety.evaluation.figure_style import label_of, spoken
from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.results import Key, Results
from drake_safety.evaluation.tables import Column, Table, rows_of
from drake_safety.files.atomic import replacing
from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import EVALUATION, RELEASE, use_of
from drake_safety.simulation.scenario import Scenario, load_scenario
from drake_safety.simulation.worker_processes import Progress, map_items

ReleaseOption = Annotated[
    bool, typer.Option("--release", help="Use the release's seeds: once, for published figures.")
]
Arrays = dict[str, np.ndarray]


@dataclass(kw_only=True)
class Study:
    """A running study of the training in a folder.

    Attributes:
        seed: First seed of the fresh episodes.
        entries: Entries of the file besides rows.
        rows: By set, method and metric.
    """

    name: str
    scenario: Scenario
    folder: Path
    seed: int
    workers: int | None
    stages: StageProgress
    entries: dict[str, Any] = field(default_factory=dict)
    rows: dict[Key, Estimate] = field(default_factory=dict)

    def add(self, set: str, method: str, estimates: Mapping[str, Estimate]) -> None:
        """Adds the rows of a method by metric."""
        self.rows |= {(set, method, metric): one for metric, one in estimates.items()}

    def load(self, mode: str, seeds: Iterable[int]) -> SafetyAssessment:
        """The assessment of a mode, which has not used these seeds."""
        assessment = load_assessment(self.folder, mode)
        check_fresh(assessment, self.scenario, seeds)
        return assessment

    def results(self) -> Results:
        """The rows, and what made them."""
        made = made_by(self.scenario.name, "python -m studies")
        made |= {"scenario_hash": self.scenario.simulation_hash(), "seed": self.seed}
        made["seed_use"] = use_of(self.seed)
        return Results(self.rows, made | self.entries)


@contextmanager
def open_study(
    name: str,
    scenario: str,
    folder: Path,
    *,
    seed: int = EVALUATION.first,
    release: bool = False,
    workers: int | None = None,
    out: Path | None = None,
) -> Iterator[Study]:
    """Runs a study in the block; afterwards its rows are written and printed."""
    loaded, seed = load_scenario(scenario), seed + RELEASE * release
    with open_stages() as stages:
        study = Study(
            name=name, scenario=loaded, folder=folder, seed=seed, workers=workers, stages=stages
        )
        yield study
    file = (out or folder) / f"{name}.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    results = study.results()
    results.write(file)
    for set_ in dict.fromkeys(key[0] for key in results):
        keys = [key for key in results if key[0] == set_]
        columns = [
            Column(metric, spoken(metric)) for metric in dict.fromkeys(key[2] for key in keys)
        ]
        labels = {key[:2]: label_of(key[1]) for key in keys}
        table = Table(corner=set_, columns=columns, rows=rows_of(results, labels, columns))
        console.print(table.to_rich())
    say("figures", file)


def kept(
    folder: Path,
    indices: Sequence[int],
    function: Callable[[int], tuple[int, Any]],
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> list[Arrays]:
    """Calls a function in worker processes, and keeps the arrays that it returns with the index."""
    folder.mkdir(parents=True, exist_ok=True)
    files = {index: folder / f"{index:05d}.npz" for index in indices}
    missing = [index for index, file in files.items() if not file.is_file()]
    options: dict[str, Any] = {"num_workers": workers, "batch_size": 1, "progress": progress}
    found = map_items(function, missing, num_done=len(files) - len(missing), **options)
    for index, arrays in found:
        with replacing(files[index]) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)
    return [_loaded(file) for file in files.values()]


def _loaded(file: Path) -> Arrays:
    try:
        with np.load(file, allow_pickle=False) as arrays:
            return dict(arrays)
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{file} is damaged ({error!r}): remove it") from error
