"""Check of a hand-over: a policy takes over a robot, walks at a command, and stops."""

import math
from bisect import bisect
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.tree import PdControllerGains
from pydrake.systems.framework import Context

from drake_safety.control.inverse_kinematics import solve_inverse_kinematics
from drake_safety.control.kinematics import NUM_BASE_VELOCITIES, RobotKinematics
from drake_safety.files.progress import StageProgress, ignore
from drake_safety.robots.robot import PlantVariation
from drake_safety.robots.shift import Shift
from drake_safety.simulation.contract import Finding, failed, passed
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.motion import End, Motion, simulate
from drake_safety.systems.policy_controller import HELD

ITEM = "takes over and walks"
POLICY_REMEDY = (
    "compare policy.yaml with the policy's training: order of 'joints' and of the terms of "
    "'observation', their 'scale' and 'history', 'default_positions', 'action_scale', "
    "'action_clip', 'gains', 'period_s', and a normalizer of observations"
)
_MOTORS_REMEDY = (
    "the robot's motors may not follow: train the policy with the robot's limits of torque and "
    "speed and a penalty near them, and compare 'action_scale', 'action_clip' and 'gains' in "
    "policy.yaml with training"
)
_RANGES_REMEDY = "state the largest commands of training, 'command: {highest: ...}' in policy.yaml"
_START_REMEDY = "move the joints to the policy's first targets before it takes over, or blend"
_RANDOM_REMEDY = "train the policy with random latency, friction and mass beyond the robot's"
_COMMAND_REMEDY = "send the policy no smaller commands but zero, or train it with small commands"
_CHANGE_M = 0.02  # Height of the crouch and of the drop of the base.
_STAND_S, _WALK_S, _STOP_S = 1.0, 3.0, 2.0
_SETTLED_S = 1.0  # From a command to its steady motion.
_NEAR = 0.95  # Share of a limit that is near it.
_LIFTED_M, _TOUCHING_M = 0.01, 0.005  # Heights of a foot between which a step ends.
_STOPPED_M_S = 0.1
_AXES = (("forward", "m/s"), ("left", "m/s"), ("yaw", "rad/s"))
_LEVELS = (0.05, 0.1, 0.2, 0.4)  # Commands, by the largest of their axis.
_LEVEL_S = 1.5  # Time for which each is held.
_FEW = 0.2  # Smallest command outside a dead zone, by the largest.
_MARGIN_S = 3.0  # Walking on a changed plant.
_CHANGES: dict[str, tuple[float, ...]] = {
    "latency": (0.005, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12),  # [s]
    "friction": (0.8, 0.6, 0.45, 0.3, 0.2, 0.1, 0.05),  # Factor, as of masses.
    "more mass": (1.1, 1.2, 1.35, 1.5, 1.75, 2.0, 2.5),
    "less mass": (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3),
}
_ENOUGH = 2  # Rungs of a ladder that should not fell a robot.


