"""Protocols of optional features of a task, queried by ``isinstance`` or :func:`require`.

Throughout, ``context`` is the diagram's root Context, which a reset overwrites, ``rng`` a random
generator, and ``episode`` an episode of the loop.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from pydrake.systems.framework import Context

from drake_safety.learning.inputs import is_rate
from drake_safety.simulation.planned_loop import PlannedLoop

if TYPE_CHECKING:
    from drake_safety.control.kinematics import RobotKinematics
    from drake_safety.learning.segments import Episode
    from drake_safety.plants.balls import Throw
    from drake_safety.plants.pushes import Push
    from drake_safety.simulation.closed_loop import ClosedLoop
    from drake_safety.simulation.contract import Finding
    from drake_safety.simulation.episode_start import EpisodeStart, StatePlane
    from drake_safety.simulation.scenario import Scenario

_Capability = TypeVar("_Capability")


@runtime_checkable
class HasOwnFiles(Protocol):
    """A task, the class itself, with files of its own that ``check`` checks before the diagram."""

    @classmethod
    def check_files(cls, scenario: Scenario, kinematics: RobotKinematics) -> Iterator[Finding]:
        """Findings about the task's own files, for a scenario and its robot."""


@runtime_checkable
class HasGoals(Protocol):
    """Plans lead to a goal: three numbers, a point in the world [m] or what `goal_words` says.

    Attributes:
        named_targets: Named goals, (3,) each.
        hand: The reaching frame that moves to the goal; None for another part of the robot.
    """

    named_targets: Mapping[str, list[float]]
    hand: str | None

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
        """Starts at rest in the standing posture with a plan to a goal (3,) [m] in the world.

        The initial state is without noise; later noise is that of fixed seeds by default.
        """

    def goal_of(self, episode: Episode) -> np.ndarray:
        """Goal of an episode's plan, in the world, (3,) [m]."""


@dataclass(frozen=True, kw_only=True)
class GoalWords:
    """What goals are called in messages and figures.

    Attributes:
        goal: A goal.
        axes: Its three entries.
        units: Their units; a single one holds for all.
        subject: What moves.
    """

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
        if len(self.units) == 1:
            return f"{' '.join(numbers)} {self.units[0]}"
        return " ".join(f"{n} {u}" for n, u in zip(numbers, self.units, strict=True))

    def distance(self, difference: np.ndarray) -> str:
        """The size of a difference of goals (3,)."""
        length = float(np.linalg.norm(difference))
        return f"{100 * length:.1f} cm" if self.is_point else f"{length:.2f}"


@runtime_checkable
class NamesGoals(Protocol):
    """Goals are called otherwise than targets.

    Attributes:
        goal_words: What they are called.
    """

    goal_words: GoalWords


@runtime_checkable
class HasFairGoals(Protocol):
    """Some goals are trivially safe or unsafe; without this protocol, none are."""

    @property
    def fair_box(self) -> np.ndarray:
        """The part of the target box without trivial goals, (2, 3) [m]."""

    def is_fair(self, episode: Episode) -> bool:
        """Whether the verdict on an episode's goal is not trivial."""


@runtime_checkable
class CanFall(Protocol):
    """The robot can fall, which ends a motion.

    Attributes:
        fall_name: The constraint whose violation is a fall.
        watched_features: Features that a conventional monitor thresholds, by quantity; larger
            values are safer.
    """

    fall_name: str
    watched_features: Mapping[str, str]


@runtime_checkable
class HasVisuals(Protocol):
    """The diagram has shapes that only pictures need, and that cost time in each query."""

    def remove_visuals(self, context: Context) -> None:
        """Removes them from the Context of a simulation that is not rendered."""


@runtime_checkable
class HasBall(Protocol):
    """A ball can be thrown at the robot, and recovery can be triggered."""

    def reset_calm(self, context: Context, rng: np.random.Generator) -> None:
        """Samples an undisturbed motion, during which a ball is thrown."""

    def sample_throw(self, rng: np.random.Generator, time_s: float) -> Throw:
        """Samples a ball with a given time of impact [s]."""

    def throw_ball(self, context: Context, throw: Throw, lead_s: float) -> float:
        """Sets a ball in flight towards the robot.

        It hits a robot at rest after ``lead_s`` [s].

        Returns:
            The time of impact, simulation time [s].

        Raises:
            ValueError: The loop was built without its ball.
        """


@runtime_checkable
class CanBePushed(Protocol):
    """Forces can act on the robot's bodies.

    Attributes:
        pushes: Named pushes for single runs.
    """

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
        """Sets whether a guard replaces commands that are not accepted.

        Raises:
            ValueError: The loop was built without a guard.
        """


@runtime_checkable
class OffersPlans(Protocol):
    """There are several plans to choose from in a state.

    Attributes:
        plan_variety: Where a scenario specifies how plans may differ, for messages.
    """

    plan_variety: str

    def candidate_plans(
        self, context: Context, rng: np.random.Generator, num_plans: int
    ) -> list[Any]:
        """Samples plans from the state of a Context, within the distribution of training.

        Returns:
            At most ``num_plans`` arguments for :meth:`set_plan`; the first is the present plan.
        """

    def set_plan(self, context: Context, plan: Any) -> None:
        """Sets one of :meth:`candidate_plans` and keeps the state."""


