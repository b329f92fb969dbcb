"""``python -m studies walking``: tours, alarms, guard and recovery of a walking robot."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Any

import numpy as np
import typer

from drake_safety.cli.console import ScenarioArgument, TrainingOption, WorkersOption
from drake_safety.cli.training_folder import MODES, assessment_file, episodes_folder
from drake_safety.evaluation.metrics import Estimate, median, proportion, rate_per_hour
from drake_safety.evaluation.scorers import Scorer, assessment_scorer
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.assessment_file import file_hash
from drake_safety.simulation.capabilities import CanFall, require
from drake_safety.simulation.dataset import load_episodes
from drake_safety.simulation.motion import Motion
from drake_safety.simulation.scenario import Scenario
from studies.alarms import (
    Alarm,
    first_alarm,
    lowest_value,
    scorer_alarm,
    threshold_alarms,
)
from studies.baselines import classifier_scorers
from studies.harness import open_study
from studies.walking_motions import run_motions

EARLY_S = 0.2
"""Time before a fall that an alarm should leave [s]."""
_LEAST = 1e-6  # Of a probability and its complement, in logits.
_DURATIONS_S = {"tour": 60.0, "push": 5.0, "command": 4.0}
_SPEED_S = 12.0
_SEEDS = {"calibration": 6_000_000, "tour": 6_000_001, "push": 6_000_002, "command": 6_000_004}


def walking(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    tours: Annotated[int, typer.Option(help="Undisturbed tours of a minute.", min=1)] = 300,
    calibration_tours: Annotated[
        int, typer.Option(help="Others, on which thresholds are chosen.", min=1)
    ] = 60,
    pushes: Annotated[int, typer.Option(help="Pushed motions.", min=1)] = 600,
    commands: Annotated[int, typer.Option(help="Commands past the policy's ranges.", min=0)] = 300,
    guarded_tours: Annotated[int, typer.Option(help="Tours with the guard.", min=0)] = 20,
    recovered: Annotated[
        int, typer.Option(help="Falls after a push, simulated again with each recovery.", min=0)
    ] = 150,
    speeds: Annotated[int, typer.Option(help="Commands simulated in MuJoCo too.", min=0)] = 20,
    variation: Annotated[str, typer.Option(help="The plant.")] = "nominal",
    workers: WorkersOption = None,
) -> None:
    """Judge a walking robot: falls on tours, alarms on pushes, guard, recovery, MuJoCo.

    Alarms have the highest thresholds that give none on the calibration tours, less a reserve.
    Motions are kept in ASSESSMENT/walking: a stopped study continues. With more tours, only those
    are simulated that are not there yet.
    """
    with open_study("walking", scenario, assessment, workers=workers) as study:
        walker, gamma = study.scenario, study.load(MODES[0], [])
        sha256 = file_hash(assessment_file(assessment, MODES[0]))

        def run(
            kind: str,
            indices: Sequence[int],
            seeds: str = "",
            plant: str = variation,
            branch: str = "",
            duration_s: float = 0.0,
            **options: Any,
        ) -> list[Motion]:
            which = walker
            if branch:
                options["recovery"] = True
                recovery = replace(walker.parameters.recovery, branch=branch)
                which = copy.copy(walker)
                which.parameters = replace(walker.parameters, recovery=recovery)
            seed = _SEEDS[seeds or kind]
            seconds = duration_s or _DURATIONS_S[kind]
            by = sha256[:12] if options else ""  # Γ, where it has a say.
            parts = (seeds or kind, plant, branch, *options, f"{seconds:g}s", by)
            name = "-".join(filter(None, parts))
            return run_motions(
                which,
                kind,
                indices,
                seed=seed,
                duration_s=seconds,
                folder=assessment / f"walking/{which.simulation_hash(plant)[:12]}-{seed}-{name}",
                variation=plant,
                assessment=gamma if options else None,
                options=options,
                num_workers=workers,
                progress=partial(study.stages, name),
            )

        train_set = load_episodes(episodes_folder(assessment))
        alarms = walking_alarms(walker, gamma, classifier_scorers(train_set, study.stages))
        calm = run("tour", range(calibration_tours), "calibration")
        thresholds = alarm_thresholds(alarms, calm)
        study.entries |= {
            "variation": variation,
            "seeds": _SEEDS,
            "assessment_sha256": sha256,
            "thresholds": thresholds,
        }
        pushed = run("push", range(pushes))
        push_s = walker.parameters.random_pushes.duration_s
        study.rows |= alarm_estimates(alarms, thresholds, pushed, push_s)
        if recovered:
            fallen = [m.index for m in pushed if m.fall_time_s >= m.push_time_s and m.has_fallen]
            fallen = fallen[:recovered]
            alone = [motion for motion in pushed if motion.index in set(fallen)]
            for branch in ("stop", "slower"):
                again = run("push", fallen, branch=branch)
                study.rows |= recovery_estimates(branch, alone, again)
        if commands:
            unguarded = run("command", range(commands))
            guarded = run("command", range(commands), guard=True)
            inside = run("tour", range(guarded_tours), guard=True)
            study.rows |= guard_estimates(unguarded, guarded, inside)
        if speeds:
            ours, theirs = (
                run("tour", range(speeds), "calibration", plant, duration_s=_SPEED_S)
                for plant in ("nominal", "mujoco")
            )
            study.rows |= speed_estimates(ours, theirs)
        study.rows |= tour_estimates(alarms, thresholds, run("tour", range(tours)))


def walking_alarms(
    scenario: Scenario, assessment: SafetyAssessment, classifiers: Sequence[Scorer]
) -> list[Alarm]:
    """Alarms on Γ, classifiers, tilt, capture point and the policy's own change of action."""
    loop = scenario.make_loop()
    watched = require(loop, CanFall).watched_features
    scorers = [assessment_scorer("sharpened", assessment), *classifiers]
    alarms = [
        *(_in_logits(scorer_alarm(scorer)) for scorer in scorers),
        *threshold_alarms(loop.state_names, loop.feature_names, watched),
    ]
    column = loop.feature_names.index("action_change")
    alarms.append(Alarm(name="action_change", value=lambda one: -one["features"][:, column]))
    return alarms


