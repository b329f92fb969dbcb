"""PlannedLoop: base of tasks that follow a plan of points within a safe set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from functools import cached_property
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem, OutputPort
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.robots.robot import PlantVariation
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.systems.monitored_assessor import MonitoredSafetyAssessor
from drake_safety.systems.plan_features import PlanFeatures
from drake_safety.systems.safety_monitor import FeaturedSafeSet, SafetyMonitor
from drake_safety.systems.trajectory_planner import TrajectoryPlanner


class PlannedLoop(ClosedLoop):
    """A closed loop with a planner, a monitor and features of its plan.

    A subclass calls in this order: :meth:`_add_planner`, adds its controller,
    :meth:`_add_monitor` and :meth:`_add_features`, sets the names of state and output,
    :meth:`export`, and ``builder.BuildInto(self)``. It implements :meth:`_set_state`, which sets
    the plant's state. Episodes can then begin with a given start.
    """

    def _check_variation(self, *varied: str) -> None:
        """Checks that a variation of a task's own plant changes only the entries ``varied``."""
        found, plain = self._plant_variation, PlantVariation()
        for name in (entry.name for entry in fields(PlantVariation)):
            if name not in varied and getattr(found, name) != getattr(plain, name):
                raise ValueError(
                    f"{type(self).__name__.lower()}: variation '{self.variation}' sets "
                    f"{name}; entries of this plant are {list(varied)}"
                )

    def _add_planner(
        self, builder: DiagramBuilder, *, outlook_s: float, num_outlook: int
    ) -> TrajectoryPlanner:
        """Adds the planner; its outlook has ``num_outlook`` samples over ``outlook_s`` [s]."""
        scenario = self.scenario
        self._num_outlook = num_outlook
        self._planner: TrajectoryPlanner = builder.AddNamedSystem(
            "trajectory_planner",
            TrajectoryPlanner(
                horizon=scenario.assessment.horizon,
                step_s=scenario.preview_step_s,
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

    def _add_features(self, builder: DiagramBuilder, safe_set: FeaturedSafeSet) -> None:
        """Adds the features of a monitored state that is measured exactly."""
        sizes = self.plant_state_sizes
        features = builder.AddNamedSystem(
            "plan_features", PlanFeatures(safe_set, *sizes, horizon=self._num_outlook)
        )
        builder.Connect(self._plant_state, features.GetInputPort("plant_state"))
        # The features cover the whole plan: safety depends on its end, beyond the H steps.
        outlook = self._planner.GetOutputPort("desired_outlook")
        builder.Connect(outlook, features.GetInputPort("desired_preview"))
        self._seen = {
            "features": features.GetOutputPort("features"),
            "margins": self._monitor.GetOutputPort("margins"),
        }
        self.feature_names = features.feature_names

    def _add_monitor(
        self,
        builder: DiagramBuilder,
        safe_set: FeaturedSafeSet,
        sizes: tuple[int, int],
        plant_state: OutputPort,
    ) -> None:
        """Adds the monitor of the true state."""
        self.plant_state_sizes, self._plant_state = sizes, plant_state
        self._monitor = builder.AddNamedSystem("safety_monitor", SafetyMonitor(safe_set, *sizes))
        builder.Connect(plant_state, self._monitor.GetInputPort("plant_state"))
        self.constraint_names = self._monitor.constraint_names

    def export(
        self, builder: DiagramBuilder, ports: Mapping[str, OutputPort], **options: Any
    ) -> MonitoredSafetyAssessor | None:
        """Exports ports, and those of planner and monitor; see :meth:`ClosedLoop.export`."""
        ports = {
            "true_state": ports["state"],
            "desired_output": self._planner.GetOutputPort("desired_output"),
            "desired_preview": self._planner.GetOutputPort("desired_preview"),
            "features": self._seen["features"],
            "margins": self._monitor.GetOutputPort("margins"),
            "safe": self._monitor.GetOutputPort("safe"),
            "plant_state": self._plant_state,
            **ports,
        }
        return super().export(builder, ports, margins=self._seen["margins"], **options)

    @cached_property
    def _default(self) -> Context:
        return self.CreateDefaultContext()

    def reset_to(
        self, context: Context, rng: np.random.Generator | None, start: EpisodeStart
    ) -> None:
        """Sets plant state and plan; see `CanStartAnywhere`."""
        del rng  # There is no noise.
        start.check(f"start of task '{type(self).__name__}'", *self.plant_state_sizes)
        self._enter(context, start)

    def start_of(self, context: Context) -> EpisodeStart:
        """State and plan of a Context, as a start."""
        plant_state = self.GetOutputPort("plant_state").Eval(self.GetMyContextFromRoot(context))
        q, v = np.split(plant_state, [self.plant_state_sizes[0]])
        plan = self._planner.plan_from_now(self._planner.GetMyContextFromRoot(context))
        return EpisodeStart(q=q, v=v, plan=plan)

    def set_plan(self, context: Context, plan: PiecewisePolynomial) -> None:
        """Sets the plan and keeps the state.

        Args:
            plan: Desired output over simulation time, in the stance frame, (n_z, 1) [m].
        """
        self._planner.set_plan(self._planner.GetMyMutableContextFromRoot(context), plan)

    def _plan_of(self, context: Context) -> PiecewisePolynomial:
        return self._planner.get_plan(self._planner.GetMyContextFromRoot(context))

    def _enter(self, context: Context, start: EpisodeStart) -> None:
        # Only the state is reset: parameters such as an assessor's beliefs outlive an episode.
        context.SetTime(0.0)
        own_context = self.GetMyMutableContextFromRoot(context)
        own_context.get_mutable_discrete_state().SetFrom(self._default.get_discrete_state())
        self._set_state(context, start)
        self._planner.set_plan(
            self._planner.GetMyMutableContextFromRoot(context), start.plan, self._stance_of(start)
        )

    def _set_state(self, context: Context, start: EpisodeStart) -> None:
        """Sets the states of plant and controller to a start."""
        raise TypeError(f"task '{type(self).__name__}' must override _set_state")

    def _stance_of(self, start: EpisodeStart) -> np.ndarray:
        """Pose of the frame of a start's plan, [x, y, yaw] in the world (3,) [m, rad]."""
        del start
        return np.zeros(3)
