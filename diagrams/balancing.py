"""Balancing: a legged robot keeps its base over its feet along a plan, and steps when it must."""

from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.safe_sets import BalanceSafeSet
from drake_safety.diagrams.balancing_parameters import BalancingParameters, fitted_to_robot
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.models import load_robot, robot_files
from drake_safety.plants.balls import Throw
from drake_safety.plants.physics import ENGINES_WITH_BALLS, Scene, add_physics
from drake_safety.robots.robot import ObservationNoise
from drake_safety.robots.robot_model import by_pattern
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.observers import Observers, combined
from drake_safety.simulation.sampling import Start, calm_start
from drake_safety.simulation.scenario import Scenario
from drake_safety.systems.inverse_kinematics_controller import InverseKinematicsController
from drake_safety.systems.plan_features import PlanFeatures
from drake_safety.systems.recovery_switch import RecoverySwitch
from drake_safety.systems.safety_monitor import SafetyMonitor
from drake_safety.systems.trajectory_planner import TrajectoryPlanner, interpolate

_NUM_OUTLOOK = 5  # Samples of the plan from now to its end that the features see.
_LATEST_HIT_S = 1.5  # Of a calm motion, in episodes that begin with a hit.


class Balancing(ClosedLoop):
    """The diagram of the balancing task, for any robot.yaml with feet and joint gains.

    Args:
        scenario: The scenario.
        variation: Name of the plant variation.
        assessment: Γ; adds the assessor.
        meshcat: Adds a visualiser.
        recovery: Whether there are recovery steps; by default there are when there is Γ to
            trigger them. Without Γ the diagram has an input port ``safety_probability``.
        ball: Whether the plant has a ball; by default it has when pushes are sampled.

    Raises:
        ValueError: A robot without feet or gains, an assessment of another diagram, or a ball
            with an engine that has none.
    """

    Parameters = BalancingParameters
    online_parameters = ("recovery", "demonstration")

    def __init__(
        self,
        scenario: Scenario,
        variation: str = "nominal",
        *,
        assessment: SafetyAssessment | None = None,
        meshcat: Meshcat | None = None,
        recovery: bool | None = None,
        ball: bool | None = None,
    ):
        super().__init__(scenario, variation, assessment)
        recovery = assessment is not None if recovery is None else recovery
        parameters = scenario.parameters
        horizon = scenario.assessment.horizon
        # Γ, trigger, step planner and controller tick one after the other within a plant step.
        tick_offset_s = 0.25 * scenario.time_step_s
        robot = load_robot(scenario.robot)
        builder = DiagramBuilder()

        has_ball = parameters.push.share > 0 if ball is None else ball
        physics = add_physics(
            builder,
            robot,
            self.variation,
            Scene(has_ball=has_ball),
            time_step_s=scenario.time_step_s,
            servos=True,
        )
        self._physics = physics
        self.plant, self.robot, self.robot_instance = physics.plant, robot, physics.instance
        self.ball = physics.ball

        nominal = scenario.variation("nominal")
        kinematics = RobotKinematics(robot, nominal)
        self.kinematics = kinematics
        n_q, n_v = kinematics.num_positions, kinematics.num_velocities
        plant_state = physics.state

        noise = self.variation.observation_noise
        observers = Observers(builder, kinematics, plant_state, scenario.control_period_s)
        self._observers = observers
        observer = observers.add("observer", noise)
        assessor_observer = observers.add(
            "assessor_observer", combined(noise, self.variation.input_noise)
        )
        true_observer = observers.add("true_observer", ObservationNoise())
        measured = observer.GetOutputPort("measured_plant_state")

        planner = builder.AddNamedSystem(
            "trajectory_planner",
            TrajectoryPlanner(
                horizon=horizon,
                step_s=scenario.step_s,
                outlook_s=scenario.episode_duration_s,
                num_outlook=_NUM_OUTLOOK,
            ),
        )
        self._planner = planner
        desired_output = planner.GetOutputPort("desired_output")
        desired_preview = planner.GetOutputPort("desired_preview")
        # The features see the whole plan: where it ends decides, and H steps do not reach it.
        desired_outlook = planner.GetOutputPort("desired_outlook")

        self._recovery_switch = None
        if recovery:
            switch = builder.AddNamedSystem(
                "recovery_switch",
                RecoverySwitch(
                    kinematics,
                    parameters.recovery.step,
                    threshold=parameters.recovery.threshold,
                    period_s=scenario.control_period_s,
                    offset_s=tick_offset_s,
                    horizon=horizon,
                    num_outlook=_NUM_OUTLOOK,
                ),
            )
            self._recovery_switch = switch
            builder.Connect(measured, switch.GetInputPort("plant_state"))
            builder.Connect(desired_output, switch.GetInputPort("nominal_desired_output"))
            builder.Connect(desired_preview, switch.GetInputPort("nominal_desired_preview"))
            builder.Connect(desired_outlook, switch.GetInputPort("nominal_desired_outlook"))
            builder.Connect(
                switch.GetOutputPort("stance_pose"), planner.GetInputPort("stance_pose")
            )
            desired_output = switch.GetOutputPort("desired_output")
            desired_preview = switch.GetOutputPort("desired_preview")
            desired_outlook = switch.GetOutputPort("desired_outlook")
            builder.ExportOutput(switch.GetOutputPort("recovery_active"), "recovery_active")

        stiffness = [
            getattr(by_pattern(robot.joint_gains, name, "gains", robot.name), "stiffness", 0.0)
            for name in kinematics.joint_names
        ]
        controller = builder.AddNamedSystem(
            "inverse_kinematics_controller",
            InverseKinematicsController(
                kinematics,
                np.array(stiffness),
                period_s=scenario.control_period_s,
                offset_s=3 * tick_offset_s,
            ),
        )
        self._controller = controller
        builder.Connect(measured, controller.GetInputPort("plant_state"))
        builder.Connect(desired_output, controller.GetInputPort("desired_output"))
        if recovery:
            for name in ("desired_foot_positions", "desired_yaw"):
                builder.Connect(switch.GetOutputPort(name), controller.GetInputPort(name))
        physics.connect_servos(
            builder, kinematics.joint_names, controller.GetOutputPort("desired_joint_state")
        )

        safe_set = BalanceSafeSet(kinematics, parameters.safe_set)
        monitor = builder.AddNamedSystem(
            "safety_monitor",
            SafetyMonitor(safe_set, n_q, n_v, period_s=scenario.control_period_s),
        )
        builder.Connect(plant_state, monitor.GetInputPort("plant_state"))
        features = builder.AddNamedSystem(
            "plan_features", PlanFeatures(safe_set, n_q, n_v, horizon=_NUM_OUTLOOK)
        )
        builder.Connect(
            assessor_observer.GetOutputPort("measured_plant_state"),
            features.GetInputPort("plant_state"),
        )
        builder.Connect(desired_outlook, features.GetInputPort("desired_preview"))

        self.state_names = assessor_observer.state_names
        self.output_names = assessor_observer.output_names
        self.feature_names = features.feature_names
        self.constraint_names = monitor.constraint_names
        self.fall_name = safe_set.fall_name
        self.watched_features = safe_set.watched_features
        self._rate_features = safe_set.rate_features
        assessor = self.add_assessor(
            builder,
            period_s=parameters.recovery.assessment_period_s,
            state=assessor_observer.GetOutputPort("state"),
            desired_preview=desired_preview,
            features=features.GetOutputPort("features"),
        )
        if assessor is not None and recovery:
            builder.Connect(
                assessor.GetOutputPort(self.trigger_port),
                switch.GetInputPort("safety_probability"),
            )
        elif recovery:
            builder.ExportInput(switch.GetInputPort("safety_probability"), "safety_probability")
        builder.ExportOutput(assessor_observer.GetOutputPort("state"), "state")
        builder.ExportOutput(true_observer.GetOutputPort("state"), "true_state")
        builder.ExportOutput(observer.GetOutputPort("output"), "output")
        builder.ExportOutput(desired_output, "desired_output")
        builder.ExportOutput(desired_preview, "desired_preview")
        builder.ExportOutput(features.GetOutputPort("features"), "features")
        builder.ExportOutput(monitor.GetOutputPort("margins"), "margins")
        builder.ExportOutput(monitor.GetOutputPort("safe"), "safe")
        builder.ExportOutput(plant_state, "plant_state")
        if physics.ball_state is not None:
            builder.ExportOutput(physics.ball_state, "ball_state")
        if meshcat is not None:
            MeshcatVisualizer.AddToBuilder(builder, physics.scene_graph, meshcat)
        self.finish(builder)
        self._default = self.CreateDefaultContext()

    @classmethod
    def complete_parameters(cls, robot: str, stated: dict[str, Any]) -> dict[str, Any]:
        """Scales defaults to the robot where the scenario asks for it."""
        if stated.get("scale_to_robot") is not True:
            return stated
        return fitted_to_robot(stated, RobotKinematics(load_robot(robot)))

    @classmethod
    def pairing_options(cls, scenario: Scenario, variation: str) -> dict[str, bool]:
        """Without a ball on either side where the variation's engine has none."""
        if scenario.variation(variation).engine in ENGINES_WITH_BALLS:
            return {}
        return {"ball": False}

    @classmethod
    def model_files(cls, scenario: Scenario) -> list[Path]:
        """The robot's YAML and model file."""
        return robot_files(scenario.robot)

    @property
    def rate_names(self) -> list[str]:
        """Velocities of the state, and the features that they enter."""
        return [*super().rate_names, *self._rate_features]

    def reset(self, context: Context, rng: np.random.Generator) -> int:
        """Samples an initial state and a plan; some episodes begin as a ball hits."""
        parameters = self.scenario.parameters
        is_push = self.ball is not None and rng.random() < parameters.push.share
        if not is_push:
            self._set(context, rng, parameters.start.sample(self.kinematics, rng))
            return 0
        # The ball hits at any moment of a calm motion, not only as it starts.
        self._start_calm(context, rng, elapsed_s=rng.uniform(0.0, _LATEST_HIT_S))
        # The first row after the hit sees it between 0 and one assessment step ago.
        lead_s = rng.uniform(0.0, 1.0) * self.scenario.step_s
        self.throw_ball(context, parameters.push.sample(rng, lead_s), lead_s)
        return 1

    def reset_calm(self, context: Context, rng: np.random.Generator) -> None:
        """Starts a calm motion near the stance, as it is when a ball is thrown."""
        self._start_calm(context, rng, elapsed_s=0.0)

    def _start_calm(self, context: Context, rng: np.random.Generator, elapsed_s: float) -> None:
        """Enters a calm motion ``elapsed_s`` after its start, as if it had been tracked well."""
        parameters = self.scenario.parameters
        start = calm_start(
            self.kinematics,
            rng,
            half_widths_m=parameters.push.target_offset_m,
            plan_duration_s=parameters.start.plan_duration_s,
            elapsed_s=elapsed_s,
        )
        self._set(context, rng, start)

    def reset_to(
        self, context: Context, rng: np.random.Generator | None, start: EpisodeStart
    ) -> None:
        """Begins with a given state and plan; see :meth:`ClosedLoop.reset_to`."""
        start.check(self.kinematics)
        self._enter(context, start)
        self._observers.reseed(context, rng)
        if rng is None:
            self._observers.silence(context)

    def start_of(self, context: Context) -> EpisodeStart:
        """What an episode that goes on from here begins with."""
        state = self.GetOutputPort("plant_state").Eval(context)
        q, v = np.split(state, [self.kinematics.num_positions])
        controller_context = self._controller.GetMyContextFromRoot(context)
        return EpisodeStart(
            q=q,
            v=v,
            plan=self._planner.plan_from_now(self._planner.GetMyContextFromRoot(context)),
            foot_positions=self._controller.foot_positions(controller_context).copy(),
        )

    def standing_start(self) -> EpisodeStart:
        """At rest in the standing posture, which the plan keeps."""
        kinematics = self.kinematics
        base = np.append(kinematics.nominal_base_offset, kinematics.standing_height)
        return EpisodeStart(
            q=kinematics.standing_positions(),
            v=np.zeros(kinematics.num_velocities),
            plan=PiecewisePolynomial(base[:, None]),
        )

    def _set(self, context: Context, rng: np.random.Generator, start: Start) -> None:
        joints = np.clip(start.joints, *self.kinematics.position_limits.T)
        q = self.kinematics.positions_at(start.X_WB, joints)
        self._enter(
            context, EpisodeStart(q=q, v=start.v, plan=start.plan, foot_positions=start.p_WC)
        )
        self._observers.reseed(context, rng)

    def _enter(self, context: Context, start: EpisodeStart) -> None:
        # The state alone: parameters such as an assessor's beliefs are not an episode's to forget.
        context.SetTime(0.0)
        context.get_mutable_discrete_state().SetFrom(self._default.get_discrete_state())
        with self._physics.edited(context) as plant_context:
            self.plant.SetPositionsAndVelocities(
                plant_context, self.robot_instance, np.concatenate([start.q, start.v])
            )
            if self.ball is not None:
                self.ball.park(plant_context)
        p_WC, stance_pose = start.feet(self.kinematics), start.stance_pose(self.kinematics)
        self._planner.set_plan(
            self._planner.GetMyMutableContextFromRoot(context), start.plan, stance_pose
        )
        self._controller.set_foot_positions(
            self._controller.GetMyMutableContextFromRoot(context), p_WC
        )
        if self._recovery_switch is not None:
            step_planner = self._recovery_switch.step_planner
            step_planner.set_stance(
                step_planner.GetMyMutableContextFromRoot(context), p_WC, stance_pose
            )

    def candidate_plans(
        self, context: Context, rng: np.random.Generator, num_plans: int
    ) -> list[PiecewisePolynomial]:
        """Plans that end over the same point, at other heights and after other durations.

        Both as training draws them. A motion that is under way goes on as it was planned.
        """
        planned = self._planner.get_plan(self._planner.GetMyContextFromRoot(context))
        if planned.start_time() < context.get_time():
            return [planned]
        sampling = self.scenario.parameters.start
        start, goal = (
            planned.value(time).ravel() for time in (planned.start_time(), planned.end_time())
        )
        plans = [planned]
        for _ in range(num_plans - 1):
            height_m = rng.uniform(*sampling.target_height_m)
            duration_s = rng.uniform(*sampling.plan_duration_s)
            end = np.append(goal[:2], height_m)
            plans.append(interpolate(start, end, duration_s, planned.start_time()))
        return plans

    def set_plan(self, context: Context, plan: PiecewisePolynomial) -> None:
        """Sets a plan; see :meth:`ClosedLoop.set_plan`."""
        self._planner.set_plan(self._planner.GetMyMutableContextFromRoot(context), plan)

    @property
    def trigger_port(self) -> str:
        """Name of the output port that recovery is triggered by."""
        is_normalized = self.scenario.parameters.recovery.is_normalized
        return "normalized_safety_probability" if is_normalized else "safety_probability"

    def sample_throw(self, rng: np.random.Generator, time_s: float) -> Throw:
        """A random ball; see :meth:`ClosedLoop.sample_throw`."""
        return self.scenario.parameters.push.sample(rng, time_s)

    def throw_ball(self, context: Context, throw: Throw, lead_s: float) -> float:
        """Sets the ball in flight; see :meth:`ClosedLoop.throw_ball`."""
        if self.ball is None:
            raise ValueError("balancing: built without a ball; pass ball=True to make_loop")
        with self._physics.edited(context) as plant_context:
            self.ball.throw(plant_context, throw, lead_s)
        return context.get_time() + lead_s
