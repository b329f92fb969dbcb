"""ClosedLoop: the contract between a task's diagram and everything that runs or judges it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort

from drake_safety.control.observation import is_rate
from drake_safety.simulation.contract import (
    ASSESSMENT_PORTS,
    RECORDED_PORTS,
    REQUIRED_PORTS,
    check_ports,
)
from drake_safety.simulation.view import View
from drake_safety.systems.float_system import FloatSystem

if TYPE_CHECKING:
    from drake_safety.learning.assessment import SafetyAssessment
    from drake_safety.learning.segments import Episode
    from drake_safety.plants.balls import Throw
    from drake_safety.plants.pushes import Push
    from drake_safety.simulation.episode_start import EpisodeStart
    from drake_safety.simulation.scenario import Scenario
    from drake_safety.simulation.state_plane import StatePlane
    from drake_safety.systems.safety_assessor import SafetyAssessor

__all__ = ["ASSESSMENT_PORTS", "RECORDED_PORTS", "REQUIRED_PORTS", "ClosedLoop"]


class ClosedLoop(FloatSystem, Diagram):
    """A task's diagram: plant, controller, planner, monitor, and the assessor when there is Γ.

    Whoever runs, records or judges episodes uses only what this class promises: the output ports
    below, :meth:`reset`, and the names of what the ports carry. Throws and pictures also use the
    plant: ``plant``, ``robot``, ``robot_instance``, ``kinematics``, ``fall_name`` and
    ``trigger_port``, which a task with a ball provides. A task whose plans have a goal, a point
    in the world, announces it by :attr:`target_box`; its ``reset`` then takes a goal, and it
    overrides :meth:`goal_of` and :meth:`reset_standing`; :attr:`fair_box`, :meth:`is_fair`,
    :attr:`mirror_options`, :attr:`hand`, :attr:`named_targets`, :attr:`pushes` and, with them,
    :meth:`set_push` and :meth:`sample_push` where they say something of it. A subclass wires its
    systems in ``__init__``, calls :meth:`check_assessment` before it wires one, and ends with
    :meth:`finish`.

    ====================== ======= ============================================================
    output port            size    meaning
    ====================== ======= ============================================================
    ``state``              n_s     s_k as the assessor sees it, in the stance frame
    ``true_state``         n_s     s_k without observation noise
    ``output``             n_z     z_k, measured, in the world [m]
    ``desired_output``     n_z     z*_k, in the world [m]
    ``desired_preview``    H n_z   z*_{k:k+H}, row-major in time, in the stance frame [m]
    ``features``           n_f     the safe set's features of state and preview
    ``margins``            n_c     signed margins of the safe set, negative = violated
    ``safe``               1       1 while the state is inside the safe set
    ``safety_probability`` 1       Γ, with an assessment (also ``normalized_…``)
    ``belief``             3       (safe, unsafe, unknown), with an assessment
    ``recovery_active``    1       1 during a recovery step, with recovery
    ====================== ======= ============================================================

    Args:
        scenario: The scenario.
        variation: Name of the plant variation.
        assessment: Γ, or None.

    Attributes:
        state_names, output_names, feature_names, constraint_names: What the ports carry.
    """

    Parameters: type
    """Schema of the task's own part of the scenario file."""

    online_parameters: tuple[str, ...] = ()
    """Parameters that no recorded episode depends on; the scenario's hash leaves them out."""

    judging_options: Mapping[str, Any] = {}
    """Options of the diagram that verdicts are judged with, where they are not the training's."""

    plan_variety = "the task decides which plans there are"
    """Where a scenario says how plans may differ."""

    state_names: list[str]
    output_names: list[str]
    feature_names: list[str]
    constraint_names: list[str]

    hand: str | None = None
    """The robot's reaching frame that goes to the goal, for tasks with such plans."""
    angular_constraints: tuple[str, ...] = ()
    """Constraints whose margins are angles [rad]; those of all others are lengths [m]."""
    view: View = View()
    """Where pictures are taken from."""
    named_targets: Mapping[str, list[float]] = {}
    """Goals that can be asked for by name, in the world, (3,) [m] each."""
    pushes: Mapping[str, Push] = {}
    """Pushes that a run can be disturbed with, by name."""
    watched_features: Mapping[str, str] = {}
    """Features that one would set an alarm on by hand, by what they measure; larger is safer."""

    def __init__(self, scenario: Scenario, variation: str, assessment: SafetyAssessment | None):
        super().__init__()
        self.scenario = scenario
        self.variation_name = variation
        self.variation = scenario.variation(variation)
        self.assessment = assessment

    def finish(self, builder: DiagramBuilder) -> None:
        """Builds the diagram and checks that its ports keep the contract.

        Raises:
            ValueError: A promised port is missing, or has another size than its names promise.
        """
        builder.BuildInto(self)
        for finding in check_ports(self):
            if not finding.is_ok:
                raise ValueError(finding.message)

    def check_assessment(self) -> None:
        """Refuses an assessment that was learned from something else.

        To be called when the names of what the ports carry are set, before the assessment is wired.

        Raises:
            ValueError: Both sides are named.
        """
        if self.assessment is None:
            return
        info, scenario = self.assessment.info_, self.scenario
        sides = {
            "scenario": (info.scenario, scenario.name),
            "horizon": (info.horizon, scenario.assessment.horizon),
            "step_s": (info.step_s, scenario.step_s),
            "state": (list(info.state_names), list(self.state_names)),
            "output": (list(info.output_names), list(self.output_names)),
            "features": (list(info.feature_names), list(self.feature_names)),
            "constraints": (list(info.constraint_names), list(self.constraint_names)),
            "scenario hash": (info.scenario_hash, scenario.simulation_hash(info.variation)),
        }
        for what, (learned, here) in sides.items():
            if learned != here:
                raise ValueError(
                    f"assessment and diagram differ in {what}: the assessment was learned with "
                    f"{learned}, the diagram has {here}"
                )

    def add_assessor(
        self,
        builder: DiagramBuilder,
        *,
        period_s: float,
        state: OutputPort,
        desired_preview: OutputPort,
        features: OutputPort,
    ) -> SafetyAssessor | None:
        """Adds the assessor, if there is Γ, and exports what it says.

        To be called when the names of what the ports carry are set.

        Args:
            builder: Of the task's diagram.
            period_s: Time between two of its looks [s].
            state: As it sees it.
            desired_preview: The coming desired outputs.
            features: As it sees them.

        Returns:
            The assessor; None without Γ.

        Raises:
            ValueError: The assessment was learned from something else.
        """
        if self.assessment is None:
            return None
        from drake_safety.systems.safety_assessor import SafetyAssessor

        self.check_assessment()
        assessor = builder.AddNamedSystem(
            "safety_assessor", SafetyAssessor(self.assessment, period_s=period_s)
        )
        inputs = {"state": state, "desired_preview": desired_preview, "features": features}
        for name, port in inputs.items():
            builder.Connect(port, assessor.GetInputPort(name))
        for i in range(assessor.num_output_ports()):
            port = assessor.get_output_port(i)
            builder.ExportOutput(port, port.get_name())
        return assessor

    @property
    def target_box(self) -> np.ndarray | None:
        """Lowest and highest corner of the goals that are drawn, in the world, (2, 3) [m].

        None for a task whose plans have no goal.
        """
        return None

    @property
    def fair_box(self) -> np.ndarray | None:
        """The part of the target box whose goals are neither trivial nor absurd, (2, 3) [m]."""
        return self.target_box

    @property
    def mirror_options(self) -> dict[str, Any]:
        """Options of the diagram that is this one in the mirror; empty where there is none."""
        return {}

    @property
    def state_planes(self) -> Mapping[str, StatePlane]:
        """Planes of starts on which the true safe set can be simulated, by name of the plan.

        Empty for tasks whose state is more than two numbers that matter.
        """
        return {}

    def goal_of(self, episode: Episode) -> np.ndarray:
        """Where the plan of an episode of this loop led to, in the world, (3,) [m].

        Args:
            episode: The episode; one that ended early will do.
        """
        raise ValueError(f"task '{type(self).__name__}' has plans without a goal")

    def is_fair(self, episode: Episode) -> bool:
        """Whether an episode of this loop belongs to the set in which verdicts are not trivial.

        Args:
            episode: The episode.
        """
        goal, box = self.goal_of(episode), self.fair_box
        return box is None or bool(np.all((goal >= box[0]) & (goal <= box[1])))

    @property
    def monitor_period_s(self) -> float:
        """Time between two looks at the safe set's margins [s]."""
        return self.scenario.control_period_s

    def num_controller_failures(self, context: Context) -> int:
        """How often a controller had no command of its own since the episode began.

        Args:
            context: The diagram's Context.
        """
        del context
        return 0

    @classmethod
    def complete_parameters(cls, robot: str, stated: dict[str, Any]) -> dict[str, Any]:
        """What the scenario file says of the task's parameters, with defaults that it asks for.

        Args:
            robot: The scenario's robot.
            stated: What stands in the file.
        """
        del robot
        return stated

    @classmethod
    def pairing_options(cls, scenario: Scenario, variation: str) -> dict[str, Any]:
        """Options of the diagram with which a variation and its nominal twin begin alike.

        Args:
            scenario: The scenario.
            variation: Which plant is the actual one.
        """
        del scenario, variation
        return {}

    @classmethod
    def model_files(cls, scenario: Scenario) -> list[Path]:
        """Files besides the scenario that decide what the plant is; part of its hash."""
        del scenario
        return []

    def reset(
        self, context: Context, rng: np.random.Generator, goal: np.ndarray | None = None
    ) -> int:
        """Samples an initial state and a plan into the root Context.

        Args:
            context: The diagram's Context; what an earlier episode left is overwritten.
            rng: Source of every draw.
            goal: Where the plan shall lead, in place of a random goal; a task whose plans have
                no goal of their own leaves this argument out.

        Returns:
            The first step whose future is undisturbed: 0, or later when the episode begins
            with a push.
        """
        raise TypeError(f"task '{type(self).__name__}' must override reset")

    def reset_to(
        self, context: Context, rng: np.random.Generator | None, start: EpisodeStart
    ) -> None:
        """Begins with a given plant state and plan; tasks with a robot override this.

        Args:
            context: The diagram's Context; what an earlier episode left is overwritten.
            rng: Source of the noise that follows; None takes the noise out of this instant.
            start: Where and how it begins.

        Raises:
            ValueError: The start does not fit the robot.
        """
        raise ValueError(f"task '{type(self).__name__}' cannot begin with a given start")

    def start_of(self, context: Context) -> EpisodeStart:
        """What an episode that goes on from here begins with; see :meth:`reset_to`.

        Args:
            context: The diagram's Context.
        """
        raise ValueError(f"task '{type(self).__name__}' cannot begin with a given start")

    def standing_start(self) -> EpisodeStart:
        """At rest in the robot's posture, which the plan keeps; tasks with robots override it."""
        raise ValueError(f"task '{type(self).__name__}' has no posture to stand in")

    def reset_standing(
        self, context: Context, goal: np.ndarray, rng: np.random.Generator | None = None
    ) -> None:
        """Starts at rest in the robot's own posture; tasks whose plans have a goal override this.

        What the assessor sees of the first instant is without noise.

        Args:
            context: The diagram's Context; what an earlier episode left is overwritten.
            goal: Where the plan shall lead, in the world, (3,) [m].
            rng: Source of the noise that follows; always the same by default.
        """
        raise ValueError(f"task '{type(self).__name__}' has plans without a goal")

    def set_push(self, context: Context, push: Push) -> None:
        """Plans a push on the robot in a run that was reset; tasks with pushes override this.

        Args:
            context: The diagram's Context.
            push: Where, how hard, when.
        """
        raise ValueError(f"task '{type(self).__name__}' cannot push its robot's bodies")

    def sample_push(self, rng: np.random.Generator) -> Push:
        """A random push on the robot; tasks with pushes override this.

        Args:
            rng: Source of every draw.
        """
        raise ValueError(f"task '{type(self).__name__}' cannot push its robot's bodies")

    @property
    def rate_names(self) -> list[str]:
        """States and features that are made of velocities; tasks may name more."""
        return [name for name in self.state_names if is_rate(name)]

    def candidate_plans(
        self, context: Context, rng: np.random.Generator, num_plans: int
    ) -> list[Any]:
        """Plans from the state of a Context that would do; tasks that offer some override this.

        They stay inside what the scenario's training covers, or Γ could not judge them.

        Args:
            context: The diagram's Context, with a plan.
            rng: Source of the others.
            num_plans: How many at most.

        Returns:
            What :meth:`set_plan` takes; the first is the plan that the Context has.
        """
        raise ValueError(f"task '{type(self).__name__}' offers no plans to choose from")

    def set_plan(self, context: Context, plan: Any) -> None:
        """Sets a plan in place of the one that the Context has; the state stays as it is.

        Args:
            context: The diagram's Context.
            plan: One of :meth:`candidate_plans`.
        """
        raise ValueError(f"task '{type(self).__name__}' offers no plans to choose from")

    def reset_calm(self, context: Context, rng: np.random.Generator) -> None:
        """Samples a calm motion, during which a ball is thrown; tasks with a ball override this.

        Args:
            context: The diagram's Context.
            rng: Source of every draw.
        """
        raise ValueError(f"task '{type(self).__name__}' has no calm motion to throw a ball at")

    def sample_throw(self, rng: np.random.Generator, time_s: float) -> Throw:
        """Samples a ball that touches at a given time; tasks with a ball override this.

        Args:
            rng: Source of every draw.
            time_s: When it touches [s].
        """
        raise ValueError(f"task '{type(self).__name__}' has no ball to throw")

    def throw_ball(self, context: Context, throw: Throw, lead_s: float) -> float:
        """Sets a ball in flight towards the robot; tasks with a ball override this.

        Args:
            context: The diagram's Context.
            throw: Mass, speed and direction.
            lead_s: Time from now until the ball touches the robot, were it to stay still [s].

        Returns:
            When the ball touches, simulation time [s].

        Raises:
            ValueError: The task was built without a ball.
        """
        raise ValueError(f"task '{type(self).__name__}' has no ball to throw")