class MotorLoads:
    """Largest loads of the motors by their limits, read after each step of a simulation.

    Torque is what a servo asks for, which may exceed the motor's. Power is electrical, of a DC
    motor whose torque at rest is τ₀ and whose speed without load is ω₀: τ ω + τ² ω₀ / τ₀, by that
    at rest, τ₀ ω₀.
    """

    def __init__(self, loop: Any):
        kinematics: RobotKinematics = loop.kinematics
        plant = kinematics.plant
        actuators = map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
        motors = {one.joint().name(): one for one in actuators}
        ordered = [motors[name] for name in kinematics.joint_names]
        loose = PdControllerGains()  # Zero: of a joint without a servo.
        gains = [one.get_controller_gains() if one.has_controller() else loose for one in ordered]
        self.names = kinematics.joint_names
        effort = np.array([one.effort_limit() for one in ordered])
        # By the limit of torque [1/rad, s/rad].
        self.stiffness, self._damping = np.array([(one.p, one.d) for one in gains]).T / effort
        self._speed = kinematics.velocity_limits
        self._state = loop.GetOutputPort("plant_state")
        self._controller = loop.GetSubsystemByName("policy_controller")
        self._num_q = kinematics.num_positions
        self._before_s = 0.0
        self.peaks = np.zeros((3, len(self.names)))  # Torque, speed and power.
        self.hit_s = self.total_s = 0.0

    def targets(self, context: Context) -> np.ndarray:
        """The joint positions that the policy wants, (n_j,) [rad]."""
        port = self._controller.GetOutputPort("desired_joint_state")
        wanted: np.ndarray = port.Eval(self._controller.GetMyContextFromRoot(context))
        return wanted[: len(self.names)]

    def read(self, context: Context) -> None:
        """Reads the loads of a root Context."""
        q, v = np.split(self._state.Eval(context), [self._num_q])
        q, v = q[-len(self.names) :], v[NUM_BASE_VELOCITIES:]
        asked = self.stiffness * (self.targets(context) - q) - self._damping * v
        torque, speed = np.clip(asked, -1.0, 1.0), v / self._speed
        loads = np.array([np.abs(asked), np.abs(speed), torque * (torque + speed)])
        np.maximum(self.peaks, loads, out=self.peaks)
        now_s = context.get_time()
        step_s = now_s - min(self._before_s, now_s)  # Another motion begins at time zero.
        self._before_s = now_s
        self.total_s += step_s
        self.hit_s += step_s * bool((loads[:2] >= 1.0).any())

    def finding(self) -> Finding:
        """The peaks, a warning if one is near a limit."""
        texts = [
            f"{what} {100 * load.max():.0f} % ({self.names[int(load.argmax())]})"
            for what, load in zip(("torque", "speed", "power"), self.peaks, strict=True)
        ]
        hit = f"a limit is hit for {self.hit_s:.2f} of {self.total_s:.1f} s"
        is_near = bool(self.peaks.max() >= _NEAR)
        message = f"peaks of a joint by its limit: {', '.join(texts)}; {hit}"
        return passed(f"{ITEM}, motors", message, _MOTORS_REMEDY * is_near)


def check_hand_over(
    loop: Any, *, has_margins: bool = True, progress: StageProgress = ignore
) -> Generator[Finding, None, str]:
    """Checks that a policy takes over, walks and stops, and how far that is from failing.

    The policy takes over from standing, from a crouch and from a drop of 2 cm. It stands for a
    second, walks at half the largest command forward, and stops. With ``has_margins`` the smallest
    command that moves the robot follows, and limits of latency, friction and mass.

    Returns:
        The first correction, "" if the policy walks.
    """
    highest = np.array(loop.policy.parameters.command.highest)
    if not (highest > 0.0).any():
        message = f"no command is above zero: 'command' has highest {highest.tolist()}"
        yield failed(ITEM, message, _RANGES_REMEDY)
        return _RANGES_REMEDY
    axis = int(np.argmax(highest > 0.0))
    command = 0.5 * highest * np.eye(3)[axis]
    starts, loads = _starts(loop), MotorLoads(loop)
    for k, (name, start) in enumerate(starts.items()):
        progress(ITEM, k, len(starts))
        finding = _taken_over(loop, name, start, command, axis, loads)
        yield finding
        if not finding.is_ok:
            return f"correct '{finding.item}' first: the policy does not walk"
    progress(ITEM, len(starts), len(starts))
    yield loads.finding()
    if has_margins:
        yield _smallest_commands(loop, highest, partial(progress, f"{ITEM}, commands"))
        yield _margins(loop, command, partial(progress, f"{ITEM}, margins"))
    return ""


def _starts(loop: Any) -> dict[str, EpisodeStart]:
    start, kinematics = loop.standing_start(), loop.kinematics
    dropped = start.q.copy()
    dropped[6] += _CHANGE_M
    low = RigidTransform([*start.q[4:6], start.q[6] - _CHANGE_M])
    feet = kinematics.contact_positions(start.q).copy()
    bent = solve_inverse_kinematics(kinematics, low, feet, kinematics.posture)
    crouched = kinematics.positions_at(low, bent)
    return {
        "from standing": start,
        "from a crouch": replace(start, q=crouched),
        "in a drop of 2 cm": replace(start, q=dropped),
    }


