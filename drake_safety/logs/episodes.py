"""Conversion of logs to episodes, by evaluating a loop's ports at the logged states."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.systems.framework import Context
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.kinematics import planar_pose
from drake_safety.learning.causes import is_outside, violated
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


def loggable_loop(loop: LeggedLoop | Scenario) -> LeggedLoop:
    """The actual loop; one whose controller has a memory, which no log has, is refused."""
    if isinstance(loop, Scenario):
        loop = loop.make_loop("actual")
    if loop.memory_features:
        what = "its policy's memory, which no log has: 'monitor' takes .npz files of observations"
        memory = sorted(loop.memory_features)
        raise ValueError(f"scenario '{loop.scenario.name}' reads {memory}, {what}")
    return loop


def cut_log(
    log: RobotLog | Sequence[RobotLog], loop: LeggedLoop | Scenario
) -> tuple[Episodes, list[EpisodeStart]]:
    """Converts logs to consecutive episodes of the actual robot, with the starts of their twins.

    Episodes have the scenario's duration; none reaches over a cut of a log. The last one ends where
    the robot leaves the safe set. A safe remainder that is too short for a segment is dropped. The
    preview is the logged z*, constant after the last row, in the stance frame of the first row.

    Args:
        loop: The loop without Γ that evaluates the states, or a scenario with an ``actual`` one.
    """
    loop = loggable_loop(loop)
    scenario, assessment = loop.scenario, loop.scenario.assessment
    shortest = assessment.preview_stride * mode_settings(assessment).shortest
    cutter = _Cutter(loop, scenario.step_s, scenario.episode_duration_s, shortest)
    kept: list[tuple[Episode, EpisodeStart]] = []
    for parts in cutter.parts(log):
        pairs = [pair for _, several in parts for pair in several]
        if not pairs:
            longest = max((piece for piece, _ in parts), key=lambda piece: piece.duration_s)
            what = f"too short for a segment of {shortest} steps of {scenario.step_s} s"
            raise ValueError(f"log '{longest.path}' lasts {longest.duration_s:g} s: {what}")
        kept += pairs
    episodes = [replace(episode, index=i) for i, (episode, _) in enumerate(kept)]
    return Episodes(episodes_info(loop, seed=NOT_DRAWN), episodes), [start for _, start in kept]


def motions_from_log(
    log: RobotLog | Sequence[RobotLog], loop: LeggedLoop | Scenario, *, step_s: float | None = None
) -> Episodes:
    """Converts logs to motions for a `ChangeDetector`, at the step of the monitor by default."""
    loop = loggable_loop(loop)
    step_s = step_s or loop.scenario.monitor_step_s
    cutter = _Cutter(loop, step_s, MOTION_PIECE_S, shortest=2)
    motions: list[Episode] = []
    for piece, pairs in itertools.chain.from_iterable(cutter.parts(log)):
        begin_s = piece.begin_s
        for motion, _ in pairs:
            time_s = begin_s + motion.time_s
            motions.append(replace(motion, index=len(motions), time_s=time_s))
            begin_s = float(time_s[-1])
    return Episodes(replace(episodes_info(loop, seed=NOT_DRAWN), step_s=step_s), motions)


@dataclass(frozen=True)
class _Cutter:
    """Evaluates a loop's ports at the states of logs, in rows of the given distance."""

    loop: LeggedLoop
    step_s: float
    duration_s: float  # Longest of an episode.
    shortest: int  # Least number of steps of a safe episode.

    def parts(
        self, log: RobotLog | Sequence[RobotLog]
    ) -> Iterator[list[tuple[RobotLog, list[tuple[Episode, EpisodeStart]]]]]:
        """The pieces of each log, to where the robot leaves the safe set, and their episodes."""
        logs = [log] if isinstance(log, RobotLog) else log
        begins = [i for i, piece in enumerate(logs) if i == 0 or piece.piece == 0]
        for begin, end in itertools.pairwise([*begins, len(logs)]):
            parts = []
            for piece in logs[begin:end]:
                pairs, has_left = self._cut(piece)
                parts.append((piece, pairs))
                if has_left:
                    break
            yield parts

    def _cut(self, log: RobotLog) -> tuple[list[tuple[Episode, EpisodeStart]], bool]:
        """Episodes and starts of a piece, and whether it leaves the safe set."""
        if log.robot != self.loop.robot.name:
            other = f"scenario '{self.loop.scenario.name}' of '{self.loop.robot.name}'"
            raise ValueError(f"log '{log.path}' is of robot '{log.robot}', {other}")
        if log.desired_output is None:
            raise ValueError(f"log '{log.path}' has no desired output: the preview needs it")
        context = self.loop.CreateDefaultContext()
        kept: list[tuple[Episode, EpisodeStart]] = []
        begin_s = 0.0
        while log.duration_s - begin_s > self.step_s:
            start = self._start(log, log.desired_output, begin_s)
            self.loop.reset_to(context, None, start)
            episode = self._episode(log, context, begin_s)
            if not episode.is_safe and episode.num_steps == 0 and not kept:
                if log.piece:
                    return [], True
                where = f"the safe set of scenario '{self.loop.scenario.name}'"
                what = f"the margin '{episode.cause}' is {episode.margins[0].min():.3g}"
                raise ValueError(f"log '{log.path}' begins outside {where}: {what}")
            if not episode.is_safe or episode.num_steps >= self.shortest:
                kept.append((episode, start))
            if not episode.is_safe:
                return kept, True
            begin_s += float(episode.time_s[-1])
        return kept, False

    def _start(self, log: RobotLog, desired: np.ndarray, begin_s: float) -> EpisodeStart:
        """The logged state at a time, with the later z* (N, n_z) [m] as a plan."""
        kinematics, scenario = self.loop.kinematics, self.loop.scenario
        begin = np.array([begin_s])
        q, v = np.split(log.states_at(begin)[0], [kinematics.num_positions])
        feet = None
        if log.foot_positions is not None:
            feet = values_at(log.time_s, log.foot_positions, begin).reshape(-1, 3)
        hold = PiecewisePolynomial(np.zeros((desired.shape[1], 1)))
        start = EpisodeStart(q=q, v=v, plan=hold, foot_positions=feet)
        # Previews and outlooks of the longest episode end before.
        end_s = begin_s + self.duration_s + scenario.episode_duration_s
        end_s += scenario.assessment.horizon * scenario.preview_step_s
        is_later = (log.time_s > begin_s + _ROUNDING_S) & (log.time_s <= end_s)
        knots = np.append(begin, log.time_s[is_later])
        points = values_at(log.time_s, desired, knots).reshape(-1, 3)
        X_SW = planar_pose(start.stance_pose(kinematics)).inverse()
        z = X_SW.multiply(points.T).T.reshape(len(knots), -1)
        make = PiecewisePolynomial.FirstOrderHold
        if len(knots) > 2:  # A shape-preserving interpolation does not overshoot at steps of z*.
            make = PiecewisePolynomial.CubicShapePreserving
        start.plan = make(knots - begin_s, z.T)
        return start

    def _episode(self, log: RobotLog, context: Context, begin_s: float) -> Episode:
        loop, margins = self.loop, self.loop.GetOutputPort("margins")
        length_s = min(self.duration_s, log.duration_s - begin_s)
        times, ticks = (
            period_s * np.arange(int(length_s / period_s + 1e-6) + 1)
            for period_s in (self.step_s, loop.scenario.watch_period_s)
        )
        is_safe = True
        for tick_s, state in zip(ticks, log.states_at(begin_s + ticks), strict=True):
            self._set_state(context, tick_s, state)
            if is_outside(margins.Eval(context)):
                is_safe, times = False, np.append(times[times < tick_s - _ROUNDING_S], tick_s)
                break
        recorder = Recorder(loop)
        context.SetTime(0.0)
        for time_s, state in zip(times, log.states_at(begin_s + times), strict=True):
            # The log lacks the robot's commands: the loop's own controller replaces them.
            loop.advance_control(context, float(time_s))
            self._set_state(context, time_s, state)
            recorder.record(context)
        arrays: dict[str, Any] = recorder.arrays()
        cause = "" if is_safe else loop.constraint_names[violated(arrays["margins"][-1])]
        return Episode(index=0, **arrays, is_safe=is_safe, cause=cause)

    def _set_state(self, context: Context, time_s: float, state: np.ndarray) -> None:
        context.SetTime(float(time_s))
        plant_context = self.loop.plant.GetMyMutableContextFromRoot(context)
        self.loop.plant.SetPositionsAndVelocities(plant_context, self.loop.robot_instance, state)
