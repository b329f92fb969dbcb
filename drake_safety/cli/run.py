"""``drake-safety run``: simulates once with Γ in the loop, and shows the events."""

import json
import shlex
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from pydrake.geometry import Meshcat
from typer import Exit, Option

from drake_safety.cli import console
from drake_safety.cli import training_folder as folders
from drake_safety.cli.ask import judge_target, parse_target, print_verdict
from drake_safety.cli.training_folder import MODES
from drake_safety.diagrams.balancing.throws import HasBall, run_throw
from drake_safety.evaluation.figure_style import save
from drake_safety.evaluation.stills import render_stills, stack_positions, still_times
from drake_safety.evaluation.timeline_figure import timeline_figure
from drake_safety.files.atomic import write_file
from drake_safety.files.reading import parse_yaml
from drake_safety.files.schema import load_typed
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.causes import cause_words, likely_cause
from drake_safety.learning.prediction import is_unknown
from drake_safety.learning.seeds import DEMONSTRATION
from drake_safety.live.following_camera import follow
from drake_safety.planning.goal_verdict import GoalThreshold, goal_threshold
from drake_safety.plants.balls import Throw
from drake_safety.plants.pushes import Push
from drake_safety.simulation.capabilities import CanBePushed, HasGoals, goal_words, require
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.motion import End, Motion, simulate
from drake_safety.simulation.rollouts import episode_rng, run_to_goal
from drake_safety.simulation.scenario import Scenario

_WITH_BALLS_S = 5.0  # Duration of a run with balls.
_AFTER_EPISODE_S = 1.0  # Beyond an episode, to show whether the robot stays at the target.
_AFTER_LEAVING_S = 0.5  # Time for which a motion without a goal goes on outside the safe set.
_AFTER_EVENT_S = 0.15  # Time of a still: when the effect of a push or a trigger is visible.
_NUM_STILLS, _MOST_EVENTS = 3, 3  # Stills of the motion, and the most stills of events.
_MOST_STILLS, _STILL_PIXELS = 4, 480  # The last stills are kept; side of a square still.
_GAMMA = ("safety_probability", "belief", "cause_probability", "predicted_margins")
_WITHOUT_ALARM = ("probability_without_alarm", "belief_without_alarm")  # Recovery reads these.
_COLUMNS = ("time [s]", "event", "probability")  # Table of events.
# Keys of a ball on the command line, and fields of a throw.
_THROW_FIELDS = {field.name.partition("_")[0]: field.name for field in fields(Throw)}


def run(
    scenario: console.ScenarioArgument,
    assessment: console.AssessmentOption = None,
    target: console.TargetOption = None,
    hand: console.HandOption = None,
    force: Annotated[bool, Option("--force", help="Go to the target even if Γ refuses.")] = False,
    guard: Annotated[bool, Option("--guard", help="Pass on an accepted command.")] = False,
    push: Annotated[
        list[str] | None,
        Option(help="A push or 'ball' of the scenario, or 'time=1 mass=3 speed=9 direction=90'."),
    ] = None,
    variation: console.VariationOption = "nominal",
    recovery: console.RecoveryOption = None,
    duration: Annotated[
        float | None, Option(help="Seconds; by default an episode, or 5 with balls.", min=0.1)
    ] = None,
    seed: Annotated[int, Option(help="Seed of start, plan and noise.")] = DEMONSTRATION.first,
    mode: console.ModeOption = MODES[0],
    mcap: console.McapOption = None,
    out: Annotated[Path | None, Option(help="Folder of run/; by default ASSESSMENT.")] = None,
) -> None:
    """Simulate once with Γ in the loop; write a recording, a timeline and the events.

    If Γ refuses a target, nothing moves and the exit code is 1; --force goes there.
    """
    loaded, learned, gamma = folders.open_assessment(scenario, assessment, mode)
    folder = (out or learned.out) / "run"
    folders.check_writable(folder)
    rule = goal_threshold(gamma)
    options = console.given(hand=hand, recovery=recovery)
    # The verdict is on the asked goal, also if a guard would replace it.
    loop = loaded.make_loop(variation, assessment=gamma, **options)
    duration_s, simulated = loaded.episode_duration_s, partial(_move, rule=rule)
    if target is not None:
        goal, one_push = parse_target(loop, target), named_push(loop, push)
        verdict, nearest = judge_target(loop, goal)
        print_verdict(loop, verdict, nearest, rule.origin)
        if not (verdict.is_accepted or force or guard):
            console.say("refused: nothing moved; --force goes there")
            raise Exit(1)
        duration_s += _AFTER_EPISODE_S
        simulated = partial(_go, goal=goal, push=one_push, rule=rule)
    elif isinstance(loop, HasGoals):
        words, names = goal_words(loop), list(loop.named_targets)
        what = f"{' '.join(words.axes)}, or one of the names {names}"
        raise ValueError(f"run: the task needs a {words.goal}: pass --{words.goal} {what}")
    elif isinstance(loop, HasBall):
        duration_s, options["ball"] = _WITH_BALLS_S, True
        simulated = partial(_throw, throws=parse_pushes(loaded, push or []))
    elif push:
        require(loop, HasBall, "run: --push")
    viewer = console.open_viewer()
    options |= console.given(guard=guard or None)
    loop = loaded.make_loop(variation, assessment=gamma, meshcat=viewer, **options)
    viewer.StartRecording()
    with console.recorded(loop, mcap, follow(loop, viewer)) as monitor:
        shown = simulated(loop, duration_s=duration or duration_s, seed=seed, monitor=monitor)
    _save(folder, viewer, loop, shown)


