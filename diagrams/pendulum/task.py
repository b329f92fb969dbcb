"""Pendulum: an inverted pendulum with a limited torque, whose true safe set can be computed."""

import math
from dataclasses import field
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from pydrake.examples import PendulumGeometry, PendulumPlant
from pydrake.geometry import Meshcat, MeshcatVisualizer, SceneGraph
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.files.schema import Bounds, Positive, schema
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.robots.robot import PlantVariation
from drake_safety.robots.robot_size import GRAVITY_M_S2
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.planned_loop import PlannedLoop
from drake_safety.simulation.scenario import Scenario
from drake_safety.systems.periodic_update import declare_update
from drake_safety.systems.trajectory_planner import interpolate

_NUM_OUTLOOK = 41  # Samples of the plan from now to its end, for the features.


@schema(kw_only=True)
class PendulumParameters:
    """The task's part of the scenario file. Angles are from upright, positive to the front."""

    mass_kg: Positive = 1.0
    length_m: Positive = 0.5
    damping: Positive = 0.05  # Damping of the hinge [N·m·s/rad].
    # The motor's torque; at 1 it holds the horizontal pendulum, and every episode is safe.
    effort_share: Annotated[float, Field(gt=0, lt=1)] = 0.35
    stiffness: Positive = 20.0  # Gain of the angle's error [N·m/rad].
    rate_gain: Positive = 3.0  # Gain of the rate's error [N·m·s/rad].
    largest_angle_rad: Positive = 0.6  # Beyond this angle the pendulum has left the safe set.
    start_angle_rad: Positive = 0.6  # Half-width of the angles at which episodes begin.
    start_rate_rad_s: Positive = 2.0  # Half-width of the rates at which episodes begin.
    plan_angle_rad: Positive = 0.3  # Half-width of the angles at which plans begin and end.
    plan_duration_s: Bounds[Positive] = field(default_factory=lambda: [0.5, 1.5])

    @property
    def hold_angle_rad(self) -> float:
        """The largest angle that the motor can hold."""
        return math.asin(self.effort_share)


