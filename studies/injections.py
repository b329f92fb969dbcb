"""Anomalies of RAPT (Munn et al., arXiv 2602.01515): faulty sensors and changed plants.

Kinds and ranges are those of the published code (github.com/humphreymunn/RAPT, BSD-3-Clause), in
shares of the robot's height, mass and friction, which are those of their G1. What differs:

- A fault of sensors is one of what monitors see of the measured state. Theirs is seen by the policy
  too, and also concerns its command and its last actions.
- Two joints that are swapped get each other's set points; theirs are actions of the network.
- State and velocity change from the present ones; theirs are set to those of standing.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw
from pydrake.systems.framework import Context

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.evaluation.shifts import PlantShift, shifted_scenario
from drake_safety.learning.segments import RECORDED, Episode, Episodes
from drake_safety.robots.robot import Payload, PlantVariation
from drake_safety.robots.shift import Fault, JointShift, Shift
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.rollouts import (
    collect_episodes,
    episode_rng,
    episodes_info,
    run_motion,
    worker_loop,
)
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import Progress
from studies.harness import fingerprint

EPISODE_S, ONSET_S = 20.0, 1.0
"""Duration of an episode, and when its anomaly begins [s]."""
SENSORS = {
    "drift": (1, 0.025, 0.25),
    "zeroed": (5, 0.0, 0.0),
    "halved": (10, 0.5, 0.5),
    "doubled": (10, 2.0, 2.0),
    "swapped_sensors": (4, 0.0, 0.0),
    "noise": (5, 0.05, 0.15),
    "delay": (5, 0.02, 0.1),
    "slow": (5, 0.04, 0.2),
    "frozen": (5, 0.0, 0.0),
}
"""Faults: most sensors, then lowest and highest value.

