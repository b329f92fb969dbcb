"""PlannedLoop: base of tasks that follow a plan of points within a safe set."""

from collections.abc import Mapping
from functools import cached_property

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem, OutputPort
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.systems.monitored_assessor import MonitoredSafetyAssessor
from drake_safety.systems.safety_monitor import SafeSet, SafetyMonitor
from drake_safety.systems.trajectory_planner import TrajectoryPlanner


class PlannedLoop(ClosedLoop):
    """A closed loop with a planner and a monitor of a safe set; its episodes can begin anywhere.

    A subclass calls :meth:`_add_planner`, adds plant and controller, calls :meth:`_finish` with the
    ports ``plant_state``, ``state``, ``output`` and ``features``, and implements `_set_state`.
    """

    def _add_planner(
        self, builder: DiagramBuilder, *, outlook_s: float, num_outlook: int
    ) -> TrajectoryPlanner:
        planner = TrajectoryPlanner(
            horizon=self.scenario.assessment.horizon,
            step_s=self.scenario.preview_step_s,
            outlook_s=outlook_s,
            num_outlook=num_outlook,
        )
        self._planner: TrajectoryPlanner = builder.AddNamedSystem("trajectory_planner", planner)
        return self._planner

    def _connect_controller(
        self, builder: DiagramBuilder, controller: LeafSystem, measured_state: OutputPort
    ) -> None:
        builder.Connect(measured_state, controller.GetInputPort("plant_state"))
        for name in ("desired_output", "desired_output_rate"):
            builder.Connect(self._planner.GetOutputPort(name), controller.GetInputPort(name))

    def _finish(
        self,
        builder: DiagramBuilder,
        safe_set: SafeSet,
        ports: Mapping[str, OutputPort],
        *,
        sizes: tuple[int, int],
        period_s: float,
        margins: OutputPort | None = None,
        hold: OutputPort | None = None,
    ) -> MonitoredSafetyAssessor | None:
        """Adds the monitor of the true state, exports all ports, and adds an assessor."""
        self.plant_state_sizes = sizes
        monitor = builder.AddNamedSystem("safety_monitor", SafetyMonitor(safe_set, *sizes))
        builder.Connect(ports["plant_state"], monitor.GetInputPort("plant_state"))
        self.constraint_names = monitor.constraint_names
        desired = ("desired_output", "desired_preview")
        usual = {
            "true_state": ports["state"],
            **{name: self._planner.GetOutputPort(name) for name in desired},
            **{name: monitor.GetOutputPort(name) for name in ("margins", "safe")},
        }
        return self.export(
            builder, {**usual, **ports}, period_s=period_s, margins=margins, hold=hold
        )

    @cached_property
    def _default(self) -> Context:
        return self.CreateDefaultContext()

    def reset_to(
        self, context: Context, rng: np.random.Generator | None, start: EpisodeStart
    ) -> None:
        """Sets plant state and plan; see `CanStartAnywhere`."""
        del rng  # The plant has no noise.
        start.check(f"start of task '{type(self).__name__}'", *self.plant_state_sizes)
        self._enter(context, start)

    def start_of(self, context: Context) -> EpisodeStart:
        """Returns state and plan of a Context, as a start."""
        plant_state = self.GetOutputPort("plant_state").Eval(self.GetMyContextFromRoot(context))
        q, v = np.split(plant_state, [self.plant_state_sizes[0]])
        plan = self._planner.plan_from_now(self._planner.GetMyContextFromRoot(context))
        return EpisodeStart(q=q, v=v, plan=plan)

    def set_plan(self, context: Context, plan: PiecewisePolynomial) -> None:
        """Sets the plan over simulation time, in the stance frame, (n_z, 1) [m]."""
        self._planner.set_plan(self._planner.GetMyMutableContextFromRoot(context), plan)

    def _enter(self, context: Context, start: EpisodeStart) -> None:
        # Only the state is reset: parameters such as an assessor's beliefs outlive an episode.
        context.SetTime(0.0)
        own_context = self.GetMyMutableContextFromRoot(context)
        own_context.get_mutable_discrete_state().SetFrom(self._default.get_discrete_state())
        self._set_state(context, start)
        planner_context = self._planner.GetMyMutableContextFromRoot(context)
        self._planner.set_plan(planner_context, start.plan, self._stance_of(start))

    def _set_state(self, context: Context, start: EpisodeStart) -> None:
        """Sets the states of plant and controller to a start."""
        raise TypeError(f"task '{type(self).__name__}' must override _set_state")

    def _stance_of(self, start: EpisodeStart) -> np.ndarray:
        """Pose of the frame of a start's plan, [x, y, yaw] in the world (3,) [m, rad]."""
        del start
        return np.zeros(3)
