"""Throws: balls thrown at a balancing robot, and logs of them."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

# Protocols of Python 3.11 evaluate properties when `isinstance` asks a loop for a protocol.
from typing_extensions import Protocol, runtime_checkable

from drake_safety.control.kinematics import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from drake_safety.plants.balls import Throw
from drake_safety.simulation.capabilities import require
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.motion import End, Motion, simulate
from drake_safety.simulation.rollouts import episode_rng, worker_loop
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import Progress, map_items

VIOLATIONS = ("legs_collide", "joint_position", "joint_velocity", "joint_effort")
_FLIGHT_S = 0.1  # From the ball's release to its impact.
_EARLIEST_S, _LATEST_S = 0.4, 1.2  # Impact of a random ball.
_AFTER_S = 5.0  # From the first impact to the end.
_PORTS = ("state", "desired_preview", "features", "margins", "plant_state")


@runtime_checkable
class HasBall(Protocol):
    """A ball can be thrown at the robot, and recovery can be triggered."""

    def reset_calm(self, context: Context, rng: np.random.Generator) -> None:
        """Samples an undisturbed motion, during which a ball is thrown."""

    def throw_ball(self, context: Context, throw: Throw, lead_s: float) -> None:
        """Sets a ball in flight that hits a robot at rest after ``lead_s`` [s]."""


class Violations:
    """Tells which of `VIOLATIONS` make a state implausible, which invalidates a success.

    Bodies of the robot penetrate each other, or a joint is more than 0.02 rad beyond a stop, or
    above its limit of velocity or of actuation.
    """

    _POSITION_SLACK_RAD = 0.02
    _PENETRATION_M = 5e-3

    def __init__(self, loop: LeggedLoop):
        engine = loop.scenario.variation(loop.variation).engine
        if engine != "drake":
            raise ValueError(f"throws need a variation of Drake's engine; got '{engine}'")
        self._plant, self._instance = plant, instance = loop.plant, loop.robot_instance
        self._kinematics = loop.kinematics
        self._bodies = set(plant.GetBodyIndices(instance))
        actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(instance)]
        limits: Counter[str] = Counter()
        for actuator in actuators:
            limits[actuator.joint().name()] += actuator.effort_limit()
        # The plant reports the net actuation of the joint for each of its actuators.
        self._effort_limits = np.array([limits[each.joint().name()] for each in actuators])

    def __call__(self, context: Context) -> list[bool]:
        """Tells whether the state of a root Context has each violation."""
        plant, instance = self._plant, self._instance
        plant_context = plant.GetMyContextFromRoot(context)
        contacts = plant.get_contact_results_output_port().Eval(plant_context)
        infos = map(contacts.point_pair_contact_info, range(contacts.num_point_pair_contacts()))
        legs_collide = any(
            {info.bodyA_index(), info.bodyB_index()} <= self._bodies
            and info.point_pair().depth > self._PENETRATION_M
            for info in infos
        )
        q = plant.GetPositions(plant_context, instance)[NUM_BASE_POSITIONS:]
        v = plant.GetVelocities(plant_context, instance)[NUM_BASE_VELOCITIES:]
        effort = plant.get_net_actuation_output_port(instance).Eval(plant_context)
        lowest, highest = self._kinematics.position_limits.T
        beyond = np.maximum(lowest - q, q - highest).max()
        return [
            legs_collide,
            bool(beyond > self._POSITION_SLACK_RAD),
            bool(np.any(np.abs(v) > self._kinematics.velocity_limits)),
            bool(np.any(np.abs(effort) > self._effort_limits + 1e-6)),
        ]


def run_throw(
    loop: ClosedLoop,
    index: int,
    *,
    seed: int,
    trigger_time_s: float = math.nan,
    throws: list[Throw] | None = None,
    duration_s: float | None = None,
    after_fall_s: float = 0.0,
    ports: Iterable[str] = (),
    **options: Any,
) -> Motion:
    """Throws a random ball, or given balls, at a robot in undisturbed motion, until it falls.

    It logs the assessor's inputs, ``margins``, ``plant_state``, ``recovery_active`` if there is
    one, ``violations`` (N, 4) and further ports; it ends at ``duration_s``, by default 5 s after
    the first impact. If the loop has an input port ``safety_probability`` (recovery without an
    assessment), recovery is triggered at ``trigger_time_s``; otherwise by Γ. ``options`` are as for
    :func:`~drake_safety.simulation.motion.simulate`.
    """
    thrown = require(loop, HasBall)
    if throws is None:
        rng = episode_rng(seed, index)
        thrown.reset_calm(loop.CreateDefaultContext(), rng)  # The ball is drawn after the start.
        push = loop.scenario.parameters.push
        throws = [push.sample(rng, rng.uniform(_EARLIEST_S, _LATEST_S))]
    impact_s = min((throw.time_s for throw in throws), default=math.inf)
    if duration_s is None:
        duration_s = _AFTER_S + (impact_s if throws else _LATEST_S)
    violations, rows = Violations(loop), []

    def set_probability(context: Context, value: float) -> None:
        if loop.HasInputPort("safety_probability"):
            loop.GetInputPort("safety_probability").FixValue(context, [value])

    def start(context: Context) -> None:
        thrown.reset_calm(context, episode_rng(seed, index))
        set_probability(context, 1.0)

    events: list[tuple[float, Callable[[Context], object]]] = []
    for throw in throws:
        release_s = max(throw.time_s - _FLIGHT_S, 0.0)
        lead_s = throw.time_s - release_s
        events.append((release_s, partial(thrown.throw_ball, throw=throw, lead_s=lead_s)))
    if not math.isnan(trigger_time_s):
        # One low value suffices: the trigger latches.
        low_s = 2.0 * loop.scenario.control_period_s
        events.append((trigger_time_s, partial(set_probability, value=0.0)))
        events.append((trigger_time_s + low_s, partial(set_probability, value=1.0)))
    motion = simulate(
        loop,
        start,
        (*_PORTS, *ports, *filter(loop.HasOutputPort, ["recovery_active"])),
        End(duration_s=duration_s, after_fall_s=after_fall_s),
        events=events,
        each_row=lambda context: rows.append(violations(context)),
        index=index,
        who=f"throw {index} of '{loop.scenario.name}' (seed {seed})",
        **options,
    )
    motion.ports["violations"] = np.array(rows)
    motion.push_time_s = impact_s
    return motion


def run_throws(
    scenario: Scenario,
    indices: Sequence[int],
    *,
    seed: int,
    trigger_times_s: Sequence[float] | None = None,
    num_workers: int | None = None,
    progress: Progress | bool | None = None,
) -> list[Motion]:
    """Throws a set of balls at the actual plant; without times of triggers [s] none recovers."""
    times = [math.nan] * len(indices) if trigger_times_s is None else trigger_times_s
    make = worker_loop(scenario, "actual", ball=True, recovery=trigger_times_s is not None)

    def throw(item: tuple[int, tuple[int, float]]) -> tuple[int, Motion]:
        place, (index, trigger_time_s) = item
        return place, run_throw(make(), index, seed=seed, trigger_time_s=trigger_time_s)

    logs = map_items(
        throw,
        enumerate(zip(indices, times, strict=True)),
        num_workers=num_workers,
        progress=progress,
        stage="throws",
    )
    return [log for _, log in sorted(logs, key=itemgetter(0))]


def trigger_time(log: Motion, probability: np.ndarray, threshold: float) -> float:
    """Time at which a probability (N,), or NaN, is first below a threshold [s]; NaN for never."""
    below = ~(probability >= threshold)
    return float(log.time_s[int(np.argmax(below))]) if below.any() else math.nan