def _moved(
    loop: Any,
    start: EpisodeStart,
    commands: Sequence[tuple[float, np.ndarray]],
    duration_s: float,
    **options: Any,
) -> Motion:
    """The motion from a start by commands from their times on, zero before."""
    return simulate(
        loop,
        lambda context: loop.reset_to(context, None, start),
        ("output", "margins", "plant_state", "controller_status"),
        End(duration_s=duration_s),
        step_s=loop.scenario.control_period_s,
        events=[(time_s, partial(loop.set_command, command=one)) for time_s, one in commands],
        may_fail=True,
        who=ITEM,
        **options,
    )


def _mean(motion: Motion, begin_s: float, end_s: float) -> np.ndarray:
    """Mean output (3,) between two times, NaN if the motion has ended before."""
    rows = (motion.time_s >= begin_s) & (motion.time_s <= end_s)
    is_over = motion.time_s[-1] < end_s - 1e-6
    return np.full(3, math.nan) if is_over else motion["output"][rows].mean(axis=0)


def _taken_over(
    loop: Any, name: str, start: EpisodeStart, command: np.ndarray, axis: int, loads: MotorLoads
) -> Finding:
    stop_s = _STAND_S + _WALK_S
    commands = [(_STAND_S, command), (stop_s, np.zeros(3))]
    jump, period_s = np.zeros(len(loads.names)), loop.policy.parameters.period_s

    def watch(context: Context) -> None:
        if context.get_time() <= period_s:  # Before the second action; at time zero before any.
            jump[:] = np.abs(loads.targets(context) - start.q[-len(jump) :])
        loads.read(context)

    motion = _moved(loop, start, commands, stop_s + _STOP_S, monitor=watch)
    item, (where, unit) = f"{ITEM}, {name}", _AXES[axis]
    message = f"the joint targets jump by {jump.max():.2f} rad ({loads.names[jump.argmax()]}); "
    if motion.failure:
        return failed(item, f"{message}the simulation fails: {motion.failure}", POLICY_REMEDY)
    if (motion["controller_status"] == HELD).any():
        what = "the network returns actions that are not finite, and the last one is held"
        return failed(item, message + what, POLICY_REMEDY)
    if motion.has_left:
        what = f"it leaves the safe set at {motion.leave_time_s:.2f} s: {motion.cause}"
        what += f", and falls at {motion.fall_time_s:.2f} s" * motion.has_fallen
        return failed(item, message + what, POLICY_REMEDY)
    mean = _mean(motion, _STAND_S + _SETTLED_S, stop_s)
    asked, moves = command[axis], mean[axis]
    message += f"asked for {asked:.2f} {unit} {where}, it moves at {moves:.2f}"
    if moves < 0.1 * asked:
        return failed(item, f"{message}: it holds its posture", POLICY_REMEDY)
    message += f" with {_steps_a_second(loop, motion):.1f} steps a second"
    end_s = stop_s + _STOP_S
    speed = float(np.linalg.norm(_mean(motion, end_s - _SETTLED_S, end_s)[:2]))
    message += f"; {_STOP_S - _SETTLED_S:g} s after a command of zero it moves at {speed:.2f} m/s"
    remedies = [
        f"if it should be faster, {POLICY_REMEDY}"
        * bool(np.linalg.norm(mean - command) > 0.5 * asked + 0.1),
        "train the policy to stand at a command of zero" * (speed > _STOPPED_M_S),
        _START_REMEDY * bool((jump * loads.stiffness).max() >= _NEAR),
    ]
    return passed(item, message, "; ".join(filter(None, remedies)))


