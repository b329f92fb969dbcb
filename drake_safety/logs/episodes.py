"""Conversion of logs to episodes, by evaluating a loop's ports at the logged states."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.framework import Context
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.kinematics import planar_pose
from drake_safety.learning.mode_settings import mode_settings
from drake_safety.learning.seeds import NOT_DRAWN
from drake_safety.learning.segments import Episode, Episodes
from drake_safety.logs.conversion import values_at
from drake_safety.logs.robot_log import RobotLog
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.motion import Recorder
from drake_safety.simulation.rollouts import MOTION_PIECE_S, episodes_info
from drake_safety.simulation.scenario import Scenario

_ROUNDING_S = 1e-9


def episodes_from_log(
    log: RobotLog | Sequence[RobotLog],
    loop: LeggedLoop | Scenario,
    *,
    desired_output: np.ndarray | None = None,
) -> Episodes:
    """Returns the episodes of :func:`cut_log` without their starts."""
    return cut_log(log, loop, desired_output=desired_output)[0]


def cut_log(
    log: RobotLog | Sequence[RobotLog],
    loop: LeggedLoop | Scenario,
    *,
    desired_output: np.ndarray | None = None,
) -> tuple[Episodes, list[EpisodeStart]]:
    """Converts logs to consecutive episodes of the actual robot, with the starts of their twins.

    Episodes have the scenario's duration; none reaches over a cut of
    :func:`~drake_safety.logs.robot_log.read_pieces`. The last episode of a log ends where the robot
    leaves the safe set at a tick of the loop's monitor; later rows are ignored. A safe remainder
    that is too short for a segment is dropped. No noise is added to the logged states, which
    contain measurement noise. The preview is the logged z*, constant after the last row, in the
    stance frame of the episode's first row.

    Args:
        log: The log, or several of one robot, whose episodes are numbered consecutively.
        loop: The loop without Γ that evaluates the states, or a scenario with an ``actual`` one.
        desired_output: Constant z* in the world for logs without it, (n_z,) [m].

    Returns:
        The episodes and their starts: ``run_episode(nominal_loop, start=starts[i])`` is the twin
        of ``episodes[i]``.

    Raises:
        ValueError: A log is of another robot, has no z*, begins outside the safe set, or is
            too short for one segment.
    """
    if isinstance(loop, Scenario):
        loop = loop.make_loop("actual")
    scenario = loop.scenario
    assessment = scenario.assessment
    shortest = assessment.preview_stride * mode_settings(assessment).shortest
    rows = _Rows(scenario.step_s, scenario.episode_duration_s, shortest)
    episodes: list[Episode] = []
    starts: list[EpisodeStart] = []
    for parts in _parts(log, loop, desired_output, rows):
        found = [both for _, several in parts for both in several]
        if not found:
            longest = max((one for one, _ in parts), key=lambda one: one.duration_s)
            raise ValueError(
                f"log '{longest.path}' lasts {longest.duration_s:g} s: too short for a segment of "
                f"{shortest} steps of {scenario.step_s} s of scenario '{scenario.name}'"
            )
        for episode, start in found:
            episodes.append(replace(episode, index=len(episodes)))
            starts.append(start)
    return Episodes(episodes_info(loop, seed=NOT_DRAWN), episodes), starts


def motions_from_log(
    log: RobotLog | Sequence[RobotLog],
    loop: LeggedLoop | Scenario,
    *,
    desired_output: np.ndarray | None = None,
    step_s: float | None = None,
) -> Episodes:
    """Converts logs to motions for a `ChangeDetector`, with their times in the log.

    Each lasts up to a minute, in the stance frame of its first row. The arguments and errors are
    those of :func:`cut_log`; a log is also refused if the monitor reads the controller's memory.
    Rows are `step_s` apart, by default the scenario's `monitor_step_s`.
    """
    if isinstance(loop, Scenario):
        loop = loop.make_loop("actual")
    if unlogged := set(loop.memory_features).intersection(loop.monitored.get("features", ())):
        raise ValueError(
            f"the monitor reads {sorted(unlogged)}, which a log of positions and velocities does "
            "not have: write what the policy observes and commands as sequences of an .npz file"
        )
    rows = _Rows(step_s or loop.scenario.monitor_step_s, MOTION_PIECE_S, shortest=2)
    motions: list[Episode] = []
    for parts in _parts(log, loop, desired_output, rows):
        for one, found in parts:
            begin_s = one.begin_s
            for motion, _ in found:
                time_s = begin_s + motion.time_s
                motions.append(replace(motion, index=len(motions), time_s=time_s))
                begin_s = float(time_s[-1])
    return Episodes(replace(episodes_info(loop, seed=NOT_DRAWN), step_s=rows.step_s), motions)


class _Rows(NamedTuple):
    """Rows of the episodes of a log: their distance, duration, and least number of steps."""

    step_s: float
    duration_s: float
    shortest: int


def _parts(
    log: RobotLog | Sequence[RobotLog],
    loop: LeggedLoop,
    desired_output: np.ndarray | None,
    rows: _Rows,
) -> Iterator[list[tuple[RobotLog, list[tuple[Episode, EpisodeStart]]]]]:
    """The pieces of each log, to where the robot leaves the safe set, and their episodes."""
    logs = [log] if isinstance(log, RobotLog) else log
    begins = [i for i, one in enumerate(logs) if i == 0 or one.piece == 0]
    for begin, end in itertools.pairwise([*begins, len(logs)]):
        parts, has_left = [], False
        for one in logs[begin:end]:
            if not has_left:
                desired = _desired_output(one, loop, desired_output)
                found, has_left = _cut(one, loop, desired, rows)
                parts.append((one, found))
        yield parts


def _cut(
    log: RobotLog, loop: LeggedLoop, desired: np.ndarray, rows: _Rows
) -> tuple[list[tuple[Episode, EpisodeStart]], bool]:
    """Episodes and starts of a piece with z* (N, n_z) [m], and whether it leaves the safe set."""
    scenario = loop.scenario
    context = loop.CreateDefaultContext()
    found: list[tuple[Episode, EpisodeStart]] = []
    begin_s = 0.0
    while log.duration_s - begin_s > rows.step_s:
        start = _start(log, loop, desired, begin_s, rows.duration_s)
        loop.reset_to(context, None, start)
        episode = _episode(log, loop, context, begin_s, rows)
        if not episode.is_safe and episode.num_steps == 0 and not found:
            if log.piece:
                return [], True
            raise ValueError(
                f"log '{log.path}' begins outside the safe set of scenario '{scenario.name}': "
                f"the margin '{episode.cause}' is {episode.margins[0].min():.3g}"
            )
        if not episode.is_safe or episode.num_steps >= rows.shortest:
            found.append((episode, start))
        if not episode.is_safe:
            return found, True
        begin_s += float(episode.time_s[-1])
    return found, False


def _desired_output(
    log: RobotLog, loop: LeggedLoop, desired_output: np.ndarray | None
) -> np.ndarray:
    who = f"log '{log.path}'"
    if log.robot != loop.robot.name:
        raise ValueError(
            f"{who} is of robot '{log.robot}', scenario '{loop.scenario.name}' of "
            f"'{loop.robot.name}'"
        )
    size = len(loop.output_names)
    if log.desired_output is not None:
        if desired_output is not None:
            raise ValueError(f"{who} has a desired output of its own; got another one")
        return log.desired_output
    if desired_output is None:
        raise ValueError(
            f"{who} has no desired output, which the preview needs: map 'desired_output', or pass "
            "a constant one"
        )
    value = np.asarray(desired_output, dtype=float)
    if value.shape != (size,) or not np.isfinite(value).all():
        raise ValueError(f"{who}: desired_output must be {size} finite numbers; got {value}")
    return np.tile(value, (len(log.time_s), 1))


def _start(
    log: RobotLog, loop: LeggedLoop, desired: np.ndarray, begin_s: float, duration_s: float
) -> EpisodeStart:
    """The logged state at a time, with the later z* as a plan."""
    kinematics = loop.kinematics
    begin = np.array([begin_s])
    q, v = np.split(log.states_at(begin)[0], [kinematics.num_positions])
    feet = None
    if log.foot_positions is not None:
        feet = values_at(log.time_s, log.foot_positions, begin).reshape(-1, 3)
    scenario = loop.scenario
    # Previews and outlooks of the longest episode end before.
    reach_s = duration_s + scenario.episode_duration_s
    reach_s += scenario.assessment.horizon * scenario.preview_step_s
    later = log.time_s[(log.time_s > begin_s + _ROUNDING_S) & (log.time_s <= begin_s + reach_s)]
    hold = PiecewisePolynomial(np.zeros((desired.shape[1], 1)))
    start = EpisodeStart(q=q, v=v, plan=hold, foot_positions=feet)
    X_SW = planar_pose(start.stance_pose(kinematics)).inverse()
    knots = np.concatenate([begin, later])
    points = values_at(log.time_s, desired, knots).reshape(-1, 3)
    z = X_SW.multiply(points.T).T.reshape(len(knots), -1)
    # A shape-preserving interpolation does not overshoot at steps of z*.
    start.plan = (
        PiecewisePolynomial.CubicShapePreserving(knots - begin_s, z.T)
        if len(knots) > 2
        else PiecewisePolynomial.FirstOrderHold(knots - begin_s, z.T)
    )
    return start


def _episode(
    log: RobotLog, loop: LeggedLoop, context: Context, begin_s: float, rows: _Rows
) -> Episode:
    length_s = min(rows.duration_s, log.duration_s - begin_s)
    period_s = loop.scenario.watch_period_s
    ticks = period_s * np.arange(int(length_s / period_s + 1e-6) + 1)
    margins = _margins(log, loop, context, begin_s, ticks)
    is_out = (margins < 0).any(axis=1)
    times = rows.step_s * np.arange(int(length_s / rows.step_s + 1e-6) + 1)
    if is_out.any():
        end_s = ticks[int(np.argmax(is_out))]
        times = np.append(times[times < end_s - _ROUNDING_S], end_s)
    recorder = Recorder(loop)
    context.SetTime(0.0)
    for time_s, state in zip(times, log.states_at(begin_s + times), strict=True):
        # What the robot was commanded is not logged: the loop's own controller says it.
        loop.advance_control(context, float(time_s))
        _set_state(loop, context, time_s, state)
        recorder.record(context)
    arrays: dict[str, Any] = recorder.arrays()
    cause = ""
    if is_out.any():
        cause = loop.constraint_names[int(np.argmin(arrays["margins"][-1]))]
    return Episode(index=0, **arrays, is_safe=cause == "", cause=cause)


def _margins(
    log: RobotLog, loop: LeggedLoop, context: Context, begin_s: float, ticks: np.ndarray
) -> np.ndarray:
    """Margins at the monitor's ticks up to the first violation, (n, n_c) [m or rad]."""
    port = loop.GetOutputPort("margins")
    rows = []
    for time_s, state in zip(ticks, log.states_at(begin_s + ticks), strict=True):
        _set_state(loop, context, time_s, state)
        rows.append(port.Eval(context).copy())
        if (rows[-1] < 0).any():
            break
    return np.array(rows)


def _set_state(loop: LeggedLoop, context: Context, time_s: float, state: np.ndarray) -> None:
    context.SetTime(float(time_s))
    plant_context = loop.plant.GetMyMutableContextFromRoot(context)
    loop.plant.SetPositionsAndVelocities(plant_context, loop.robot_instance, state)
