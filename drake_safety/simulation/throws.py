"""Throws: balls thrown at a balancing robot, and logs of them.

The motion before a recovery does not depend on the trigger. A throw is therefore logged once
without recovery, every Γ or baseline is evaluated on the log, and only the recovery is simulated
again, from the same seed, with the trigger at the time found.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from drake_safety.control.kinematics import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from drake_safety.plants.balls import Throw
from drake_safety.simulation.capabilities import CanFall, HasBall, require
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.episode_recorder import Recorder, advance_to
from drake_safety.simulation.goal_motion import Mishap
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.rollouts import episode_rng, worker_loop
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import Progress, run_batches

_FLIGHT_S = 0.1  # From the ball's release to its impact.
_EARLIEST_S, _LATEST_S = 0.4, 1.2  # Impact of a random ball.
_AFTER_S = 2.5  # From the first impact to the end.
_PORTS = ("state", "desired_preview", "features", "margins", "plant_state")


@dataclass(kw_only=True, eq=False)
class ThrowLog(Mishap):
    """Log of one throw, with a row every ``log_period_s``.

    Attributes:
        throw: Mass, speed, direction; ``throw.time_s`` is the time of impact [s].
        time_s: [s], (N,).
        state: (N, n_s), the assessor's input.
        desired_preview: (N, H n_z).
        features: (N, n_f).
        margins: (N, n_c), of the true state.
        plant_state: (N, n_q + n_v) of the robot alone.
        trigger_time_s: Time at which recovery was triggered [s]; NaN if it was not.
        recovery_active: (N,), whether recovery was active.
        violations: Number of rows with each violation: see :class:`ViolationCounter`.
        extra: Other ports, (N, size) each.
    """

    index: int
    throw: Throw
    time_s: np.ndarray
    state: np.ndarray
    desired_preview: np.ndarray
    features: np.ndarray
    margins: np.ndarray
    plant_state: np.ndarray
    trigger_time_s: float
    recovery_active: np.ndarray
    violations: dict[str, int] = field(default_factory=dict)
    extra: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def recovery_intervals_s(self) -> list[tuple[float, float]]:
        """First and last time of each recovery [s]; one still active at the end ends there."""
        is_first = np.diff(self.recovery_active, prepend=0.0) > 0
        is_last = np.diff(self.recovery_active, append=0.0) < 0
        starts, ends = self.time_s[is_first].tolist(), self.time_s[is_last].tolist()
        return list(zip(starts, ends, strict=True))


class ViolationCounter:
    """Counts the rows of a log with physically implausible states, which invalidate a success.

    - ``legs_collide``: two bodies of the robot that are not neighbours penetrate each other;
    - ``joint_position``: a joint more than 0.02 rad beyond a stop;
    - ``joint_velocity``: a joint faster than its limit;
    - ``joint_effort``: the actuation of a joint above its limit.

    Args:
        loop: A closed loop with a ``plant``, a ``robot_instance`` and ``kinematics``.
    """

    _POSITION_SLACK_RAD = 0.02
    _PENETRATION_M = 5e-3

    def __init__(self, loop: LeggedLoop):
        if loop.variation.engine != "drake":
            raise ValueError(
                "throws: contacts and efforts are read from Drake's plant; variation "
                f"'{loop.variation_name}' is simulated by engine '{loop.variation.engine}'"
            )
        self._loop = loop
        plant = loop.plant
        self._bodies = set(plant.GetBodyIndices(loop.robot_instance))
        self._position_limits = loop.kinematics.position_limits
        self._velocity_limits = loop.kinematics.velocity_limits
        # The plant reports the net actuation of the joint for each of its actuators.
        actuators = [
            plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(loop.robot_instance)
        ]
        joint_limits: dict[str, float] = {}
        for actuator in actuators:
            name = actuator.joint().name()
            joint_limits[name] = joint_limits.get(name, 0.0) + actuator.effort_limit()
        self._effort_limits = np.array([joint_limits[a.joint().name()] for a in actuators])
        self.counts = dict.fromkeys(
            ("legs_collide", "joint_position", "joint_velocity", "joint_effort"), 0
        )

    def count(self, context: Context) -> None:
        """Counts the violations at one time."""
        plant, instance = self._loop.plant, self._loop.robot_instance
        plant_context = plant.GetMyContextFromRoot(context)
        contacts = plant.get_contact_results_output_port().Eval(plant_context)
        for i in range(contacts.num_point_pair_contacts()):
            info = contacts.point_pair_contact_info(i)
            if (
                info.bodyA_index() in self._bodies
                and info.bodyB_index() in self._bodies
                and info.point_pair().depth > self._PENETRATION_M
            ):
                self.counts["legs_collide"] += 1
                break
        q = plant.GetPositions(plant_context, instance)[NUM_BASE_POSITIONS:]
        v = plant.GetVelocities(plant_context, instance)[NUM_BASE_VELOCITIES:]
        lowest, highest = self._position_limits.T
        beyond = np.maximum(lowest - q, q - highest).max()
        self.counts["joint_position"] += bool(beyond > self._POSITION_SLACK_RAD)
        self.counts["joint_velocity"] += bool(np.any(np.abs(v) > self._velocity_limits))
        effort = plant.get_net_actuation_output_port(instance).Eval(plant_context)
        self.counts["joint_effort"] += bool(np.any(np.abs(effort) > self._effort_limits + 1e-6))


def play_throws(
    loop: ClosedLoop,
    simulator: Simulator,
    throws: Iterable[Throw],
    *,
    duration_s: float,
    log_period_s: float,
) -> Iterator[float]:
    """Advances a simulation while balls are thrown; yields the time of every row of a log [s]."""
    thrown = require(loop, HasBall)
    waiting = sorted(throws, key=lambda throw: throw.time_s)
    for row in range(round(duration_s / log_period_s) + 1):
        time = row * log_period_s
        while waiting and waiting[0].time_s - _FLIGHT_S <= time:
            throw = waiting.pop(0)
            release_s = max(throw.time_s - _FLIGHT_S, 0.0)
            advance_to(simulator, release_s)
            thrown.throw_ball(simulator.get_mutable_context(), throw, throw.time_s - release_s)
        advance_to(simulator, time)
        yield time


def run_throw(
    loop: ClosedLoop,
    index: int,
    *,
    seed: int,
    trigger_time_s: float = math.nan,
    throws: list[Throw] | None = None,
    duration_s: float | None = None,
    log_period_s: float = 0.02,
    ports: tuple[str, ...] = (),
    realtime_rate: float = 0.0,
) -> ThrowLog:
    """Throws one random ball, or given ones, at a robot in undisturbed motion.

    Args:
        loop: A closed loop with a ball. If it has an input port ``safety_probability`` (recovery
            without an assessment), recovery is triggered at ``trigger_time_s``; otherwise by Γ.
        index: Number of the throw; it and the seed determine start, plan and ball.
        duration_s: End time [s]; by default 2.5 s after the first impact.
    """
    rng = episode_rng(seed, index)
    simulator = Simulator(loop)
    simulator.set_target_realtime_rate(realtime_rate)
    context = simulator.get_mutable_context()
    thrown = require(loop, HasBall)
    thrown.reset_calm(context, rng)
    sampled = thrown.sample_throw(rng, rng.uniform(_EARLIEST_S, _LATEST_S))
    throws = [sampled] if throws is None else throws
    first = throws[0] if throws else sampled
    if duration_s is None:
        duration_s = first.time_s + _AFTER_S
    probability = None
    if loop.HasInputPort("safety_probability"):
        probability = loop.GetInputPort("safety_probability")
        probability.FixValue(context, [1.0])
    has_recovery = loop.HasOutputPort("recovery_active")
    simulator.Initialize()
    recorder = Recorder(loop, (*_PORTS, *ports, *(("recovery_active",) if has_recovery else ())))
    violations = ViolationCounter(loop)
    margins_port = loop.GetOutputPort("margins")
    fall_column = loop.constraint_names.index(require(loop, CanFall).fall_name)
    fall_s = leave_s = math.inf
    triggered_s = math.nan
    for time in play_throws(
        loop, simulator, throws, duration_s=duration_s, log_period_s=log_period_s
    ):
        recorder.record(context, time)
        violations.count(context)
        margins = margins_port.Eval(context)
        if margins.min() < 0:
            leave_s = min(leave_s, time)
        if margins[fall_column] < 0:
            fall_s = time
            break
        if probability is not None and time >= trigger_time_s - 1e-9:
            # One low value suffices: the trigger latches.
            probability.FixValue(context, [0.0 if math.isnan(triggered_s) else 1.0])
            triggered_s = time if math.isnan(triggered_s) else triggered_s
    arrays = recorder.arrays()
    active = arrays.pop("recovery_active", np.zeros((len(arrays["time_s"]), 1)))[:, 0]
    if has_recovery and probability is None and active.any():
        triggered_s = float(arrays["time_s"][int(np.argmax(active > 0))])
    extra = {name: arrays.pop(name) for name in ports}
    return ThrowLog(
        index=index,
        throw=first,
        **arrays,
        trigger_time_s=triggered_s,
        fall_time_s=fall_s,
        leave_time_s=leave_s,
        recovery_active=active,
        violations=violations.counts,
        extra=extra,
    )


def run_throws(
    scenario: Scenario,
    indices: list[int],
    *,
    seed: int,
    variation: str = "actual",
    trigger_times_s: dict[int, float] | None = None,
    num_workers: int | None = None,
    progress: Progress | bool | None = None,
) -> list[ThrowLog]:
    """Throws a set of balls, in worker processes.

    Args:
        trigger_times_s: Time of the trigger by index [s]; by default there is no recovery.
    """
    options = {"ball": True, "recovery": trigger_times_s is not None}
    times = trigger_times_s or {}
    logs = run_batches(
        partial(_throw_batch, scenario, variation, options, seed),
        [(i, times.get(i, math.nan)) for i in indices],
        num_workers=num_workers,
        progress=progress,
        stage="throws",
    )
    by_index = {log.index: log for log in logs}
    return [by_index[index] for index in indices]


def _throw_batch(
    scenario: Scenario,
    variation: str,
    options: dict[str, Any],
    seed: int,
    items: list[tuple[int, float]],
) -> list[ThrowLog]:
    loop = worker_loop(scenario, variation, options)
    return [run_throw(loop, index, seed=seed, trigger_time_s=time) for index, time in items]


def trigger_time(log: ThrowLog, probability: np.ndarray, threshold: float) -> float:
    """Time at which a probability first falls below a threshold [s]; NaN if it never does.

    Args:
        probability: Safety probability of every row, (N,); NaN counts as below.
    """
    below = ~(probability >= threshold)
    return float(log.time_s[int(np.argmax(below))]) if below.any() else math.nan
