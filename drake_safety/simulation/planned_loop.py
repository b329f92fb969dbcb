"""PlannedLoop: what tasks share whose robot follows a plan of points and stays in a safe set."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Protocol

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem, OutputPort
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.robots.robot import PlantVariation
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.systems.plan_features import FeatureMap, PlanFeatures
from drake_safety.systems.safety_monitor import SafeSet, SafetyMonitor
from drake_safety.systems.trajectory_planner import TrajectoryPlanner

if TYPE_CHECKING:
    from drake_safety.systems.safety_assessor import SafetyAssessor


class WatchedSet(SafeSet, FeatureMap, Protocol):
    """A safe set with features."""


class PlannedLoop(ClosedLoop):
    """A closed loop with a planner, a monitor and features of its plan.

    A subclass wires in this order: :meth:`_add_planner`, its controller, :meth:`_add_safe_set`,
    the names of state and output, :meth:`_export`, :meth:`finish`. It says in :meth:`_set_state`
    how a start becomes the plant's state. Its episodes can then begin with a given start.

    Attributes:
        plant_state_sizes: n_q and n_v.
    """

    def _check_variation(self, *varied: str) -> None:
        """Refuses a variation that changes more of a plant of the task's own than ``varied``."""
        for entry in fields(PlantVariation):
            is_plain = getattr(self.variation, entry.name) == getattr(PlantVariation(), entry.name)
            if not is_plain and entry.name not in varied:
                raise ValueError(
                    f"{type(self).__name__.lower()}: variation '{self.variation_name}' sets "
                    f"{entry.name}, which this plant has not; it has {list(varied)}"
                )

    def _add_planner(
        self, builder: DiagramBuilder, *, outlook_s: float, num_outlook: int
    ) -> TrajectoryPlanner:
        """Adds the planner; features look ``outlook_s`` [s] ahead, at ``num_outlook`` instants."""
        scenario = self.scenario
        self._num_outlook = num_outlook
        self._planner: TrajectoryPlanner = builder.AddNamedSystem(
            "trajectory_planner",
            TrajectoryPlanner(
                horizon=scenario.assessment.horizon,
                step_s=scenario.step_s,
                outlook_s=outlook_s,
                num_outlook=num_outlook,
            ),
        )
        return self._planner

    def _connect_controller(
        self, builder: DiagramBuilder, controller: LeafSystem, measured_state: OutputPort
    ) -> None:
        """Connects a controller that follows the planner's point."""
        builder.Connect(measured_state, controller.GetInputPort("plant_state"))
        for name in ("desired_output", "desired_output_rate"):
            builder.Connect(self._planner.GetOutputPort(name), controller.GetInputPort(name))

    def _add_safe_set(
        self,
        builder: DiagramBuilder,
        safe_set: WatchedSet,
        sizes: tuple[int, int],
        *,
        plant_state: OutputPort,
        seen_state: OutputPort | None = None,
        outlook: OutputPort | None = None,
    ) -> None:
        """Adds monitor and features, and sets the names of what they say.

        Args:
            builder: Of the task's diagram.
            safe_set: The safe set.
            sizes: n_q and n_v.
            plant_state: The true state, which the monitor looks at, ``[q; v]``.
            seen_state: What the features see of it, as the assessor does; all by default.
            outlook: The plan that the features look at; the planner's by default.
        """
        self.plant_state_sizes = sizes
        self._plant_state = plant_state
        self._monitor = builder.AddNamedSystem("safety_monitor", SafetyMonitor(safe_set, *sizes))
        builder.Connect(plant_state, self._monitor.GetInputPort("plant_state"))
        self._features = builder.AddNamedSystem(
            "plan_features", PlanFeatures(safe_set, *sizes, horizon=self._num_outlook)
        )
        builder.Connect(seen_state or plant_state, self._features.GetInputPort("plant_state"))
        # The features see the whole plan: where it ends decides, and H steps do not reach it.
        outlook = outlook or self._planner.GetOutputPort("desired_outlook")
        builder.Connect(outlook, self._features.GetInputPort("desired_preview"))
        self.feature_names = self._features.feature_names
        self.constraint_names = self._monitor.constraint_names

    def _export(
        self,
        builder: DiagramBuilder,
        *,
        assessment_period_s: float,
        state: OutputPort,
        true_state: OutputPort | None = None,
        output: OutputPort,
        desired_output: OutputPort | None = None,
        desired_preview: OutputPort | None = None,
    ) -> SafetyAssessor | None:
        """Adds the assessor, if there is Γ, and exports the contract's ports and ``plant_state``.

        Args:
            builder: Of the task's diagram.
            assessment_period_s: Time between two evaluations of Γ [s].
            state: See the table of :class:`ClosedLoop`, as for all that follow.
            true_state: Without noise; there is none by default.
            output: As it is measured.
            desired_output: As the controller follows it; the planner's by default.
            desired_preview: What is to come of it as the assessor sees it; by default as planned.

        Returns:
            The assessor; None without Γ.
        """
        features = self._features.GetOutputPort("features")
        desired_preview = desired_preview or self._planner.GetOutputPort("desired_preview")
        assessor = self.add_assessor(
            builder,
            period_s=assessment_period_s,
            state=state,
            desired_preview=desired_preview,
            features=features,
        )
        for name, port in {
            "state": state,
            "true_state": true_state or state,
            "output": output,
            "desired_output": desired_output or self._planner.GetOutputPort("desired_output"),
            "desired_preview": desired_preview,
            "features": features,
            "margins": self._monitor.GetOutputPort("margins"),
            "safe": self._monitor.GetOutputPort("safe"),
            "plant_state": self._plant_state,
        }.items():
            builder.ExportOutput(port, name)
        return assessor

    def finish(self, builder: DiagramBuilder) -> None:
        """Builds the diagram and checks that its ports keep the contract."""
        super().finish(builder)
        self._default = self.CreateDefaultContext()

    def reset_to(
        self, context: Context, rng: np.random.Generator | None, start: EpisodeStart
    ) -> None:
        """Begins with a given plant state and plan; see `CanStartAnywhere`."""
        del rng  # There is no noise.
        start.check(f"start of task '{type(self).__name__}'", *self.plant_state_sizes)
        self._enter(context, start)

    def start_of(self, context: Context) -> EpisodeStart:
        """What an episode that goes on from here begins with."""
        q, v = np.split(
            self.GetOutputPort("plant_state").Eval(context), [self.plant_state_sizes[0]]
        )
        plan = self._planner.plan_from_now(self._planner.GetMyContextFromRoot(context))
        return EpisodeStart(q=q, v=v, plan=plan)

    def set_plan(self, context: Context, plan: PiecewisePolynomial) -> None:
        """Sets a plan in place of the one that the Context has; the state stays as it is.

        Args:
            context: The diagram's Context.
            plan: Desired output over simulation time, in the stance frame, (n_z, 1) [m].
        """
        self._planner.set_plan(self._planner.GetMyMutableContextFromRoot(context), plan)

    def _plan_of(self, context: Context) -> PiecewisePolynomial:
        return self._planner.get_plan(self._planner.GetMyContextFromRoot(context))

    def _enter(self, context: Context, start: EpisodeStart) -> None:
        # The state alone: parameters such as an assessor's beliefs are not an episode's to forget.
        context.SetTime(0.0)
        context.get_mutable_discrete_state().SetFrom(self._default.get_discrete_state())
        self._set_state(context, start)
        self._planner.set_plan(
            self._planner.GetMyMutableContextFromRoot(context), start.plan, self._stance_of(start)
        )

    def _set_state(self, context: Context, start: EpisodeStart) -> None:
        """Writes what a start says of the plant, and of the task's controller, into a Context."""
        raise NotImplementedError

    def _stance_of(self, start: EpisodeStart) -> np.ndarray:
        """The frame of a start's plan, [x, y, yaw] in the world (3,) [m, rad]."""
        del start
        return np.zeros(3)
