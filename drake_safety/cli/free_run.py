"""``drake-safety run`` for a task without goals and balls: an episode with Γ."""

from __future__ import annotations

from rich.table import Table

from drake_safety.cli.console import cause_words
from drake_safety.cli.run_settings import (
    LOG_PERIOD_S,
    Recording,
    RunSettings,
    events_table,
    first_below,
    logged_ports,
)
from drake_safety.cli.training_folder import GoalThreshold
from drake_safety.evaluation.timeline_figure import timeline_figure
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.free_motion import FreeMotion, run_free


def run_episode_alone(settings: RunSettings, rule: GoalThreshold) -> None:
    """Simulates an episode of any task, and writes recording, timeline and events.

    Args:
        settings: Settings of the run.
        rule: Thresholds.

    Raises:
        ValueError: The task exports a port of the assessor under another name, or not at all.
    """
    recording = Recording(settings)
    loop = settings.make_loop(recording.viewer)
    recording.start()
    duration_s = settings.duration_s
    motion = run_free(
        loop,
        seed=settings.seed,
        duration_s=settings.scenario.episode_duration_s if duration_s is None else duration_s,
        log_period_s=LOG_PERIOD_S,
        ports=logged_ports(loop),
        realtime_rate=settings.realtime_rate,
    )
    probability = motion.extra["safety_probability"][:, 0]
    row = first_below(probability, rule.threshold)
    timeline = timeline_figure(
        motion.time_s,
        probability,
        rule.threshold,
        trigger_times_s=[] if row is None else [float(motion.time_s[row])],
        trigger_label="probability falls",
        leave_time_s=motion.leave_time_s,
        belief=motion.extra["belief"],
        margins=motion.margins,
        constraint_names=loop.constraint_names,
        angular_constraints=loop.angular_constraints,
    )
    recording.save(
        {"timeline": timeline},
        _table_of_events(loop, settings.assessment, motion, row),
        f"{rule.threshold:.3g}, {rule.origin}",
    )


def _table_of_events(
    loop: ClosedLoop, assessment: SafetyAssessment, motion: FreeMotion, row: int | None
) -> Table:
    events = [(0.0, "the episode starts")]
    if row is not None:
        expected = cause_words(
            loop,
            assessment,
            motion.extra["cause_probability"][row],
            motion.extra["predicted_margins"][row],
        )
        told = f"probability below the threshold; expected violation: {expected}"
        events.append((float(motion.time_s[row]), told))
    if motion.cause:
        events.append((motion.leave_time_s, f"left the safe set: {motion.cause}"))
    end = motion.failure and f"the simulation failed: {motion.failure}"
    inside = "the end, inside the safe set throughout"
    events.append((float(motion.time_s[-1]), end or ("the end" if motion.cause else inside)))
    return events_table(events, motion.time_s, motion.extra, assessment)