class PendulumSafeSet:
    """Bounds of the pendulum's angle to the front and to the back.

    Beyond the capture angle φ + φ̇ √(l/g) that the motor can hold, the pendulum cannot return. A
    plan takes the torque (l/g) φ̈ - sin φ, by that which holds the pendulum horizontally.
    """

    names = ("front", "back")

    def __init__(self, parameters: PendulumParameters, preview_step_s: float):
        self._parameters, self._step_s = parameters, preview_step_s
        self._time_s = math.sqrt(parameters.length_m / GRAVITY_M_S2)
        points = ("capture", "goal", "plan", "plan_capture", "plan_effort")
        reserves = ["now_margin", *(f"{point}_reserve" for point in points)]
        self.feature_names = [f"{reserve}_{side}" for reserve in reserves for side in self.names]
        self.feature_names += ["tracking_error", "goal_from_capture"]

    def margins(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Margins to either side (2,) [rad] of an angle (1,) [rad]; its rate is not used."""
        del v
        return _reserves(self._parameters.largest_angle_rad, q)

    def features(self, q: np.ndarray, v: np.ndarray, preview: np.ndarray) -> np.ndarray:
        """Margins now, and reserves of angle [rad] and torque [1] along a plan (M, 3) [m]."""
        hold, capture = self._parameters.hold_angle_rad, q + self._time_s * v
        planned = np.arctan2(preview[:, 0], preview[:, 2])
        rate = np.gradient(planned, self._step_s)
        plan_capture = planned + self._time_s * rate
        reserves = [_reserves(hold, x) for x in (capture, planned[-1:], planned, plan_capture)]
        # The torque to the back balances the weight of a pendulum in front of upright.
        pull = np.sin(planned) - self._time_s**2 * np.gradient(rate, self._step_s)
        reserves.append(_reserves(self._parameters.effort_share, pull))
        errors = [planned[:1] - q, planned[-1:] - capture]
        return np.concatenate([self.margins(q, v), *reserves, *errors])


def _reserves(limit: float, values: np.ndarray) -> np.ndarray:
    return np.array([limit - values.max(), limit + values.min()])


def bob_position(angle: float, length_m: float) -> np.ndarray:
    """Position of the bob relative to the hinge, (3,) [m]; an angle to the front is positive."""
    return length_m * np.array([math.sin(angle), 0.0, math.cos(angle)])


class PendulumObserver(LeafSystem):
    """Computes the pendulum's state relative to upright, the bob's position and the features.

    .. pydrake_system::

        name: PendulumObserver
        input_ports: [pendulum_state, desired_outlook]
        output_ports: [plant_state, output, features]

    ``pendulum_state`` is Drake's, from hanging; ``plant_state`` is [φ, φ̇] from upright [rad,
    rad/s], and ``output`` the bob's position relative to the hinge [m].
    """

    def __init__(self, length_m: float, safe_set: PendulumSafeSet):
        super().__init__()
        port = self.DeclareVectorInputPort("pendulum_state", 2)
        outlook = self.DeclareVectorInputPort("desired_outlook", 3 * _NUM_OUTLOOK)

        def upright(context: Context) -> np.ndarray:
            return port.Eval(context) - [math.pi, 0.0]

        def calc_state(context: Context, output: BasicVector) -> None:
            output.SetFromVector(upright(context))

        def calc_output(context: Context, output: BasicVector) -> None:
            output.SetFromVector(bob_position(upright(context)[0], length_m))

        def calc_features(context: Context, output: BasicVector) -> None:
            (q, v), plan = np.split(upright(context), 2), outlook.Eval(context).reshape(-1, 3)
            output.SetFromVector(safe_set.features(q, v, plan))

        ticket = {self.input_port_ticket(port.get_index())}
        self.DeclareVectorOutputPort("plant_state", 2, calc_state, ticket)
        self.DeclareVectorOutputPort("output", 3, calc_output, ticket)
        self.DeclareVectorOutputPort("features", len(safe_set.feature_names), calc_features)


class PendulumController(LeafSystem):
    """A PD controller of the angle with gravity compensation and limited torque.

    .. pydrake_system::

        name: PendulumController
        input_ports: [plant_state, desired_output, desired_output_rate]
        output_ports: [torque]

    ``torque`` (1,) [N·m] is held for ``period_s`` [s].
    """

    def __init__(self, parameters: PendulumParameters, period_s: float):
        super().__init__()
        weight = parameters.mass_kg * GRAVITY_M_S2 * parameters.length_m
        limit = parameters.effort_share * weight
        sizes = {"plant_state": 2, "desired_output": 3, "desired_output_rate": 3}
        ports = [self.DeclareVectorInputPort(name, size) for name, size in sizes.items()]

        def update(context: Context, state: Any) -> None:
            (angle, rate), (x, _, z), (vx, _, vz) = (port.Eval(context) for port in ports)
            desired_rate = (vx * z - vz * x) / (x * x + z * z)
            torque = (
                parameters.stiffness * (math.atan2(x, z) - angle)
                + parameters.rate_gain * (desired_rate - rate)
                - weight * math.sin(angle)
            )
            state.set_value([min(max(torque, -limit), limit)])

        self.DeclareStateOutputPort("torque", self.DeclareDiscreteState(1))
        declare_update(self, update, None, period_s, 0.0)


class Pendulum(PlannedLoop):
    """The diagram of the pendulum, whose bob follows a plan of positions relative to the hinge."""

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
        varied = self._plant_variation
        plain = PlantVariation(mass_scale=varied.mass_scale, joint_damping=varied.joint_damping)
        if varied != plain:
            what = f"variation '{variation}' may set mass_scale and joint_damping alone"
            got = [name for name, one in vars(varied).items() if one != getattr(plain, name)]
            raise ValueError(f"pendulum: {what}; got {got}")
        parameters, period_s = scenario.parameters, scenario.control_period_s
        outlook_s, builder = scenario.episode_duration_s, DiagramBuilder()
        pendulum = self._pendulum = builder.AddNamedSystem("pendulum", PendulumPlant())
        planner = self._add_planner(builder, outlook_s=outlook_s, num_outlook=_NUM_OUTLOOK)
        safe_set = PendulumSafeSet(parameters, outlook_s / (_NUM_OUTLOOK - 1))
        observer = builder.AddNamedSystem(
            "observer", PendulumObserver(parameters.length_m, safe_set)
        )
        pendulum_state, outlook = map(observer.get_input_port, range(2))
        builder.Connect(pendulum.get_state_output_port(), pendulum_state)
        builder.Connect(planner.GetOutputPort("desired_outlook"), outlook)
        state = observer.GetOutputPort("plant_state")
        controller = builder.AddNamedSystem("controller", PendulumController(parameters, period_s))
        self._connect_controller(builder, controller, state)
        builder.Connect(controller.get_output_port(), pendulum.get_input_port())
        self.state_names = ["angle", "angle_rate"]
        self.output_names = [f"bob_{axis}" for axis in "xyz"]
        self.feature_names = safe_set.feature_names
        ports = {"state": state, "plant_state": state}
        ports |= {name: observer.GetOutputPort(name) for name in ("output", "features")}
        self._finish(builder, safe_set, ports, sizes=(1, 1), period_s=period_s)
        if meshcat is not None:
            scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
            PendulumGeometry.AddToBuilder(builder, pendulum.get_state_output_port(), scene_graph)
            MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
        builder.BuildInto(self)

    def reset(self, context: Context, rng: np.random.Generator) -> int:
        """Samples an angle, a rate and a plan."""
        parameters = self.scenario.parameters
        state = rng.uniform(-1, 1, 2) * [parameters.start_angle_rad, parameters.start_rate_rad_s]
        angles = rng.uniform(-1, 1, 2) * parameters.plan_angle_rad
        plan = self.plan(*angles, rng.uniform(*parameters.plan_duration_s))
        self._enter(context, EpisodeStart(q=state[:1], v=state[1:], plan=plan))
        return 0

    def plan(self, start_rad: float, goal_rad: float, duration_s: float) -> PiecewisePolynomial:
        """A plan for the bob, from one angle to another within a duration [s]."""
        length_m = self.scenario.parameters.length_m
        ends = [bob_position(angle, length_m) for angle in (start_rad, goal_rad)]
        return interpolate(*ends, duration_s)

    def _set_state(self, context: Context, start: EpisodeStart) -> None:
        parameters, variation = self.scenario.parameters, self._plant_variation
        pendulum_context = self._pendulum.GetMyMutableContextFromRoot(context)
        values = self._pendulum.get_mutable_parameters(pendulum_context)
        values.set_mass(variation.mass_scale * parameters.mass_kg)
        values.set_length(parameters.length_m)
        values.set_damping(parameters.damping + variation.joint_damping)
        values.set_gravity(GRAVITY_M_S2)
        pendulum_context.SetContinuousState([math.pi + start.q[0], start.v[0]])
