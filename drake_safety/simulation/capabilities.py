"""What only some tasks can do, a protocol each; users ask by ``isinstance``, or :func:`require`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from pydrake.systems.framework import Context

from drake_safety.control.observation import is_rate

if TYPE_CHECKING:
    from drake_safety.learning.segments import Episode
    from drake_safety.plants.balls import Throw
    from drake_safety.plants.pushes import Push
    from drake_safety.simulation.closed_loop import ClosedLoop
    from drake_safety.simulation.episode_start import EpisodeStart, StatePlane

_Capability = TypeVar("_Capability")


@runtime_checkable
class HasGoals(Protocol):
    """Plans lead to a goal, a point in the world.

    Attributes:
        target_box: Lowest and highest corner of the goals that are drawn, in the world, (2, 3) [m].
        named_targets: Goals that can be asked for by name, in the world, (3,) [m] each.
        hand: The robot's reaching frame that goes to the goal; None for another part of it.
    """

    named_targets: Mapping[str, list[float]]
    hand: str | None

    @property
    def target_box(self) -> np.ndarray:
        """See the class."""

    def reset(
        self, context: Context, rng: np.random.Generator, goal: np.ndarray | None = None
    ) -> int:
        """Samples an initial state and plans the motion to a goal.

        Args:
            context: The diagram's Context; what an earlier episode left is overwritten.
            rng: Source of every draw.
            goal: In the world, (3,) [m], in place of a random one.

        Returns:
            As the reset of every loop.
        """

    def reset_standing(
        self, context: Context, goal: np.ndarray, rng: np.random.Generator | None = None
    ) -> None:
        """Starts at rest in the robot's own posture; its first instant is without noise.

        Args:
            context: The diagram's Context; what an earlier episode left is overwritten.
            goal: In the world, (3,) [m].
            rng: Source of the noise that follows; always the same by default.
        """

    def goal_of(self, episode: Episode) -> np.ndarray:
        """Where the plan of an episode of this loop led to, in the world, (3,) [m].

        Args:
            episode: The episode; one that ended early will do.
        """


@runtime_checkable
class HasFairGoals(Protocol):
    """Of the goals some are trivial or absurd; without this, none are."""

    @property
    def fair_box(self) -> np.ndarray:
        """The part of the target box whose goals are neither, (2, 3) [m]."""

    def is_fair(self, episode: Episode) -> bool:
        """Whether an episode of this loop belongs to the set in which verdicts are not trivial.

        Args:
            episode: The episode.
        """


@runtime_checkable
class CanFall(Protocol):
    """A robot can fall, which ends a motion.

    Attributes:
        fall_name: The constraint whose violation is a fall.
    """

    fall_name: str


@runtime_checkable
class HasBall(Protocol):
    """A ball can be thrown at the robot, and a recovery be triggered.

    Attributes:
        trigger_port: Name of the output port that recovery is triggered by.
    """

    @property
    def trigger_port(self) -> str:
        """See the class."""

    def reset_calm(self, context: Context, rng: np.random.Generator) -> None:
        """Samples a calm motion, during which a ball is thrown.

        Args:
            context: The diagram's Context.
            rng: Source of every draw.
        """

    def sample_throw(self, rng: np.random.Generator, time_s: float) -> Throw:
        """Samples a ball that touches at a given time.

        Args:
            rng: Source of every draw.
            time_s: When it touches [s].
        """

    def throw_ball(self, context: Context, throw: Throw, lead_s: float) -> float:
        """Sets a ball in flight towards the robot.

        Args:
            context: The diagram's Context.
            throw: Mass, speed and direction.
            lead_s: Time from now until the ball touches the robot, were it to stay still [s].

        Returns:
            When the ball touches, simulation time [s].

        Raises:
            ValueError: The loop was built without its ball.
        """


@runtime_checkable
class CanBePushed(Protocol):
    """Forces can act on the robot's bodies.

    Attributes:
        pushes: Pushes that a run can be disturbed with, by name.
    """

    pushes: Mapping[str, Push]

    def set_push(self, context: Context, push: Push) -> None:
        """Plans a push on the robot in a run that was reset.

        Args:
            context: The diagram's Context.
            push: Where, how hard, when.
        """

    def sample_push(self, rng: np.random.Generator) -> Push:
        """A random push on the robot.

        Args:
            rng: Source of every draw.
        """


@runtime_checkable
class OffersPlans(Protocol):
    """From a state there are several plans to choose from.

    Attributes:
        plan_variety: Where a scenario says how plans may differ.
    """

    plan_variety: str

    def candidate_plans(
        self, context: Context, rng: np.random.Generator, num_plans: int
    ) -> list[Any]:
        """Plans from the state of a Context that would do.

        They stay inside what the scenario's training covers, or Γ could not judge them.

        Args:
            context: The diagram's Context, with a plan.
            rng: Source of the others.
            num_plans: How many at most.

        Returns:
            What :meth:`set_plan` takes; the first is the plan that the Context has.
        """

    def set_plan(self, context: Context, plan: Any) -> None:
        """Sets a plan in place of the one that the Context has; the state stays as it is.

        Args:
            context: The diagram's Context.
            plan: One of :meth:`candidate_plans`.
        """


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
        """Begins with a given plant state and plan.

        Args:
            context: The diagram's Context; what an earlier episode left is overwritten.
            rng: Source of the noise that follows; None takes the noise out of this instant.
            start: Where and how it begins.

        Raises:
            ValueError: The start does not fit the plant.
        """

    def start_of(self, context: Context) -> EpisodeStart:
        """What an episode that goes on from here begins with; see :meth:`reset_to`.

        Args:
            context: The diagram's Context.
        """


@runtime_checkable
class HasStatePlanes(Protocol):
    """There are planes of starts on which the true safe set can be simulated."""

    @property
    def state_planes(self) -> Mapping[str, StatePlane]:
        """The planes, by name of the plan."""


@runtime_checkable
class HasMirrorImage(Protocol):
    """The task can be done on the other side."""

    @property
    def mirror_options(self) -> dict[str, Any]:
        """Options of the diagram that is this one in the mirror; empty where there is none."""


@runtime_checkable
class HasAngularMargins(Protocol):
    """Some margins are angles [rad]; those of all other constraints are lengths [m].

    Attributes:
        angular_constraints: The constraints of which that is so.
    """

    angular_constraints: tuple[str, ...]


@runtime_checkable
class HasWatchedFeatures(Protocol):
    """There are features that one would set an alarm on by hand.

    Attributes:
        watched_features: Features by what they measure; larger is safer.
    """

    watched_features: Mapping[str, str]


@runtime_checkable
class HasRates(Protocol):
    """Some features are made of velocities.

    Attributes:
        rate_names: States and features that are.
    """

    @property
    def rate_names(self) -> list[str]:
        """See the class."""


@runtime_checkable
class CountsFailures(Protocol):
    """A controller can be without a command of its own."""

    def num_controller_failures(self, context: Context) -> int:
        """How often that was so since the episode began.

        Args:
            context: The diagram's Context.
        """


@runtime_checkable
class HasJudgingOptions(Protocol):
    """Verdicts are judged with another diagram than episodes are learned from.

    Attributes:
        judging_options: Options of that diagram, of the task's class.
    """

    judging_options: Mapping[str, Any]


@runtime_checkable
class HasPairingOptions(Protocol):
    """A variation and its nominal twin take options to begin alike; of the task's class."""

    def pairing_options(self, scenario: Any, variation: str) -> dict[str, Any]:
        """Options of the diagrams of both.

        Args:
            scenario: The scenario.
            variation: Which plant is the actual one.
        """


