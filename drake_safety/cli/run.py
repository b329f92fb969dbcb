"""``drake-safety run``: simulates once with Γ in the loop, and shows what happened when."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from drake_safety.cli.arguments import AssessmentOption, ScenarioArgument
from drake_safety.cli.console import console, new_table, print_path
from drake_safety.cli.training_folder import load_assessment

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table

    from drake_safety.simulation.balls import Throw
    from drake_safety.simulation.closed_loop import ClosedLoop
    from drake_safety.simulation.scenario import Scenario
    from drake_safety.simulation.throws import ThrowLog

_LOG_PERIOD_S = 0.02
_PORTS = (
    "normalized_safety_probability",
    "safety_probability",
    "belief",
    "cause_probability",
    "predicted_margins",
    "ball_state",
)
# Of a ball on the command line: the key there, and the field of a throw.
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
    assessment: AssessmentOption,
    push: Annotated[
        list[str] | None,
        typer.Option(
            help="'ball' throws the scenario's own balls; or your own, repeatable: "
            "'time=1 mass=3 speed=9 direction=90' [s, kg, m/s, degrees from x]."
        ),
    ] = None,
    variation: Annotated[str, typer.Option(help="Which plant.")] = "actual",
    recovery: Annotated[
        bool, typer.Option("--recovery/--no-recovery", help="Step when Γ falls.")
    ] = True,
    duration: Annotated[float, typer.Option(help="Seconds to simulate.", min=0.1)] = 5.0,
    seed: Annotated[int, typer.Option(help="Seed of start, plan and noise.")] = 0,
    mode: Annotated[str, typer.Option(help="'sharpened' or 'paper'.")] = "sharpened",
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for recording and pictures; ASSESSMENT's by default."),
    ] = None,
    meshcat: Annotated[
        bool, typer.Option("--meshcat", help="Watch live in the browser, in real time.")
    ] = False,
) -> None:
    """Simulate once with Γ in the loop: a recording, a timeline, and what happened when."""
    from pydrake.geometry import Meshcat

    from drake_safety.evaluation.figure_style import save
    from drake_safety.simulation.scenario import load_scenario
    from drake_safety.simulation.throws import run_throw

    loaded = load_scenario(scenario)
    gamma = load_assessment(assessment, mode)
    throws = parse_pushes(loaded, push or [])
    viewer = Meshcat()
    loop = loaded.make_loop(
        variation, assessment=gamma, meshcat=viewer, recovery=recovery, ball=True
    )
    if meshcat:
        console.print(f"live at {viewer.web_url()}")
        input("Press Enter when the browser shows the robot. ")
    viewer.StartRecording()
    log = run_throw(
        loop,
        0,
        seed=seed,
        throws=throws,
        duration_s=duration,
        log_period_s=_LOG_PERIOD_S,
        ports=_PORTS,
        realtime_rate=1.0 if meshcat else 0.0,
    )
    viewer.StopRecording()
    viewer.PublishRecording()
    folder = (out or assessment) / "run"
    folder.mkdir(parents=True, exist_ok=True)
    recording = folder / "recording.html"
    recording.write_text(viewer.StaticHtml(), encoding="utf-8")
    pictures = save(_timeline(loop, log, throws), folder / "timeline")
    console.print(_table_of_events(loop, log, throws))
    print_path("recording", recording)
    for picture in pictures:
        print_path("picture  ", picture)


def parse_pushes(scenario: Scenario, pushes: list[str]) -> list[Throw]:
    """The balls that ``--push`` asks for.

    Args:
        scenario: Whose own balls 'ball' throws.
        pushes: Each 'ball', or KEY=NUMBER pairs.

    Raises:
        ValueError: An unknown key, what is no number, or a ball that cannot be.
    """
    from drake_safety.simulation.balls import Throw

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
                    f"--push '{text}': unknown '{key}'; give 'ball', or any of "
                    f"{[f'{key}=NUMBER' for key in _THROW_FIELDS]}"
                )
            try:
                values[_THROW_FIELDS[key]] = float(value)
            except ValueError:
                raise ValueError(f"--push '{text}': '{value}' is not a number") from None
        if "direction_rad" in values:
            values["direction_rad"] = float(np.radians(values["direction_rad"]))
        throws.append(Throw(**values))
    return throws


def _timeline(loop: ClosedLoop, log: ThrowLog, throws: list[Throw]) -> Figure:
    from drake_safety.evaluation.stills import render_stills, stack_positions, still_times
    from drake_safety.evaluation.timeline_figure import timeline_figure

    positions = stack_positions(
        loop, {loop.robot.name: log.plant_state, "ball": log.extra["ball_state"]}
    )
    triggers = [start for start, _ in log.recovery_intervals_s]
    instants = still_times(log.time_s, [throw.time_s for throw in throws], triggers)
    return timeline_figure(
        log.time_s,
        log.extra[loop.trigger_port][:, 0],
        loop.scenario.parameters.recovery.threshold,
        throws=throws,
        trigger_times_s=triggers,
        recovery_intervals_s=log.recovery_intervals_s,
        stills=render_stills(loop, log.time_s, positions, instants),
        belief=log.extra["belief"],
        margins=log.margins,
        constraint_names=loop.constraint_names,
    )


def _table_of_events(loop: ClosedLoop, log: ThrowLog, throws: list[Throw]) -> Table:
    def row_at(time_s: float) -> int:
        return min(round(time_s / _LOG_PERIOD_S), len(log.time_s) - 1)

    events = [
        (
            throw.time_s,
            f"ball of {throw.mass_kg:g} kg at {throw.speed_m_s:g} m/s towards "
            f"{np.degrees(throw.direction_rad):.0f}°",
        )
        for throw in throws
    ]
    for time_s, _ in log.recovery_intervals_s:
        row = row_at(time_s)
        cause = int(np.argmax(log.extra["cause_probability"][row]))
        margin = log.extra["predicted_margins"][row][cause]
        events.append(
            (
                time_s,
                f"recovery triggered; expected violation: {loop.constraint_names[cause]}, "
                f"{100 * margin:+.1f} cm",
            )
        )
    if log.has_fallen:
        events.append((log.fall_time_s, "the robot fell"))
    else:
        events.append((float(log.time_s[-1]), "standing"))
    probability = log.extra[loop.trigger_port][:, 0]
    table = new_table("time [s]", "event", "Γ")
    for time_s, event in sorted(events):
        table.add_row(f"{time_s:.2f}", event, f"{probability[row_at(time_s)]:.2f}")
    return table
