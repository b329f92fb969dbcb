"""Interactive sessions with a robot in Meshcat, in real time."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from drake_safety.learning.causes import describe_margin, likely_cause
from drake_safety.live.panel import INK_RGB, RECOVERY_RGB, SAFE_RGB, UNSAFE_RGB, LivePanel
from drake_safety.planning.goal_verdict import GoalVerdict, assess_goal
from drake_safety.planning.nearest_goal import nearest_accepted_goal
from drake_safety.plants.balls import Throw
from drake_safety.simulation.capabilities import HasBall, HasGoals, angular_constraints, require
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.rollouts import episode_rng

TICK_S = 0.04
"""Simulated time per tick [s]."""
STOP = "Stop"
PROBABILITY = "Γ, shown"
"""The slider that shows Γ as a number; moving it has no effect."""

_FLIGHT_S = 0.2  # From a ball's release to its impact, so that it is visible.
_LYING_S = 1.5  # From a fall to the reset.
_NUM_CANDIDATES = 24  # Per batch of the search: few, because the user waits for the answer.
_BREAK_S = 0.02  # Real time between ticks while nothing moves.


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
    """A closed loop with Γ in Meshcat that reacts to buttons and sliders.

    Args:
        loop: A closed loop built with this Meshcat and with an assessment.
        meshcat: The Meshcat server.
        threshold: Threshold of Γ.
        seed: Seed of starts and noise.

    Raises:
        ValueError: The loop was built without an assessment.

    Attributes:
        pace: Simulated and real time so far.
        probability: Γ as shown.
    """

    probability_port = "normalized_safety_probability"

    def __init__(self, loop: LeggedLoop, meshcat: Meshcat, *, threshold: float, seed: int = 0):
        if loop.assessment is None:
            raise ValueError("live session: the loop was built without an assessment")
        self.loop = loop
        self.assessment = loop.assessment
        self.meshcat = meshcat
        self.threshold = threshold
        self.pace = Pace()
        self.probability = math.nan
        self._seed = seed
        self._num_resets = 0
        self._clicks: dict[str, int] = {}
        self._ranges: dict[str, tuple[float, float]] = {}
        self._late_s = 0.0
        self._simulator = Simulator(loop)
        self.context = self._simulator.get_mutable_context()
        self._fall_column = loop.constraint_names.index(loop.fall_name)
        # Size of the robot: twice the height of its base, or the extent of its feet.
        q = loop.kinematics.standing_positions()
        contacts = loop.kinematics.contact_positions(q)
        self._size_m = float(max(2 * q[6], *np.ptp(contacts, axis=0)))
        self.panel = LivePanel(meshcat, loop.view, threshold=threshold, width_m=0.9 * self._size_m)
        self._add_button(STOP, "Escape")
        meshcat.AddSlider(PROBABILITY, 0.0, 1.0, 0.01, 0.0)

    @abstractmethod
    def tick(self) -> bool:
        """Reacts to the controls and advances by one tick.

        Returns:
            Whether anything was simulated.
        """

    def run(self, *, is_paced: bool = True) -> None:
        """Ticks until the button Stop is clicked.

        Args:
            is_paced: Whether to run in real time; False runs as fast as possible.
        """
        while not self._is_clicked(STOP):
            begin = time.perf_counter()
            was_simulated = self.tick()
            busy_s = time.perf_counter() - begin
            if not was_simulated:
                time.sleep(_BREAK_S)
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

    def _add_button(self, name: str, key: str = "") -> None:
        self.meshcat.AddButton(name, key)
        self._clicks[name] = 0

    def _is_clicked(self, name: str) -> bool:
        clicks = self.meshcat.GetButtonClicks(name)
        is_new = clicks > self._clicks[name]
        self._clicks[name] = clicks
        return is_new

    def _add_slider(self, name: str, low: float, high: float, step: float, value: float) -> None:
        self.meshcat.AddSlider(name, low, high, step, value)
        self._ranges[name] = (low, high)

    def _slider(self, name: str) -> float:
        """Value of a slider within its range, whatever a page sent."""
        low, high = self._ranges[name]
        value = float(self.meshcat.GetSliderValue(name))
        return min(max(value, low), high) if math.isfinite(value) else low

    def _next_rng(self) -> np.random.Generator:
        self._num_resets += 1
        return episode_rng(self._seed, self._num_resets - 1)

    def _begin(self) -> None:
        """Initializes the simulator after a reset, and redraws."""
        self._simulator.Initialize()
        self.panel.clear_history()
        self._aim_camera()

    def _advance(self) -> None:
        self._simulator.AdvanceTo(self.context.get_time() + TICK_S)
        self._show_gamma(
            self._eval(self.probability_port)[0], self._eval("belief"), self.context.get_time()
        )

    def _show_gamma(
        self, probability: float, belief: np.ndarray, time_s: float | None = None
    ) -> None:
        self.probability = float(probability)
        self.panel.show_belief(belief)
        shown = self.probability if math.isfinite(self.probability) else 0.0
        self.meshcat.SetSliderValue(PROBABILITY, min(max(shown, 0.0), 1.0))
        if time_s is not None:
            self.panel.add(time_s, shown)

    def _show_unsafe(self, note: str) -> None:
        cause = likely_cause(
            self.loop.constraint_names,
            self._eval("cause_probability"),
            self._eval("predicted_margins"),
            self.assessment.parameters.margin_unit,
        )
        self.panel.show_text(f"unsafe: {cause}" if cause else "unsafe", note, rgb=UNSAFE_RGB)

    def _eval(self, port: str) -> np.ndarray:
        return self.loop.GetOutputPort(port).Eval(self.context)

    def _base(self) -> np.ndarray:
        return self._eval("plant_state")[4:7]

    @property
    def has_fallen(self) -> bool:
        """Whether the robot has fallen."""
        return bool(self._eval("margins")[self._fall_column] < 0)

    def _rightwards(self) -> np.ndarray:
        """Direction to the right in the camera's view, in the world, (3,)."""
        azimuth = self.loop.view.azimuth_rad
        return np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])

    def _place_panel(self) -> None:
        x, y, _ = self._base()
        beside = np.array([x, y, 0.0]) + 1.1 * self._size_m * self._rightwards()
        self.panel.place(beside + [0.0, 0.0, 0.1 * self._size_m])

    def _aim_camera(self) -> None:
        view = self.loop.view
        target = self._base() * [1.0, 1.0, 0.9] + 0.5 * self._size_m * self._rightwards()
        level, up = math.cos(view.elevation_rad), math.sin(view.elevation_rad)
        away = np.array(
            [level * math.cos(view.azimuth_rad), level * math.sin(view.azimuth_rad), up]
        )
        self.meshcat.SetCameraPose(target + 1.9 * self._size_m * away, target)
        self._place_panel()


