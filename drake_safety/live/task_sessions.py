"""Live sessions by what a task can: balls, goals, commands, or none of them."""

from __future__ import annotations

import contextlib
import math
import textwrap
from collections.abc import Iterator
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform

from drake_safety.learning.causes import describe_margin
from drake_safety.learning.segments import DivergenceError
from drake_safety.live.following_camera import WORLD
from drake_safety.live.panel import COLOURS
from drake_safety.live.session import BREAK_S, LiveSession
from drake_safety.planning.goal_verdict import GoalVerdict, assess_goal
from drake_safety.planning.nearest_goal import nearest_accepted_goal
from drake_safety.plants.balls import Throw
from drake_safety.simulation.capabilities import (
    CanBePushed,
    FollowsCommands,
    HasBall,
    HasGoals,
    goal_words,
    require,
)
from drake_safety.simulation.closed_loop import ClosedLoop

_FLIGHT_S = 0.2  # From a ball's release to its impact, so that it is visible.
_NUM_CANDIDATES = 24  # Per batch of the search: few, because the user waits for the answer.
_SIZE_M = 1.0  # Of a plant without legs, for markers.
_NUM_STEPS = 8  # Key presses from zero to the farthest command of training.
_SHOWN_S = 1.5  # From the end of an episode to the next start.
_NUM_CHARACTERS = 160  # Of an error.


class LiveThrows(LiveSession):
    """A session with a balancing robot and balls to throw at it."""

    THROW = "Throw"
    BUTTONS = ((THROW, "Space"),)
    MASS, SPEED, DIRECTION = "mass [kg]", "speed [m/s]", "towards [deg]"

    def __init__(self, loop: ClosedLoop, meshcat: Meshcat, **options: Any):
        self._thrown = require(loop, HasBall)
        super().__init__(loop, meshcat, **options)
        self._has_recovery = loop.HasOutputPort("recovery_active")
        self.panel.add_slider(self.MASS, 1.0, 5.0, 0.5, 3.0)
        self.panel.add_slider(self.SPEED, 1.0, 11.0, 0.5, 8.0)
        self.panel.add_slider(self.DIRECTION, -180.0, 180.0, 15.0, -75.0)
        self._start()

    def _start(self) -> None:
        self._thrown.reset_calm(self.context, self._next_rng())
        self._begin()

    def _react(self) -> None:
        if not self.panel.take_click(self.THROW):
            return
        mass, speed, direction = map(self.panel.value, (self.MASS, self.SPEED, self.DIRECTION))
        throw = Throw(mass_kg=mass, speed_m_s=speed, direction_rad=math.radians(direction))
        try:
            self._thrown.throw_ball(self.context, throw, _FLIGHT_S)
            self._say(f"ball of {mass:g} kg at {speed:g} m/s towards {direction:g}°", 3.0)
        except ValueError:  # The robot has fallen, or the ball's path misses its base.
            self._say("this ball would miss the robot", 3.0)

    def _show_status(self) -> None:
        note = self._note("Space throws a ball")
        if self._show_fall(note):
            return
        if self._has_recovery and self._eval("recovery_active")[0] > 0:
            self.panel.show("recovering", cause=self._cause(), note=note, tone="recovery")
        else:
            self._show_by_probability(note, "balancing")


