"""How hard a push a robot survives, by direction and by phase of its gait."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.systems.framework import Context

from drake_safety.control.kinematics import NUM_BASE_POSITIONS
from drake_safety.evaluation.metrics import Estimate, proportion
from drake_safety.evaluation.outcomes import Metric, OutcomeReader
from drake_safety.evaluation.tables import Column
from drake_safety.files.atomic import write_file
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.seeds import PUSHES
from drake_safety.plants.pushes import Push
from drake_safety.robots.robot_size import GRAVITY_M_S2
from drake_safety.simulation.capabilities import HasGoals, require
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.motion import End, Motion, simulate
from drake_safety.simulation.rollouts import episode_rng
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.worker_processes import MadeOnce, Progress, map_items

_BEFORE_S, _AFTER_S = 2.0, 3.0  # Motion before the first phase, and from a push on.
_PERIODS_S = 0.2, 1.5  # Shortest and longest of gaits.
_STANDING_RAD = 0.01  # Largest spread of the joints of a robot that stands.
_PERIODIC = 0.3  # Least correlation of a gait with itself, a period later.
_LARGEST, _SMALLEST = 32.0, 0.01  # Impulses that are tried, in units of mass · sqrt(g · height).
_RETRIED = 2  # Impulses below the critical one that are tried at random in a cell.
_OF_LOW = 0.3, 0.95  # Their range, by the largest survived one.
_ASKED = np.geomspace(0.2, 2.0, 8)  # Impulses after which Γ is asked, by the critical one.
COLUMNS = ("weakest", "worst [N·s]", "median", "best", "islands", "joint speed")
"""Titles of `PushCard.summary`."""
_SHARE, _SPEED = Column("", "", "%", digits=0), Column("", "", "=", digits=2)
_PORTS = ("state", "output", "desired_preview", "margins", "safe", "plant_state")


@dataclass(frozen=True, kw_only=True)
class PushPlan:
    """The pushes to try on a robot."""

    body: str = ""  # By default the body of the scenario's random pushes, else the base.
    duration_s: float = 0.1
    directions: int = 16
    phases: int = 8  # Phases of a gait; a standing robot has one.
    command: Sequence[float] | None = None
    """Goal (3,) of the motion: a command or a target; the first named one but zero by default."""
    metric: Metric = ""  # As in `compare_loops`; a fall by default, of a robot that can fall.
    precision: float = 0.05  # Relative precision of the critical impulse.
    seed: int = PUSHES.first


@dataclass(frozen=True, kw_only=True)
class PushCell:
    """The pushes of one direction and phase, in the order in which they were tried."""

    direction: int
    phase: int
    impulses_n_s: list[float]
    has_failed: list[bool]
    speeds: list[float]  # Largest joint speed, by the joint's limit.
    num_islands: int  # Failures in two trials of random smaller impulses.
    foreseen_n_s: float | None  # From which on Γ expects a failure; None without Γ.

    @property
    def critical_n_s(self) -> float:
        """The smallest impulse that made the robot fail [N·s], or infinity."""
        tried = zip(self.impulses_n_s, self.has_failed, strict=True)
        return min((impulse for impulse, failed in tried if failed), default=math.inf)

    @property
    def survived_n_s(self) -> float:
        """The largest impulse below which every tried one was survived [N·s]."""
        critical = self.critical_n_s
        return max((one for one in self.impulses_n_s if one < critical), default=0.0)


@dataclass(frozen=True, kw_only=True)
class PushCard:
    """The pushes that a robot survives, of directions from its heading to the left."""

    plan: PushPlan
    unit_n_s: float  # mass · sqrt(g · standing height), which makes robots comparable.
    period_s: float  # Period of the gait; 0 for a standing robot.
    cells: list[PushCell]

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> PushCard:
        """Makes a card of its fields, as in ``pushes.json``."""
        parts = {"plan": PushPlan(**stored["plan"])}
        return cls(**{**stored, **parts, "cells": [PushCell(**one) for one in stored["cells"]]})

    def grid(self, name: str) -> np.ndarray:
        """A value of the cells, (directions, phases), NaN where it is unknown."""
        shape = self.plan.directions, 1 + max(cell.phase for cell in self.cells)
        values = np.full(shape, math.nan)
        for cell in self.cells:
            value = getattr(cell, name)
            values[cell.direction, cell.phase] = math.nan if value is None else value
        return values

    @property
    def weakest(self) -> PushCell:
        """The cell with the smallest impulse."""
        return min(self.cells, key=lambda cell: cell.survived_n_s)

    @property
    def islands(self) -> Estimate:
        """The share of random impulses below a critical one with which the robot failed."""
        return proportion(sum(cell.num_islands for cell in self.cells), _RETRIED * len(self.cells))

    @property
    def speed(self) -> float:
        """The speed of the fastest joint, by its stated one: of 95 % of the survived pushes."""
        pairs = (zip(cell.has_failed, cell.speeds, strict=True) for cell in self.cells)
        survived = [speed for pair in pairs for failed, speed in pair if not failed]
        return float(np.quantile(survived, 0.95)) if survived else math.nan

    @property
    def summary(self) -> tuple[str, ...]:
        """The weakest place, impulses and shares, as `COLUMNS` says."""
        impulses, cell = self.grid("survived_n_s"), self.weakest
        worst, middle, best = np.quantile(impulses, [0.0, 0.5, 1.0])
        phase = f", phase {cell.phase + 1} of {impulses.shape[1]}" if self.period_s else ""
        return (
            f"{360.0 * cell.direction / self.plan.directions:.0f}°{phase}",
            f"{worst:.0f} ({worst / self.unit_n_s:.2f})",
            f"{middle:.0f}",
            f"{best:.0f}",
            _SHARE.text(self.islands),
            _SPEED.text(Estimate.exact(self.speed, self.num_pushes)),
        )

    @property
    def num_pushes(self) -> int:
        """Number of simulated pushes."""
        return sum(len(cell.impulses_n_s) for cell in self.cells)


class PushRig:
    """A robot in undisturbed motion, and its states before the pushes of each phase."""

    def __init__(
        self,
        scenario: Scenario,
        variation: str,
        plan: PushPlan,
        assessment: SafetyAssessment | None = None,
        in_loop: SafetyAssessment | None = None,
        **options: Any,
    ):
        options = scenario.options_for("pairs", variation) | options
        loop = scenario.make_loop(variation, assessment=in_loop, **options)
        if not isinstance(loop, LeggedLoop):
            raise ValueError(f"pushes: task '{type(loop).__name__}' is not a LeggedLoop")
        self.loop, self._assessment = loop, assessment
        random = getattr(scenario.parameters, "random_pushes", None)
        body = plan.body or (random and random.body) or loop.robot.base
        metric = plan.metric or ("fall" if loop.fall_name else "unsafe")
        self.plan = replace(plan, body=body, metric=metric)
        self._reader = OutcomeReader(loop, self.plan.metric)
        self.goal = None
        if isinstance(loop, HasGoals):
            named = [one for one in loop.named_targets.values() if np.any(one)]
            default = [*named, *loop.named_targets.values(), np.zeros(3)][0]
            self.goal = np.array(default if plan.command is None else plan.command, dtype=float)
        model = loop.kinematics
        self.unit_n_s = model.total_mass * math.sqrt(GRAVITY_M_S2 * model.standing_height)

    @cached_property
    def period_s(self) -> float:
        """Period of the gait [s], 0 of a robot that stands, from the joints' correlation."""
        step_s = self.loop.scenario.control_period_s
        motion = self._moved(_BEFORE_S + 2 * _PERIODS_S[1], step_s=step_s)
        if self._reader.read(motion.episode(len(self.loop.feature_names))).value:
            raise ValueError(f"pushes: the robot fails without a push, at {motion.time_s[-1]:g} s")
        first_row, num_q = round(_BEFORE_S / step_s), self.loop.kinematics.num_positions
        q = motion["plant_state"][first_row:, NUM_BASE_POSITIONS:num_q]
        q = q - q.mean(axis=0)
        if np.abs(q).max() < _STANDING_RAD:
            return 0.0
        first, last = (round(one / step_s) for one in _PERIODS_S)
        n = len(q) - last
        size = math.sqrt(np.vdot(q[:n], q[:n]))
        alike = [np.vdot(q[:n], q[k : k + n]) / size for k in range(first - 1, last + 1)]
        for k, (before, here, after) in enumerate(zip(alike, alike[1:], alike[2:], strict=False)):
            if before < here >= after and here > _PERIODIC * size:
                return (first + k) * step_s
        return 0.0

    @property
    def num_phases(self) -> int:
        """Number of phases."""
        return self.plan.phases if self.period_s else 1

    @cached_property
    def _saved(self) -> list[tuple[float, Context]]:
        """Times of the pushes by phase [s], and the states before them."""
        grid_s = self.loop.scenario.control_period_s
        first = episode_rng(self.plan.seed, 0).uniform()  # Within its share of the period.
        shares = (first + np.arange(self.num_phases)) / self.num_phases
        times_s = [grid_s * round(t / grid_s) for t in _BEFORE_S + self.period_s * shares]
        saved: list[tuple[float, Context]] = []
        events = [(t, lambda context, t=t: saved.append((t, context.Clone()))) for t in times_s]
        self._moved(times_s[-1] + grid_s, step_s=grid_s, events=events)
        return saved

    def _moved(self, duration_s: float, **options: Any) -> Motion:
        """The undisturbed motion."""

        def begin(context: Context) -> None:
            rng = episode_rng(self.plan.seed, 1)
            if self.goal is None:
                self.loop.reset_to(context, rng, self.loop.standing_start())
            else:
                require(self.loop, HasGoals).reset_standing(context, self.goal, rng)

        end = End(duration_s=duration_s, **self._reader.simulated)
        options = {"step_s": self.loop.scenario.step_s, "who": "undisturbed motion"} | options
        return simulate(self.loop, begin, _PORTS, end, **options)

    def push(self, impulse_n_s: float, direction: int, phase: int) -> tuple[Push, Context]:
        """A push in a direction from the robot's heading, and the state before it."""
        time_s, saved = self._saved[phase]
        q = self.loop.GetOutputPort("plant_state").Eval(saved)[:4]
        ahead = RotationMatrix(Quaternion(q / np.linalg.norm(q))).matrix()[:, 0]
        angle = math.atan2(ahead[1], ahead[0]) + 2.0 * math.pi * direction / self.plan.directions
        strength_n = impulse_n_s / self.plan.duration_s
        force_n = [strength_n * math.cos(angle), strength_n * math.sin(angle), 0.0]
        durations = {"time_s": time_s, "duration_s": self.plan.duration_s}
        return Push(body=self.plan.body, force_n=force_n, **durations), saved

    def pushed(
        self,
        impulse_n_s: float,
        direction: int,
        phase: int,
        duration_s: float = _AFTER_S,
        ports: Sequence[str] = _PORTS,
        **options: Any,
    ) -> Motion:
        """The motion from a push on."""
        push, saved = self.push(impulse_n_s, direction, phase)

        def begin(context: Context) -> None:
            context.SetTimeStateAndParametersFrom(saved)
            self.loop.set_push(context, push)

        scenario = self.loop.scenario
        return simulate(
            self.loop,
            begin,
            ports,
            End(duration_s=duration_s, **self._reader.simulated),
            step_s=scenario.step_s,
            watch_period_s=scenario.watch_period_s,
            may_fail=True,
            who=f"push of {impulse_n_s:g} N·s on '{scenario.name}'",
            **options,
        )

    def try_push(self, impulse_n_s: float, direction: int, phase: int) -> tuple[bool, float]:
        """Whether the robot fails, and the speed of its fastest joint by the stated one."""
        limits, port = self.loop.kinematics.velocity_limits, self.loop.GetOutputPort("plant_state")
        fastest = np.zeros(len(limits))

        def watch(context: Context) -> None:
            np.maximum(fastest, np.abs(port.Eval(context)[-len(limits) :]), out=fastest)

        motion = self.pushed(impulse_n_s, direction, phase, monitor=watch)
        failed = self._reader.read(motion.episode(len(self.loop.feature_names))).value > 0.0
        return failed, float((fastest / limits).max())

    def failure_probability(self, impulse_n_s: float, direction: int, phase: int) -> float:
        """Γ's probability of a failure right after a push; 1 if it does not know."""
        assert self._assessment is not None
        ports, step_s = (*_PORTS, "features"), self.loop.scenario.step_s
        after_s = step_s * math.ceil(self.plan.duration_s / step_s - 1e-9)
        motion = self.pushed(impulse_n_s, direction, phase, after_s, ports)
        inputs = (motion[name][-1:] for name in ("state", "desired_preview", "features"))
        safe = float(self._assessment.predict(*inputs).probability[0])
        return 1.0 if math.isnan(safe) else 1.0 - safe

    def cell(self, place: tuple[int, int]) -> PushCell:
        """Finds the critical impulse by doubling and bisection, and tries smaller impulses."""
        tried: dict[float, tuple[bool, float]] = {}

        def fails(impulse_n_s: float) -> bool:
            tried[impulse_n_s] = self.try_push(impulse_n_s, *place)
            return tried[impulse_n_s][0]

        low, high = 0.0, self.unit_n_s
        while not fails(high) and high < _LARGEST * self.unit_n_s:
            low, high = high, 2.0 * high
        low = low if tried[high][0] else high
        rng = episode_rng(self.plan.seed, 2 + place[0] * self.num_phases + place[1])
        num_islands = 0
        for attempt in range(1 + _RETRIED):
            while high - low > self.plan.precision * max(high, _SMALLEST * self.unit_n_s):
                middle = 0.5 * (low + high)
                low, high = (low, middle) if fails(middle) else (middle, high)
            if attempt < _RETRIED and low > 0.0 and fails(lower := low * rng.uniform(*_OF_LOW)):
                survived = [impulse for impulse, (failed, _) in tried.items() if not failed]
                low, high = max([one for one in survived if one < lower], default=0.0), lower
                num_islands += 1
        failed, speeds = zip(*tried.values(), strict=True)
        return PushCell(
            direction=place[0],
            phase=place[1],
            impulses_n_s=[*tried],
            has_failed=[*failed],
            speeds=[*speeds],
            num_islands=num_islands,
            foreseen_n_s=self._foreseen(high, place),
        )

    def _foreseen(self, critical_n_s: float, place: tuple[int, int]) -> float | None:
        if self._assessment is None:
            return None
        impulses = critical_n_s * _ASKED
        expected = np.array([self.failure_probability(one, *place) for one in impulses.tolist()])
        if not (above := np.flatnonzero(expected > 0.5)).size:
            return math.inf
        k = int(above[0])
        if k == 0:
            return float(impulses[0])
        ends = slice(k - 1, k + 1)
        return float(np.exp(np.interp(0.5, expected[ends], np.log(impulses[ends]))))


