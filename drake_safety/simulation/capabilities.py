"""What only some tasks can do, a protocol each; users ask by ``isinstance``, or :func:`require`.

Throughout, ``context`` is the diagram's root Context, of which a reset overwrites what an earlier
episode left, ``rng`` the source of every draw, and ``episode`` one of the loop's own.
"""

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
        named_targets: Goals that can be asked for by name, in the world, (3,) [m] each.
        hand: The robot's reaching frame that goes to the goal; None for another part of it.
    """

    named_targets: Mapping[str, list[float]]
    hand: str | None

    @property
    def target_box(self) -> np.ndarray:
        """Lowest and highest corner of the goals that are drawn, in the world, (2, 3) [m]."""

    def reset(
        self, context: Context, rng: np.random.Generator, goal: np.ndarray | None = None
    ) -> int:
        """As the reset of every loop; ``goal`` (3,) [m], in the world, replaces a random one."""

    def reset_standing(
        self, context: Context, goal: np.ndarray, rng: np.random.Generator | None = None
    ) -> None:
        """Starts at rest in the robot's own posture towards a goal (3,) [m] in the world.

        The first instant is without noise; that which follows is always the same by default.
        """

    def goal_of(self, episode: Episode) -> np.ndarray:
        """Where the plan of an episode of this loop led to, in the world, (3,) [m]."""


@runtime_checkable
class HasFairGoals(Protocol):
    """Of the goals some are trivial or absurd; without this, none are."""

    @property
    def fair_box(self) -> np.ndarray:
        """The part of the target box whose goals are neither, (2, 3) [m]."""

    def is_fair(self, episode: Episode) -> bool:
        """Whether an episode of this loop belongs to the set in which verdicts are not trivial."""


@runtime_checkable
class CanFall(Protocol):
    """A robot can fall, which ends a motion and violates the constraint ``fall_name``."""

    fall_name: str


@runtime_checkable
class HasBall(Protocol):
    """A ball can be thrown at the robot, and a recovery be triggered."""

    @property
    def trigger_port(self) -> str:
        """Name of the output port that recovery is triggered by."""

    def reset_calm(self, context: Context, rng: np.random.Generator) -> None:
        """Samples a calm motion, during which a ball is thrown."""

    def sample_throw(self, rng: np.random.Generator, time_s: float) -> Throw:
        """Samples a ball that touches at a given time [s]."""

    def throw_ball(self, context: Context, throw: Throw, lead_s: float) -> float:
        """Sets a ball in flight towards the robot.

        It touches, were the robot to stay still, ``lead_s`` [s] from now.

        Returns:
            When it touches, simulation time [s].

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
        """Plans a push on the robot in a run that was reset."""

    def sample_push(self, rng: np.random.Generator) -> Push:
        """A random push on the robot."""


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

        Returns:
            At most ``num_plans`` of what :meth:`set_plan` takes; the first is the plan that the
            Context has.
        """

    def set_plan(self, context: Context, plan: Any) -> None:
        """Sets one of :meth:`candidate_plans`; the state stays as it is."""


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
        """Begins with a given plant state and plan; no ``rng``: no noise in this instant.

        Raises:
            ValueError: The start does not fit the plant.
        """

    def start_of(self, context: Context) -> EpisodeStart:
        """What an episode that goes on from here begins with; see :meth:`reset_to`."""


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
    """Margins of ``angular_constraints`` are angles [rad]; those of all others lengths [m]."""

    angular_constraints: tuple[str, ...]


@runtime_checkable
class HasWatchedFeatures(Protocol):
    """One would set an alarm on features by hand: by what they measure; larger is safer."""

    watched_features: Mapping[str, str]


@runtime_checkable
class HasRates(Protocol):
    """Some features are made of velocities."""

    @property
    def rate_names(self) -> list[str]:
        """States and features that are."""


@runtime_checkable
class HasMonitorPeriod(Protocol):
    """Whether the state is safe is looked at with a period of its own.

    Attributes:
        monitor_period_s: Time between two looks [s].
    """

    monitor_period_s: float


@runtime_checkable
class CountsFailures(Protocol):
    """A controller can be without a command of its own."""

    def num_controller_failures(self, context: Context) -> int:
        """How often that was so since the episode began."""


@runtime_checkable
class HasJudgingOptions(Protocol):
    """Verdicts are judged with other options of the diagram than training's; of the class."""

    judging_options: Mapping[str, Any]


@runtime_checkable
class HasPairingOptions(Protocol):
    """A variation and its nominal twin take options to begin alike; of the task's class."""

    def pairing_options(self, scenario: Any, variation: str) -> dict[str, Any]:
        """Options of the diagrams of both; ``variation`` is the actual one's."""


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


def monitor_period_s(loop: ClosedLoop) -> float:
    """Time between two looks at whether a loop's state is safe; the control period by default."""
    if isinstance(loop, HasMonitorPeriod):
        return loop.monitor_period_s
    return loop.scenario.control_period_s


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
