"""``python -m studies store``, ``readme`` and ``ship``: publishing the results of a run."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_safety.assessments import assessed_scenarios, shipped_folder
from drake_safety.cli.console import TrainingOption, open_stages, print_path
from drake_safety.cli.evaluate_shifts import SHIFTS_FILE
from drake_safety.cli.training_folder import MODES, assessment_file, episodes_folder
from drake_safety.evaluation.results import Results
from drake_safety.simulation.dataset import read_info
from drake_safety.simulation.scenario import load_scenario
from studies.cards import write_card
from studies.converged import CONVERGED_FILE
from studies.learning_curve import CURVE_FILE
from studies.readings import READINGS_FILE
from studies.readme import rewrite_readme
from studies.shipping import ship as ship_assessments
from studies.stored_results import store_results
from studies.walking import WALKING_FILE

_DOCUMENTS = [
    Path("README.md"),
    *(Path("docs") / f"{name}.md" for name in ("results", "paper", "shifts", "walking")),
]


def store(
    assessment: TrainingOption,
    out: Annotated[Path, typer.Option(help="File to write: docs/results/NAME.json.")],
) -> None:
    """Store the evaluation in ASSESSMENT compactly, with its studies if there are any."""
    results, extra = _evaluated(assessment)
    store_results(results, out, train_command=extra.get("command"))
    print_path("stored", out)


def readme(
    paths: Annotated[list[Path] | None, typer.Argument(help="Markdown files.", exists=True)] = None,
) -> None:
    """Rewrite the tables of README.md and docs from docs/results/NAME.json.

    They stand between <!-- results: NAME -->, or another kind of table, and <!-- end -->. Without
    PATHS also the cards of the shipped assessments, from what ships.
    """
    for path in paths or _DOCUMENTS:
        for name in rewrite_readme(path):
            print_path(f"results of {name} in", path)
    for name in [] if paths else assessed_scenarios():
        print_path("card", write_card(shipped_folder(name), load_scenario(name)))


def ship(
    assessment: TrainingOption,
    into: Annotated[
        Path, typer.Option(help="Parent of the folder, which is named after the scenario.")
    ] = Path("assessments"),
) -> None:
    """Copy trained assessments, with their evaluation and a card, into the package."""
    results, extra = _evaluated(assessment)
    if "command" not in extra:
        raise ValueError(
            f"ship: the training command of {assessment} is unknown: there is no "
            f"command in {episodes_folder(assessment)}"
        )
    with open_stages() as stages:
        folder = ship_assessments(
            results,
            {mode: assessment_file(assessment, mode) for mode in MODES},
            into,
            load_scenario(str(results.entries["scenario"])),
            train_command=str(extra["command"]),
            progress=partial(stages, "first fresh episodes"),
        )
    print_path("shipped", folder)


def _evaluated(folder: Path) -> tuple[Results, dict[str, Any]]:
    """Results of an evaluation, and metadata of the training episodes."""
    file = folder / "evaluation.json"
    if not file.is_file():
        raise ValueError(
            f"{folder} holds no evaluation to store: `drake-safety evaluate` makes one"
        )
    results = Results.read(file)
    try:
        _, extra = read_info(episodes_folder(folder))
    except (ValueError, OSError):
        extra = {}  # The results do not need the training episodes.
    curve = folder / CURVE_FILE
    if curve.is_file():
        drawn = Results.read(curve)
        keys = ("scenario_hash", "assessment_sha256", "seed")
        if any(drawn.entries.get(key) != results.entries.get(key) for key in keys):
            raise ValueError(f"{curve} is of another training or other seeds than {file}")
        command = {"learning_curve_command": drawn.entries["command"]}
        results = Results({**results, **drawn}, results.entries | command)
    for name in (READINGS_FILE, CONVERGED_FILE, SHIFTS_FILE, WALKING_FILE):
        if (folder / name).is_file():
            studied = Results.read(folder / name)
            entries = results.entries | {Path(name).stem: studied.entries}
            results = Results({**results, **studied}, entries)
    return results, extra
