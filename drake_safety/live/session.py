"""LiveSession: a simulation in Meshcat, in real time, with controls."""

import contextlib
import math
import textwrap
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import count, repeat
from types import FrameType
from typing import Any, Literal

import numpy as np
from pydrake.geometry import Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from drake_safety.diagrams.balancing.throws import HasBall
from drake_safety.learning.causes import cause_words, is_on, is_outside, likely_cause, violated
from drake_safety.learning.prediction import is_unknown
from drake_safety.learning.segments import DivergenceError
from drake_safety.live.following_camera import WORLD, FollowingCamera
from drake_safety.live.panel import COLOURS, LivePanel, Slider, Status
from drake_safety.planning.goal_verdict import GoalVerdict, assess_goal
from drake_safety.planning.nearest_goal import nearest_accepted_goal
from drake_safety.plants.balls import Throw
from drake_safety.simulation.capabilities import (
    CanBePushed,
    CanFall,
    FollowsCommands,
    HasGoals,
    goal_words,
)
from drake_safety.simulation.closed_loop import ClosedLoop, require_ports
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.rollouts import episode_rng

TICK_S = 0.04  # Simulated per tick.
BREAK_S = 0.02  # Real time between ticks while nothing is simulated.
STOP, START = "Stop", "Start again"
THROW, PUSH = "Throw", "Push"
ASK, GO, FORCE = "Ask", "Go", "Go all the same"
HALT, GUARD = "Halt", "Guard on/off"
MASS, SPEED, DIRECTION = "mass [kg]", "speed [m/s]", "towards [deg]"
AXES = ("x [m]", "y [m]", "z [m]")
STEPS = (
    ("Faster", "ArrowUp", 0, 1),
    ("Slower", "ArrowDown", 0, -1),
    ("Turn left", "ArrowLeft", 2, 1),
    ("Turn right", "ArrowRight", 2, -1),
    ("Left", "KeyA", 1, 1),
    ("Right", "KeyD", 1, -1),
)  # Buttons that change a command, their keys, the entry of it, and the sign of the step.

_PORTS = ("safety_probability", "belief", "cause_probability", "predicted_margins")
_SHOWN_S = 1.5  # From a fall, a failure or the end of an episode to the next start.
_FLIGHT_S = 0.2  # From a ball's release to its impact, so that it is visible.
_NUM_CANDIDATES = 24  # Per batch of the search: few, because the user waits for the answer.
_NUM_STEPS = 8  # Key presses from zero to the farthest command of training.
_GOAL, _NEAREST = f"{WORLD}/target", f"{WORLD}/nearest_accepted"