class LiveGoals(LiveSession):
    """A session with a robot that reaches for accepted targets."""

    ASK, GO, FORCE, START = "Ask", "Go", "Go all the same", "Stand"
    BUTTONS = ((ASK, "KeyA"), (GO, "Space"), (FORCE, ""))
    STARTS_AGAIN = False
    AXES = ("x [m]", "y [m]", "z [m]")
    _TARGET, _NEAREST = f"{WORLD}/target", f"{WORLD}/nearest_accepted"

    def __init__(
        self,
        loop: ClosedLoop,
        meshcat: Meshcat,
        *,
        unsafe_below: float | None = None,
        **options: Any,
    ):
        super().__init__(loop, meshcat, **options)
        self._unsafe_below = unsafe_below
        self.verdict: GoalVerdict | None = None
        self.nearest: GoalVerdict | None = None
        self._goals = require(loop, HasGoals)
        box = self._goals.target_box
        start = next(iter(self._goals.named_targets.values()), box.mean(axis=0))
        for name, low, high, value in zip(self.AXES, *box.tolist(), start, strict=True):
            self.panel.add_slider(name, low, high, 0.01, value)
        radius_m = 0.03 * (self._camera.size_m if self._camera else _SIZE_M)
        meshcat.SetObject(self._TARGET, Sphere(radius_m), Rgba(*COLOURS["plain"], 0.8))
        meshcat.SetObject(self._NEAREST, Sphere(radius_m), Rgba(*COLOURS["safe"], 0.8))
        self._start()

    def _react(self) -> None:
        """Assesses a target that was moved, starts a motion if requested, and shows the verdict."""
        goal = np.array([self.panel.value(name) for name in self.AXES])
        is_asked = self.panel.take_click(self.ASK)
        is_to_go, is_forced = self.panel.take_click(self.GO), self.panel.take_click(self.FORCE)
        if is_asked or is_to_go or is_forced or not np.array_equal(goal, self._goal):
            verdict = self._assess(goal, is_thorough=is_asked or is_to_go)
            if is_forced or (is_to_go and verdict.is_accepted):
                self._goals.reset_standing(self.context, goal, self._next_rng())
                self._begin(self.loop.scenario.episode_duration_s + 1.0)

    def _start(self) -> None:
        # Shows the posture only; no motion begins.
        self._goals.reset_standing(self.context, self._goals.target_box.mean(axis=0))
        self._begin(-math.inf)
        self._goal = np.full(3, np.nan)

    def _assess(self, goal: np.ndarray, *, is_thorough: bool) -> GoalVerdict:
        self._goal = goal
        self.meshcat.SetTransform(self._TARGET, RigidTransform(goal))
        self.meshcat.SetProperty(self._NEAREST, "visible", False)
        asked = (self.loop, self.assessment, goal)
        self.verdict = verdict = assess_goal(
            *asked, threshold=self.threshold, unsafe_below=self._unsafe_below
        )
        self.nearest = None
        if is_thorough and not verdict.is_accepted:
            self.nearest = nearest_accepted_goal(
                *asked,
                threshold=self.threshold,
                rng=np.random.default_rng(self._seed),
                num_candidates=_NUM_CANDIDATES,
            )
        self.panel.show_belief(verdict.probability, verdict.belief)
        self._show_verdict(verdict, is_thorough=is_thorough)
        return verdict

    def _show_verdict(self, verdict: GoalVerdict, *, is_thorough: bool) -> None:
        told = f"probability {verdict.probability:.2f}"
        if verdict.is_accepted:
            self.panel.show(f"accepted: {told}", note="Space goes there", tone="safe")
            return
        if verdict.reason:
            told = "don't know"
        cause = describe_margin(verdict.cause, verdict.cause_margin, self.loop.angular_constraints)
        notes = [] if cause else [verdict.reason]
        if self.nearest is not None:
            distance_m = float(np.linalg.norm(self.nearest.goal - verdict.goal))
            notes.append(f"accepted {100 * distance_m:.0f} cm away")
            self.meshcat.SetTransform(self._NEAREST, RigidTransform(self.nearest.goal))
            self.meshcat.SetProperty(self._NEAREST, "visible", True)
        elif is_thorough:
            notes.append("nothing near is accepted")
        note = "; ".join(filter(None, notes))
        self.panel.show(f"refused: {told}", cause=cause, note=note, tone="unsafe")

    def _show_status(self) -> None:
        margins, note = self._eval("margins"), "R stands it up again"
        if self._show_fall(note):
            return
        if margins.min() < 0:
            name = self.loop.constraint_names[int(np.argmin(margins))]
            self.panel.show("left the safe set", cause=name, note=note, tone="unsafe")
        elif self._is_over:
            miss_m = float(np.linalg.norm(self._eval("output") - self._goal))
            self.panel.show("there", note=f"{100 * miss_m:.1f} cm off", tone="recovery")
        else:
            note = f"the {self._goals.hand} hand reaches"
            self.panel.show("on the way", note=note, tone="safe")