def _in_logits(alarm: Alarm) -> Alarm:
    """An alarm on the logit of a probability, whose lowest values are spread."""

    def value(motion: Motion) -> np.ndarray:
        p = np.clip(alarm.value(motion), _LEAST, 1.0 - _LEAST)
        return np.log(p / (1.0 - p))

    return Alarm(name=alarm.name, value=value)


def _values(alarm: Alarm, motion: Motion) -> np.ndarray:
    """The alarm's value of each row; NaN, "don't know", is below every threshold."""
    return np.nan_to_num(alarm.value(motion), nan=-math.inf)


def alarm_thresholds(alarms: Sequence[Alarm], calm: Sequence[Motion]) -> dict[str, float]:
    """Thresholds that give no alarm on undisturbed tours, with a reserve.

    The reserve below the lowest value is half of its distance to the median of the tours' lowest
    values, as many more hours have lower ones.

    Args:
        alarms: The alarms.
        calm: Tours; those that leave the safe set are left out.

    Raises:
        ValueError: Every tour does.
    """
    calm = [motion for motion in calm if not motion.has_left]
    if not calm:
        raise ValueError("walking: the robot leaves its safe set on every calibration tour")
    thresholds = {}
    for alarm in alarms:
        lowest = [lowest_value(motion, _values(alarm, motion)) for motion in calm]
        thresholds[alarm.name] = float(min(lowest) - 0.5 * (np.median(lowest) - min(lowest)))
    return thresholds


def alarm_estimates(
    alarms: Sequence[Alarm],
    thresholds: Mapping[str, float],
    pushed: Sequence[Motion],
    push_s: float,
) -> dict[str, Estimate]:
    """Shares of falls announced, lead times, and alarms in motions without a fall.

    Args:
        alarms: The alarms.
        thresholds: By alarm.
        pushed: Motions with a push.
        push_s: Duration of a push [s].
    """
    judged = [motion for motion in pushed if not motion.leave_time_s < motion.push_time_s]
    fallen = [motion for motion in judged if motion.has_fallen]
    safe = [motion for motion in judged if not motion.has_left]
    until = np.array([motion.fall_time_s - motion.push_time_s for motion in fallen])
    estimates = {
        "pushes.fallen": proportion(len(fallen), len(judged)),
        "pushes.push_to_fall_s": median(until),
        "pushes.fallen_soon": proportion(int(np.sum(until < push_s + EARLY_S)), len(fallen)),
    }
    for alarm in alarms:
        threshold = thresholds[alarm.name]
        lead = np.array([_lead(alarm, motion, threshold) for motion in fallen])
        false = sum(
            math.isfinite(first_alarm(motion, _values(alarm, motion), threshold)) for motion in safe
        )
        key = f"alarm.{alarm.name}"
        estimates |= {
            f"{key}.announced": proportion(int(np.sum(lead >= EARLY_S - 1e-9)), len(fallen)),
            f"{key}.lead_s": median(lead),
            f"{key}.alarms_without_leaving": proportion(false, len(safe)),
        }
    return estimates


