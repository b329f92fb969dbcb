"""Pendulum: an inverted pendulum with a weak motor follows a point; its true safe set is known."""

import math
from dataclasses import fields
from itertools import pairwise

import numpy as np
from pydrake.examples import PendulumGeometry, PendulumParams, PendulumPlant
from pydrake.geometry import Meshcat, MeshcatVisualizer, SceneGraph
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    OutputPort,
)
from pydrake.systems.primitives import Saturation, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.diagrams.pendulum_parameters import GRAVITY, PendulumParameters
from drake_safety.diagrams.pendulum_systems import (
    PendulumController,
    PendulumObserver,
    PendulumSafeSet,
    bob_position,
)
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.robots.robot import PlantVariation
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.state_plane import StatePlane
from drake_safety.systems.plan_features import PlanFeatures
from drake_safety.systems.safety_monitor import SafetyMonitor
from drake_safety.systems.trajectory_planner import TrajectoryPlanner, interpolate

_NUM_OUTLOOK = 41  # Samples of the plan from now to its end that the features see.
_VARIED = ("mass_scale", "joint_damping")  # What a variation can change of this plant.


class Pendulum(ClosedLoop):
    """The diagram of the pendulum: Drake's plant, its torque limited, behind a PD controller.

    The output is the position of the bob over the hinge, and plans are points for it to follow.
    The torque is that of a PD controller on the angle, with the weight compensated, held for a
    control period and limited.

    Args:
        scenario: The scenario.
        variation: Name of the plant variation.
        assessment: Γ; adds the assessor.
        meshcat: Adds a visualiser.

    Raises:
        ValueError: A variation that asks for what this plant has not, or an assessment of another
            diagram.
    """

    Parameters = PendulumParameters
    angular_constraints = PendulumSafeSet.names

    def __init__(
        self,
        scenario: Scenario,
        variation: str = "nominal",
        *,
        assessment: SafetyAssessment | None = None,
        meshcat: Meshcat | None = None,
    ):
        super().__init__(scenario, variation, assessment)
        _check_variation(self.variation, variation)
        parameters = scenario.parameters
        builder = DiagramBuilder()
        self._pendulum = builder.AddNamedSystem("pendulum", PendulumPlant())
        pendulum_state = self._pendulum.get_state_output_port()
        observer = builder.AddNamedSystem("observer", PendulumObserver(parameters.length_m))
        builder.Connect(pendulum_state, observer.get_input_port())
        plant_state = observer.GetOutputPort("plant_state")

        planner = builder.AddNamedSystem(
            "trajectory_planner",
            TrajectoryPlanner(
                horizon=scenario.assessment.horizon,
                step_s=scenario.step_s,
                outlook_s=scenario.episode_duration_s,
                num_outlook=_NUM_OUTLOOK,
            ),
        )
        self._planner = planner
        self._add_controller(builder, parameters, plant_state)

        safe_set = PendulumSafeSet(parameters, scenario.episode_duration_s / (_NUM_OUTLOOK - 1))
        monitor = builder.AddNamedSystem(
            "safety_monitor",
            SafetyMonitor(safe_set, 1, 1),
        )
        builder.Connect(plant_state, monitor.GetInputPort("plant_state"))
        features = builder.AddNamedSystem(
            "plan_features", PlanFeatures(safe_set, 1, 1, horizon=_NUM_OUTLOOK)
        )
        builder.Connect(plant_state, features.GetInputPort("plant_state"))
        builder.Connect(
            planner.GetOutputPort("desired_outlook"), features.GetInputPort("desired_preview")
        )

        self.state_names = ["angle", "angle_rate"]
        self.output_names = [f"bob_{axis}" for axis in "xyz"]
        self.feature_names = features.feature_names
        self.constraint_names = monitor.constraint_names
        self.add_assessor(
            builder,
            period_s=scenario.control_period_s,
            state=plant_state,
            desired_preview=planner.GetOutputPort("desired_preview"),
            features=features.GetOutputPort("features"),
        )
        builder.ExportOutput(plant_state, "state")
        builder.ExportOutput(plant_state, "true_state")
        builder.ExportOutput(observer.GetOutputPort("output"), "output")
        builder.ExportOutput(planner.GetOutputPort("desired_output"), "desired_output")
        builder.ExportOutput(planner.GetOutputPort("desired_preview"), "desired_preview")
        builder.ExportOutput(features.GetOutputPort("features"), "features")
        builder.ExportOutput(monitor.GetOutputPort("margins"), "margins")
        builder.ExportOutput(monitor.GetOutputPort("safe"), "safe")
        if meshcat is not None:
            scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
            PendulumGeometry.AddToBuilder(builder, pendulum_state, scene_graph)
            MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
        self.finish(builder)
        self._default = self.CreateDefaultContext()

    def _add_controller(
        self, builder: DiagramBuilder, parameters: PendulumParameters, plant_state: OutputPort
    ) -> None:
        """Adds what follows the planner's point: PD, hold, limit."""
        controller = builder.AddNamedSystem("controller", PendulumController(parameters))
        builder.Connect(plant_state, controller.GetInputPort("plant_state"))
        for name in ("desired_output", "desired_output_rate"):
            builder.Connect(self._planner.GetOutputPort(name), controller.GetInputPort(name))
        hold = builder.AddNamedSystem("hold", ZeroOrderHold(self.scenario.control_period_s, 1))
        limit = parameters.effort_limit()
        saturation = builder.AddNamedSystem("effort_limit", Saturation([-limit], [limit]))
        for before, after in pairwise((controller, hold, saturation, self._pendulum)):
            builder.Connect(before.get_output_port(), after.get_input_port())

    def reset(self, context: Context, rng: np.random.Generator) -> int:
        """Samples an angle, a rate and a plan."""
        parameters = self.scenario.parameters
        state = rng.uniform(-1, 1, 2) * [parameters.start_angle_rad, parameters.start_rate_rad_s]
        angles = rng.uniform(-1, 1, 2) * parameters.plan_angle_rad
        plan = self.plan(*angles, rng.uniform(*parameters.plan_duration_s))
        self._enter(context, EpisodeStart(q=state[:1], v=state[1:], plan=plan))
        return 0

    def plan(self, start_rad: float, goal_rad: float, duration_s: float) -> PiecewisePolynomial:
        """A plan for the bob, from one angle to another.

        Args:
            start_rad: Where it begins.
            goal_rad: Where it ends.
            duration_s: How long it takes [s].
        """
        length_m = self.scenario.parameters.length_m
        ends = [bob_position(angle, length_m) for angle in (start_rad, goal_rad)]
        return interpolate(*ends, duration_s)

    def reset_to(
        self, context: Context, rng: np.random.Generator | None, start: EpisodeStart
    ) -> None:
        """Begins with a given angle, rate and plan; see :meth:`ClosedLoop.reset_to`."""
        for name in ("q", "v"):
            value = getattr(start, name)
            if np.shape(value) != (1,) or not np.isfinite(value).all():
                raise ValueError(f"pendulum: {name} must be one finite number; got {value}")
        self._enter(context, start)

    def start_of(self, context: Context) -> EpisodeStart:
        """What an episode that goes on from here begins with."""
        q, v = np.split(self.GetOutputPort("true_state").Eval(context), 2)
        plan = self._planner.plan_from_now(self._planner.GetMyContextFromRoot(context))
        return EpisodeStart(q=q, v=v, plan=plan)

    @property
    def state_planes(self) -> dict[str, StatePlane]:
        """Nearly all starts, for a plan that holds still and for two that move."""
        parameters = self.scenario.parameters
        # The border of the starts may be the safe set's own, where rounding decides.
        half = 0.95 * np.array([parameters.start_angle_rad, parameters.start_rate_rad_s])
        far = 0.8 * parameters.plan_angle_rad
        duration_s = float(np.mean(parameters.plan_duration_s))
        plans = {"hold": (0.0, 0.0), "lean forward": (0.0, far), "from back to front": (-far, far)}
        return {
            name: StatePlane(
                axes=("angle [rad]", "rate [rad/s]"),
                lowest=(-half[0], -half[1]),
                highest=(half[0], half[1]),
                start=lambda point, angles=angles: EpisodeStart(
                    q=point[:1], v=point[1:], plan=self.plan(*angles, duration_s)
                ),
            )
            for name, angles in plans.items()
        }

    def _enter(self, context: Context, start: EpisodeStart) -> None:
        # The state alone: parameters such as an assessor's beliefs are not an episode's to forget.
        context.SetTime(0.0)
        context.get_mutable_discrete_state().SetFrom(self._default.get_discrete_state())
        parameters = self.scenario.parameters
        pendulum_context = self._pendulum.GetMyMutableContextFromRoot(context)
        pendulum_context.get_mutable_numeric_parameter(0).SetFromVector(
            _pendulum_parameters(parameters, self.variation)
        )
        pendulum_context.SetContinuousState([math.pi + start.q[0], start.v[0]])
        self._planner.set_plan(
            self._planner.GetMyMutableContextFromRoot(context), start.plan, np.zeros(3)
        )


def _pendulum_parameters(parameters: PendulumParameters, variation: PlantVariation) -> np.ndarray:
    values = PendulumParams()
    values.set_mass(variation.mass_scale * parameters.mass_kg)
    values.set_length(parameters.length_m)
    values.set_damping(parameters.damping + variation.joint_damping)
    values.set_gravity(GRAVITY)
    return values.get_value()


def _check_variation(variation: PlantVariation, name: str) -> None:
    plain = PlantVariation()
    for entry in fields(PlantVariation):
        if entry.name not in _VARIED and getattr(variation, entry.name) != getattr(
            plain, entry.name
        ):
            raise ValueError(
                f"pendulum: variation '{name}' sets {entry.name}, which this plant has not; it "
                f"has {list(_VARIED)}"
            )