_Events = list[tuple[float, str]]  # Times [s] and words.


class _Shown(NamedTuple):
    """A motion with its events, its threshold (also in words), and arguments of a timeline."""

    motion: Motion
    events: _Events
    threshold: float
    threshold_text: str
    timeline: dict[str, Any]


def _go(
    loop: Any, goal: np.ndarray, push: Push | None, rule: GoalThreshold, **options: Any
) -> _Shown:
    """Moves to a goal, pushed or not."""
    motion = run_to_goal(loop, goal, push=push, ports=_logged_ports(loop), **options)
    words, output = goal_words(loop), motion["output"]
    # A motion has many rows: its promise has its own threshold.
    promise = loop.assessment.calibrations_.get("motion")
    threshold, origin = rule.threshold, "that of the verdict"
    if promise is not None:
        threshold, origin = promise.threshold, promise.origin
    events: _Events = [(0.0, f"{words.subject} starts")]
    if push is not None:
        strength = f"{push.force_n} N for {push.duration_s:g} s"
        events.append((push.time_s, f"{push.body} is pushed with {strength}"))
    if words.is_point:
        end = f"standing, {words.distance(output[-1] - goal)} from the {words.goal}"
    else:
        reached = np.round(output[len(output) // 2 :].mean(axis=0), 2)
        end = f"on its feet; mean of the second half {words.value(reached)}"
    alarms_s = alarm_times(motion, threshold)
    events = _all_events(loop, motion, events, end, alarms_s, threshold)
    text = f"alarm where the probability is below {threshold:.3f} in any row, {origin}"
    timeline = {"trigger_times_s": alarms_s, "pushes": [] if push is None else [push]}
    return _Shown(motion, events, threshold, text, timeline)


def _throw(loop: Any, throws: list[Throw], **options: Any) -> _Shown:
    """Throws balls at a robot in undisturbed motion."""
    ports = (*_logged_ports(loop), "ball_state")
    motion = run_throw(loop, 0, throws=throws, ports=ports, **options)
    threshold = loop.scenario.parameters.recovery.threshold
    events: _Events = []
    for throw in throws:
        flight = f"{throw.speed_m_s:g} m/s towards {np.degrees(throw.direction_rad):.0f}°"
        events.append((throw.time_s, f"ball of {throw.mass_kg:g} kg at {flight}"))
    events = _all_events(loop, motion, events, "standing", [], threshold)
    text = f"recovery where the probability is below {threshold:g}, as in the scenario"
    triggers = [start_s for start_s, _ in motion.recovery_intervals_s]
    timeline = {"throws": throws, "trigger_times_s": triggers, "trigger_label": "trigger"}
    return _Shown(motion, events, threshold, text, timeline)


def _move(
    loop: ClosedLoop, rule: GoalThreshold, *, seed: int, duration_s: float, **options: Any
) -> _Shown:
    """Simulates an episode from a random start, and a little beyond the safe set."""
    motion = simulate(
        loop,
        lambda context: loop.reset(context, episode_rng(seed, 0)),
        ("margins", *_logged_ports(loop)),
        End(duration_s=duration_s, after_leaving_s=_AFTER_LEAVING_S),
        may_fail=True,
        who=f"run of '{loop.scenario.name}' (seed {seed})",
        **options,
    )
    is_below = ~(motion["safety_probability"][:, 0] >= rule.threshold)
    alarms_s = motion.time_s[is_below][:1].tolist()
    end = f"the simulation failed: {motion.failure}" if motion.failure else "the end"
    begin = [(0.0, "the episode starts")]
    events = _all_events(loop, motion, begin, end, alarms_s, rule.threshold)
    text = f"{rule.threshold:.3g}, {rule.origin}"
    return _Shown(motion, events, rule.threshold, text, {"trigger_times_s": alarms_s})


def alarm_times(motion: Motion, threshold: float) -> list[float]:
    """First time with the probability below the threshold [s]; none if it was so at the start."""
    is_below = ~(motion["safety_probability"][:, 0] >= threshold)
    times_s: list[float] = motion.time_s[is_below][:1].tolist()
    return [time_s for time_s in times_s if time_s > motion.time_s[0]]


def _all_events(
    loop: Any, motion: Motion, events: _Events, end: str, alarms_s: list[float], threshold: float
) -> _Events:
    """Events, and recoveries, the guard, alarms, where it leaves the safe set, and the end."""
    if recoveries := motion.recovery_intervals_s:
        starts, limit = [start for start, _ in recoveries], loop.scenario.parameters.recovery
        words = "recovery triggered: "
        events = events + reason_events(loop, motion, starts, limit.threshold, words)
    for start_s, _ in motion.intervals_s("guard_active")[:1]:
        events = [*events, (start_s, "the guard passes on another command")]
    events = events + reason_events(loop, motion, alarms_s, threshold)
    if motion.has_left:
        events = [*events, (motion.leave_time_s, f"left the safe set: {motion.cause}")]
    else:
        end += ", inside the safe set throughout"
    fall = (motion.fall_time_s, "the robot fell")
    return [*events, fall if motion.has_fallen else (float(motion.time_s[-1]), end)]


def reason_events(
    loop: Any, motion: Motion, times_s: list[float], threshold: float, happens: str = ""
) -> _Events:
    """Why Γ was low at given times: "don't know" and its reason, or a cause."""
    names, parameters = loop.constraint_names, loop.assessment.parameters
    # A recovery, which happens, heeds no alarm.
    probability, belief = map(motion.__getitem__, _WITHOUT_ALARM if happens else _GAMMA[:2])
    events = []
    for time_s in times_s:
        row = int(np.abs(motion.time_s - time_s).argmin())
        margins, unit = motion["predicted_margins"][row], parameters.margin_unit
        alarms_s = [begin for begin, end in motion.intervals_s("alarm") if begin <= time_s <= end]
        reason = f"probability {probability[row, 0]:.3f} < {threshold:.3g}"
        if is_unknown(belief[row], parameters.initial_uncertainty):
            reason = "don't know: unlike training"
            if alarms_s and not happens:
                reason = f"don't know: monitor's alarm since {alarms_s[0]:.2f} s"
        elif cause := likely_cause(names, motion["cause_probability"][row], margins, unit):
            margin = margins[names.index(cause)]
            reason += "; " + ": ".join(cause_words(cause, margin, loop.angular_constraints))
        events.append((time_s, happens + reason))
    return events


def _logged_ports(loop: ClosedLoop) -> tuple[str, ...]:
    """The ports of Γ and, if the loop has them, of the monitor, the guard and recovery."""
    some = filter(loop.HasOutputPort, ("alarm", "alarm_cause", "guard_active", "recovery_active"))
    return (*_GAMMA, *_WITHOUT_ALARM, *some)


def _timeline(loop: Any, shown: _Shown) -> Figure:
    """The probability along a motion, with stills of a robot."""
    motion, options = shown.motion, {"trigger_label": "alarm"} | shown.timeline
    if isinstance(loop, LeggedLoop) and "plant_state" in motion.ports:
        states = {loop.robot.name: motion["plant_state"]}
        if "ball_state" in motion.ports:
            states["ball"] = motion["ball_state"]
        instants: list[float] = []
        for at_s in sorted(at_s + _AFTER_EVENT_S for at_s, _ in shown.events if at_s):
            if at_s - max(instants, default=0.0) > _AFTER_EVENT_S:
                instants.append(at_s)
        times_s = still_times(motion.time_s, instants[:_MOST_EVENTS], num_stills=_NUM_STILLS)
        shown_s, positions = times_s[-_MOST_STILLS:], stack_positions(loop, states)
        options["stills"] = render_stills(
            loop, motion.time_s, positions, shown_s, width=_STILL_PIXELS, height=_STILL_PIXELS
        )
    return timeline_figure(
        motion.time_s,
        motion["safety_probability"][:, 0],
        shown.threshold,
        leave_time_s=motion.leave_time_s,
        recovery_intervals_s=motion.recovery_intervals_s,
        alarm_intervals_s=motion.intervals_s("alarm"),
        belief=motion["belief"],
        margins=motion["margins"],
        constraint_names=loop.constraint_names,
        angular_constraints=loop.angular_constraints,
        **options,
    )


def event_rows(
    events: _Events, motion: Motion, gamma: SafetyAssessment
) -> list[tuple[str, str, str]]:
    """Rows of events and of the monitor's alarms: time [s], words, and the probability then."""
    time_s, probability = motion.time_s, motion["safety_probability"][:, 0]
    withdrawn = ". The promise is withdrawn" if gamma.calibrations_ else ""
    alarms = []
    is_on = motion.ports.get("alarm", np.zeros((len(time_s), 1)))[:, 0] > 0.5
    for k in np.flatnonzero(np.diff(is_on, prepend=False)).tolist():
        cause = f"{motion['alarm_cause'][k]}{withdrawn}" if is_on[k] else "the alarm ends"
        alarms.append((float(time_s[k]), f"monitor: {cause}"))
    return [
        (f"{instant:.2f}", event, f"{probability[abs(time_s - instant).argmin()]:.2f}")
        for instant, event in sorted([*events, *alarms], key=lambda one: one[0])
    ]


def _save(folder: Path, viewer: Meshcat, loop: Any, shown: _Shown) -> None:
    """Writes recording, figures and events, and prints the events and the paths."""
    motion = shown.motion
    viewer.StopRecording()
    viewer.PublishRecording()
    recording = folder / "recording.html"
    write_file(recording, viewer.StaticHtml())
    rows = event_rows(shown.events, motion, loop.assessment)
    content = console.made_by(loop.scenario.name) | {"columns": _COLUMNS, "rows": rows}
    write_file(folder / "run.json", json.dumps(content, indent=2, ensure_ascii=False) + "\n")
    console.show(console.new_table(*_COLUMNS, rows=rows))
    console.say("threshold", shown.threshold_text)
    console.say("recording", recording)
    for path in save(_timeline(loop, shown), folder / "timeline"):
        console.say("picture  ", path)


def named_push(loop: ClosedLoop, names: list[str] | None) -> Push | None:
    """The push that ``--push`` names, if any."""
    if not names:
        return None
    pushes = require(loop, CanBePushed, "--push").pushes
    if len(names) > 1 or names[0] not in pushes:
        raise ValueError(f"--push: expected one of {list(pushes)}; got {names}")
    return pushes[names[0]]


def parse_pushes(scenario: Scenario, pushes: list[str]) -> list[Throw]:
    """The balls of ``--push``: each is 'ball', as in the scenario, or KEY=NUMBER pairs."""
    throws: list[Throw] = []
    for text in pushes:
        if text == "ball":
            throws += scenario.parameters.demonstration
            continue
        words = dict(pair.partition("=")[::2] for pair in shlex.split(text))
        values = {_THROW_FIELDS.get(key, key): parse_yaml(x, key) for key, x in words.items()}
        throw = load_typed(Throw, values, f"--push '{text}'")
        if "direction" in words:
            throw.direction_rad = float(np.radians(throw.direction_rad))
        throws.append(throw)
    return throws