@runtime_checkable
class CanStartAnywhere(Protocol):
    """Episodes can begin with a given state and plan.

    Attributes:
        plant_state_sizes: n_q and n_v of the port ``plant_state``.
    """

    plant_state_sizes: tuple[int, int]

    def reset_to(
        self, context: Context, rng: np.random.Generator | None, start: EpisodeStart
    ) -> None:
        """Sets plant state and plan; without ``rng`` the initial state is without noise.

        Raises:
            ValueError: The start does not fit the plant.
        """

    def start_of(self, context: Context) -> EpisodeStart:
        """State and plan of a Context, as a start for :meth:`reset_to`."""


@runtime_checkable
class HasStatePlanes(Protocol):
    """The true safe set can be simulated on planes of starts."""

    @property
    def state_planes(self) -> Mapping[str, StatePlane]:
        """The planes, by name of the plan."""


@runtime_checkable
class HasMirrorImage(Protocol):
    """The task has a mirror image."""

    @property
    def mirror_options(self) -> dict[str, Any]:
        """Options of the mirrored diagram; empty without a mirror image."""


_DESCRIPTIONS: dict[type, str] = {
    HasGoals: "plans with a goal",
    HasBall: "a ball to throw",
    CanFall: "a fall",
    CanBePushed: "pushes on its robot",
    FollowsCommands: "commands that change while it moves",
    OffersPlans: "plans to choose from",
    CanStartAnywhere: "episodes from a given start",
    HasStatePlanes: "state planes",
    HasMirrorImage: "a mirror image",
}
"""Descriptions for messages."""


def require(loop: object, capability: type[_Capability], who: str = "") -> _Capability:
    """Returns the loop if it has a capability.

    Args:
        loop: A closed loop.
        capability: A protocol of this module.
        who: Beginning of the message, such as the command that requires it.

    Raises:
        ValueError: The task lacks the capability.
    """
    if isinstance(loop, capability):
        return loop
    present = [text for protocol, text in _DESCRIPTIONS.items() if isinstance(loop, protocol)]
    missing = _DESCRIPTIONS[capability].removeprefix("a ")
    raise ValueError(
        f"{who + ': ' if who else ''}task '{type(loop).__name__}' has no {missing}; "
        f"it has {', '.join(present) or 'no optional features'}"
    )


def judging_options(task: type) -> dict[str, Any]:
    """Options of a task's diagram for evaluation, if they differ from those of training."""
    return dict(task.judging_options) if issubclass(task, PlannedLoop) else {}


def paper_options(task: type) -> dict[str, Any]:
    """Options of a task's diagram for training episodes of the paper's mode."""
    return dict(task.paper_options) if issubclass(task, PlannedLoop) else {}


def pairing_options(scenario: Any, variation: str) -> dict[str, Any]:
    """Options with which a variation and its nominal twin can start alike.

    Args:
        scenario: The scenario.
        variation: The actual plant.
    """
    task = scenario.task_class()
    return task.pairing_options(scenario, variation) if issubclass(task, PlannedLoop) else {}


def remove_visuals(loop: object, context: Context) -> None:
    """Removes from a Context the shapes that only pictures need, if the loop has any.

    Args:
        loop: A closed loop.
        context: The root Context of a simulation that is not rendered.
    """
    if isinstance(loop, HasVisuals):
        loop.remove_visuals(context)


def angular_constraints(loop: object) -> tuple[str, ...]:
    """Constraints of a loop whose margins are angles [rad]; the others are lengths [m]."""
    return tuple(getattr(loop, "angular_constraints", ()))


def monitor_period_s(loop: ClosedLoop) -> float:
    """Sampling period of a loop's port ``safe`` [s]; the control period by default."""
    if isinstance(loop, PlannedLoop):
        return loop.monitor_period_s
    return loop.scenario.control_period_s


def rate_names(loop: ClosedLoop) -> list[str]:
    """States and features of a loop that depend on velocities."""
    if isinstance(loop, PlannedLoop):
        return loop.rate_names
    return [*filter(is_rate, loop.state_names)]


def goal_words(loop: HasGoals) -> GoalWords:
    """What the goals of a loop are called."""
    if isinstance(loop, NamesGoals):
        return loop.goal_words
    return GoalWords() if loop.hand is None else GoalWords(subject=f"the {loop.hand} hand")


def fair_box(loop: HasGoals) -> np.ndarray:
    """The part of a loop's target box without trivial goals, (2, 3) [m]."""
    return loop.fair_box if isinstance(loop, HasFairGoals) else loop.target_box


def is_fair(loop: HasGoals, episode: Episode) -> bool:
    """Whether the verdict on the goal of a loop's episode is not trivial."""
    return loop.is_fair(episode) if isinstance(loop, HasFairGoals) else True


def is_in_box(goal: np.ndarray, box: np.ndarray) -> bool:
    """Whether a goal lies between the lowest and the highest corner of a box, (2, 3) [m]."""
    return bool(np.all((goal >= box[0]) & (goal <= box[1])))
