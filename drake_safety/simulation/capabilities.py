"""Protocols of optional features of a task; every ``context`` is the diagram's root Context."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from pydrake.systems.framework import Context

# Protocols of Python 3.11 evaluate properties when `isinstance` asks a loop for a protocol.
from typing_extensions import Protocol, runtime_checkable

if TYPE_CHECKING:
    from drake_safety.plants.pushes import Push
    from drake_safety.simulation.episode_start import EpisodeStart

_Capability = TypeVar("_Capability")


@runtime_checkable
class HasGoals(Protocol):
    """Plans lead to a goal: three numbers, a point in the world [m] or what `goal_words` says."""

    named_targets: Mapping[str, list[float]]
    hand: str | None  # The reaching frame that moves to the goal, if one does.

    @property
    def target_box(self) -> np.ndarray:
        """Lowest and highest corner of the sampled goals, in the world, (2, 3) [m]."""

    def reset(
        self, context: Context, rng: np.random.Generator, goal: np.ndarray | None = None
    ) -> int:
        """Like :meth:`ClosedLoop.reset`; ``goal`` (3,) [m], in the world, replaces a random one."""

    def reset_standing(
        self, context: Context, goal: np.ndarray, rng: np.random.Generator | None = None
    ) -> None:
        """Starts at rest in the standing posture, without noise, with a plan to a goal (3,)."""


@dataclass(frozen=True, kw_only=True)
class GoalWords:
    """Words for goals in messages and figures."""

    goal: str = "target"
    axes: tuple[str, str, str] = ("x", "y", "z")
    units: tuple[str, ...] = ("m",)
    subject: str = "the robot"

    @property
    def is_point(self) -> bool:
        """Whether a goal is a point in the world."""
        return self.units == ("m",)

    def value(self, goal: np.ndarray) -> str:
        """A goal with its units."""
        numbers = [f"{value:.12g}" for value in goal.tolist()]
        if self.is_point:
            return f"{' '.join(numbers)} m"
        return " ".join(f"{n} {u}" for n, u in zip(numbers, self.units, strict=True))

    def distance(self, difference: np.ndarray) -> str:
        """The size of a difference of goals (3,)."""
        length = float(np.linalg.norm(difference))
        return f"{100 * length:.1f} cm" if self.is_point else f"{length:.2f}"


@runtime_checkable
class CanFall(Protocol):
    """The robot can fall, which ends a motion."""

    fall_name: str  # The constraint whose violation is a fall.
    # Features that a conventional monitor thresholds, by quantity; larger values are safer.
    watched_features: Mapping[str, str]


@runtime_checkable
class MovesUndisturbed(Protocol):
    """The robot can move for as long as one likes, by plans that follow each other."""

    def reset_undisturbed(
        self, context: Context, rng: np.random.Generator, duration_s: float
    ) -> None:
        """Samples motion without offset, push or ball of a given duration [s]."""


@runtime_checkable
class CanBePushed(Protocol):
    """Forces can act on the robot's bodies."""

    pushes: Mapping[str, Push]

    def set_push(self, context: Context, push: Push) -> None:
        """Sets a push on the robot; call it after a reset."""

    def sample_push(self, rng: np.random.Generator) -> Push:
        """Samples a push on the robot."""


@runtime_checkable
class FollowsCommands(Protocol):
    """Goals are commands that can change while the robot moves."""

    def set_command(self, context: Context, command: np.ndarray) -> None:
        """Sets a constant command (3,) from now on."""

    def set_guarded(self, context: Context, is_guarded: bool) -> None:
        """Sets whether a guard replaces commands that are not accepted."""


@runtime_checkable
class CanStartAnywhere(Protocol):
    """Episodes can begin with a given state and plan."""

    plant_state_sizes: tuple[int, int]

    def reset_to(
        self, context: Context, rng: np.random.Generator | None, start: EpisodeStart
    ) -> None:
        """Sets plant state and plan; without ``rng`` the initial state is without noise."""

    def start_of(self, context: Context) -> EpisodeStart:
        """State and plan of a Context, as a start for :meth:`reset_to`."""


def require(loop: object, capability: type[_Capability], who: str = "") -> _Capability:
    """Returns the loop if it has a capability, a protocol of this module or of a task."""
    if isinstance(loop, capability):
        return loop
    who = f"{who}{who and ': '}task '{type(loop).__name__}'"
    raise ValueError(f"{who} lacks '{capability.__name__}': {capability.__doc__}")


def goal_words(loop: HasGoals) -> GoalWords:
    """Words for the goals of a loop: its ``goal_words``, if any."""
    words = GoalWords() if loop.hand is None else GoalWords(subject=f"the {loop.hand} hand")
    return getattr(loop, "goal_words", words)
