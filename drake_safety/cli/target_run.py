"""``drake-safety run --target``: a motion to a goal that Γ accepts, or that is forced."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from drake_safety.cli.console import cause_words, console
from drake_safety.cli.run_settings import (
    LOG_PERIOD_S,
    Recording,
    RunSettings,
    events_table,
    first_below,
    logged_ports,
)
from drake_safety.cli.targets import nearest_accepted, parse_target, print_verdict
from drake_safety.cli.training_folder import GoalThreshold
from drake_safety.evaluation.stills import render_stills, stack_positions, still_times
from drake_safety.evaluation.timeline_figure import timeline_figure
from drake_safety.files.reading import did_you_mean
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.planning.goal_verdict import assess_goal
from drake_safety.plants.pushes import Push
from drake_safety.simulation.capabilities import CanBePushed, HasGoals, goal_words, require
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.goal_motion import GoalMotion, run_to_goal

_HAPPENING = {
    "guard_active": "the guard passes on another command",
    "recovery_active": "recovery triggered",
}
"""Ports that a loop may have, and what it means when they become positive."""
_NUM_STILLS = 5
_AFTER_PUSH_S = 0.15  # Time at which the effect of a push is visible.
_AFTER_EPISODE_S = 1.0  # Beyond an episode, to show whether the robot stays at the target.


def run_to_target(
    settings: RunSettings, target: str, rule: GoalThreshold, *, is_forced: bool
) -> bool:
    """Prints the verdict on a target and goes there if it is accepted or forced.

    Args:
        settings: Settings of the run.
        target: Value of ``--target``.
        rule: Thresholds of the verdict.
        is_forced: Whether to go there even if it is refused.

    Returns:
        Whether the robot moved.

    Raises:
        ValueError: The task has no goals, or no such target, hand or push.
    """
    # The verdict is on what is asked, whatever a guard would pass on.
    options = {name: value for name, value in settings.options.items() if name != "guard"}
    loop = replace(settings, options=options).make_loop()
    goal = parse_target(loop, target)
    push = named_push(loop, settings.pushes)
    threshold = rule.threshold
    verdict = assess_goal(
        loop, settings.assessment, goal, threshold=threshold, unsafe_below=rule.unsafe_below
    )
    nearest = None if verdict.is_accepted else nearest_accepted(loop, settings.assessment, verdict)
    print_verdict(loop, verdict, nearest, rule.origin)
    if not (verdict.is_accepted or is_forced):
        console.print("refused: nothing moved; --force goes there", highlight=False)
        return False
    recording = Recording(settings)
    loop = settings.make_loop(recording.viewer)
    recording.start()
    duration_s = settings.duration_s
    if duration_s is None:
        duration_s = settings.scenario.episode_duration_s + _AFTER_EPISODE_S
    motion = run_to_goal(
        loop,
        goal,
        push=push,
        duration_s=duration_s,
        seed=settings.seed,
        log_period_s=LOG_PERIOD_S,
        ports=(*logged_ports(loop), *filter(loop.HasOutputPort, _HAPPENING)),
        realtime_rate=settings.realtime_rate,
    )
    calibration = settings.assessment.calibrations_.get("motion")
    # A motion has many rows: its promise has its own threshold.
    threshold = threshold if calibration is None else calibration.threshold
    origin = "that of the verdict" if calibration is None else calibration.origin
    recording.save(
        {"timeline": draw_motion(loop, motion, threshold)},
        table_of_motion(loop, settings.assessment, motion, threshold),
        f"alarm where the probability is below {threshold:.3f} in any row, {origin}",
    )
    return True


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


def alarm_row(motion: GoalMotion, threshold: float) -> int | None:
    """First row with the probability below the threshold, if it was above at the start, or None."""
    # Row 0 is no alarm: it was below from the start.
    return first_below(motion.extra["safety_probability"][:, 0], threshold) or None


def draw_motion(loop: ClosedLoop, motion: GoalMotion, threshold: float) -> Figure:
    """Plots the probability along a motion, with stills.

    Args:
        loop: The simulated closed loop.
        motion: Log of the motion, with the assessor's outputs.
        threshold: Probability below which a row is an alarm.
    """
    positions = stack_positions(loop, {loop.robot.name: motion.plant_state})
    events = [motion.leave_time_s] if motion.has_left else []
    if motion.has_fallen:
        events.append(motion.fall_time_s)
    if motion.push is not None:
        events += [motion.push.time_s, motion.push.time_s + motion.push.duration_s + _AFTER_PUSH_S]
    events = [instant for instant in events if instant <= motion.time_s[-1]]
    instants = still_times(motion.time_s, events, num_stills=_NUM_STILLS)
    alarm = alarm_row(motion, threshold)
    return timeline_figure(
        motion.time_s,
        motion.extra["safety_probability"][:, 0],
        threshold,
        pushes=[] if motion.push is None else [motion.push],
        trigger_times_s=[] if alarm is None else [float(motion.time_s[alarm])],
        trigger_label="probability falls",
        leave_time_s=motion.leave_time_s,
        stills=render_stills(loop, motion.time_s, positions, instants),
        belief=motion.extra["belief"],
        margins=motion.margins,
        constraint_names=loop.constraint_names,
        angular_constraints=loop.angular_constraints,
    )


def table_of_motion(
    loop: ClosedLoop, assessment: SafetyAssessment, motion: GoalMotion, threshold: float
) -> Table:
    """A table of the events of a motion, with the probability at their times.

    Args:
        loop: The simulated closed loop.
        assessment: Γ.
        motion: Log of the motion, with the assessor's outputs.
        threshold: Probability below which a row is an alarm.
    """
    words = goal_words(require(loop, HasGoals))
    events = [(0.0, f"{words.subject} starts")]
    for port, happens in _HAPPENING.items():
        if port in motion.extra and (motion.extra[port] > 0).any():
            row = int(np.argmax(motion.extra[port][:, 0] > 0))
            events.append((float(motion.time_s[row]), happens))
    if motion.push is not None:
        push = motion.push
        events.append(
            (push.time_s, f"{push.body} is pushed with {push.force_n} N for {push.duration_s:g} s")
        )
    alarm = alarm_row(motion, threshold)
    if alarm is not None:
        expected = cause_words(
            loop,
            assessment,
            motion.extra["cause_probability"][alarm],
            motion.extra["predicted_margins"][alarm],
        )
        events.append(
            (
                float(motion.time_s[alarm]),
                f"probability below {threshold:.3f}; expected violation: {expected}",
            )
        )
    if motion.has_left:
        events.append((motion.leave_time_s, f"left the safe set: {motion.cause}"))
    if motion.has_fallen:
        events.append((motion.fall_time_s, "the robot fell"))
    else:
        place = "" if motion.has_left else ", inside the safe set throughout"
        if words.is_point:
            missed = f"standing{place}; {words.distance(motion.miss)} from the {words.goal}"
        else:
            reached = np.round(motion.output[len(motion.output) // 2 :].mean(axis=0), 2)
            missed = f"on its feet{place}; mean of the second half {words.value(reached)}"
        events.append((float(motion.time_s[-1]), missed))
    return events_table(events, motion.time_s, motion.extra, assessment)
