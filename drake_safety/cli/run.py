"""``drake-safety run``: simulates once with Γ in the loop, and shows the events."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from matplotlib.figure import Figure
from rich.table import Table

from drake_safety.cli.console import (
    LOOPBACK,
    AssessmentOption,
    HostOption,
    ScenarioArgument,
    cause_words,
    print_shipped,
)
from drake_safety.cli.free_run import run_episode_alone
from drake_safety.cli.run_settings import (
    LOG_PERIOD_S,
    Recording,
    RunSettings,
    events_table,
    logged_ports,
)
from drake_safety.cli.target_run import run_to_target
from drake_safety.cli.targets import HandOption, TargetOption
from drake_safety.cli.training_folder import assessment_folder, goal_threshold, load_assessment
from drake_safety.evaluation.path_figure import path_figure
from drake_safety.evaluation.stills import render_stills, stack_positions, still_times
from drake_safety.evaluation.timeline_figure import timeline_figure
from drake_safety.files.reading import did_you_mean
from drake_safety.files.schema import load_typed
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import DEMONSTRATION
from drake_safety.plants.balls import Throw
from drake_safety.simulation.capabilities import HasBall, HasGoals, goal_words, require
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.scenario import Scenario, load_scenario
from drake_safety.simulation.throws import ThrowLog, run_throw

_DURATION_S = 5.0  # Of a run with balls.
_AROUND_IMPACT_S = (-0.02, 0.16)  # The ball in the air, and its effect.
_AFTER_TRIGGER_S = 0.3  # Feet in the air.
# Keys of a ball on the command line, and fields of a throw.
_THROW_FIELDS = {
    "time": "time_s",
    "mass": "mass_kg",
    "speed": "speed_m_s",
    "direction": "direction_rad",
    "offset": "offset_m",
    "height": "height_m",
}


def run(
    scenario: ScenarioArgument,
    assessment: AssessmentOption = None,
    target: TargetOption = None,
    hand: HandOption = None,
    force: Annotated[
        bool, typer.Option("--force", help="Go to the target even if Γ refuses it.")
    ] = False,
    guard: Annotated[
        bool, typer.Option("--guard", help="Pass on the nearest accepted command instead.")
    ] = False,
    push: Annotated[
        list[str] | None,
        typer.Option(
            help="With a target: the name of a push in the scenario. Otherwise: 'ball' for the "
            "scenario's balls, or a ball, repeatable: 'time=1 mass=3 speed=9 direction=90' "
            "[s, kg, m/s, degrees from x]."
        ),
    ] = None,
    variation: Annotated[str, typer.Option(help="Variation of the plant.")] = "actual",
    recovery: Annotated[
        bool | None, typer.Option("--recovery/--no-recovery", help="Recovery; the task's default.")
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(
            help="Seconds to simulate; by default 5 with balls, one more than an episode with a "
            "target, and otherwise an episode.",
            min=0.1,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of start, plan and noise.")] = (
        DEMONSTRATION.first
    ),
    mode: Annotated[str, typer.Option(help="'sharpened' or 'paper'.")] = "sharpened",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for recording and figures; by default ASSESSMENT, or else "
            "runs/SCENARIO-shipped."
        ),
    ] = None,
    meshcat: Annotated[
        bool, typer.Option("--meshcat", help="Show the run live in the browser, in real time.")
    ] = False,
    host: HostOption = LOOPBACK,
) -> None:
    """Simulate once with Γ in the loop; write a recording, a timeline and the events.

    If Γ refuses a target, nothing moves and the exit code is 1; --force goes there.
    """
    given = {"hand": hand, "recovery": recovery, "guard": guard or None}
    loaded = load_scenario(scenario)
    learned = assessment_folder(loaded, assessment)
    settings = RunSettings(
        scenario=loaded,
        assessment=load_assessment(learned.path, mode),
        variation=variation,
        options={name: value for name, value in given.items() if value is not None},
        pushes=push or [],
        seed=seed,
        duration_s=duration,
        folder=(out or learned.out) / "run",
        is_live=meshcat,
        host=host,
    )
    print_shipped(learned, settings.assessment)
    if target is not None:
        rule = goal_threshold(learned.path, settings.assessment)
        if not run_to_target(settings, target, rule, is_forced=force or guard):
            raise typer.Exit(1)
        return
    if force:
        raise ValueError("run: --force goes to a target that Γ refuses: pass that too")
    # Check the capabilities of the task before a browser is opened.
    loop = settings.make_loop()
    if isinstance(loop, HasGoals):
        words = goal_words(loop)
        raise ValueError(
            f"run: task '{type(loop).__name__}' needs a {words.goal}: pass --{words.goal} "
            f"{' '.join(words.axes)}, or one of the names {list(loop.named_targets)}"
        )
    if isinstance(loop, HasBall):
        _run_with_balls(settings)
        return
    if settings.pushes:
        require(loop, HasBall, "run: --push")
    run_episode_alone(settings, goal_threshold(learned.path, settings.assessment))


def _run_with_balls(settings: RunSettings) -> None:

    throws = parse_pushes(settings.scenario, settings.pushes)
    recording = Recording(settings)
    loop = settings.make_loop(recording.viewer, ball=True)
    recording.start()
    log = run_throw(
        loop,
        0,
        seed=settings.seed,
        throws=throws,
        duration_s=_DURATION_S if settings.duration_s is None else settings.duration_s,
        log_period_s=LOG_PERIOD_S,
        ports=(*logged_ports(loop), "embedding", "ball_state"),
        realtime_rate=settings.realtime_rate,
    )
    figures = {
        "timeline": _timeline(loop, log, throws),
        "path": _path(loop, settings.assessment, log, throws),
    }
    recording.save(
        figures,
        _table_of_events(loop, settings.assessment, log, throws),
        f"recovery where the probability is below {loop.scenario.parameters.recovery.threshold:g}, "
        f"that of scenario '{loop.scenario.name}'",
    )


def parse_pushes(scenario: Scenario, pushes: list[str]) -> list[Throw]:
    """The balls of ``--push``.

    Args:
        scenario: The scenario, whose balls 'ball' stands for.
        pushes: Each 'ball', or KEY=NUMBER pairs.

    Raises:
        ValueError: A key is unknown, a value is not a number, or a ball is invalid.
    """
    throws: list[Throw] = []
    for text in pushes:
        if text == "ball":
            throws += scenario.parameters.demonstration
            continue
        values = {}
        for pair in shlex.split(text):
            key, _, value = pair.partition("=")
            if key not in _THROW_FIELDS:
                raise ValueError(
                    f"--push '{text}': unknown '{key}'"
                    f"{did_you_mean(key, ['ball', *_THROW_FIELDS])}; give 'ball', or any of "
                    f"{[f'{key}=NUMBER' for key in _THROW_FIELDS]}"
                )
            try:
                values[_THROW_FIELDS[key]] = float(value)
            except ValueError:
                raise ValueError(f"--push '{text}': '{value}' is not a number") from None
        if "direction_rad" in values:
            values["direction_rad"] = float(np.radians(values["direction_rad"]))
        throws.append(load_typed(Throw, values, f"--push '{text}'"))
    return throws


def _path(
    loop: ClosedLoop, assessment: SafetyAssessment, log: ThrowLog, throws: list[Throw]
) -> Figure:

    events = {f"ball {i}": throw.time_s for i, throw in enumerate(throws, start=1)}
    starts = [start for start, _ in log.recovery_intervals_s]
    events |= {f"recovery {i}": start_s for i, start_s in enumerate(starts, start=1)}
    return path_figure(
        assessment,
        log.time_s,
        log.extra["embedding"],
        log.extra["safety_probability"][:, 0],
        loop.scenario.parameters.recovery.threshold,
        {"start": 0.0, **events},
    )


def _timeline(loop: ClosedLoop, log: ThrowLog, throws: list[Throw]) -> Figure:

    positions = stack_positions(
        loop, {loop.robot.name: log.plant_state, "ball": log.extra["ball_state"]}
    )
    triggers = [start for start, _ in log.recovery_intervals_s]
    events = [throw.time_s + after_s for throw in throws for after_s in _AROUND_IMPACT_S]
    events += [trigger_s + _AFTER_TRIGGER_S for trigger_s in triggers[:1]]
    instants = still_times(log.time_s, events)
    return timeline_figure(
        log.time_s,
        log.extra["safety_probability"][:, 0],
        loop.scenario.parameters.recovery.threshold,
        throws=throws,
        trigger_times_s=triggers,
        recovery_intervals_s=log.recovery_intervals_s,
        stills=render_stills(loop, log.time_s, positions, instants),
        belief=log.extra["belief"],
        margins=log.margins,
        constraint_names=loop.constraint_names,
    )


def _table_of_events(
    loop: ClosedLoop, assessment: SafetyAssessment, log: ThrowLog, throws: list[Throw]
) -> Table:
    events = [
        (
            throw.time_s,
            f"ball of {throw.mass_kg:g} kg at {throw.speed_m_s:g} m/s towards "
            f"{np.degrees(throw.direction_rad):.0f}°",
        )
        for throw in throws
    ]
    for time_s, _ in log.recovery_intervals_s:
        row = int(np.abs(log.time_s - time_s).argmin())
        expected = cause_words(
            loop,
            assessment,
            log.extra["cause_probability"][row],
            log.extra["predicted_margins"][row],
        )
        events.append((time_s, f"recovery triggered; expected violation: {expected}"))
    if log.has_fallen:
        events.append((log.fall_time_s, "the robot fell"))
    else:
        events.append((float(log.time_s[-1]), "standing"))
    return events_table(events, log.time_s, log.extra, assessment)