class LiveCommands(LiveSession):
    """A session with a walking robot: keys change its command, push it, and switch the guard."""

    STEPS = (
        ("Faster", "ArrowUp", 0, 1),
        ("Slower", "ArrowDown", 0, -1),
        ("Turn left", "ArrowLeft", 2, 1),
        ("Turn right", "ArrowRight", 2, -1),
        ("Left", "KeyA", 1, 1),
        ("Right", "KeyD", 1, -1),
    )
    """Name and key of each button, and the entry of the command that it changes by a step."""
    HALT, PUSH, GUARD = "Halt", "Push", "Guard on/off"
    BUTTONS = (
        *((name, key) for name, key, _, _ in STEPS),
        (HALT, "KeyH"),
        (PUSH, "Space"),
        (GUARD, "KeyG"),
    )

    def __init__(self, loop: ClosedLoop, meshcat: Meshcat, **options: Any):
        super().__init__(loop, meshcat, **options)
        self._commanded = require(loop, FollowsCommands)
        self._goals, self._pushed = require(loop, HasGoals), require(loop, CanBePushed)
        self._words = goal_words(self._goals)
        self._step = np.abs(self._goals.target_box).max(axis=0) / _NUM_STEPS
        self.is_guarded = True
        self._start()

    def _start(self) -> None:
        self.command = np.zeros(3)
        self._goals.reset_standing(self.context, self.command, self._next_rng())
        self._commanded.set_guarded(self.context, self.is_guarded)
        self._begin()

    def _react(self) -> None:
        command = self.command.copy()
        for name, _, entry, sign in self.STEPS:
            if self.panel.take_click(name):
                command[entry] += sign * self._step[entry]
        if self.panel.take_click(self.HALT):
            command[:] = 0.0
        command = np.clip(command, *self._goals.target_box)
        if not np.array_equal(command, self.command):
            self.command = command
            self._commanded.set_command(self.context, command)
        if self.panel.take_click(self.GUARD):
            self.is_guarded = not self.is_guarded
            self._commanded.set_guarded(self.context, self.is_guarded)
        if self.panel.take_click(self.PUSH):
            self._push(self._pushed)

    def _show_status(self) -> None:
        note = self._note(self._words.value(self.command))
        if not self.is_guarded:
            note += "; guard off"
        if self._show_fall(note):
            return
        is_changed = self.loop.HasOutputPort("guard_active") and self._eval("guard_active")[0] > 0
        if self.is_guarded and is_changed:
            passed = self._words.value(np.round(self._eval("desired_output"), 2))
            told = f"{passed}; asked: {note}"
            self.panel.show("guard: another command", note=told, tone="recovery")
        else:
            self._show_by_probability(note, "walking" if self.command.any() else "standing")


class LiveEpisodes(LiveSession):
    """A session with any task: episode after episode, each from a random start.

    An episode ends 1.5 s after the state left the safe set, or 1.5 s after its duration; a
    simulation that fails is shown for 1.5 s. Then the next one begins.

    Attributes:
        cause: The constraint that was violated first in this episode; "" for none.
    """

    START, PUSH = "New start", "Push"

    def __init__(self, loop: ClosedLoop, meshcat: Meshcat, **options: Any):
        super().__init__(loop, meshcat, **options)
        self.cause = ""
        self._num_waits = 0  # Ticks for which a failure is still shown.
        self._pushed = loop if isinstance(loop, CanBePushed) else None
        if self._pushed is not None:
            self.panel.add_button(self.PUSH, "Space")
        with self._shows_failure():
            self._start()

    def tick(self) -> bool:
        """Starts anew if it is time or requested, advances, and shows belief and verdict."""
        if self._num_waits > 0 and not self.panel.take_click(self.START):
            self._num_waits -= 1
            return False
        with self._shows_failure():
            super().tick()
        return self._num_waits == 0

    def _start(self) -> None:
        self._num_waits = 0
        self.cause = ""
        self._renew_context()
        self.loop.reset(self.context, self._next_rng())
        self._begin(self.loop.scenario.episode_duration_s + _SHOWN_S)

    def _react(self) -> None:
        if self._pushed is not None and self.panel.take_click(self.PUSH):
            self._push(self._pushed)

    @contextlib.contextmanager
    def _shows_failure(self) -> Iterator[None]:
        """Shows why a simulation failed, and lets the next one begin a while later."""
        try:
            yield
        except RuntimeError as error:
            # Drake's solvers raise it, and so does a task whose simulation diverges.
            note = textwrap.shorten(str(error), _NUM_CHARACTERS)
            self.panel.show("the simulation failed", note=note, tone="unsafe")
            self._num_waits = round(_SHOWN_S / BREAK_S)
            self._end_s = -math.inf

    def _show_status(self) -> None:
        now, margins = self.context.get_time(), self._eval("margins")
        if not np.isfinite(margins).all():
            raise DivergenceError(f"a margin is not finite at {now:.2f} s")
        if margins.min() < 0 and not self.cause:
            self.cause = self.loop.constraint_names[int(np.argmin(margins))]
            self._end_s = now + _SHOWN_S
        duration_s = self.loop.scenario.episode_duration_s
        note = "R starts anew"
        if self.cause:
            note = "the next start follows"
        elif now >= duration_s:
            note = f"the episode's {duration_s:g} s have passed; the next start follows"
        note = self._note(note)
        if self.cause:
            name = self.cause.replace("_", " ")
            self.panel.show(f"left the safe set: {name}", note=note, tone="unsafe")
        else:
            self._show_by_probability(note)