It is the rate, of either sign [1/s]; the factor; the bound of the uniform noise; the age [s]; the
time between two samples [s]. At least one sensor is faulty, or two are swapped."""
PLANTS: dict[str, dict[str, Any]] = {
    "swapped_commands": {"most_joints": 4},
    "actuators": {"most_joints": 5, "torque": (0.4, 0.8), "gain": ((0.1, 0.5), (1.1, 1.5))},
    "state": {"rate_rad_s": 0.5, "rise_by_height": (0.13, 0.63), "tilt_rad": 0.5},
    "push_or_payload": {"push_m_s": (0.05, 0.4), "payload_by_mass": 0.3},
    "friction": {"factors": (0.6, 1.4)},
}
"""Changed plants: lowest and highest factors of a joint's torque, stiffness or damping; largest
change of joint rates [rad/s], roll and pitch [rad], lowest and highest rise of the base; change of
its velocity [m/s], or added mass; factors of the friction. A motor may also be dead."""
_DEAD = 1e-6  # Share of its torque that a dead motor has.
_LEAST_ROWS = 10  # Since the onset: of a robot that leaves its safe set at once nothing is judged.


def faulty(
    rows: np.ndarray,
    kind: str,
    columns: Sequence[int],
    value: float,
    onset: int,
    step_s: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Rows (K, n) in which some columns have a fault of one of `SENSORS` from a row on.

    Args:
        columns: Swapped ones in pairs.
        value: See `SENSORS`.
        onset: The row.
        step_s: Time between two rows [s].
        rng: Draws the noise.
    """
    part, since = rows[:, columns], np.arange(len(rows) - onset)
    after, periods = part[onset:], max(round(value / step_s), 1)
    if kind == "drift":
        after = after + value * step_s * since[:, None]
    elif kind in ("zeroed", "halved", "doubled"):
        after = value * after
    elif kind == "swapped_sensors":
        after = after.reshape(len(after), -1, 2)[:, :, ::-1].reshape(after.shape)
    elif kind == "noise":
        after = after + rng.uniform(-value, value, after.shape)
    elif kind == "delay":
        after = part[onset + since - periods]
    elif kind == "slow":
        after = part[onset + since // periods * periods]
    else:
        after = np.repeat(part[onset : onset + 1], len(after), axis=0)
    found = rows.copy()
    found[onset:, columns] = after
    return found


def drawn_fault(kind: str, num_sensors: int, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Draws which of the sensors are faulty, and the value."""
    most, low, high = SENSORS[kind]
    if kind == "swapped_sensors":
        count = 2 * int(rng.integers(1, most // 2 + 1))
    else:
        count = int(rng.integers(1, most + 1))
    sign = rng.choice([-1.0, 1.0]) if kind == "drift" else 1.0
    return rng.permutation(num_sensors)[:count], float(sign * rng.uniform(low, high))


@dataclass(frozen=True, kw_only=True)
class Change:
    """What happens to a robot.

    Attributes:
        variation: The other plant; None for the same.
        start: Changes the state.
        joints: The changed joints, if the change is one of joints.
    """

    variation: PlantVariation | None = None
    start: Callable[[EpisodeStart], EpisodeStart] | None = None
    joints: frozenset[str] = frozenset()


def kind_of(index: int) -> str:
    """The kind of a changed plant, which is each of `PLANTS` in turn."""
    return [*PLANTS][index % len(PLANTS)]


def drawn_change(loop: Any, seed: int, index: int) -> Change:
    """Draws the change of an episode; alternatives of a kind are taken in turn."""
    kinematics, nominal = loop.kinematics, loop.scenario.variation(loop.variation)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index, 1)))
    kind, turn = kind_of(index), index // len(PLANTS)
    limits, joints = PLANTS[kind], rng.permutation(kinematics.joint_names).tolist()
    if kind == "swapped_commands":
        joints = joints[: 2 * rng.integers(1, limits["most_joints"] // 2 + 1)]
        faults = [
            Fault(kind="swap", entries=[f"{name}{suffix}" for name in joints[i : i + 2]])
            for i in range(0, len(joints), 2)
            for suffix in ("", "_rate")
        ]
        variation = replace(nominal, shift=Shift(command_faults=faults))
        return Change(variation=variation, joints=frozenset(joints))
    if kind == "actuators":
        joints = joints[: rng.integers(1, limits["most_joints"] + 1)]
        shifts = {name: _joint_shift(turn % 4, limits, rng) for name in joints}
        variation = replace(nominal, shift=Shift(joints=shifts))
        return Change(variation=variation, joints=frozenset(joints))
    if kind == "state":
        return Change(start=partial(_moved, kinematics=kinematics, which=turn % 3, rng=rng))
    if kind == "friction":
        friction = nominal.foot_friction or kinematics.robot.foot_friction
        factor = limits["factors"][turn % 2]
        return Change(variation=replace(nominal, foot_friction=factor * friction))
    if turn % 2:
        payload = Payload(mass_kg=limits["payload_by_mass"] * kinematics.total_mass)
        return Change(variation=replace(nominal, payload=payload))
    angle, speed = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(*limits["push_m_s"])
    return Change(start=partial(_pushed, velocity=speed * np.exp(1j * angle)))


def _joint_shift(which: int, limits: dict[str, Any], rng: np.random.Generator) -> JointShift:
    gain = rng.uniform(*limits["gain"][rng.integers(2)])
    return (
        JointShift(effort_scale=rng.uniform(*limits["torque"])),
        JointShift(stiffness_scale=gain, damping_scale=1.0 / gain),  # The damping stays.
        JointShift(damping_scale=gain),
        JointShift(effort_scale=_DEAD),
    )[which]


def _pushed(start: EpisodeStart, *, velocity: complex) -> EpisodeStart:
    v = start.v.copy()
    v[3:5] += velocity.real, velocity.imag
    return replace(start, v=v)


def _moved(
    start: EpisodeStart, *, kinematics: RobotKinematics, which: int, rng: np.random.Generator
) -> EpisodeStart:
    """Other joint rates, height, or roll and pitch with no foot in the ground."""
    limits, q, v = PLANTS["state"], start.q.copy(), start.v.copy()
    if which == 0:
        v[6:] += limits["rate_rad_s"] * rng.uniform(-1.0, 1.0, len(v) - 6)
    elif which == 1:
        q[6] += kinematics.standing_height * rng.uniform(*limits["rise_by_height"])
    else:
        angles = RollPitchYaw(Quaternion(q[:4] / np.linalg.norm(q[:4]))).vector()
        angles[:2] += limits["tilt_rad"] * rng.uniform(-1.0, 1.0, 2)
        q[:4] = RollPitchYaw(angles).ToQuaternion().wxyz()
        heights = kinematics.contact_positions(q)[:, 2] - kinematics.foot_radii
        q[6] += max(0.0, -float(heights.min()))
    return replace(start, q=q, v=v)


def run_changed(
    scenario: Scenario,
    num: int,
    *,
    seed: int,
    path: Path,
    num_workers: int | None = None,
    progress: Progress | None = None,
) -> Episodes:
    """Simulates episodes of `drawn_change`, and keeps them; only those with enough rows are given.

    Args:
        path: Folder for the episodes.
    """
    make = worker_loop(scenario)
    step_s = scenario.monitor_step_s
    info = replace(
        episodes_info(make(), seed, {"changes": fingerprint(PLANTS, EPISODE_S, ONSET_S)}),
        step_s=step_s,
        num_steps=round(EPISODE_S / step_s),
    )
    found = collect_episodes(
        info,
        range(num),
        make,
        partial(_drawn_episode, scenario=scenario, seed=seed),
        num_workers=num_workers,
        path=path,
        progress=progress,
    )
    least = round(ONSET_S / step_s) + _LEAST_ROWS
    return Episodes(info, [one for one in found if one.num_steps >= least])


def _drawn_episode(loop: Any, index: int, *, scenario: Scenario, seed: int) -> Episode:
    change, other = drawn_change(loop, seed, index), loop
    if change.variation is not None:
        shift = PlantShift(kind="plant", variation=change.variation)
        other = shifted_scenario(scenario, "changed", shift).make_loop("changed")
    return changed_episode(loop, other, change, seed, index)


def changed_episode(loop: Any, other: Any, change: Change, seed: int, index: int) -> Episode:
    """Simulates undisturbed motion of a loop, which goes on as another one from `ONSET_S` on.

    State, plan and the controller's memory are handed over.
    """
    rng, contexts = episode_rng(seed, index), []

    def begin(context: Context) -> None:
        loop.reset_undisturbed(context, rng, EPISODE_S)
        contexts.append(context)

    before = run_motion(loop, index, seed=seed, until_s=ONSET_S, start=begin)
    if not before.is_safe:
        return before
    start = loop.start_of(contexts[0])
    start = start if change.start is None else change.start(start)
    after = run_motion(
        other,
        index,
        seed=seed,
        until_s=EPISODE_S - ONSET_S,
        start=lambda context: other.reset_to(context, rng, start),
    )
    rows: dict[str, Any] = {
        name: np.concatenate([getattr(before, name)[:-1], getattr(after, name)])
        for name in RECORDED
    }
    time_s = np.concatenate([before.time_s[:-1], before.time_s[-1] + after.time_s])
    return dataclasses.replace(after, time_s=time_s, **rows)
