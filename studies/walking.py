"""``python -m studies walking``: tours, alarms, guard and recovery of a walking robot."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_safety.cli.console import (
    ScenarioArgument,
    console,
    interval,
    new_table,
    open_stages,
    print_path,
)
from drake_safety.cli.training_folder import MODES, episodes_folder, load_assessment
from drake_safety.diagrams.walking_parameters import BRANCHES
from drake_safety.evaluation.metrics import Estimate
from drake_safety.evaluation.results import Results
from drake_safety.evaluation.scorers import classifier_scorers
from drake_safety.files.progress import StageProgress
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.assessment_file import file_hash
from drake_safety.simulation.dataset import load_episodes
from drake_safety.simulation.scenario import Scenario, load_scenario
from studies import command_line
from studies.walking_alarms import (
    alarm_estimates,
    alarm_thresholds,
    guard_estimates,
    recovery_estimates,
    speed_estimates,
    tour_estimates,
    walking_alarms,
)
from studies.walking_motions import WalkedMotion, run_motions

WALKING_FILE = "walking.json"
TOUR_S, _PUSHED_S, _COMMANDED_S, _SPEED_S = 60.0, 5.0, 4.0, 12.0
_SEEDS = {"calibration": 6_000_000, "tour": 6_000_001, "push": 6_000_002, "command": 6_000_004}


@dataclass(frozen=True, kw_only=True)
class _Motions:
    """Sets of motions of one plant, kept in a folder."""

    scenario: Scenario
    assessment: SafetyAssessment
    variation: str
    folder: Path
    stages: StageProgress

    def run(
        self,
        kind: str,
        indices: Sequence[int],
        duration_s: float,
        *,
        seeds: str = "",
        variation: str = "",
        branch: str = "",
        is_guarded: bool = False,
    ) -> list[WalkedMotion]:
        scenario, plant = self.scenario, variation or self.variation
        seeds = seeds or kind
        options: dict[str, Any] = {}
        if is_guarded:
            options["guard"] = True
        if branch:
            options["recovery"] = True
            recovery = replace(scenario.parameters.recovery, branch=branch)
            scenario = copy.copy(scenario)
            scenario.parameters = replace(scenario.parameters, recovery=recovery)
        name = "-".join(filter(None, (seeds, plant, branch, "guard" if is_guarded else "")))
        return run_motions(
            scenario,
            kind,
            indices,
            seed=_SEEDS[seeds],
            duration_s=duration_s,
            folder=self.folder / f"{scenario.simulation_hash(plant)[:12]}-{_SEEDS[seeds]}-{name}",
            variation=plant,
            assessment=self.assessment if options else None,
            options=options,
            progress=partial(self.stages, name),
        )


def walking(
    scenario: ScenarioArgument,
    assessment: Annotated[Path, typer.Option(help="Folder written by train.")],
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
) -> None:
    """Judge a walking robot: falls on tours, alarms on pushes, guard, recovery, MuJoCo.

    Alarms have the highest thresholds that give none on the calibration tours, less a reserve.
    Motions are kept in ASSESSMENT/walking: a stopped study continues. With more tours, only those
    are simulated that are not there yet.
    """
    loaded = load_scenario(scenario)
    gamma = load_assessment(assessment, MODES[0])
    estimates: dict[str, Estimate] = {}
    with open_stages() as stages:
        sets = _Motions(
            scenario=loaded,
            assessment=gamma,
            variation=variation,
            folder=assessment / "walking",
            stages=stages,
        )
        train_set = load_episodes(episodes_folder(assessment))
        alarms = walking_alarms(loaded, gamma, classifier_scorers(train_set, stages))
        calm = sets.run("tour", range(calibration_tours), TOUR_S, seeds="calibration")
        thresholds = alarm_thresholds(alarms, calm)
        pushed = sets.run("push", range(pushes), _PUSHED_S)
        estimates |= alarm_estimates(
            alarms, thresholds, pushed, loaded.parameters.random_pushes.duration_s
        )
        if recovered:
            fallen = [m.index for m in pushed if m.fall_time_s >= m.push_time_s and m.has_fallen]
            fallen = fallen[:recovered]
            alone = [motion for motion in pushed if motion.index in set(fallen)]
            for branch in BRANCHES:
                again = sets.run("push", fallen, _PUSHED_S, branch=branch)
                estimates |= recovery_estimates(branch, alone, again)
        if commands:
            unguarded = sets.run("command", range(commands), _COMMANDED_S)
            guarded = sets.run("command", range(commands), _COMMANDED_S, is_guarded=True)
            inside = sets.run("tour", range(guarded_tours), TOUR_S, is_guarded=True)
            estimates |= guard_estimates(unguarded, guarded, inside)
        if speeds:
            ours, theirs = (
                sets.run("tour", range(speeds), _SPEED_S, seeds="calibration", variation=plant)
                for plant in ("nominal", "mujoco")
            )
            estimates |= speed_estimates(ours, theirs)
        walked = sets.run("tour", range(tours), TOUR_S)
        estimates |= tour_estimates(alarms, thresholds, walked)
    entries = {
        "command": command_line(),
        "scenario": loaded.name,
        "variation": variation,
        "seeds": _SEEDS,
        "assessment_sha256": file_hash(assessment / f"{MODES[0]}.safetensors"),
        "thresholds": thresholds,
    }
    file = assessment / WALKING_FILE
    Results(estimates, entries).write(file)
    table = new_table("figure", "value", "n")
    for key, estimate in estimates.items():
        table.add_row(key, interval(estimate), f"{estimate.n}")
    console.print(table)
    print_path("figures", file)
