"""``python -m studies monitor``: the monitor on changed plants and sensors, and for hours."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

import typer

from drake_safety.cli.console import ScenarioArgument, TrainingOption, WorkersOption
from drake_safety.cli.training_folder import fresh_episodes_folder
from drake_safety.evaluation.monitor_study import (
    false_alarms,
    monitor_estimates,
    monitored,
    run_monitored,
)
from drake_safety.evaluation.shift_study import assessment_judge
from drake_safety.evaluation.shifts import plant_shifts, shifted_scenario
from drake_safety.learning import calibration
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import FRESH_MOTION, SHIFTS
from drake_safety.simulation.rollouts import run_motions
from drake_safety.simulation.scenario import Scenario
from studies.harness import Arrays, ReleaseOption, fingerprint, kept, open_study

_NOMINAL = "nominal"


def monitor(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    motions: Annotated[int, typer.Option(help="Undisturbed motions of each shift.", min=2)] = 24,
    hours: Annotated[float, typer.Option(help="Hours of other nominal motion.", min=0.0)] = 5.0,
    seed: Annotated[int, typer.Option(help="Seed of the shifts' motions.")] = SHIFTS.first,
    release: ReleaseOption = False,
    workers: WorkersOption = None,
) -> None:
    """Evaluate the monitor: alarms under each shift, Γ's confident errors, false alarms an hour.

    Writes ASSESSMENT/monitor.json. What is simulated is kept: a stopped study continues.
    """
    with open_study(
        "monitor", scenario, assessment, seed=seed, release=release, workers=workers
    ) as study:
        seed, fresh_seed = study.seed, FRESH_MOTION.first_beside(study.seed)
        gamma, loaded = study.load("sharpened", [seed]), study.scenario
        shifts = plant_shifts(loaded, loaded.make_loop())
        promise = gamma.calibrations_.get(calibration.MOTION)
        work = {}
        for name, shift in shifts.items():
            options = {**loaded.options_for("evaluation"), **shift.options}
            shifted = shifted_scenario(loaded, name, shift)
            work[name.replace(" ", "_")] = (shifted, name, motions, seed, gamma, options)
        key = fingerprint(
            loaded.simulation_hash(), motions, seed, *map(str, gamma.detector_.limits.ravel())
        )
        found = kept(
            study.folder / "monitor" / key,
            work,
            _watched,
            workers=workers,
            progress=partial(study.stages, "shifts"),
        )
        for name, arrays in found.items():
            study.add(f"monitor.{name}", _plain(monitor_estimates(arrays, promise)))
        if hours:
            usual = run_motions(
                loaded,
                3600.0 * hours,
                seed=fresh_seed,
                num_workers=workers,
                path=fresh_episodes_folder(study.folder, "motion", fresh_seed, {}),
                progress=partial(study.stages, "hours of nominal motion"),
            )
            alarms = {"false_alarms_per_hour": false_alarms(usual, gamma.detector_)}
            study.add(f"monitor.{_NOMINAL}", alarms)
        study.entries |= {
            "monitor": gamma.detector_.describe(),
            "kinds": {name.replace(" ", "_"): shift.kind for name, shift in shifts.items()},
        }


def _plain(estimates: dict[str, Any]) -> dict[str, Any]:
    return {name.removeprefix("monitor."): estimate for name, estimate in estimates.items()}


def _watched(
    scenario: Scenario,
    variation: str,
    num_motions: int,
    seed: int,
    assessment: SafetyAssessment,
    options: dict[str, Any],
) -> Arrays:
    motions = run_monitored(
        scenario,
        variation,
        num_motions,
        seed,
        assessment.detector_,
        options=options,
        num_workers=1,
    )
    return monitored(motions, assessment, assessment_judge(assessment))
