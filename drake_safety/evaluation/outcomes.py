"""Failure of an episode: metrics, and the record that is kept."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_safety.files.reading import is_number
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.causes import is_outside
from drake_safety.learning.segments import DIVERGED, Episode
from drake_safety.simulation.capabilities import CanFall, require
from drake_safety.simulation.closed_loop import ClosedLoop

UNSAFE = "unsafe"
HELD = "held actions"
"""Cause of an episode in which a controller found no command, and held the last one."""

Metric = str | Callable[[Episode], float]
"""How bad an episode is: ``unsafe``, ``fall``, a constraint, ``tracking=BOUND``, or a function with
values in [0, 1]. Episodes of the first and the last end where they leave the safe set."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Badness of an episode, the time of its failure or end, and its first violation.

    The desired output ``commanded`` (n_z,), as far ahead as Γ sees, and Γ's belief, None without Γ,
    belong to the first undisturbed row.
    """

    episode: int | str  # A name in files of other simulators.
    value: float
    time_s: float
    cause: str
    commanded: tuple[float, ...]
    belief: tuple[float, ...] | None


class OutcomeReader:
    """Reads what is kept of the episodes of a loop, which are ``simulated`` by some options."""

    def __init__(self, loop: ClosedLoop, metric: Metric, gamma: SafetyAssessment | None = None):
        self._metric, self._gamma = metric, gamma
        self._duration_s = loop.scenario.episode_duration_s
        self._bad_rows = _bad_rows(loop, UNSAFE if callable(metric) else metric)
        self.simulated: dict[str, Any] = {}
        if not callable(metric) and metric != UNSAFE:
            self.simulated["after_leaving_s"] = math.inf
            if (name := _constraint(loop, metric)) in loop.constraint_names:
                self.simulated["until"] = name

    def read(self, episode: Episode) -> Outcome:
        """Reads an episode."""
        is_held = episode.num_controller_failures > 0
        is_bad = self._bad_rows(episode) | _last_row(episode, is_held or episode.cause == DIVERGED)
        value = float(self._metric(episode) if callable(self._metric) else is_bad.any())
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"metric: episode {episode.index} has {value}, expected 0 to 1")
        inputs, belief = episode.first_inputs, None
        if self._gamma is not None:
            belief = tuple(self._gamma.predict_one(*inputs).belief.tolist())
        return Outcome(
            episode=episode.index,
            value=value,
            time_s=min([*episode.time_s[is_bad].tolist(), self._duration_s]),
            cause=HELD if is_held else episode.cause,
            commanded=tuple(inputs[1][-episode.output.shape[1] :].tolist()),
            belief=belief,
        )


def _bad_rows(loop: ClosedLoop, metric: str) -> Callable[[Episode], np.ndarray]:
    """The rows of an episode in which it fails, (N,), by a metric."""
    names = loop.constraint_names
    kind, _, bound = metric.partition("=")
    if metric == UNSAFE:
        return lambda one: _last_row(one, not one.is_safe)
    if kind == "tracking" and is_number(bound) and float(bound) > 0:
        fall = [names.index(loop.fall_name)] if isinstance(loop, CanFall) else []
        return lambda one: (
            ~(np.linalg.norm(one.output - one.desired_output, axis=1) <= float(bound))
            | (one.margins[:, fall] < 0.0).any(axis=1)
        )
    name = _constraint(loop, metric)
    if name not in names:
        known = [UNSAFE, "fall", "tracking=BOUND", *names]
        raise ValueError(f"metric '{metric}': expected one of {known}, or a Python function")
    # The cause may be a constraint without a negative margin, by a task's own port ``safe``.
    k = names.index(name)
    return lambda one: is_outside(one.margins[:, [k]]) | _last_row(one, one.cause == name)


def _constraint(loop: ClosedLoop, metric: str) -> str:
    return require(loop, CanFall, "metric 'fall'").fall_name if metric == "fall" else metric


def _last_row(episode: Episode, is_bad: bool) -> np.ndarray:
    """Rows that are bad, (N,): the last one or none."""
    return np.arange(len(episode.time_s)) >= episode.num_steps + (not is_bad)