class LiveSession:
    """A closed loop with Γ in Meshcat that reacts to the controls of its panel.

    The capabilities of the loop, which is built with this Meshcat and an assessment, decide what
    the controls do: change commands, choose a goal, or throw balls. Any other task runs episode
    after episode from random starts. From the threshold on a probability is "safe", and a goal
    below ``unsafe_below`` is unsafe; in between is "don't know". ``monitor`` is called with the
    Context after each step of the simulator.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        meshcat: Meshcat,
        *,
        threshold: float,
        unsafe_below: float | None = None,
        seed: int = 0,
        monitor: Callable[[Context], object] | None = None,
    ):
        require_ports(loop, _PORTS)
        self.loop: Any = loop  # Its capabilities are checked below.
        self.assessment: Any = loop.assessment
        self.meshcat = meshcat
        self.threshold, self.unsafe_below = threshold, unsafe_below
        self._simulator = Simulator(loop)
        if monitor is not None:
            self._simulator.set_monitor(monitor)
        self.cause = ""  # The constraint that was violated first since the start.
        self.command, self.is_guarded = np.zeros(3), True
        # Verdicts on the present goal, and on the nearest accepted goal.
        self.verdict: GoalVerdict | None = None
        self.nearest: GoalVerdict | None = None
        self._goal = np.full(3, np.nan)
        self._seed, self._rngs = seed, map(episode_rng, repeat(seed), count())
        self._end_s = math.inf  # End of the motion.
        self._num_waits = 0  # Ticks for which a failure is still shown.
        self._is_ended, self._said, self._said_until_s = False, "", -math.inf
        self._camera = FollowingCamera(loop, meshcat) if isinstance(loop, LeggedLoop) else None
        self.panel = LivePanel(title=loop.scenario.name, threshold=threshold)
        self.panel.buttons[STOP] = "Escape"
        self._actions: dict[str, Callable[[], object]] = {}
        self._use: Literal["commands", "goals", "balls", "episodes"] = "episodes"
        if isinstance(loop, FollowsCommands):
            self._use = "commands"
            for name, key, entry, sign in STEPS:
                self._add(name, key, partial(self._step, entry, sign))
            self._add(HALT, "KeyH", partial(self._set_command, np.zeros(3)))
            self._add(GUARD, "KeyG", self._switch_guard)
        elif isinstance(loop, HasGoals):
            self._use = "goals"
            self._add(ASK, "KeyA", partial(self._assess, is_thorough=True))
            self._add(GO, "Space", partial(self._go, is_forced=False))
            self._add(FORCE, "", partial(self._go, is_forced=True))
            box = loop.target_box
            start = next(iter(loop.named_targets.values()), box.mean(axis=0))
            for name, low, high, value in zip(AXES, *box.tolist(), start, strict=True):
                self.panel.sliders[name] = Slider(low, high, 0.01, value)
            marker = Sphere(0.03 * (self._camera.size_m if self._camera else 1.0))
            meshcat.SetObject(_GOAL, marker, Rgba(*COLOURS["plain"], 0.8))
            meshcat.SetObject(_NEAREST, marker, Rgba(*COLOURS["safe"], 0.8))
        elif isinstance(loop, HasBall):
            self._use = "balls"
            self._add(THROW, "Space", self._throw)
            self.panel.sliders[MASS] = Slider(1.0, 5.0, 0.5, 3.0)
            self.panel.sliders[SPEED] = Slider(1.0, 11.0, 0.5, 8.0)
            self.panel.sliders[DIRECTION] = Slider(-180.0, 180.0, 15.0, -75.0)
        if isinstance(loop, CanBePushed) and self._use in ("commands", "episodes"):
            self._add(PUSH, "Space", self._push)
        self.panel.buttons[START] = "KeyR"
        with self._shows_failure():
            self._start()

    @property
    def has_fallen(self) -> bool:
        """Whether the robot has fallen; False where nothing can fall."""
        names, margins = self.loop.constraint_names, self._eval("margins")
        return isinstance(self.loop, CanFall) and not margins[names.index(self.loop.fall_name)] >= 0

    def tick(self) -> bool:
        """Reacts to the controls and simulates one tick; returns whether anything was simulated."""
        is_asked = self.panel.take_click(START)
        if self._num_waits > 0 and not is_asked:
            self._num_waits -= 1
            return False
        with self._shows_failure():
            if is_asked or (self._is_over and self._use != "goals"):
                self._start()
            for name, action in self._actions.items():
                if self.panel.take_click(name):
                    action()
            if self._use == "goals" and not np.array_equal(self._slid_goal(), self._goal):
                self._assess(is_thorough=False)
            if self._is_over:
                return False
            self._simulator.AdvanceTo(self.context.get_time() + TICK_S)
            probability, belief = self._eval("safety_probability")[0], self._eval("belief")
            self.panel.show_belief(probability, belief, self.context.get_time())
            if self._camera is not None:
                self._camera.follow(self.context)
            status = self._status()
            if self._is_on("alarm"):
                status = replace(status, note=f"monitor: {self._eval('alarm_cause')}")
            self.panel.status = status
        return self._num_waits == 0

    def run(self) -> None:
        """Ticks in real time until Stop is clicked or :meth:`end` is called."""
        self._simulator.set_target_realtime_rate(1.0)
        self._simulator.ResetStatistics()
        try:
            while not (self._is_ended or self.panel.take_click(STOP)):
                if not self.tick():
                    time.sleep(BREAK_S)
        finally:
            self.panel.stop()

    def end(self, number: int = 0, frame: FrameType | None = None) -> None:
        """Ends :meth:`run` after the present tick; a handler of signals."""
        self._is_ended = True

    def _add(self, name: str, key: str, action: Callable[[], object]) -> None:
        self.panel.buttons[name] = key
        self._actions[name] = action

    def _start(self) -> None:
        loop, end_s = self.loop, math.inf
        self._simulator.reset_context(loop.CreateDefaultContext())
        self.context = self._simulator.get_mutable_context()
        self.cause, self._num_waits = "", 0
        match self._use:
            case "commands":
                self.command = np.zeros(3)
                loop.reset_standing(self.context, self.command, next(self._rngs))
                loop.set_guarded(self.context, self.is_guarded)
            case "goals":
                # Shows the posture only; no motion begins.
                loop.reset_standing(self.context, loop.target_box.mean(axis=0))
                end_s, self._goal = -math.inf, np.full(3, np.nan)
            case "balls":
                loop.reset_calm(self.context, next(self._rngs))
            case "episodes":
                loop.reset(self.context, next(self._rngs))
                end_s = loop.scenario.episode_duration_s + _SHOWN_S
        self._begin(end_s)

    def _begin(self, end_s: float) -> None:
        self._end_s, self._said_until_s = end_s, -math.inf
        self._simulator.Initialize()
        self.panel.history.clear()
        if self._camera is not None:
            self._camera.follow(self.context)

    @property
    def _is_over(self) -> bool:
        return self.context.get_time() >= self._end_s - 1e-9

    @contextlib.contextmanager
    def _shows_failure(self) -> Iterator[None]:
        """Shows why a simulation failed, and lets the next one begin a while later."""
        try:
            yield
        except RuntimeError as error:  # From Drake's solvers, or a simulation that diverges.
            note = textwrap.shorten(str(error), 160)
            self.panel.status = Status("the simulation failed", note=note, tone="unsafe")
            self._num_waits = round(_SHOWN_S / BREAK_S)
            self._end_s = -math.inf

    def _status(self) -> Status:
        loop, now_s, margins = self.loop, self.context.get_time(), self._eval("margins")
        if not np.isfinite(margins).all():
            raise DivergenceError(f"a margin is not finite at {now_s:.2f} s")
        left = loop.constraint_names[violated(margins)] if is_outside(margins) else ""
        if self._use == "episodes":
            if left and not self.cause:
                self._end_s = now_s + _SHOWN_S
            left = self.cause or left  # Until the next start.
        self.cause = self.cause or left
        note = self._note()
        if self.has_fallen:
            self._end_s = min(self._end_s, now_s + _SHOWN_S)
            return Status("fallen", note=note, tone="unsafe")
        if self._is_on("recovery_active"):
            return Status("recovering", self._cause(), note, "recovery")
        if left:
            return Status(f"left the safe set: {left.replace('_', ' ')}", note=note, tone="unsafe")
        if self._use == "goals":
            miss_m = float(np.linalg.norm(self._eval("output") - self._goal))
            state, tone = ("there", "recovery") if self._is_over else ("on the way", "safe")
            return Status(state, note=f"{100 * miss_m:.1f} cm off", tone=tone)
        if self._is_on("guard_active") and self.is_guarded:
            passed = goal_words(loop).value(np.round(self._eval("desired_output"), 2))
            return Status("guard: another command", "", f"{passed}; asked: {note}", "recovery")
        if self.panel.probability >= self.threshold:
            return Status("safe", note=note, tone="safe")
        if is_unknown(self._eval("belief"), self.assessment.parameters.initial_uncertainty):
            return Status("don't know", note=note)
        return Status("unsafe", self._cause(), note, "unsafe")

    def _note(self) -> str:
        if self.context.get_time() < self._said_until_s:
            return self._said
        if self._use != "commands":
            return ""
        command = goal_words(self.loop).value(self.command)
        return command if self.is_guarded else f"{command}; guard off"

    def _say(self, note: str) -> None:
        self._said, self._said_until_s = note, self.context.get_time() + 3.0

    def _cause(self) -> str:
        names, margins = self.loop.constraint_names, self._eval("predicted_margins")
        unit = self.assessment.parameters.margin_unit
        cause = likely_cause(names, self._eval("cause_probability"), margins, unit)
        if not cause:
            return ""
        # Without its number, which would flicker.
        words = cause_words(cause, margins[names.index(cause)], self.loop.angular_constraints)
        return f"{words[0]}: {cause}"

    def _eval(self, port: str) -> Any:
        return self.loop.GetOutputPort(port).Eval(self.context)

    def _is_on(self, port: str) -> bool:
        return self.loop.HasOutputPort(port) and is_on(self._eval(port)[0])

    def _push(self) -> None:
        push = self.loop.sample_push(next(self._rngs))
        push = replace(push, time_s=self.context.get_time() + 0.5 * TICK_S)
        self.loop.set_push(self.context, push)
        self._say(f"pushed with {push.strength_n:.0f} N for {push.duration_s:g} s")

    def _throw(self) -> None:
        sliders = self.panel.sliders
        mass, speed, direction = (sliders[name].value for name in (MASS, SPEED, DIRECTION))
        throw = Throw(mass_kg=mass, speed_m_s=speed, direction_rad=math.radians(direction))
        try:
            self.loop.throw_ball(self.context, throw, _FLIGHT_S)
            self._say(f"ball of {mass:g} kg at {speed:g} m/s towards {direction:g}°")
        except ValueError:  # The robot has fallen, or the ball's path misses its base.
            self._say("this ball would miss the robot")

    def _step(self, entry: int, sign: int) -> None:
        box = self.loop.target_box
        command = self.command.copy()
        command[entry] += sign * np.abs(box).max(axis=0)[entry] / _NUM_STEPS
        self._set_command(np.clip(command, *box))

    def _set_command(self, command: np.ndarray) -> None:
        self.command = command
        self.loop.set_command(self.context, command)

    def _switch_guard(self) -> None:
        self.is_guarded = not self.is_guarded
        self.loop.set_guarded(self.context, self.is_guarded)

    def _slid_goal(self) -> np.ndarray:
        return np.array([self.panel.sliders[name].value for name in AXES])

    def _go(self, *, is_forced: bool) -> None:
        verdict = self._assess(is_thorough=not is_forced)
        if verdict.is_accepted or is_forced:
            self.loop.reset_standing(self.context, verdict.goal, next(self._rngs))
            self._begin(self.loop.scenario.episode_duration_s + 1.0)

    def _assess(self, *, is_thorough: bool) -> GoalVerdict:
        """Assesses and shows the goal; thoroughly also the nearest one that is accepted."""
        self._goal = goal = self._slid_goal()
        self.meshcat.SetTransform(_GOAL, RigidTransform(goal))
        self.meshcat.SetProperty(_NEAREST, "visible", False)
        loop, gamma, limit = self.loop, self.assessment, self.threshold
        self.verdict = verdict = assess_goal(
            loop, gamma, goal, threshold=limit, unsafe_below=self.unsafe_below
        )
        self.nearest = None
        if is_thorough and not verdict.is_accepted:
            few: Any = {"rng": np.random.default_rng(self._seed), "num_candidates": _NUM_CANDIDATES}
            self.nearest = nearest_accepted_goal(loop, gamma, goal, threshold=limit, **few)
        self.panel.show_belief(verdict.probability, verdict.belief)
        if verdict.is_accepted:
            self.panel.status = Status("accepted", note="Space goes there", tone="safe")
            return verdict
        cause = ": ".join(filter(None, verdict.cause_words(loop.angular_constraints)))
        note = "nothing near is accepted" if is_thorough else verdict.reason
        if self.nearest is not None:
            distance_m = float(np.linalg.norm(self.nearest.goal - verdict.goal))
            note = f"accepted {100 * distance_m:.0f} cm away"
            self.meshcat.SetTransform(_NEAREST, RigidTransform(self.nearest.goal))
            self.meshcat.SetProperty(_NEAREST, "visible", True)
        state = "refused: don't know" if verdict.reason else "refused"
        self.panel.status = Status(state, cause, note, "unsafe")
        return verdict
