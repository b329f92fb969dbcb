"""Pendulum: an inverted pendulum with a weak motor follows a point; its true safe set is known."""

import math
from dataclasses import dataclass, field, fields
from itertools import pairwise

import numpy as np
from pydrake.examples import PendulumGeometry, PendulumParams, PendulumPlant
from pydrake.geometry import Meshcat, MeshcatVisualizer, SceneGraph
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    LeafSystem,
    OutputPort,
)
from pydrake.systems.primitives import Saturation, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.robot import PlantVariation
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.state_plane import StatePlane
from drake_safety.systems.plan_features import PlanFeatures
from drake_safety.systems.safety_assessor import SafetyAssessor
from drake_safety.systems.safety_monitor import SafetyMonitor
from drake_safety.systems.trajectory_planner import TrajectoryPlanner, interpolate

_GRAVITY = 9.81
_NUM_OUTLOOK = 41  # Samples of the plan from now to its end that the features see.
_VARIED = ("mass_scale", "joint_damping")  # What a variation can change of this plant.


@dataclass(kw_only=True)
class PendulumParameters:
    """The task's part of the scenario file. Angles are from upright, positive to the front."""

    mass_kg: float = 1.0
    length_m: float = 0.5
    damping: float = 0.05
    """Of the hinge [N·m·s/rad]."""
    effort_share: float = 0.35
    """The motor's torque, as a share of what holds the pendulum when it is horizontal."""
    stiffness: float = 20.0
    """Gain of the angle's error [N·m/rad]."""
    rate_gain: float = 3.0
    """Gain of the rate's error [N·m·s/rad]."""
    largest_angle_rad: float = 0.6
    """Beyond this angle the pendulum has left the safe set."""
    start_angle_rad: float = 0.6
    """Half-width of the angles at which episodes begin."""
    start_rate_rad_s: float = 2.0
    """Half-width of the rates at which episodes begin."""
    plan_angle_rad: float = 0.3
    """Half-width of the angles at which plans begin and end."""
    plan_duration_s: list[float] = field(default_factory=lambda: [0.5, 1.5])
    """Shortest and longest duration of the planned motion."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not np.all(np.isfinite(value)) or np.min(value) <= 0:
                raise ValueError(f"pendulum: {entry.name} must be finite and positive; got {value}")
        if len(self.plan_duration_s) != 2 or self.plan_duration_s[0] > self.plan_duration_s[1]:
            raise ValueError(
                f"pendulum: plan_duration_s must be [shortest, longest]; got {self.plan_duration_s}"
            )
        if self.start_angle_rad > self.largest_angle_rad:
            raise ValueError(
                f"pendulum: start_angle_rad must not exceed largest_angle_rad "
                f"{self.largest_angle_rad}, or episodes begin outside the safe set; got "
                f"{self.start_angle_rad}"
            )
        if not self.effort_share < 1:
            raise ValueError(
                f"pendulum: effort_share must be below 1, or nothing can go wrong; got "
                f"{self.effort_share}"
            )

    @property
    def hold_angle_rad(self) -> float:
        """The largest angle that the motor can hold."""
        return math.asin(self.effort_share)

    def effort_limit(self) -> float:
        """The motor's largest torque [N·m]."""
        return self.effort_share * self.mass_kg * _GRAVITY * self.length_m


