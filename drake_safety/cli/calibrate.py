"""``drake-safety calibrate``: thresholds of Γ with a promised miss rate, stored with Γ."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import typer
from rich.table import Table

from drake_safety.cli.console import (
    AssessmentOption,
    ClusterOption,
    ScenarioArgument,
    WorkersOption,
    console,
    new_table,
    open_stages,
    print_path,
    print_shipped,
)
from drake_safety.cli.training_folder import (
    MODES,
    assessment_file,
    assessment_folder,
    check_fresh,
    check_writable,
    load_assessment,
    run_fresh_episodes,
)
from drake_safety.evaluation.scorers import assessment_scorer
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.calibration import KINDS, Calibration, episode_scores
from drake_safety.learning.calibration import calibrate as choose
from drake_safety.learning.seeds import CALIBRATION
from drake_safety.learning.segments import split
from drake_safety.simulation.scenario import load_scenario


def calibrate(
    scenario: ScenarioArgument,
    assessment: AssessmentOption = None,
    miss_rate: Annotated[
        float, typer.Option(help="Promised miss rate: share of unsafe episodes classified safe.")
    ] = 0.01,
    false_alarm_rate: Annotated[
        float,
        typer.Option(help="Promised share of safe episodes classified unsafe, not 'don't know'."),
    ] = 0.05,
    confidence: Annotated[
        float | None,
        typer.Option(help="Confidence of the promise, such as 0.95; on average by default."),
    ] = None,
    episodes: Annotated[int, typer.Option(help="Fresh episodes.", min=2)] = 1000,
    variation: Annotated[
        str | None,
        typer.Option(
            help="Plant of the episodes, for which the promise holds; by default that which the "
            "assessment was adapted to, else nominal."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the episodes.")] = CALIBRATION.first,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
) -> None:
    """Choose thresholds with a promised miss rate on fresh episodes.

    The promise holds for the plant of the episodes: calibrate again after `adapt`. `ask`, `run` and
    `evaluate` use the thresholds. Episodes are kept in ASSESSMENT: a stopped calibration
    continues, and another promise reuses them. A shipped assessment is not changed; its calibrated
    copy is written to runs/SCENARIO-shipped.
    """
    loaded = load_scenario(scenario)
    folder = assessment_folder(loaded, assessment)
    print_shipped(folder)
    learned = {
        mode: load_assessment(folder.path, mode)
        for mode in MODES
        if mode == MODES[0] or assessment_file(folder.path, mode).is_file()
    }
    plant = variation or _adapted_to(learned[MODES[0]]) or "nominal"
    scenario_hash = loaded.simulation_hash(plant)
    for gamma in learned.values():
        check_fresh(gamma, loaded)
        gamma.check_unused(seed, purpose="calibration")
    check_writable(folder.out)
    with open_stages() as stages:
        progress = partial(stages, "calibration episodes")
        fresh = run_fresh_episodes(
            loaded,
            folder.out,
            episodes,
            seed,
            progress,
            workers,
            plant,
            **loaded.options_for("pairs", plant),
        )
    segments = split(fresh, stride=1, discount=1.0, shortest=1)
    found: dict[str, list[Calibration]] = {}
    for mode, gamma in learned.items():
        score = assessment_scorer(mode, gamma).unsafe_score(segments)
        for kind in KINDS:
            of_episodes, is_unsafe = episode_scores(segments, score, kind)
            one = choose(
                of_episodes,
                is_unsafe,
                kind=kind,
                miss_rate=miss_rate,
                false_alarm_rate=false_alarm_rate,
                confidence=confidence,
                seed=seed,
                scenario_hash=scenario_hash,
                variation=plant,
            )
            found.setdefault(mode, []).append(one)
    for mode, gamma in learned.items():
        gamma.adopt_calibrations(found[mode], fresh.info, len(fresh))
        gamma.save(assessment_file(folder.out, mode))
    console.print(_table(found))
    for mode in learned:
        print_path("calibrated", assessment_file(folder.out, mode))


def _adapted_to(assessment: SafetyAssessment) -> str:
    return "" if assessment.adaptation_ is None else assessment.adaptation_.variation


def _table(found: dict[str, list[Calibration]]) -> Table:
    one = next(iter(found.values()))[0]
    table = new_table(
        "mode",
        "score",
        "safe from probability",
        "unsafe below",
        "misses",
        "safe recall",
        title=f"Promised: {one.promise}",
    )
    for mode, calibrations in found.items():
        for calibration in calibrations:
            table.add_row(
                mode,
                {"plan": "first row", "motion": "worst row"}[calibration.kind],
                f"{calibration.threshold:.4f}",
                f"{calibration.unsafe_below:.4f}",
                f"{calibration.num_missed} of {calibration.num_unsafe}",
                f"{calibration.num_accepted} of {calibration.num_safe}",
            )
    return table
