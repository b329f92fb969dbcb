"""Interactive sessions with a simulation in Meshcat, in real time."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np
from pydrake.geometry import Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from drake_safety.learning.causes import describe_margin, likely_cause
from drake_safety.learning.prediction import is_unknown
from drake_safety.live.following_camera import WORLD, FollowingCamera
from drake_safety.live.panel import COLOURS, LivePanel
from drake_safety.planning.goal_verdict import GoalVerdict, assess_goal
from drake_safety.planning.nearest_goal import nearest_accepted_goal
from drake_safety.plants.balls import Throw
from drake_safety.simulation.capabilities import (
    CanBePushed,
    CanFall,
    HasBall,
    HasGoals,
    angular_constraints,
    require,
)
from drake_safety.simulation.closed_loop import ClosedLoop, require_ports
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.rollouts import episode_rng

TICK_S = 0.04
"""Simulated time per tick [s]."""
BREAK_S = 0.02
"""Real time between ticks while nothing is simulated [s]."""
STOP = "Stop"

_PORTS = ("safety_probability", "belief", "cause_probability", "predicted_margins")
_FLIGHT_S = 0.2  # From a ball's release to its impact, so that it is visible.
_LYING_S = 1.5  # From a fall to the reset.
_NUM_CANDIDATES = 24  # Per batch of the search: few, because the user waits for the answer.
_SIZE_M = 1.0  # Of a plant without legs, for markers.


@dataclass
class Pace:
    """Simulated and real time of a live session.

    Attributes:
        simulated_s: Simulated time [s].
        busy_s: Real time spent on simulation and drawing, without waiting [s].
        elapsed_s: Real time elapsed during the simulation [s].
    """

    simulated_s: float = 0.0
    busy_s: float = 0.0
    elapsed_s: float = 0.0

    @property
    def realtime_factor(self) -> float:
        """Simulated by elapsed real time; 1 if the simulation kept up with the clock."""
        return self.simulated_s / self.elapsed_s if self.elapsed_s > 0 else math.nan

    @property
    def possible_factor(self) -> float:
        """Simulated time by the real time spent on it: the largest possible real-time factor."""
        return self.simulated_s / self.busy_s if self.busy_s > 0 else math.nan


class LiveSession(ABC):
    """A closed loop with Γ in Meshcat that reacts to the controls of its panel.

    Args:
        loop: A closed loop built with this Meshcat and with an assessment.
        meshcat: The Meshcat server.
        threshold: Threshold of the probability.
        seed: Seed of starts and noise.

    Raises:
        ValueError: The loop was built without an assessment, or lacks a port of the assessor.

    Attributes:
        pace: Simulated and real time so far.
        probability: The probability as shown.
        panel: What a page shows, and its controls.
    """

    def __init__(self, loop: ClosedLoop, meshcat: Meshcat, *, threshold: float, seed: int = 0):
        if loop.assessment is None:
            raise ValueError("live session: the loop was built without an assessment")
        require_ports(loop, _PORTS, "live session: ")
        self.loop = loop
        self.assessment = loop.assessment
        self.meshcat = meshcat
        self.threshold = threshold
        self.pace = Pace()
        self.probability = math.nan
        self._seed = seed
        self._num_resets = 0
        self._late_s = 0.0
        self._renew_context()
        self._camera = FollowingCamera(loop, meshcat) if isinstance(loop, LeggedLoop) else None
        self._fall_column = None
        if isinstance(loop, CanFall):
            self._fall_column = loop.constraint_names.index(loop.fall_name)
        self.panel = LivePanel(
            title=loop.scenario.name,
            threshold=threshold,
        )
        self.panel.add_button(STOP, "Escape")

    @abstractmethod
    def tick(self) -> bool:
        """Reacts to the controls and advances by one tick.

        Returns:
            Whether anything was simulated.
        """

    def run(self, *, is_paced: bool = True) -> None:
        """Ticks until the button Stop is clicked; however it ends, the panel says so.

        Args:
            is_paced: Whether to run in real time; False runs as fast as possible.
        """
        try:
            self._run(is_paced)
        finally:
            self.panel.stop()

    def _run(self, is_paced: bool) -> None:
        while not self.panel.take_click(STOP):
            begin = time.perf_counter()
            was_simulated = self.tick()
            busy_s = time.perf_counter() - begin
            if not was_simulated:
                time.sleep(BREAK_S)
                self._late_s = 0.0
                continue
            if is_paced:
                # A delay is made up for, up to a few ticks.
                spare_s = TICK_S - busy_s - self._late_s
                time.sleep(max(spare_s, 0.0))
                self._late_s = min(max(-spare_s, 0.0), 5 * TICK_S)
            self.pace.simulated_s += TICK_S
            self.pace.busy_s += busy_s
            self.pace.elapsed_s += time.perf_counter() - begin

    def _next_rng(self) -> np.random.Generator:
        self._num_resets += 1
        return episode_rng(self._seed, self._num_resets - 1)

    def _renew_context(self) -> None:
        """Replaces the Context by the default one."""
        self._simulator = Simulator(self.loop)
        self.context = self._simulator.get_mutable_context()

    def _begin(self) -> None:
        """Initializes the simulator after a reset, and redraws."""
        self._simulator.Initialize()
        self.panel.clear_history()
        if self._camera is not None:
            self._camera.begin(self.context)

    def _advance(self) -> None:
        self._simulator.AdvanceTo(self.context.get_time() + TICK_S)
        self._show_belief(
            self._eval("safety_probability")[0], self._eval("belief"), self.context.get_time()
        )
        if self._camera is not None:
            self._camera.follow(self.context)

    def _show_belief(
        self, probability: float, belief: np.ndarray, time_s: float | None = None
    ) -> None:
        self.probability = float(probability)
        self.panel.show_belief(self.probability, belief, time_s)

    def _show_by_probability(self, note: str, doing: str = "") -> None:
        """Shows "safe", "unsafe" or "don't know", and what the robot does."""
        doing = f": {doing}" if doing else ""
        if self.probability >= self.threshold:
            self.panel.show(f"safe{doing}", note=note, tone="safe")
        elif is_unknown(self._eval("belief"), self.assessment.parameters.initial_uncertainty):
            self.panel.show(f"don't know{doing}", note=note)
        else:
            self.panel.show(f"unsafe{doing}", cause=self._cause(), note=note, tone="unsafe")

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

    def _push(self, pushed: CanBePushed) -> str:
        """Begins a random push, and returns what it is."""
        push = pushed.sample_push(self._next_rng())
        start_s = self.context.get_time() + 0.5 * TICK_S
        pushed.set_push(self.context, replace(push, time_s=start_s))
        return f"pushed with {push.strength_n:.0f} N for {push.duration_s:g} s"

    @property
    def has_fallen(self) -> bool:
        """Whether the robot has fallen; False where nothing can fall."""
        column = self._fall_column
        return column is not None and bool(self._eval("margins")[column] < 0)


class LiveThrows(LiveSession):
    """A session with a balancing robot and balls to throw at it.

    Args:
        loop: A closed loop with a ball, built with this Meshcat and with an assessment.
        meshcat: The Meshcat server.
        threshold: Threshold of the probability that triggers recovery.
        seed: Seed of starts and noise.
    """

    THROW, STAND = "Throw", "Stand up again"
    MASS, SPEED, DIRECTION = "mass [kg]", "speed [m/s]", "towards [deg]"

    def __init__(self, loop: ClosedLoop, meshcat: Meshcat, *, threshold: float, seed: int = 0):
        self._thrown = require(loop, HasBall)
        super().__init__(loop, meshcat, threshold=threshold, seed=seed)
        self._has_recovery = loop.HasOutputPort("recovery_active")

        self._note, self._note_until_s = "", 0.0
        self._lies_until_s = math.inf
        self.panel.add_button(self.THROW, "Space")
        self.panel.add_button(self.STAND, "KeyR")
        self.panel.add_slider(self.MASS, 1.0, 5.0, 0.5, 3.0)
        self.panel.add_slider(self.SPEED, 1.0, 11.0, 0.5, 8.0)
        self.panel.add_slider(self.DIRECTION, -180.0, 180.0, 15.0, -75.0)
        self._stand()

    def tick(self) -> bool:
        """Throws a ball if the button was clicked, advances, and shows Γ, belief and verdict."""
        now = self.context.get_time()
        if self.panel.take_click(self.STAND) or now >= self._lies_until_s:
            self._stand()
        if self.panel.take_click(self.THROW):
            self._throw()
        self._advance()
        self._show_status()
        return True

    def _stand(self) -> None:
        self._lies_until_s, self._note_until_s = math.inf, 0.0
        self._thrown.reset_calm(self.context, self._next_rng())
        self._begin()

    def _throw(self) -> None:
        mass, speed, direction = map(self.panel.value, (self.MASS, self.SPEED, self.DIRECTION))
        throw = Throw(mass_kg=mass, speed_m_s=speed, direction_rad=math.radians(direction))
        try:
            self._thrown.throw_ball(self.context, throw, _FLIGHT_S)
            self._note = f"ball of {mass:g} kg at {speed:g} m/s towards {direction:g}°"
        except ValueError:  # The robot has fallen, or the ball's path misses its base.
            self._note = "this ball would miss the robot"
        self._note_until_s = self.context.get_time() + 3.0

    def _show_status(self) -> None:
        now = self.context.get_time()
        note = self._note if now < self._note_until_s else "Space throws a ball"
        if self.has_fallen:
            self._lies_until_s = min(self._lies_until_s, now + _LYING_S)
            self.panel.show("fallen", note=note, tone="unsafe")
        elif self._has_recovery and self._eval("recovery_active")[0] > 0:
            self.panel.show("recovering", cause=self._cause(), note=note, tone="recovery")
        else:
            self._show_by_probability(note, "balancing")


class LiveGoals(LiveSession):
    """A session with a robot that reaches for accepted targets.

    Args:
        loop: A closed loop whose plans have a goal, built with this Meshcat and with an assessment.
        meshcat: The Meshcat server.
        threshold: See :func:`drake_safety.planning.goal_verdict.assess_goal`.
        unsafe_below: See there.
        seed: Seed of the noise.
    """

    ASK, GO, FORCE, STAND = "Ask", "Go", "Go all the same", "Stand"
    AXES = ("x [m]", "y [m]", "z [m]")
    _TARGET, _NEAREST = f"{WORLD}/target", f"{WORLD}/nearest_accepted"

    def __init__(
        self,
        loop: ClosedLoop,
        meshcat: Meshcat,
        *,
        threshold: float,
        unsafe_below: float | None = None,
        seed: int = 0,
    ):
        super().__init__(loop, meshcat, threshold=threshold, seed=seed)
        self._unsafe_below = unsafe_below
        self.verdict: GoalVerdict | None = None
        self.nearest: GoalVerdict | None = None
        self._end_s = -math.inf
        self._goals = require(loop, HasGoals)
        box = self._goals.target_box
        start = next(iter(self._goals.named_targets.values()), box.mean(axis=0))
        for name, key in (
            (self.ASK, "KeyA"),
            (self.GO, "Space"),
            (self.FORCE, ""),
            (self.STAND, "KeyR"),
        ):
            self.panel.add_button(name, key)
        for name, low, high, value in zip(self.AXES, *box.tolist(), start, strict=True):
            self.panel.add_slider(name, low, high, 0.01, value)
        radius_m = 0.03 * (self._camera.size_m if self._camera else _SIZE_M)
        meshcat.SetObject(self._TARGET, Sphere(radius_m), Rgba(*COLOURS["plain"], 0.8))
        meshcat.SetObject(self._NEAREST, Sphere(radius_m), Rgba(*COLOURS["safe"], 0.8))
        self._goal = np.full(3, np.nan)
        self._stand()

    def tick(self) -> bool:
        """Assesses a target that was moved, starts a motion if requested, and shows the verdict."""
        goal = np.array([self.panel.value(name) for name in self.AXES])
        is_asked = self.panel.take_click(self.ASK)
        is_to_go, is_forced = self.panel.take_click(self.GO), self.panel.take_click(self.FORCE)
        if self.panel.take_click(self.STAND):
            self._stand()
        if is_asked or is_to_go or is_forced or not np.array_equal(goal, self._goal):
            verdict = self._assess(goal, is_thorough=is_asked or is_to_go)
            if is_forced or (is_to_go and verdict.is_accepted):
                self._go(goal)
        if self.context.get_time() >= self._end_s - 1e-9:
            return False
        self._advance()
        self._show_motion()
        return True

    def _assess(self, goal: np.ndarray, *, is_thorough: bool) -> GoalVerdict:
        self._goal = goal
        self.meshcat.SetTransform(self._TARGET, RigidTransform(goal))
        self.meshcat.SetProperty(self._NEAREST, "visible", False)
        self.verdict = verdict = assess_goal(
            self.loop,
            self.assessment,
            goal,
            threshold=self.threshold,
            unsafe_below=self._unsafe_below,
        )
        self.nearest = None
        if is_thorough and not verdict.is_accepted:
            self.nearest = nearest_accepted_goal(
                self.loop,
                self.assessment,
                goal,
                threshold=self.threshold,
                rng=np.random.default_rng(self._seed),
                num_candidates=_NUM_CANDIDATES,
            )
        self._show_belief(verdict.probability, verdict.belief)
        self._show_verdict(verdict, is_thorough=is_thorough)
        return verdict

    def _go(self, goal: np.ndarray) -> None:
        self._goals.reset_standing(self.context, goal, self._next_rng())
        self._begin()
        self._end_s = self.loop.scenario.episode_duration_s + 1.0

    def _stand(self) -> None:
        # Shows the posture only; no motion begins.
        self._goals.reset_standing(self.context, self._goals.target_box.mean(axis=0))
        self._begin()
        self._end_s = -math.inf
        self._goal = np.full(3, np.nan)

    def _show_verdict(self, verdict: GoalVerdict, *, is_thorough: bool) -> None:
        if verdict.is_accepted:
            self.panel.show(
                f"accepted: probability {verdict.probability:.2f}",
                note="Space goes there",
                tone="safe",
            )
            return
        first = f"refused: probability {verdict.probability:.2f}"
        if verdict.reason:
            first = "refused: don't know"
        cause = describe_margin(verdict.cause, verdict.cause_margin, angular_constraints(self.loop))
        note = "" if cause else verdict.reason
        if is_thorough:
            found = "nothing near is accepted"
            if self.nearest is not None:
                distance_m = float(np.linalg.norm(self.nearest.goal - verdict.goal))
                found = f"accepted {100 * distance_m:.0f} cm away"
                self.meshcat.SetTransform(self._NEAREST, RigidTransform(self.nearest.goal))
                self.meshcat.SetProperty(self._NEAREST, "visible", True)
            note = f"{note}; {found}" if note else found
        self.panel.show(first, cause=cause, note=note, tone="unsafe")

    def _show_motion(self) -> None:
        margins = self._eval("margins")
        if self.has_fallen:
            self._end_s = min(self._end_s, self.context.get_time() + _LYING_S)
            self.panel.show("fallen", note="R stands it up again", tone="unsafe")
        elif margins.min() < 0:
            name = self.loop.constraint_names[int(np.argmin(margins))]
            self.panel.show(
                "left the safe set", cause=name, note="R stands it up again", tone="unsafe"
            )
        elif self.context.get_time() >= self._end_s - 1e-9:
            miss_m = float(np.linalg.norm(self._eval("output") - self._goal))
            self.panel.show("there", note=f"{100 * miss_m:.1f} cm off", tone="recovery")
        else:
            note = f"the {self._goals.hand} hand reaches"
            self.panel.show("on the way", note=note, tone="safe")
