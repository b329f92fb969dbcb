"""``drake-safety run``: simulates once with Γ in the loop, and shows the events."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from matplotlib.figure import Figure
from pydrake.geometry import Meshcat
from rich.table import Table

from drake_safety.cli.console import (
    LOOPBACK,
    AssessmentOption,
    HostOption,
    ScenarioArgument,
    cause_words,
    command_line,
    console,
    new_table,
    open_viewer,
    print_path,
    print_shipped,
    versions,
    warn_of_empty_scene,
)
from drake_safety.cli.targets import (
    HandOption,
    TargetOption,
    nearest_accepted,
    parse_target,
    print_verdict,
)
from drake_safety.cli.training_folder import (
    GoalThreshold,
    assessment_folder,
    goal_threshold,
    load_assessment,
)
from drake_safety.evaluation.figure_style import save
from drake_safety.evaluation.path_figure import path_figure
from drake_safety.evaluation.stills import render_stills, stack_positions, still_times
from drake_safety.evaluation.timeline_figure import timeline_figure
from drake_safety.files.reading import did_you_mean
from drake_safety.files.schema import load_typed
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import DEMONSTRATION
from drake_safety.planning.goal_verdict import assess_goal
from drake_safety.plants.balls import Throw
from drake_safety.plants.pushes import Push
from drake_safety.simulation.capabilities import (
    CanBePushed,
    HasBall,
    HasGoals,
    goal_words,
    require,
)
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.motion import Motion, simulate
from drake_safety.simulation.rollouts import episode_rng, run_to_goal
from drake_safety.simulation.scenario import Scenario, load_scenario
from drake_safety.simulation.throws import run_throw

_WITH_BALLS_S = 5.0  # Duration of a run with balls.
_AFTER_EPISODE_S = 1.0  # Beyond an episode, to show whether the robot stays at the target.
_AFTER_LEAVING_S = 0.5  # Time for which a motion without a goal goes on outside the safe set.
_AROUND_IMPACT_S = (-0.02, 0.16)  # The ball in the air, and its effect.
_AFTER_TRIGGER_S = 0.3  # Feet in the air.
_AFTER_PUSH_S = 0.15  # Time at which the effect of a push is visible.
_NUM_STILLS = 5  # Of a motion to a goal.
_HAPPENING = {
    "guard_active": "the guard passes on another command",
    "recovery_active": "recovery triggered",
}
"""Ports that a loop may have, and what it means when they become positive."""
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
    if force and target is None:
        raise ValueError("run: --force goes to a target that Γ refuses: pass that too")
    loaded = load_scenario(scenario)
    learned = assessment_folder(loaded, assessment)
    gamma = load_assessment(learned.path, mode)
    given = {"hand": hand, "recovery": recovery, "guard": guard or None}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    print_shipped(learned, gamma)
    rule = goal_threshold(learned.path, gamma)
    # The verdict is on what is asked, whatever a guard would pass on.
    asked = {name: value for name, value in options.items() if target is None or name != "guard"}
    # Check the capabilities of the task before a browser is opened.
    loop = loaded.make_loop(variation, assessment=gamma, **asked)
    goal, one_push, throws = None, None, None
    if target is not None:
        goal, one_push = parse_target(loop, target), named_push(loop, push or [])
        if not (_ask(loop, gamma, goal, rule) or force or guard):
            console.print("refused: nothing moved; --force goes there", highlight=False)
            raise typer.Exit(1)
    elif isinstance(loop, HasGoals):
        words = goal_words(loop)
        raise ValueError(
            f"run: task '{type(loop).__name__}' needs a {words.goal}: pass --{words.goal} "
            f"{' '.join(words.axes)}, or one of the names {list(loop.named_targets)}"
        )
    elif isinstance(loop, HasBall):
        throws = parse_pushes(loaded, push or [])
        options["ball"] = True
    elif push:
        require(loop, HasBall, "run: --push")
    viewer = open_viewer(host)
    if meshcat:
        console.print(f"live at {viewer.web_url()}")
    loop = loaded.make_loop(variation, assessment=gamma, meshcat=viewer, **options)
    if meshcat:
        input("Press Enter when the browser shows the robot. ")
    viewer.StartRecording()
    simulated: dict[str, Any] = {"seed": seed, "realtime_rate": 1.0 if meshcat else 0.0}
    if goal is not None:
        shown = _go(loop, gamma, goal, one_push, rule, duration, **simulated)
    elif throws is not None:
        shown = _throw(loop, gamma, throws, duration, **simulated)
    else:
        shown = _move(loop, gamma, rule, duration, **simulated)
    warn_of_empty_scene(viewer, loaded.task)
    _save((out or learned.out) / "run", viewer, *shown)


_Shown = tuple[Mapping[str, Figure], Table, str]  # Figures, events, and the threshold in words.


def _ask(loop: ClosedLoop, gamma: SafetyAssessment, goal: np.ndarray, rule: GoalThreshold) -> bool:
    """Prints the verdict on a goal, and returns whether it is accepted."""
    verdict = assess_goal(
        loop, gamma, goal, threshold=rule.threshold, unsafe_below=rule.unsafe_below
    )
    nearest = None if verdict.is_accepted else nearest_accepted(loop, gamma, verdict)
    print_verdict(loop, verdict, nearest, rule.origin)
    return verdict.is_accepted


def _go(
    loop: ClosedLoop,
    gamma: SafetyAssessment,
    goal: np.ndarray,
    push: Push | None,
    rule: GoalThreshold,
    duration_s: float | None,
    **options: Any,
) -> _Shown:
    """Moves to a goal, pushed or not."""
    ports = (*_logged_ports(loop), *filter(loop.HasOutputPort, _HAPPENING))
    duration_s = duration_s or loop.scenario.episode_duration_s + _AFTER_EPISODE_S
    motion = run_to_goal(loop, goal, push=push, duration_s=duration_s, ports=ports, **options)
    threshold, origin = motion_threshold(gamma, rule)
    alarm = alarm_row(motion, threshold)
    words = goal_words(require(loop, HasGoals))
    instants = [motion.leave_time_s, motion.fall_time_s]
    events = [(0.0, f"{words.subject} starts")]
    for port, happens in _HAPPENING.items():
        if port in motion.ports and (motion[port] > 0).any():
            row = int(np.argmax(motion[port][:, 0] > 0))
            events.append((float(motion.time_s[row]), happens))
    if push is not None:
        instants += [push.time_s, push.time_s + push.duration_s + _AFTER_PUSH_S]
        told = f"{push.body} is pushed with {push.force_n} N for {push.duration_s:g} s"
        events.append((push.time_s, told))
    if alarm is not None:
        told = f"probability below {threshold:.3f}; {_expected(loop, gamma, motion, alarm)}"
        events.append((float(motion.time_s[alarm]), told))
    if motion.has_left:
        events.append((motion.leave_time_s, f"left the safe set: {motion.cause}"))
    if motion.has_fallen:
        events.append((motion.fall_time_s, "the robot fell"))
    else:
        place = "" if motion.has_left else ", inside the safe set throughout"
        output = motion["output"]
        if words.is_point:
            miss = words.distance(output[-1] - goal)
            told = f"standing{place}; {miss} from the {words.goal}"
        else:
            reached = np.round(output[len(output) // 2 :].mean(axis=0), 2)
            told = f"on its feet{place}; mean of the second half {words.value(reached)}"
        events.append((float(motion.time_s[-1]), told))
    timeline = _timeline(
        loop,
        motion,
        threshold,
        instants=[instant for instant in instants if instant <= motion.time_s[-1]],
        num_stills=_NUM_STILLS,
        pushes=[] if push is None else [push],
        alarm=alarm,
    )
    told = f"alarm where the probability is below {threshold:.3f} in any row, {origin}"
    return {"timeline": timeline}, events_table(events, motion, gamma), told


def _throw(
    loop: ClosedLoop,
    gamma: SafetyAssessment,
    throws: list[Throw],
    duration_s: float | None,
    **options: Any,
) -> _Shown:
    """Throws balls at a robot in undisturbed motion."""
    ports = (*_logged_ports(loop), "embedding", "ball_state")
    duration_s = duration_s or _WITH_BALLS_S
    motion = run_throw(loop, 0, throws=throws, duration_s=duration_s, ports=ports, **options)
    threshold = loop.scenario.parameters.recovery.threshold
    triggers = [start_s for start_s, _ in motion.recovery_intervals_s]
    events = [
        (
            throw.time_s,
            f"ball of {throw.mass_kg:g} kg at {throw.speed_m_s:g} m/s towards "
            f"{np.degrees(throw.direction_rad):.0f}°",
        )
        for throw in throws
    ]
    for time_s in triggers:
        row = int(np.abs(motion.time_s - time_s).argmin())
        told = f"recovery triggered; {_expected(loop, gamma, motion, row)}"
        events.append((time_s, told))
    fall = (motion.fall_time_s, "the robot fell")
    events.append(fall if motion.has_fallen else (float(motion.time_s[-1]), "standing"))
    instants = [throw.time_s + after_s for throw in throws for after_s in _AROUND_IMPACT_S]
    instants += [trigger_s + _AFTER_TRIGGER_S for trigger_s in triggers[:1]]
    timeline = _timeline(
        loop, motion, threshold, instants=instants, throws=throws, trigger_times_s=triggers
    )
    marked = {f"ball {i}": throw.time_s for i, throw in enumerate(throws, start=1)}
    marked |= {f"recovery {i}": start_s for i, start_s in enumerate(triggers, start=1)}
    path = path_figure(
        gamma,
        motion.time_s,
        motion["embedding"],
        motion["safety_probability"][:, 0],
        threshold,
        {"start": 0.0, **marked},
    )
    told = (
        f"recovery where the probability is below {threshold:g}, that of scenario "
        f"'{loop.scenario.name}'"
    )
    return {"timeline": timeline, "path": path}, events_table(events, motion, gamma), told


def _move(
    loop: ClosedLoop,
    gamma: SafetyAssessment,
    rule: GoalThreshold,
    duration_s: float | None,
    *,
    seed: int,
    realtime_rate: float,
) -> _Shown:
    """Simulates an episode from a random start, and a little beyond the safe set."""
    motion = simulate(
        loop,
        lambda context: loop.reset(context, episode_rng(seed, 0)),
        ("margins", *_logged_ports(loop)),
        duration_s=duration_s or loop.scenario.episode_duration_s,
        after_leaving_s=_AFTER_LEAVING_S,
        may_fail=True,
        realtime_rate=realtime_rate,
        who=f"run of '{loop.scenario.name}' (seed {seed})",
    )
    alarm = first_below(motion["safety_probability"][:, 0], rule.threshold)
    events = [(0.0, "the episode starts")]
    if alarm is not None:
        told = f"probability below the threshold; {_expected(loop, gamma, motion, alarm)}"
        events.append((float(motion.time_s[alarm]), told))
    end = "the end, inside the safe set throughout"
    if motion.has_left:
        events.append((motion.leave_time_s, f"left the safe set: {motion.cause}"))
        end = "the end"
    if motion.failure:
        end = f"the simulation failed: {motion.failure}"
    events.append((float(motion.time_s[-1]), end))
    figures = {"timeline": _timeline(loop, motion, rule.threshold, alarm=alarm)}
    told = f"{rule.threshold:.3g}, {rule.origin}"
    return figures, events_table(events, motion, gamma), told


def _save(
    folder: Path,
    viewer: Meshcat,
    figures: Mapping[str, Figure],
    events: Table,
    threshold: str,
) -> None:
    """Writes recording, figures and events, and prints the events and the paths."""
    viewer.StopRecording()
    viewer.PublishRecording()
    folder.mkdir(parents=True, exist_ok=True)
    recording = folder / "recording.html"
    recording.write_text(viewer.StaticHtml(), encoding="utf-8")
    pictures = [path for name in figures for path in save(figures[name], folder / name)]
    content = {
        "command": command_line(),
        "versions": versions(),
        "columns": [str(column.header) for column in events.columns],
        "rows": [list(row) for row in zip(*(c.cells for c in events.columns), strict=True)],
    }
    text = json.dumps(content, indent=2, ensure_ascii=False) + "\n"
    (folder / "run.json").write_text(text, encoding="utf-8")
    console.print(events)
    console.print("threshold", threshold, highlight=False, soft_wrap=True)
    print_path("recording", recording)
    for path in pictures:
        print_path("picture  ", path)


def _timeline(
    loop: ClosedLoop,
    motion: Motion,
    threshold: float,
    *,
    alarm: int | None = None,
    instants: Sequence[float] | None = None,
    num_stills: int = 2,
    **options: Any,
) -> Figure:
    """The probability along a motion; with stills at instants [s], and an alarm in a row."""
    if alarm is not None:
        alarms_s = [float(motion.time_s[alarm])]
        options |= {"trigger_times_s": alarms_s, "trigger_label": "probability falls"}
    if instants is not None and isinstance(loop, LeggedLoop):
        states = {loop.robot.name: motion["plant_state"]}
        if "ball_state" in motion.ports:
            states["ball"] = motion["ball_state"]
        times_s = still_times(motion.time_s, instants, num_stills=num_stills)
        positions = stack_positions(loop, states)
        options["stills"] = render_stills(loop, motion.time_s, positions, times_s)
    return timeline_figure(
        motion.time_s,
        motion["safety_probability"][:, 0],
        threshold,
        leave_time_s=motion.leave_time_s,
        recovery_intervals_s=motion.recovery_intervals_s,
        belief=motion["belief"],
        margins=motion["margins"],
        constraint_names=loop.constraint_names,
        angular_constraints=loop.angular_constraints,
        **options,
    )


def _logged_ports(loop: ClosedLoop) -> tuple[str, ...]:
    """The ports of Γ and, if the loop has them, of the monitor."""
    of_gamma = ("safety_probability", "belief", "cause_probability", "predicted_margins")
    return (*of_gamma, *filter(loop.HasOutputPort, ("alarm", "alarm_cause")))


def _expected(loop: ClosedLoop, gamma: SafetyAssessment, motion: Motion, row: int) -> str:
    masses, margins = motion["cause_probability"][row], motion["predicted_margins"][row]
    return f"expected violation: {cause_words(loop, gamma, masses, margins)}"


def first_below(probability: np.ndarray, threshold: float) -> int | None:
    """First row in which the probability is below a threshold or NaN; None for never."""
    is_below = ~(probability >= threshold)
    return int(np.argmax(is_below)) if is_below.any() else None


def alarm_row(motion: Motion, threshold: float) -> int | None:
    """First row with the probability below the threshold, if it was above at the start, or None."""
    # Row 0 is no alarm: it was below from the start.
    return first_below(motion["safety_probability"][:, 0], threshold) or None


def motion_threshold(gamma: SafetyAssessment, rule: GoalThreshold) -> tuple[float, str]:
    """Threshold of alarms during a motion, and its origin."""
    # A motion has many rows: its promise has its own threshold.
    calibration = gamma.calibrations_.get("motion")
    if calibration is None:
        return rule.threshold, "that of the verdict"
    return calibration.threshold, calibration.origin


def events_table(
    events: Sequence[tuple[float, str]], motion: Motion, gamma: SafetyAssessment
) -> Table:
    """A table of events, times [s] and words, and the monitor's alarms, with the probability then.

    The motion has the port ``safety_probability``, and those of the monitor if there is one.
    """
    table = new_table("time [s]", "event", "probability")
    time_s, probability = motion.time_s, motion["safety_probability"][:, 0]
    is_on = motion.ports.get("alarm", np.zeros((len(time_s), 1)))[:, 0] > 0.5
    withdrawn = ". The promise is withdrawn" if gamma.calibrations_ else ""
    alarms = []
    for k in np.flatnonzero(np.diff(is_on, prepend=False)).tolist():
        told = f"{motion['alarm_cause'][k]}{withdrawn}" if is_on[k] else "the alarm ends"
        alarms.append((float(time_s[k]), f"monitor: {told}"))
    for instant, event in sorted([*events, *alarms], key=lambda one: one[0]):
        row = abs(time_s - instant).argmin()
        table.add_row(f"{instant:.2f}", event, f"{probability[row]:.2f}")
    return table


def named_push(loop: ClosedLoop, names: list[str]) -> Push | None:
    """The push of ``--push``, if any.

    Args:
        loop: The closed loop.
        names: Values of ``--push``.

    Raises:
        ValueError: The push does not exist, or there is more than one.
    """
    if not names:
        return None
    if len(names) > 1:
        raise ValueError(f"--push: a motion to a target takes one push; got {names}")
    (name,) = names
    pushes = require(loop, CanBePushed, "--push").pushes
    if name not in pushes:
        raise ValueError(
            f"--push '{name}': scenario '{loop.scenario.name}' has no such push for a motion to a "
            f"target{did_you_mean(name, pushes)}; it has {list(pushes)}"
        )
    return pushes[name]


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