class PendulumSafeSet:
    """The pendulum leans less than its largest angle to the front and to the back.

    Args:
        parameters: The task's numbers.
        preview_step_s: Time between two points that the features are given of a plan [s].
    """

    names = ("front", "back")

    def __init__(self, parameters: PendulumParameters, preview_step_s: float):
        self._step_s = preview_step_s
        self._largest = parameters.largest_angle_rad
        self._hold = parameters.hold_angle_rad
        self._effort_share = parameters.effort_share
        self._time_s = math.sqrt(parameters.length_m / _GRAVITY)
        self.feature_names = [
            f"{point}_{limit}_{side}"
            for point, limit in (
                ("now", "margin"),
                ("capture", "reserve"),
                ("goal", "reserve"),
                ("plan", "reserve"),
                ("plan_capture", "reserve"),
                ("plan_effort", "reserve"),
            )
            for side in self.names
        ] + ["tracking_error", "goal_from_capture"]

    def margins(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Angle left to either side, (2,) [rad].

        Args:
            q: The angle, (1,) [rad].
            v: Its rate, unused by these constraints.
        """
        del v
        return np.array([self._largest - q[0], self._largest + q[0]])

    def features(self, q: np.ndarray, v: np.ndarray, preview: np.ndarray) -> np.ndarray:
        """The margins now, and what the motor has in reserve along the plan.

        The capture angle φ + φ̇ √(l/g) is where a small pendulum that is left alone goes to;
        beyond the angle that the motor can hold there is no way back. Following the plan takes the
        torque (l/g) φ̈ - sin φ, in units of what holds the pendulum when it is horizontal.

        Args:
            q: The angle, (1,) [rad].
            v: Its rate, (1,) [rad/s].
            preview: Points that are to be followed, from now to the end, (M, 3) [m].

        Returns:
            Features, in the order of :attr:`feature_names` [rad], those of the effort in its unit.
        """
        angle = q[0]
        capture = angle + self._time_s * v[0]
        planned = np.arctan2(preview[:, 0], preview[:, 2])
        goal = planned[-1]
        rate = np.gradient(planned, self._step_s)
        plan_capture = planned + self._time_s * rate
        effort = self._time_s**2 * np.gradient(rate, self._step_s) - np.sin(planned)
        return np.array(
            [
                *self.margins(q, v),
                self._hold - capture,
                self._hold + capture,
                self._hold - goal,
                self._hold + goal,
                self._hold - planned.max(),
                self._hold + planned.min(),
                self._hold - plan_capture.max(),
                self._hold + plan_capture.min(),
                # What keeps it from falling to the front pulls it to the back.
                self._effort_share + effort.min(),
                self._effort_share - effort.max(),
                planned[0] - angle,
                goal - capture,
            ]
        )


class PendulumObserver(LeafSystem):
    """Tells the pendulum's state from upright, and where the bob is.

    .. pydrake_system::

        name: PendulumObserver
        input_ports:
        - pendulum_state
        output_ports:
        - plant_state
        - output

    ``pendulum_state`` is Drake's, from hanging; ``plant_state`` is [φ, φ̇] from upright [rad,
    rad/s], and ``output`` the bob over the hinge, (3,) [m].

    Args:
        length_m: From the hinge to the bob.
    """

    def __init__(self, length_m: float):
        super().__init__()
        port = self.DeclareVectorInputPort("pendulum_state", 2)

        def calc_state(context: Context, output: BasicVector) -> None:
            theta, rate = port.Eval(context)
            output.SetFromVector([theta - math.pi, rate])

        def calc_output(context: Context, output: BasicVector) -> None:
            output.SetFromVector(bob_position(port.Eval(context)[0] - math.pi, length_m))

        self.DeclareVectorOutputPort("plant_state", BasicVector(2), calc_state)
        self.DeclareVectorOutputPort("output", BasicVector(3), calc_output)


class PendulumController(LeafSystem):
    """A PD controller on the angle, with the weight compensated; its torque knows no limit.

    .. pydrake_system::

        name: PendulumController
        input_ports:
        - plant_state
        - desired_output
        - desired_output_rate
        output_ports:
        - torque

    Args:
        parameters: The task's numbers.
    """

    def __init__(self, parameters: PendulumParameters):
        super().__init__()
        weight = parameters.mass_kg * _GRAVITY * parameters.length_m
        state_port = self.DeclareVectorInputPort("plant_state", 2)
        point_port = self.DeclareVectorInputPort("desired_output", 3)
        velocity_port = self.DeclareVectorInputPort("desired_output_rate", 3)

        def calc_torque(context: Context, output: BasicVector) -> None:
            angle, rate = state_port.Eval(context)
            x, _, z = point_port.Eval(context)
            vx, _, vz = velocity_port.Eval(context)
            desired_rate = (vx * z - vz * x) / (x * x + z * z)
            torque = (
                parameters.stiffness * (math.atan2(x, z) - angle)
                + parameters.rate_gain * (desired_rate - rate)
                - weight * math.sin(angle)
            )
            output.SetAtIndex(0, torque)

        self.DeclareVectorOutputPort("torque", BasicVector(1), calc_torque)


def bob_position(angle: float, length_m: float) -> np.ndarray:
    """The bob over the hinge, (3,) [m]; an angle to the front is positive."""
    return length_m * np.array([math.sin(angle), 0.0, math.cos(angle)])


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
            SafetyMonitor(safe_set, 1, 1, period_s=scenario.control_period_s),
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
        if assessment is not None:
            self.check_assessment()
            assessor = builder.AddNamedSystem(
                "safety_assessor", SafetyAssessor(assessment, period_s=scenario.control_period_s)
            )
            builder.Connect(plant_state, assessor.GetInputPort("state"))
            builder.Connect(
                planner.GetOutputPort("desired_preview"), assessor.GetInputPort("desired_preview")
            )
            builder.Connect(features.GetOutputPort("features"), assessor.GetInputPort("features"))
            for i in range(assessor.num_output_ports()):
                port = assessor.get_output_port(i)
                builder.ExportOutput(port, port.get_name())
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
    values.set_gravity(_GRAVITY)
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