def make_push_card(
    scenario: Scenario,
    plan: PushPlan | None = None,
    *,
    variation: str = "nominal",
    assessment: SafetyAssessment | None = None,
    num_workers: int | None = None,
    path: str | PathLike[str] | None = None,
    progress: Progress | bool | None = None,
    in_loop: SafetyAssessment | None = None,
    **loop_options: Any,
) -> PushCard:
    """Finds the smallest impulse that makes a robot fail, for each direction and phase.

    The robot moves undisturbed for two seconds; each push begins in one of its states. Survival is
    not monotone: below the critical impulse others are tried at random, and a failure among them
    becomes the critical one. The ``assessment``, if given, is asked right after pushes.

    Args:
        in_loop: Γ of the diagram, with which it may recover.
        path: Folder in which finished cells are kept; the same call continues.
        **loop_options: Options of the task, such as ``recovery=True``.
    """
    plan, options = plan or PushPlan(), {"assessment": assessment, "in_loop": in_loop}
    learned = [one and (one.info_, one.calibrations_) for one in options.values()]
    plant = scenario.simulation_hash(variation), scenario.to_yaml()
    identity = repr((plant, plan, learned, sorted(loop_options.items())))
    key = hashlib.sha256(identity.encode()).hexdigest()[:12]
    make = MadeOnce(key, partial(PushRig, scenario, variation, plan, **options, **loop_options))
    rig = make()
    cells: dict[tuple[int, int], PushCell] = {}
    file = None if path is None else Path(path) / f"cells-{key}.json"
    if file is not None and file.is_file():
        for kept in json.loads(file.read_text(encoding="utf-8")):
            cells[kept["direction"], kept["phase"]] = PushCell(**kept)
    places = [(i, k) for i in range(plan.directions) for k in range(rig.num_phases)]
    pending = [place for place in places if place not in cells]
    results = map_items(
        PushRig.cell,
        pending,
        make=make,
        num_workers=num_workers,
        batch_size=1,
        progress=progress,
        num_done=len(cells),
        stage="directions and phases",
    )
    with closing(results):
        for cell in results:
            cells[cell.direction, cell.phase] = cell
            if file is not None:
                write_file(file, json.dumps([asdict(one) for one in cells.values()]))
    return PushCard(
        plan=rig.plan,
        unit_n_s=rig.unit_n_s,
        period_s=rig.period_s,
        cells=[cells[place] for place in places],
    )