def _steps_a_second(loop: Any, motion: Motion) -> float:
    kinematics = loop.kinematics
    rows = (motion.time_s >= _STAND_S + _SETTLED_S) & (motion.time_s <= _STAND_S + _WALK_S)
    num_steps, lifted = 0, np.zeros(len(kinematics.foot_slices), dtype=bool)
    for q in motion["plant_state"][rows, : kinematics.num_positions]:
        heights = kinematics.contact_positions(q)[:, 2] - kinematics.foot_radii
        lowest = np.array([heights[points].min() for points in kinematics.foot_slices])
        num_steps += int((lifted & (lowest < _TOUCHING_M)).sum())
        lifted = (lifted | (lowest > _LIFTED_M)) & (lowest >= _TOUCHING_M)
    return num_steps / (_WALK_S - _SETTLED_S)


def _smallest_commands(
    loop: Any, highest: np.ndarray, progress: Callable[[int, int], Any]
) -> Finding:
    """The smallest command of each axis that moves the robot by half of it or more."""
    texts, is_dead = [], False
    for axis, (where, unit) in enumerate(_AXES):
        progress(axis, len(_AXES))
        levels = highest[axis] * np.array(_LEVELS)
        if not highest[axis] > 0.0:
            continue
        times_s = _STAND_S + _LEVEL_S * np.arange(len(levels) + 1)
        commands = [(t, one * np.eye(3)[axis]) for t, one in zip(times_s, levels, strict=False)]
        motion = _moved(loop, loop.standing_start(), commands, times_s[-1])
        drift = _mean(motion, 0.5 * _STAND_S, _STAND_S)[axis]
        ends = zip(times_s[1:].tolist(), levels.tolist(), strict=True)
        means = [(_mean(motion, t - 0.5 * _LEVEL_S, t)[axis] - drift, one) for t, one in ends]
        moving = [one for mean, one in means if mean >= 0.5 * one]
        is_dead |= not moving or moving[0] > _FEW * float(highest[axis])
        least = f"{moving[0]:.3g}" if moving else f"none up to {levels[-1]:.3g}"
        texts.append(f"{where} {least} {unit}")
    progress(len(_AXES), len(_AXES))
    message = f"of {', '.join(f'{100 * one:g}' for one in _LEVELS)} % of the largest: "
    item = f"{ITEM}, smallest commands that move it"
    return passed(item, message + ", ".join(texts), _COMMAND_REMEDY * is_dead)


def _margins(loop: Any, command: np.ndarray, progress: Callable[[int, int], Any]) -> Finding:
    """The first rung of each ladder on which the robot falls, by bisection."""
    num_tried, texts, is_small = 0, [], False

    def falls(kind: str, plant: PlantVariation) -> bool:
        nonlocal num_tried
        progress(num_tried, 3 * len(_CHANGES))
        num_tried += 1
        other = loop.scenario.with_variation(kind, plant).make_loop(kind)
        motion = _moved(other, other.standing_start(), [(0.5, command)], 0.5 + _MARGIN_S)
        return motion.has_fallen or bool(motion.failure)

    for kind, values in _CHANGES.items():
        rungs = [_changed(loop, kind, x) for x in values]
        stands = bisect(rungs, False, key=lambda rung: falls(kind, rung[1]))
        parts = [f"falls at {text}" for text, _ in rungs[stands : stands + 1]]
        parts += [f"no fall at {text}" for text, _ in rungs[:stands][-1:]]
        texts.append(f"{kind}: {', '.join(parts)}")
        is_small |= stands < _ENOUGH
    progress(num_tried, num_tried)
    return passed(f"{ITEM}, margins", "; ".join(texts), _RANDOM_REMEDY * is_small)


def _changed(loop: Any, kind: str, x: float) -> tuple[str, PlantVariation]:
    """A plant that differs from the nominal one by a rung of a ladder, with words."""
    nominal: PlantVariation = loop.scenario.variation("nominal")
    if kind == "latency":
        shift = nominal.shift or Shift()
        late = replace(shift, command_delay_s=shift.command_delay_s + x)
        return f"{1000 * x:g} ms", replace(nominal, shift=late)
    if kind == "friction":
        friction = x * (nominal.foot_friction or loop.robot.foot_friction)
        return f"{friction:.2g}", replace(nominal, foot_friction=friction)
    return f"×{x:g}", replace(nominal, mass_scale=x * nominal.mass_scale)
