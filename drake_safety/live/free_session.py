"""LiveEpisodes: a session with a task that has neither goals nor balls."""

from __future__ import annotations

import contextlib
import math
import textwrap
from collections.abc import Iterator

import numpy as np
from pydrake.geometry import Meshcat

from drake_safety.learning.segments import DivergenceError
from drake_safety.live.session import BREAK_S, LiveSession
from drake_safety.simulation.capabilities import CanBePushed
from drake_safety.simulation.closed_loop import ClosedLoop

_SHOWN_S = 1.5  # From the end of an episode to the next start.
_NOTE_S = 2.0  # For which a push is shown.
_NUM_CHARACTERS = 160  # Of an error.


class LiveEpisodes(LiveSession):
    """A session with any task: episode after episode, each from a random start.

    An episode ends 1.5 s after the state left the safe set, or 1.5 s after its duration; a
    simulation that fails is shown for 1.5 s. Then the next one begins.

    Args:
        loop: A closed loop, built with this Meshcat and with an assessment.
        meshcat: The Meshcat server.
        threshold: Lowest probability that is shown as safe.
        seed: Seed of starts, noise and pushes.

    Attributes:
        cause: The constraint that was violated first in this episode; "" for none.
    """

    NEW, PUSH = "New start", "Push"

    def __init__(self, loop: ClosedLoop, meshcat: Meshcat, *, threshold: float, seed: int = 0):
        super().__init__(loop, meshcat, threshold=threshold, seed=seed)
        self.cause = ""
        self._end_s = self._note_until_s = -math.inf
        self._note = ""
        self._num_waits = 0  # Ticks for which a failure is still shown.
        self.panel.add_button(self.NEW, "KeyR")
        self._pushed = loop if isinstance(loop, CanBePushed) else None
        if self._pushed is not None:
            self.panel.add_button(self.PUSH, "Space")
        with self._shows_failure():
            self._start()

    def tick(self) -> bool:
        """Starts anew if it is time or requested, advances, and shows Γ, belief and verdict."""
        is_new = self.panel.take_click(self.NEW)
        is_pushed = self.panel.take_click(self.PUSH)
        if self._num_waits > 0 and not is_new:
            self._num_waits -= 1
            return False
        with self._shows_failure():
            if is_new or self.context.get_time() >= self._end_s - 1e-9:
                self._start()
            if is_pushed and self._pushed is not None:
                self._note = self._push(self._pushed)
                self._note_until_s = self.context.get_time() + _NOTE_S
            self._advance()
            self._show_status()
        return self._num_waits == 0

    def _start(self) -> None:
        self._num_waits = 0
        self.cause = ""
        self._note_until_s = -math.inf
        self._end_s = self.loop.scenario.episode_duration_s + _SHOWN_S
        self._renew_context()
        self.loop.reset(self.context, self._next_rng())
        self._begin()

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
        if now < self._note_until_s:
            note = self._note
        elif self.cause:
            note = "the next start follows"
        elif now >= duration_s:
            note = f"the episode's {duration_s:g} s have passed; the next start follows"
        if self.cause:
            name = self.cause.replace("_", " ")
            self.panel.show(f"left the safe set: {name}", note=note, tone="unsafe")
        else:
            self._show_by_probability(note)
