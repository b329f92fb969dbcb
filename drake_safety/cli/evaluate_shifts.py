"""Evaluation of Γ under shifts by ``evaluate --shifts``."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from drake_safety.cli.console import (
    command_line,
    console,
    new_table,
    open_stages,
    print_path,
    versions,
)
from drake_safety.cli.training_folder import (
    assessment_file,
    check_fresh,
    episodes_folder,
    fresh_episodes_folder,
    load_assessment,
    run_fresh_episodes,
)
from drake_safety.learning.seeds import SHIFTS

if TYPE_CHECKING:
    from drake_safety.cli.console import StageProgress
    from drake_safety.evaluation.shift_study import ShiftResult
    from drake_safety.evaluation.shifted_motions import ShiftedSet
    from drake_safety.simulation.closed_loop import ClosedLoop
    from drake_safety.simulation.scenario import Scenario

SHIFTS_FILE = "shifts.json"
_MOST_JUDGED = 1000  # Nominal motions; all of them count for false alarms.
_COLUMNS = {
    "unsafe": "unsafe",
    "without_novelty.confident_error": "CE by the grid alone",
    "gamma.confident_error": "CE",
    "gamma.unknown": "DK",
    "monitor.confident_error_10s": "CE, 10 s with monitor",
    "monitor.confident_error_60s": "CE, 60 s",
    "monitor.delay_s": "alarm after [s]",
    "monitor.delay_95_s": "95 % [s]",
    "gradient_boosting.confident_error": "CE of boosting",
    "mlp.confident_error": "CE of MLP",
    "isolation_forest.confident_error": "CE, isolation forest",
    "deep_knn.confident_error": "CE, deep kNN",
}


def evaluate_shifts_command(
    scenario: Scenario,
    assessment: Path,
    num_motions: int,
    num_nominal: int,
    *,
    baselines: bool,
    seed: int | None,
    folder: Path,
    workers: int | None,
) -> None:
    """Evaluates Γ under shifts of plant, sensors, plans and inputs, and writes ``shifts.json``.

    Args:
        scenario: The scenario.
        assessment: Folder written by ``train``.
        num_motions: Motions of each shift.
        num_nominal: Nominal motions, for false alarms and contradictions.
        baselines: Whether to train the baseline classifiers and detectors.
        seed: Seed of the motions; None for the default.
        folder: Folder of the results.
        workers: Number of worker processes; None for one a core.
    """
    from drake_safety.evaluation.figure_style import save
    from drake_safety.evaluation.results import Results
    from drake_safety.evaluation.scorers import classifier_scorers
    from drake_safety.evaluation.shift_study import evaluate_shifts, false_alarms
    from drake_safety.evaluation.shifts_figure import shifts_figure
    from drake_safety.learning.assessment_file import file_hash
    from drake_safety.simulation.dataset import load_episodes

    gamma = load_assessment(assessment, "sharpened")
    seeds = SHIFTS.seeds(seed)
    check_fresh(gamma, scenario, seeds.values())
    training = load_episodes(episodes_folder(assessment)) if baselines else None
    with open_stages() as stages:
        sets = _shifted_sets(
            scenario, assessment, num_motions, num_nominal, seeds["shifts"], stages, workers
        )
        shortest = gamma.parameters.shortest_segment or None
        classifiers = (
            [] if training is None else classifier_scorers(training, stages, shortest=shortest)
        )
        every = sets["nominal"].motions
        sets["nominal"] = replace(sets["nominal"], motions=every[:_MOST_JUDGED])
        results = evaluate_shifts(sets, gamma, classifiers, training, stages)
        alarms = false_alarms(every, gamma)
        results["nominal"].estimates["monitor.false_alarms_per_hour"] = alarms
    file = folder / SHIFTS_FILE
    entries = {
        "command": command_line(),
        "scenario": scenario.name,
        "seed": seeds["shifts"],
        "assessment_sha256": file_hash(assessment_file(assessment, "sharpened")),
        "versions": versions(),
        "kinds": {name: result.kind for name, result in results.items()},
    }
    estimates = {
        f"shifts.{name}.{key}": estimate
        for name, result in results.items()
        for key, estimate in result.estimates.items()
    }
    Results(estimates, entries).write(file)
    _print_table(results)
    print_path("figures", file)
    for picture in save(shifts_figure(results), folder / "shifts"):
        print_path("picture", picture)


def _shifted_sets(
    scenario: Scenario,
    assessment: Path,
    num_motions: int,
    num_nominal: int,
    seed: int,
    stages: StageProgress,
    workers: int | None,
) -> dict[str, ShiftedSet]:
    from drake_safety.evaluation.shifted_motions import (
        junk,
        of_episodes,
        run_changed_starts,
        shifted_scenario,
    )
    from drake_safety.evaluation.shifts import plant_shifts
    from drake_safety.simulation.rollouts import run_episodes

    nominal = run_fresh_episodes(
        scenario, assessment, num_nominal, seed, partial(stages, "nominal motions"), workers
    )
    sets = {"nominal": of_episodes("nominal", nominal)}
    loop: ClosedLoop = scenario.make_loop()
    shifts = plant_shifts(scenario, loop)
    options = scenario.task_class().judging_options
    for i, (name, shift) in enumerate(shifts.items()):
        stages("shifted motions", i, len(shifts))
        shifted = shifted_scenario(scenario, name, shift)
        own_options = {**options, **shift.options}
        episodes = run_episodes(
            shifted,
            num_motions,
            variation=name,
            seed=seed,
            num_workers=workers,
            path=fresh_episodes_folder(
                assessment, shifted.simulation_hash(name), seed, own_options
            ),
            **own_options,
        )
        sets[name] = of_episodes(shift.kind, episodes)
    stages("shifted motions", len(shifts), len(shifts))
    sets |= run_changed_starts(scenario, num_motions, seed, workers)
    return sets | junk(sets["nominal"].motions[:num_motions], seed)


def _print_table(results: dict[str, ShiftResult]) -> None:
    used = {
        key: title
        for key, title in _COLUMNS.items()
        if any(key in result.estimates for result in results.values())
    }
    table = new_table("shift", *used.values(), title="Γ under shifts")
    table.caption = (
        'CE: share of rows called safe with at least 0.9, not "don\'t know", in motions that end '
        'unsafely [%]; DK: share of "don\'t know" [%]. Intervals are in shifts.json.'
    )
    for name, result in results.items():
        cells = []
        for key in used:
            estimate = result.estimates.get(key)
            scale = 1.0 if key.endswith("_s") else 100.0
            cells.append("" if estimate is None else f"{scale * estimate.value:.1f}")
        table.add_row(name.replace("_", " "), *cells)
    console.print(table)
    false = results["nominal"].estimates["monitor.false_alarms_per_hour"]
    console.print(
        f"false alarms of the monitor: {false.value:.2f} ({false.low:.2f}–{false.high:.2f}) an "
        f"hour on {false.n} safe nominal motions",
        highlight=False,
    )
