"""``python -m studies walking``: tours, alarms, guard and recovery of a walking robot."""

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Any

import numpy as np
import typer

from drake_safety.cli.console import ScenarioArgument, TrainingOption, WorkersOption
from drake_safety.cli.training_folder import MODES, assessment_file, training_episodes
from drake_safety.evaluation.metrics import Estimate, median, proportion, rate_per_hour
from drake_safety.evaluation.results import Key
from drake_safety.evaluation.scorers import Scorer, assessment_scorer
from drake_safety.evaluation.shift_study import SEEN
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.assessment_file import file_hash
from drake_safety.learning.change_detector import ChangeDetector
from drake_safety.learning.seeds import WALKING
from drake_safety.simulation.capabilities import CanFall, require
from drake_safety.simulation.motion import Motion
from drake_safety.simulation.scenario import Scenario
from studies.alarm_curves import EARLY_S, Watched, equal_cost_estimates
from studies.alarms import Alarm, scorer_alarm, threshold_alarms
from studies.baselines import KINDS, classifier_scorers
from studies.harness import ReleaseOption, open_study
from studies.walking_motions import run_motions

_LEAST = 1e-6  # Least probability, and complement, in logits.
_DURATIONS_S = {"tour": 60.0, "push": 5.0, "command": 4.0}
_SPEED_S = 12.0
_CLASSIFIER_SEEDS = (0, 1, 2)


def walking(
    scenario: ScenarioArgument,
    assessment: TrainingOption,
    tours: Annotated[int, typer.Option(help="Undisturbed tours of a minute.", min=1)] = 300,
    pushes: Annotated[int, typer.Option(help="Pushed motions.", min=1)] = 600,
    commands: Annotated[int, typer.Option(help="Commands past the policy's ranges.", min=0)] = 300,
    guarded_tours: Annotated[int, typer.Option(help="Tours with the guard.", min=0)] = 20,
    recovered: Annotated[
        int, typer.Option(help="Falls after a push, simulated again with each recovery.", min=0)
    ] = 150,
    speeds: Annotated[int, typer.Option(help="Commands simulated in MuJoCo too.", min=0)] = 20,
    variation: Annotated[str, typer.Option(help="The plant.")] = "nominal",
    release: ReleaseOption = False,
    workers: WorkersOption = None,
) -> None:
    """Judge a walking robot: falls on tours, alarms on pushes, guard, recovery, MuJoCo.

    Alarms are compared at the same share of pushed motions that they alarm without need. Motions
    are kept in ASSESSMENT/walking: a stopped study continues, and simulates missing tours only.
    """
    with open_study(
        "walking",
        scenario,
        assessment,
        seed=WALKING.first,
        release=release,
        workers=workers,
    ) as study:
        seeds_of = WALKING.seeds(study.seed)
        walker, gamma = study.scenario, study.load(MODES[0], seeds_of.values())
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
            seed = seeds_of[seeds or kind]
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

        train_set = training_episodes(assessment, gamma)
        classifiers = classifier_scorers(train_set, study.stages, seeds=_CLASSIFIER_SEEDS)
        alarms = walking_alarms(walker, gamma, classifiers)
        study.entries |= {"variation": variation, "seeds": seeds_of, "assessment_sha256": sha256}
        study.entries["alarms"] = list(alarms)
        pushed = run("push", range(pushes))
        push_s = walker.parameters.random_pushes.duration_s
        study.rows |= push_estimates(pushed, push_s)
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
        toured = run("tour", range(tours))
        study.rows |= tour_estimates(toured, gamma.detector_)
        # A motion that leaves the safe set before the push is not judged.
        pushed = [motion for motion in pushed if not motion.leave_time_s < motion.push_time_s]
        safe = [motion for motion in toured if not motion.has_left]
        watched = {
            name: [Watched.of(alarm, pushed, safe) for alarm in seeds]
            for name, seeds in alarms.items()
        }
        study.rows |= equal_cost_estimates(watched, MODES[0], "gradient_boosting")


def walking_alarms(
    scenario: Scenario, assessment: SafetyAssessment, classifiers: Sequence[Scorer]
) -> dict[str, list[Alarm]]:
    """Alarms on Γ, classifiers, tilt and capture point.

    Returns:
        By method; one for each seed of a kind.
    """
    loop = scenario.make_loop()
    watched = require(loop, CanFall).watched_features
    alarms = {MODES[0]: [_in_logits(assessment_scorer(MODES[0], assessment))]}
    if assessment.fall_logit_ is not None:
        fall = Scorer(name="fall", probability=partial(_stays_up, assessment))
        alarms[fall.name] = [_in_logits(fall)]
    for kind in KINDS:
        seeds = [_in_logits(one) for one in classifiers if one.name.startswith(kind)]
        alarms |= {kind: seeds} if seeds else {}
    for alarm in threshold_alarms(loop.state_names, loop.feature_names, watched):
        alarms[alarm.name] = [alarm]
    return alarms