def _lead(alarm: Alarm, motion: Motion, threshold: float) -> float:
    since = motion.push_time_s
    alarm_s = first_alarm(motion, _values(alarm, motion), threshold, since_s=since)
    return motion.fall_time_s - alarm_s if alarm_s <= motion.fall_time_s else -math.inf


def tour_estimates(
    alarms: Sequence[Alarm], thresholds: Mapping[str, float], tours: Sequence[Motion]
) -> dict[str, Estimate]:
    """Shares of tours with a fall, and false alarms an hour on the others.

    Args:
        alarms: The alarms.
        thresholds: By alarm.
        tours: Undisturbed tours.
    """
    calm = [motion for motion in tours if not motion.has_left]
    duration_s = sum(float(motion.time_s[-1]) for motion in calm)
    estimates = {
        "tours.without_fall": proportion(sum(not m.has_fallen for m in tours), len(tours)),
        "tours.hours": Estimate.exact(duration_s / 3600.0, len(calm)),
    }
    for alarm in alarms:
        threshold = thresholds[alarm.name]
        count = 0
        for motion in calm:
            is_below = ~(_values(alarm, motion) >= threshold)
            count += int(np.sum(np.diff(is_below.astype(int), prepend=0) > 0))
        estimates[f"tours.{alarm.name}.false_alarms_per_hour"] = rate_per_hour(
            count, duration_s, len(calm)
        )
    return estimates


def recovery_estimates(
    branch: str, alone: Sequence[Motion], again: Sequence[Motion]
) -> dict[str, Estimate]:
    """Share of falls saved by a branch, and impact speeds of those that it does not save.

    Args:
        branch: Name of the branch.
        alone: Motions that fell without recovery.
        again: The same with recovery.
    """
    not_saved = [(a, b) for a, b in zip(alone, again, strict=True) if b.has_fallen]
    return {
        f"recovery.{branch}.saved": proportion(len(alone) - len(not_saved), len(alone)),
        f"recovery.{branch}.impact_m_s": median(np.array([_impact(b) for _, b in not_saved])),
        f"recovery.{branch}.impact_without_m_s": median(
            np.array([_impact(a) for a, _ in not_saved])
        ),
    }


def _impact(motion: Motion) -> float:
    """Largest downward velocity of the base since the push [m/s]."""
    since_s = motion.push_time_s if math.isfinite(motion.push_time_s) else 0.0
    return float(motion["downward_m_s"][motion.time_s >= since_s].max(initial=0.0))


def guard_estimates(
    unguarded: Sequence[Motion],
    guarded: Sequence[Motion],
    inside: Sequence[Motion],
) -> dict[str, Estimate]:
    """Falls with and without the guard, and the share of time in which it changes a command.

    Args:
        unguarded: Commands past the ranges.
        guarded: The same with the guard.
        inside: Tours of commands inside the ranges, with the guard.
    """
    kept = np.array([float(np.mean(motion["guard_active"] == 0)) for motion in inside])
    estimates = {
        "guard.falls_without": proportion(sum(m.has_fallen for m in unguarded), len(unguarded)),
        "guard.falls_with": proportion(sum(m.has_fallen for m in guarded), len(guarded)),
        "guard.left_without": proportion(sum(m.has_left for m in unguarded), len(unguarded)),
        "guard.left_with": proportion(sum(m.has_left for m in guarded), len(guarded)),
    }
    if len(inside):
        low, high = np.quantile(kept, [0.025, 0.975])
        estimates["guard.unchanged_inside"] = Estimate(
            float(kept.mean()), float(low), float(high), len(inside)
        )
    return estimates


def speed_estimates(ours: Sequence[Motion], theirs: Sequence[Motion]) -> dict[str, Estimate]:
    """Difference of mean planar velocities between two engines, over the same commands.

    Args:
        ours: Tours in Drake.
        theirs: The same in MuJoCo; of tours that last differently the common part counts.
    """
    pairs = []
    for a, b in zip(ours, theirs, strict=True):
        rows = min(len(a.time_s), len(b.time_s))
        if not (a.has_fallen or b.has_fallen):
            pairs.append((a["output"][:rows].mean(axis=0), b["output"][:rows].mean(axis=0)))
    difference = np.array([np.linalg.norm((a - b)[:2]) for a, b in pairs])
    return {"speed.difference_to_mujoco_m_s": median(difference)}