@runtime_checkable
class CompletesParameters(Protocol):
    """Defaults of parameters depend on the robot; a method of the task's class."""

    def complete_parameters(self, robot: str, stated: dict[str, Any]) -> dict[str, Any]:
        """What the scenario file says of the task's parameters, with defaults that it asks for.

        Args:
            robot: The scenario's robot.
            stated: What stands in the file.
        """


_WORDS: dict[type, str] = {
    HasGoals: "plans with a goal",
    HasBall: "a ball to throw",
    CanFall: "a fall",
    CanBePushed: "pushes on its robot",
    OffersPlans: "plans to choose from",
    CanStartAnywhere: "episodes from a given start",
    HasStatePlanes: "state planes",
    HasMirrorImage: "a mirror image",
}
"""What a user can ask a task for."""


def require(loop: object, capability: type[_Capability], who: str = "") -> _Capability:
    """The loop itself, for what only some tasks can do.

    Args:
        loop: A closed loop.
        capability: A protocol of this module.
        who: Who asks, with what should be done where the task cannot; begins the message.

    Raises:
        ValueError: The task has no such thing; it is said what it has.
    """
    if isinstance(loop, capability):
        return loop
    has = [word for protocol, word in _WORDS.items() if isinstance(loop, protocol)]
    lacked = _WORDS[capability].removeprefix("a ")
    raise ValueError(
        f"{who + ': ' if who else ''}task '{type(loop).__name__}' has no {lacked}; "
        f"it has {', '.join(has) or 'nothing that only some tasks have'}"
    )


def judging_options(task: type) -> dict[str, Any]:
    """Options of the diagram that verdicts are judged with, where they are not the training's.

    Args:
        task: The task's class.
    """
    return dict(task.judging_options) if isinstance(task, HasJudgingOptions) else {}


def pairing_options(scenario: Any, variation: str) -> dict[str, Any]:
    """Options of the diagram with which a variation and its nominal twin begin alike.

    Args:
        scenario: The scenario.
        variation: Which plant is the actual one.
    """
    task = scenario.task_class()
    if isinstance(task, HasPairingOptions):
        return task.pairing_options(scenario, variation)
    return {}


def angular_constraints(loop: object) -> tuple[str, ...]:
    """Constraints of a loop whose margins are angles [rad]; those of all others are lengths [m]."""
    return loop.angular_constraints if isinstance(loop, HasAngularMargins) else ()


def rate_names(loop: ClosedLoop) -> list[str]:
    """States and features of a loop that are made of velocities, as far as the task says."""
    return loop.rate_names if isinstance(loop, HasRates) else [*filter(is_rate, loop.state_names)]


def fair_box(loop: HasGoals) -> np.ndarray:
    """The part of a loop's target box whose goals are neither trivial nor absurd, (2, 3) [m]."""
    return loop.fair_box if isinstance(loop, HasFairGoals) else loop.target_box


def is_fair(loop: HasGoals, episode: Episode) -> bool:
    """Whether an episode of a loop belongs to the set in which verdicts are not trivial."""
    return loop.is_fair(episode) if isinstance(loop, HasFairGoals) else True


def is_in_box(goal: np.ndarray, box: np.ndarray) -> bool:
    """Whether a goal lies between the lowest and the highest corner of a box, (2, 3) [m]."""
    return bool(np.all((goal >= box[0]) & (goal <= box[1])))