def _stays_up(assessment: SafetyAssessment, *inputs: np.ndarray) -> np.ndarray:
    """The probability of no fall."""
    return 1.0 - assessment.predict(*inputs).fall_probability


def _in_logits(scorer: Scorer) -> Alarm:
    """An alarm on the logit of a probability, whose lowest values are spread."""
    alarm = scorer_alarm(scorer)

    def value(motion: Motion) -> np.ndarray:
        p = np.clip(alarm.value(motion), _LEAST, 1.0 - _LEAST)
        return np.log(p / (1.0 - p))

    return Alarm(name=alarm.name, value=value)


def push_estimates(pushed: Sequence[Motion], push_s: float) -> dict[Key, Estimate]:
    """Share of pushed motions with a fall, and its time after the push."""
    judged = [motion for motion in pushed if not motion.leave_time_s < motion.push_time_s]
    fallen = [motion for motion in judged if motion.has_fallen]
    until = np.array([motion.fall_time_s - motion.push_time_s for motion in fallen])
    return {
        ("pushes", "", "fallen"): proportion(len(fallen), len(judged)),
        ("pushes", "", "push_to_fall_s"): median(until),
        ("pushes", "", "fallen_soon"): proportion(
            int(np.sum(until < push_s + EARLY_S)), len(fallen)
        ),
    }


def tour_estimates(tours: Sequence[Motion], detector: ChangeDetector) -> dict[Key, Estimate]:
    """Share of undisturbed tours without a fall, safe hours, and the monitor's false alarms."""
    safe = [motion for motion in tours if not motion.has_left]
    rows = [np.concatenate([motion[name] for name in SEEN], axis=1) for motion in safe]
    alarms = sum(len(detector.watch([one])[1]) for one in rows)
    duration_s = sum(float(motion.time_s[-1]) for motion in safe)
    false_alarms = rate_per_hour(alarms, duration_s, len(safe))
    return {
        ("tours", "", "without_fall"): proportion(sum(not m.has_fallen for m in tours), len(tours)),
        ("tours", "", "hours"): Estimate.exact(duration_s / 3600.0, len(safe)),
        ("tours", "monitor", "false_alarms_per_hour"): false_alarms,
    }


def recovery_estimates(
    branch: str, alone: Sequence[Motion], again: Sequence[Motion]
) -> dict[Key, Estimate]:
    """Share of falls saved by a branch, and impact speeds of the remaining falls."""
    not_saved = [(a, b) for a, b in zip(alone, again, strict=True) if b.has_fallen]
    return {
        ("recovery", branch, "saved"): proportion(len(alone) - len(not_saved), len(alone)),
        ("recovery", branch, "impact_m_s"): median(np.array([_impact(b) for _, b in not_saved])),
        ("recovery", branch, "impact_without_m_s"): median(
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
) -> dict[Key, Estimate]:
    """Falls with and without the guard, and the share of time in which it changes a command."""
    kept = np.array([float(np.mean(motion["guard_active"] == 0)) for motion in inside])
    estimates = {
        ("guard", "", "falls_without"): proportion(
            sum(m.has_fallen for m in unguarded), len(unguarded)
        ),
        ("guard", "", "falls_with"): proportion(sum(m.has_fallen for m in guarded), len(guarded)),
        ("guard", "", "left_without"): proportion(
            sum(m.has_left for m in unguarded), len(unguarded)
        ),
        ("guard", "", "left_with"): proportion(sum(m.has_left for m in guarded), len(guarded)),
    }
    if len(inside):
        low, high = np.quantile(kept, [0.025, 0.975])
        estimates["guard", "", "unchanged_inside"] = Estimate(
            float(kept.mean()), float(low), float(high), len(inside)
        )
    return estimates


def speed_estimates(ours: Sequence[Motion], theirs: Sequence[Motion]) -> dict[Key, Estimate]:
    """Difference of mean planar velocities between two engines, over the same commands."""
    pairs = []
    for a, b in zip(ours, theirs, strict=True):
        rows = min(len(a.time_s), len(b.time_s))
        if not (a.has_fallen or b.has_fallen):
            pairs.append((a["output"][:rows].mean(axis=0), b["output"][:rows].mean(axis=0)))
    difference = np.array([np.linalg.norm((a - b)[:2]) for a, b in pairs])
    return {("speed", "", "difference_to_mujoco_m_s"): median(difference)}
