"""Reaching: a robot stands and moves a hand to a target, if it can do so safely."""

import math
from pathlib import Path
from types import MappingProxyType

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import MatrixGain
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.kinematics import RobotKinematics, fit_stance
from drake_safety.control.reaching_safe_set import ReachingSafeSet
from drake_safety.diagrams.reaching_parameters import ReachingParameters
from drake_safety.diagrams.reaching_side import ReachingSide
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.segments import Episode
from drake_safety.models import load_robot, robot_files
from drake_safety.plants.obstacles import Clearance
from drake_safety.plants.physics import Scene, add_physics
from drake_safety.plants.pushes import Push
from drake_safety.robots.robot import ObservationNoise, model_file
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.observers import Observers, combined
from drake_safety.simulation.plan_shape import plan_shape, points_of_plan
from drake_safety.simulation.scenario import Scenario
from drake_safety.systems.plan_features import PlanFeatures
from drake_safety.systems.push_source import PushSource
from drake_safety.systems.safety_monitor import SafetyMonitor
from drake_safety.systems.trajectory_planner import TrajectoryPlanner, interpolate
from drake_safety.systems.whole_body_controller import WholeBodyController

_NUM_OUTLOOK = 31  # Samples of the whole plan: a board must not fit between two of them.


class Reaching(ClosedLoop):
    """The diagram of the reaching task, for any robot.yaml with feet and reaching frames.

    The other hand is the trained one in the mirror: ``state``, ``desired_preview`` and
    ``features`` are then those of the mirror image, so that one assessment serves both. All else
    is as it is.

    Args:
        scenario: The scenario.
        variation: Name of the plant variation.
        assessment: Γ; adds the assessor.
        meshcat: Adds a visualiser.
        hand: Which hand reaches; the scenario's by default.
        exploring: Whether episodes without a goal of their own also make detours and are pushed,
            as the scenario says; else every plan is the straight one, undisturbed.

    Raises:
        ValueError: A robot without feet or reaching frames, an unknown hand, one that is neither
            the trained hand nor its mirror image, a decoration that can be touched, or an
            assessment of another diagram.
    """

    Parameters = ReachingParameters
    judging_options = MappingProxyType({"exploring": False})
    online_parameters = (
        "decorations",
        "fair",
        "named_targets",
        "pushes",
        "assessment_period_s",
        "view",
    )
    plan_variety = "its parameter 'detours' says how far plans may lead around, in training too"

    def __init__(
        self,
        scenario: Scenario,
        variation: str = "nominal",
        *,
        assessment: SafetyAssessment | None = None,
        meshcat: Meshcat | None = None,
        hand: str | None = None,
        exploring: bool = True,
    ):
        super().__init__(scenario, variation, assessment)
        parameters = scenario.parameters
        horizon = scenario.assessment.horizon
        robot = load_robot(scenario.robot)
        if not robot.reaching_frames:
            raise ValueError(f"robot '{robot.name}' has no reaching frames, so it cannot reach")
        self._is_exploring = exploring
        nominal = scenario.variation("nominal")
        kinematics = RobotKinematics(robot, nominal)
        self.kinematics = kinematics
        trained_hand = parameters.hand or next(iter(robot.reaching_frames))
        self._side = ReachingSide(kinematics, trained_hand, hand, scenario_name=scenario.name)
        self.hand, self.mirror = self._side.hand, self._side.mirror
        builder = DiagramBuilder()

        physics = add_physics(
            builder,
            robot,
            self.variation,
            Scene(obstacles=parameters.obstacles, decorations=parameters.decorations),
            time_step_s=scenario.time_step_s,
            servos=False,
        )
        self._physics = physics
        self.plant, self.robot, self.robot_instance = physics.plant, robot, physics.instance
        self.scene_graph = physics.scene_graph

        n_q, n_v = kinematics.num_positions, kinematics.num_velocities
        plant_state = physics.state

        noise = self.variation.observation_noise
        self._observers = Observers(
            builder,
            kinematics,
            plant_state,
            scenario.control_period_s,
            hand=self.hand,
            mirror=self.mirror,
        )
        observer = self._observers.add("observer", noise)
        assessor_observer = self._observers.add(
            "assessor_observer", combined(noise, self.variation.input_noise)
        )
        true_observer = self._observers.add("true_observer", ObservationNoise())

        planner = builder.AddNamedSystem(
            "trajectory_planner",
            TrajectoryPlanner(
                horizon=horizon,
                step_s=scenario.step_s,
                outlook_s=parameters.plan_duration_s,
                num_outlook=_NUM_OUTLOOK,
            ),
        )
        self._planner = planner
        desired_preview = planner.GetOutputPort("desired_preview")
        if self.mirror is not None:
            reflection = builder.AddNamedSystem(
                "preview_reflection",
                MatrixGain(D=np.kron(np.eye(horizon), np.diag(self.mirror.points(np.ones(3))))),
            )
            builder.Connect(desired_preview, reflection.get_input_port())
            desired_preview = reflection.get_output_port()

        controller = builder.AddNamedSystem(
            "whole_body_controller",
            WholeBodyController(
                kinematics,
                hand=self.hand,
                actuation_matrix=physics.actuation_matrix(kinematics.joint_names),
                period_s=scenario.control_period_s,
                # After the noise of its instant was drawn, within the plant's step.
                offset_s=0.5 * scenario.time_step_s,
            ),
        )
        self._controller = controller
        builder.Connect(
            observer.GetOutputPort("measured_plant_state"), controller.GetInputPort("plant_state")
        )
        for name in ("desired_output", "desired_output_rate"):
            builder.Connect(planner.GetOutputPort(name), controller.GetInputPort(name))
        physics.connect_torques(builder, controller.GetOutputPort("actuation"))
        self._push_source = builder.AddNamedSystem(
            "push_source",
            PushSource(self.plant, physics.instance, period_s=scenario.control_period_s),
        )
        builder.Connect(self._push_source.get_output_port(), physics.applied_spatial_force)

        clearance = Clearance(robot, parameters.obstacles, range_m=parameters.clearance_range_m)
        self.safe_set = ReachingSafeSet(
            controller.model, clearance, parameters.safe_set, is_mirrored=self.mirror is not None
        )
        monitor = builder.AddNamedSystem(
            "safety_monitor",
            SafetyMonitor(self.safe_set, n_q, n_v),
        )
        builder.Connect(plant_state, monitor.GetInputPort("plant_state"))
        features = builder.AddNamedSystem(
            "plan_features", PlanFeatures(self.safe_set, n_q, n_v, horizon=_NUM_OUTLOOK)
        )
        builder.Connect(
            assessor_observer.GetOutputPort("measured_plant_state"),
            features.GetInputPort("plant_state"),
        )
        builder.Connect(
            planner.GetOutputPort("desired_outlook"), features.GetInputPort("desired_preview")
        )

        self.state_names = assessor_observer.state_names
        self.output_names = assessor_observer.output_names
        self.feature_names = features.feature_names
        self.constraint_names = monitor.constraint_names
        self.fall_name = self.safe_set.fall_name
        self.watched_features = self.safe_set.watched_features
        self.angular_constraints = self.safe_set.angular_names
        self.named_targets = parameters.named_targets
        self.pushes = parameters.pushes
        self.view = parameters.view if self.mirror is None else parameters.view.mirrored()
        self.add_assessor(
            builder,
            period_s=parameters.assessment_period_s,
            state=assessor_observer.GetOutputPort("state"),
            desired_preview=desired_preview,
            features=features.GetOutputPort("features"),
        )
        builder.ExportOutput(assessor_observer.GetOutputPort("state"), "state")
        builder.ExportOutput(true_observer.GetOutputPort("state"), "true_state")
        builder.ExportOutput(observer.GetOutputPort("output"), "output")
        builder.ExportOutput(planner.GetOutputPort("desired_output"), "desired_output")
        builder.ExportOutput(desired_preview, "desired_preview")
        builder.ExportOutput(features.GetOutputPort("features"), "features")
        builder.ExportOutput(monitor.GetOutputPort("margins"), "margins")
        builder.ExportOutput(monitor.GetOutputPort("safe"), "safe")
        builder.ExportOutput(controller.GetOutputPort("solver_status"), "solver_status")
        builder.ExportOutput(plant_state, "plant_state")
        if meshcat is not None:
            MeshcatVisualizer.AddToBuilder(builder, physics.scene_graph, meshcat)
        self.finish(builder)
        self._default = self.CreateDefaultContext()

    @classmethod
    def model_files(cls, scenario: Scenario) -> list[Path]:
        """The robot's YAML and model file, and the obstacles' files."""
        files = [model_file(obstacle.model) for obstacle in scenario.parameters.obstacles]
        return [*robot_files(scenario.robot), *files]

    @property
    def target_box(self) -> np.ndarray:
        """Lowest and highest corner of the targets of this hand in the world, (2, 3) [m]."""
        return np.sort(self._side.points(self.scenario.parameters.target.box), axis=0)

    @property
    def fair_box(self) -> np.ndarray:
        """Lowest and highest corner of this hand's fair targets in the world, (2, 3) [m]."""
        parameters = self.scenario.parameters
        return np.sort(self._side.points(parameters.fair.box(parameters.target)), axis=0)

    @property
    def mirror_options(self) -> dict[str, str]:
        """The hand on the other side, if the robot has one there."""
        other = self._side.other_hand
        return {} if other is None else {"hand": other}

    def goal_of(self, episode: Episode) -> np.ndarray:
        """The target of an episode in the world, (3,) [m], as exact as feet are placed."""
        return self._shape_of_plan(episode)[1]

    def is_fair(self, episode: Episode) -> bool:
        """Whether the target is in the fair box, and the plan leads through no obstacle."""
        path = points_of_plan(self._shape_of_plan(episode), _NUM_OUTLOOK)
        radius_m = self.robot.reaching_frame(self.hand).radius_m
        is_clear = self.safe_set.clearance.of_points(path, radius_m).min() > 0
        return bool(is_clear) and super().is_fair(episode)

    def _shape_of_plan(self, episode: Episode) -> np.ndarray:
        """Start, goal and detour of the hand's motion in the world, (3, 3) [m]."""
        # The preview carries no noise, but it may end before the motion does.
        preview = episode.desired_preview[0].reshape(-1, 3)
        duration_s = self.scenario.parameters.plan_duration_s
        shape = self._side.points(plan_shape(preview, self.scenario.step_s, duration_s))
        # An episode begins on the feet of the standing posture.
        shape[:2, :2] -= self.kinematics.nominal_base_offset
        return shape

    @property
    def monitor_period_s(self) -> float:
        """Time between two looks at the margins [s]."""
        return self.scenario.parameters.monitor_period_s

    def num_controller_failures(self, context: Context) -> int:
        """Ticks whose quadratic program had no solution."""
        return self._controller.num_failures(self._controller.GetMyContextFromRoot(context))

    def reset(
        self, context: Context, rng: np.random.Generator, goal: np.ndarray | None = None
    ) -> int:
        """Samples a standing posture and a target, and plans the hand's motion between them.

        Args:
            context: The diagram's Context; what an earlier episode left is overwritten.
            rng: Source of every draw.
            goal: Target in the world, (3,) [m], in place of a random one.

        Returns:
            0, or the first step after the push that an episode begins with.

        Raises:
            ValueError: The goal is not three finite numbers.
            RuntimeError: No posture that is drawn is in the safe set.
        """
        parameters = self.scenario.parameters
        q = parameters.start.sample(self.safe_set, rng, self.mirror)
        drawn = rng.uniform(*parameters.target.box)
        detour = push = None
        noise_rng = rng.spawn(1)[0]
        if goal is None:
            goal = self._side.points(drawn)
            if self._is_exploring:
                push = parameters.random_pushes.sample(rng, self.robot.base)
                detour = parameters.detours.sample(rng)
        if detour is not None:
            detour = self._side.points(detour)
        self._set(context, q, goal, detour)
        self._observers.reseed(context, noise_rng)
        if push is None:
            return 0
        self.set_push(context, self._side.push(push))
        end_s = push.time_s + push.duration_s + self.scenario.control_period_s
        return math.ceil(end_s / self.scenario.step_s)

    def set_push(self, context: Context, push: Push) -> None:
        """Plans a push on a body of the robot, in the run that was reset.

        Args:
            context: The diagram's Context.
            push: Where, how hard, when.

        Raises:
            ValueError: The robot has no such body.
        """
        self._push_source.set_push(
            self._push_source.GetMyMutableContextFromRoot(context),
            push.body,
            np.asarray(push.force_n, dtype=float),
            start_s=push.time_s,
            duration_s=push.duration_s,
        )

    def sample_push(self, rng: np.random.Generator) -> Push:
        """A push as episodes begin with it, whatever their share."""
        push = self.scenario.parameters.random_pushes.draw(rng, self.robot.base)
        return self._side.push(push)

    @property
    def rate_names(self) -> list[str]:
        """Velocities of the state, and the features that they enter."""
        return [*super().rate_names, *self.safe_set.rate_features]

    def candidate_plans(
        self, context: Context, rng: np.random.Generator, num_plans: int
    ) -> list[PiecewisePolynomial]:
        """The plan that there is, and ones that make detours as training has drawn them."""
        planned = self._planner.get_plan(self._planner.GetMyContextFromRoot(context))
        detours = self.scenario.parameters.detours
        if not detours.share or planned.start_time() < context.get_time():
            return [planned]
        start, end = planned.start_time(), planned.end_time()
        ends = [planned.value(time).ravel() for time in (start, end)]
        plans = [planned]
        for _ in range(num_plans - 1):
            detour = self._side.points(detours.draw(rng))
            plans.append(interpolate(*ends, end - start, start, detour=detour))
        return plans

    def set_plan(self, context: Context, plan: PiecewisePolynomial) -> None:
        """Sets a plan; see :meth:`ClosedLoop.set_plan`."""
        self._planner.set_plan(self._planner.GetMyMutableContextFromRoot(context), plan)

    def reset_standing(
        self, context: Context, goal: np.ndarray, rng: np.random.Generator | None = None
    ) -> None:
        """Starts in the standing posture towards a target; its first instant is without noise.

        Args:
            context: The diagram's Context; what an earlier episode left is overwritten.
            goal: Target in the world, (3,) [m].
            rng: Source of the noise that follows; always the same by default.

        Raises:
            ValueError: The goal is not three finite numbers.
        """
        self._set(context, self.kinematics.standing_positions(), goal)
        self._observers.reseed(context, rng)
        self._observers.silence(context)

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
        plan = self._planner.plan_from_now(self._planner.GetMyContextFromRoot(context))
        return EpisodeStart(q=q, v=v, plan=plan)

    def standing_start(self) -> EpisodeStart:
        """At rest in the standing posture, the hand where it is."""
        q = self.kinematics.standing_positions()
        hand = self._controller.model.reaching_position(q).copy()
        # The plan is told from the feet.
        hand[:2] += self.kinematics.nominal_base_offset
        v = np.zeros(self.kinematics.num_velocities)
        return EpisodeStart(q=q, v=v, plan=PiecewisePolynomial(hand[:, None]))

    def _set(
        self,
        context: Context,
        q: np.ndarray,
        goal: np.ndarray,
        detour: np.ndarray | None = None,
    ) -> None:
        goal = np.asarray(goal, dtype=float)
        if goal.shape != (3,) or not np.isfinite(goal).all():
            raise ValueError(f"reaching: a target is three finite numbers [m]; got {goal}")
        q = q.copy()
        q[6] -= self.scenario.parameters.start.sink_m
        stance_pose = fit_stance(
            self.kinematics.contact_positions(q), self.kinematics.nominal_contacts
        )
        x, y, yaw = stance_pose
        X_SW = RigidTransform(RotationMatrix.MakeZRotation(yaw), [x, y, 0.0]).inverse()
        plan = interpolate(
            X_SW @ self._controller.model.reaching_position(q),
            X_SW @ goal,
            self.scenario.parameters.plan_duration_s,
            detour=None if detour is None else X_SW.rotation() @ detour,
        )
        v = np.zeros(self.kinematics.num_velocities)
        self._enter(context, EpisodeStart(q=q, v=v, plan=plan))

    def _enter(self, context: Context, start: EpisodeStart) -> None:
        # The state alone: parameters such as an assessor's beliefs are not an episode's to forget.
        context.SetTime(0.0)
        context.get_mutable_discrete_state().SetFrom(self._default.get_discrete_state())
        self._push_source.clear_push(self._push_source.GetMyMutableContextFromRoot(context))
        with self._physics.edited(context) as plant_context:
            self.plant.SetPositionsAndVelocities(
                plant_context, self.robot_instance, np.concatenate([start.q, start.v])
            )
        self._controller.set_reference(
            self._controller.GetMyMutableContextFromRoot(context),
            self._controller.model.reference(start.q),
        )
        self._planner.set_plan(
            self._planner.GetMyMutableContextFromRoot(context),
            start.plan,
            start.stance_pose(self.kinematics),
        )
