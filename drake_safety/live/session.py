"""A session with a simulation in Meshcat, in real time."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator

from drake_safety.learning.causes import likely_cause
from drake_safety.learning.prediction import is_unknown
from drake_safety.live.following_camera import FollowingCamera
from drake_safety.live.panel import LivePanel
from drake_safety.simulation.capabilities import CanBePushed, CanFall
from drake_safety.simulation.closed_loop import ClosedLoop, require_ports
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.rollouts import episode_rng

TICK_S = 0.04
"""Simulated time per tick [s]."""
BREAK_S = 0.02
"""Real time between ticks while nothing is simulated [s]."""
STOP = "Stop"

_PORTS = ("safety_probability", "belief", "cause_probability", "predicted_margins")
_LYING_S = 1.5  # From a fall to the next start.


@dataclass
class Pace:
    """Simulated time, and the real time that it took with waiting and without, so far [s]."""

    simulated_s: float = 0.0
    busy_s: float = 0.0
    elapsed_s: float = 0.0

    @property
    def realtime_factor(self) -> float:
        """Simulated by elapsed real time; 1 if the simulation kept up."""
        return self.simulated_s / self.elapsed_s if self.elapsed_s > 0 else math.nan

    @property
    def possible_factor(self) -> float:
        """Simulated time by the real time spent on it: the largest possible real-time factor."""
        return self.simulated_s / self.busy_s if self.busy_s > 0 else math.nan


class LiveSession(ABC):
    """A closed loop with Γ in Meshcat that reacts to the controls of its panel.

    It starts anew when :attr:`START` is clicked. A subclass says how it starts, what its other
    controls do, and what is shown.

    The loop is built with this Meshcat and with an assessment.
    """

    START = "Stand up again"
    BUTTONS: tuple[tuple[str, str], ...] = ()
    """Name and key of each button besides Stop and that of the start."""
    STARTS_AGAIN = True
    """Whether it also starts anew when a motion is over."""

    def __init__(self, loop: ClosedLoop, meshcat: Meshcat, *, threshold: float, seed: int = 0):
        if loop.assessment is None:
            raise ValueError("live session: the loop was built without an assessment")
        require_ports(loop, _PORTS, "live session: ")
        self.loop = loop
        self.assessment = loop.assessment
        self.meshcat = meshcat
        self.threshold = threshold
        self.pace = Pace()
        self._seed = seed
        self._num_resets = 0
        self._end_s = math.inf  # Of the motion; then it starts anew.
        self._said, self._said_until_s = "", -math.inf
        self._renew_context()
        self._camera = FollowingCamera(loop, meshcat) if isinstance(loop, LeggedLoop) else None
        self._fall_column = None
        if isinstance(loop, CanFall):
            self._fall_column = loop.constraint_names.index(loop.fall_name)
        self.panel = LivePanel(title=loop.scenario.name, threshold=threshold)
        for name, key in ((STOP, "Escape"), *self.BUTTONS, (self.START, "KeyR")):
            self.panel.add_button(name, key)

    @property
    def probability(self) -> float:
        """The probability as shown; NaN before the first."""
        return self.panel.probability

    @abstractmethod
    def _start(self) -> None:
        """Resets the Context, and calls `_begin`."""

    @abstractmethod
    def _react(self) -> None:
        """Reacts to the controls."""

    @abstractmethod
    def _show_status(self) -> None:
        """Shows what the robot does."""

    def tick(self) -> bool:
        """Reacts to the controls, advances by one tick, and shows belief and verdict."""
        if self.panel.take_click(self.START) or (self.STARTS_AGAIN and self._is_over):
            self._start()
        self._react()
        if self._is_over:
            return False
        self._simulator.AdvanceTo(self.context.get_time() + TICK_S)
        probability, belief = self._eval("safety_probability")[0], self._eval("belief")
        self.panel.show_belief(probability, belief, self.context.get_time())
        if self._camera is not None:
            self._camera.follow(self.context)
        self._show_status()
        if self.loop.HasOutputPort("alarm") and self._eval("alarm")[0] > 0.5:
            cause = self.loop.GetOutputPort("alarm_cause").Eval(self.context)
            note = f"{self.panel.status.note}; monitor: {cause}".removeprefix("; ")
            self.panel.status = replace(self.panel.status, note=note)
        return True

    def run(self, *, is_paced: bool = True) -> None:
        """Ticks, in real time or as fast as possible, until Stop is clicked; the panel says so."""
        late_s = 0.0
        try:
            while not self.panel.take_click(STOP):
                begin = time.perf_counter()
                was_simulated = self.tick()
                busy_s = time.perf_counter() - begin
                if not was_simulated:
                    time.sleep(BREAK_S)
                    late_s = 0.0
                    continue
                if is_paced:
                    # A delay is made up for, up to a few ticks.
                    spare_s = TICK_S - busy_s - late_s
                    time.sleep(max(spare_s, 0.0))
                    late_s = min(max(-spare_s, 0.0), 5 * TICK_S)
                self.pace.simulated_s += TICK_S
                self.pace.busy_s += busy_s
                self.pace.elapsed_s += time.perf_counter() - begin
        finally:
            self.panel.stop()

    def _next_rng(self) -> np.random.Generator:
        self._num_resets += 1
        return episode_rng(self._seed, self._num_resets - 1)

    def _renew_context(self) -> None:
        """Replaces the Context by the default one."""
        self._simulator = Simulator(self.loop)
        self.context = self._simulator.get_mutable_context()

    def _begin(self, end_s: float = math.inf) -> None:
        """Initializes the simulator after a reset, and redraws."""
        self._end_s, self._said_until_s = end_s, -math.inf
        self._simulator.Initialize()
        self.panel.clear_history()
        if self._camera is not None:
            self._camera.begin(self.context)

    @property
    def _is_over(self) -> bool:
        return self.context.get_time() >= self._end_s - 1e-9

    def _show_by_probability(self, note: str, doing: str = "") -> None:
        """Shows "safe", "unsafe" or "don't know", and what the robot does."""
        doing = f": {doing}" if doing else ""
        if self.probability >= self.threshold:
            self.panel.show(f"safe{doing}", note=note, tone="safe")
        elif is_unknown(self._eval("belief"), self.assessment.parameters.initial_uncertainty):
            self.panel.show(f"don't know{doing}", note=note)
        else:
            self.panel.show(f"unsafe{doing}", cause=self._cause(), note=note, tone="unsafe")

    def _say(self, note: str, seconds: float) -> None:
        """Has `_note` return this for a while."""
        self._said, self._said_until_s = note, self.context.get_time() + seconds

    def _note(self, otherwise: str) -> str:
        return self._said if self.context.get_time() < self._said_until_s else otherwise

    def _cause(self) -> str:
        """The constraint that is most likely to be violated; "" for none."""
        return likely_cause(
            self.loop.constraint_names,
            self._eval("cause_probability"),
            self._eval("predicted_margins"),
            self.assessment.parameters.margin_unit,
        )

    def _eval(self, port: str) -> np.ndarray:
        return self.loop.GetOutputPort(port).Eval(self.context)

    def _push(self, pushed: CanBePushed) -> None:
        """Begins a random push."""
        push = pushed.sample_push(self._next_rng())
        start_s = self.context.get_time() + 0.5 * TICK_S
        pushed.set_push(self.context, replace(push, time_s=start_s))
        self._say(f"pushed with {push.strength_n:.0f} N for {push.duration_s:g} s", 2.0)

    @property
    def has_fallen(self) -> bool:
        """Whether the robot has fallen; False where nothing can fall."""
        column = self._fall_column
        return column is not None and bool(self._eval("margins")[column] < 0)

    def _show_fall(self, note: str) -> bool:
        """Shows that the robot has fallen, if it has, and ends the motion a while later."""
        if not self.has_fallen:
            return False
        self._end_s = min(self._end_s, self.context.get_time() + _LYING_S)
        self.panel.show("fallen", note=note, tone="unsafe")
        return True
