"""``python -m studies monitor``: the monitor on changed plants and sensors, and for hours."""

from __future__ import annotations

import math
from functools import partial
from typing import Annotated, Any

import numpy as np
import typer

from drake_safety.cli.console import ScenarioArgument, TrainingOption, WorkersOption
from drake_safety.cli.training_folder import fresh_episodes_folder
from drake_safety.evaluation.metrics import Estimate, proportion
from drake_safety.evaluation.shift_study import (
    Minute,
    error_estimates,
    false_alarms,
    last_rows,
    monitor_estimates,
    monitored,
    run_monitored,
    safety_probability,
)
from drake_safety.evaluation.shifts import plant_shifts, shifted_scenario
from drake_safety.learning import calibration
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.causes import is_outside
from drake_safety.learning.seeds import FRESH_MOTION, SHIFTS
from drake_safety.learning.segments import Episode
from drake_safety.robots.family import FAMILY
from drake_safety.simulation.rollouts import MOTION_PIECE_S, run_motions
from drake_safety.simulation.scenario import Scenario
from studies.harness import Arrays, ReleaseOption, fingerprint, kept, open_study


def monitor(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    motions: Annotated[int, typer.Option(help="Undisturbed motions of each shift.", min=2)] = 24,
    hours: Annotated[float, typer.Option(help="Hours of other nominal motion.", min=0.0)] = 5.0,
    family_hours: Annotated[
        float, typer.Option(help="Hours of motion on random plants, one each.", min=0.0)
    ] = 2.0,
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
            shifted = shifted_scenario(loaded, name, shift.variation)
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
            study.add("monitor", name, _estimates(arrays, promise))
        plants = math.ceil(3600.0 * family_hours / MOTION_PIECE_S)
        lasting: dict[str, tuple[float, dict[str, Any]]] = {"nominal": (hours, {})}
        if loaded.family is not None:
            lasting[FAMILY] = family_hours, {"variation": FAMILY, "plants": plants}
        for name, (duration_h, plants_of) in lasting.items():
            if duration_h:
                usual = run_motions(
                    loaded,
                    3600.0 * duration_h,
                    seed=fresh_seed,
                    num_workers=workers,
                    path=fresh_episodes_folder(study.folder, "motion", fresh_seed, plants_of),
                    progress=partial(study.stages, f"hours of motion, {name}"),
                    **plants_of,
                )
                alarms = {"false_alarms_per_hour": false_alarms(usual, gamma.detector_)}
                study.add("monitor", name, alarms)
        study.entries |= {
            "monitor": gamma.detector_.describe(),
            "kinds": {name.replace(" ", "_"): shift.kind for name, shift in shifts.items()},
        }


def _estimates(arrays: Arrays, promise: calibration.Calibration | None) -> dict[str, Estimate]:
    """What `evaluate --shifts` says of the monitor, and the same without it.

    Of the motions that leave the safe set, "silent_missed" are those whose probability is never
    below the threshold of a promise for motions; "missed" are those without an alarm until then.
    """
    fields = (arrays[name].tolist() for name in Minute._fields)
    minutes = [Minute(*one) for one in zip(*fields, strict=True)]
    silent = error_estimates([one.silent_error_s for one in minutes])
    num_leaving = int(np.isfinite(arrays["leave_s"]).sum())
    estimates = monitor_estimates(minutes) | {
        "leaves": proportion(num_leaving, len(minutes)),
        **{f"silent_{metric}": one for metric, one in silent.items()},
    }
    num_unsafe = int(np.isfinite(arrays["least"]).sum())
    if promise is not None and num_unsafe:
        is_missed = arrays["least"] >= promise.threshold
        is_late = arrays["alarm_s"] > arrays["leave_s"]
        estimates["silent_missed"] = proportion(int(is_missed.sum()), num_unsafe)
        estimates["missed"] = proportion(int((is_missed & is_late).sum()), num_unsafe)
    return estimates


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
    minutes = zip(*monitored(motions, assessment), strict=True)
    arrays = dict(zip(Minute._fields, map(np.array, minutes), strict=True))
    return arrays | {"least": np.array([_least(one, assessment) for one in motions])}


def _least(motion: Episode, assessment: SafetyAssessment) -> float:
    """The least probability inside the safe set before leaving it; NaN if it stays."""
    if motion.is_safe:
        return math.nan
    every = max(1, round(assessment.info_.step_s / assessment.detector_.step_s))
    rows = last_rows(motion, assessment, every)
    rows = rows[~is_outside(motion.margins[rows])]
    return float(min(np.nan_to_num(safety_probability(assessment, motion, rows)), default=0.0))
