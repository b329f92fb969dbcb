"""LiveCommands: a session with a robot that follows commands."""

from __future__ import annotations

import math

import numpy as np
from pydrake.geometry import Meshcat

from drake_safety.live.session import LiveSession
from drake_safety.simulation.capabilities import (
    CanBePushed,
    FollowsCommands,
    HasGoals,
    goal_words,
    require,
)
from drake_safety.simulation.closed_loop import ClosedLoop

_LYING_S = 1.5  # From a fall to the reset.
_NUM_STEPS = 8  # Key presses from zero to the farthest command of training.


class LiveCommands(LiveSession):
    """A session with a walking robot: keys change its command, push it, and switch the guard.

    Args:
        loop: A loop that follows commands, built with this Meshcat, an assessment and a guard.
        meshcat: The Meshcat server.
        threshold: Lowest Γ of an accepted command.
        seed: Seed of starts, noise and pushes.
    """

    KEYS = (
        ("Faster", "ArrowUp", 0, 1),
        ("Slower", "ArrowDown", 0, -1),
        ("Turn left", "ArrowLeft", 2, 1),
        ("Turn right", "ArrowRight", 2, -1),
        ("Left", "KeyA", 1, 1),
        ("Right", "KeyD", 1, -1),
    )
    """Name and key of each button, and the entry of the command that it changes by a step."""
    HALT, PUSH, GUARD, STAND = "Halt", "Push", "Guard on/off", "Stand up again"

    def __init__(self, loop: ClosedLoop, meshcat: Meshcat, *, threshold: float, seed: int = 0):
        super().__init__(loop, meshcat, threshold=threshold, seed=seed)
        self._commanded = require(loop, FollowsCommands)
        self._goals, self._pushed = require(loop, HasGoals), require(loop, CanBePushed)
        self._words = goal_words(self._goals)
        self._step = np.abs(self._goals.target_box).max(axis=0) / _NUM_STEPS
        self.command = np.zeros(3)
        self.is_guarded = True
        self._note, self._note_until_s = "", 0.0
        self._lies_until_s = math.inf
        for name, key, _, _ in self.KEYS:
            self.panel.add_button(name, key)
        for name, key in (
            (self.HALT, "KeyH"),
            (self.PUSH, "Space"),
            (self.GUARD, "KeyG"),
            (self.STAND, "KeyR"),
        ):
            self.panel.add_button(name, key)
        self._stand()

    def tick(self) -> bool:
        """Reacts to the keys, advances, and shows Γ, belief, command and verdict."""
        now = self.context.get_time()
        if self.panel.take_click(self.STAND) or now >= self._lies_until_s:
            self._stand()
        command = self.command.copy()
        for name, _, entry, sign in self.KEYS:
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
            self._note = self._push(self._pushed)
            self._note_until_s = now + 2.0
        self._advance()
        self._show_status()
        return True

    def _stand(self) -> None:
        self._lies_until_s, self._note_until_s = math.inf, 0.0
        self.command = np.zeros(3)
        self._goals.reset_standing(self.context, self.command, self._next_rng())
        self._commanded.set_guarded(self.context, self.is_guarded)
        self._begin()

    def _show_status(self) -> None:
        now = self.context.get_time()
        note = self._note if now < self._note_until_s else self._words.value(self.command)
        if not self.is_guarded:
            note += "; guard off"
        if self.has_fallen:
            self._lies_until_s = min(self._lies_until_s, now + _LYING_S)
            self.panel.show("fallen", note=note, tone="unsafe")
            return
        state = "walking" if self.command.any() else "standing"
        is_changed = self.loop.HasOutputPort("guard_active") and self._eval("guard_active")[0] > 0
        if self.is_guarded and is_changed:
            passed = np.round(self._eval("desired_output"), 2)
            self.panel.show(
                "guard: another command",
                note=f"{self._words.value(passed)}; asked: {note}",
                tone="recovery",
            )
        else:
            self._show_by_probability(note, state)