class LiveThrows(LiveSession):
    """A session with a balancing robot and balls to throw at it.

    Args:
        loop: A closed loop with a ball, built with this Meshcat and with an assessment.
        meshcat: The Meshcat server.
        threshold: Threshold of Γ that triggers recovery.
        seed: Seed of starts and noise.
    """

    THROW, STAND = "Throw", "Stand up again"
    MASS, SPEED, DIRECTION = "mass [kg]", "speed [m/s]", "towards [deg]"

    def __init__(self, loop: LeggedLoop, meshcat: Meshcat, *, threshold: float, seed: int = 0):
        super().__init__(loop, meshcat, threshold=threshold, seed=seed)
        self._thrown = require(loop, HasBall)
        self.probability_port = self._thrown.trigger_port
        self._has_recovery = loop.HasOutputPort("recovery_active")

        self._note, self._note_until_s = "", 0.0
        self._lies_until_s = math.inf
        self._add_button(self.THROW, "Space")
        self._add_button(self.STAND, "KeyR")
        self._add_slider(self.MASS, 1.0, 5.0, 0.5, 3.0)
        self._add_slider(self.SPEED, 1.0, 11.0, 0.5, 8.0)
        self._add_slider(self.DIRECTION, -180.0, 180.0, 15.0, -75.0)
        self._stand()

    def tick(self) -> bool:
        """Throws a ball if the button was clicked, advances, and shows Γ, belief and verdict."""
        now = self.context.get_time()
        if self._is_clicked(self.STAND) or now >= self._lies_until_s:
            self._stand()
        if self._is_clicked(self.THROW):
            self._throw()
        self._advance()
        self._place_panel()
        self._show_status()
        return True

    def _stand(self) -> None:
        self._lies_until_s, self._note_until_s = math.inf, 0.0
        self._thrown.reset_calm(self.context, self._next_rng())
        self._begin()

    def _throw(self) -> None:
        mass, speed, direction = map(self._slider, (self.MASS, self.SPEED, self.DIRECTION))
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
            self.panel.show_text("fell", note, rgb=UNSAFE_RGB)
        elif self._has_recovery and self._eval("recovery_active")[0] > 0:
            self.panel.show_text("Γ fell: recovery steps", note, rgb=RECOVERY_RGB)
        elif self.probability >= self.threshold:
            self.panel.show_text("safe: balancing", note, rgb=SAFE_RGB)
        else:
            self._show_unsafe(note)


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
    _TARGET, _NEAREST = "/target", "/nearest_accepted"

    def __init__(
        self,
        loop: LeggedLoop,
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
            self._add_button(name, key)
        for name, low, high, value in zip(self.AXES, *box.tolist(), start, strict=True):
            self._add_slider(name, low, high, 0.01, value)
        radius_m = 0.03 * self._size_m
        meshcat.SetObject(self._TARGET, Sphere(radius_m), Rgba(*INK_RGB, 0.8))
        meshcat.SetObject(self._NEAREST, Sphere(radius_m), Rgba(*SAFE_RGB, 0.8))
        self._goal = np.full(3, np.nan)
        self._stand()

    def tick(self) -> bool:
        """Assesses a target that was moved, starts a motion if requested, and shows the verdict."""
        goal = np.array([self._slider(name) for name in self.AXES])
        is_asked = self._is_clicked(self.ASK)
        is_to_go, is_forced = self._is_clicked(self.GO), self._is_clicked(self.FORCE)
        if self._is_clicked(self.STAND):
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
        self._show_gamma(verdict.safety_probability, verdict.belief)
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
            self.panel.show_text(
                f"accepted: Γ {verdict.safety_probability:.2f}", "Space goes there", rgb=SAFE_RGB
            )
            return
        first = f"refused: Γ {verdict.safety_probability:.2f}"
        if verdict.reason:
            first = "refused: don't know"
        cause = describe_margin(verdict.cause, verdict.cause_margin, angular_constraints(self.loop))
        second = f"expected: {cause}" if cause else verdict.reason
        if is_thorough:
            if self.nearest is None:
                second += "; nothing near is accepted"
            else:
                distance_m = float(np.linalg.norm(self.nearest.goal - verdict.goal))
                second += f"; accepted {100 * distance_m:.0f} cm away"
                self.meshcat.SetTransform(self._NEAREST, RigidTransform(self.nearest.goal))
                self.meshcat.SetProperty(self._NEAREST, "visible", True)
        self.panel.show_text(first, second, rgb=UNSAFE_RGB)

    def _show_motion(self) -> None:
        margins = self._eval("margins")
        if self.has_fallen:
            self._end_s = min(self._end_s, self.context.get_time() + _LYING_S)
            self.panel.show_text("fell", "R stands it up again", rgb=UNSAFE_RGB)
        elif margins.min() < 0:
            name = self.loop.constraint_names[int(np.argmin(margins))]
            self.panel.show_text(
                f"left the safe set: {name}", "R stands it up again", rgb=UNSAFE_RGB
            )
            return
        else:
            miss_m = float(np.linalg.norm(self._eval("output") - self._goal))
            if self.context.get_time() >= self._end_s - 1e-9:
                self.panel.show_text("there", f"{100 * miss_m:.1f} cm off", rgb=RECOVERY_RGB)
            else:
                self.panel.show_text(
                    "on the way", f"the {self._goals.hand} hand reaches", rgb=SAFE_RGB
                )
