"""Reaching: a robot stands and moves a hand to a target, if it can do so safely."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, DiscreteContactApproximation
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, MatrixGain
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.inverse_kinematics import solve_inverse_kinematics
from drake_safety.control.kinematics import NUM_BASE_POSITIONS, RobotKinematics, fit_stance
from drake_safety.control.mirror import Mirror
from drake_safety.control.obstacles import (
    Clearance,
    Obstacle,
    add_obstacles,
    collision_geometries,
    filter_collisions,
)
from drake_safety.control.reaching_safe_set import ReachingLimits, ReachingSafeSet
from drake_safety.control.robot import (
    ObservationNoise,
    actuation_matrix,
    add_robot,
    apply_mass_scale,
    model_file,
)
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.segments import Episode
from drake_safety.models import load_robot, robot_files
from drake_safety.simulation.closed_loop import ClosedLoop
from drake_safety.simulation.ground import add_ground
from drake_safety.simulation.observers import Observers, combined
from drake_safety.simulation.pushes import Push
from drake_safety.simulation.scenario import Scenario
from drake_safety.simulation.view import View
from drake_safety.systems.plan_features import PlanFeatures
from drake_safety.systems.safety_assessor import SafetyAssessor
from drake_safety.systems.safety_monitor import SafetyMonitor
from drake_safety.systems.trajectory_planner import TrajectoryPlanner, interpolate
from drake_safety.systems.whole_body_controller import WholeBodyController

_NUM_OUTLOOK = 31  # Samples of the whole plan: a board must not fit between two of them.
_MAX_TRIES = 100


@dataclass(kw_only=True)
class PostureSampling:
    """Random standing postures. Half-widths about the standing one, unless it says otherwise."""

    base_offset_m: list[float] = field(default_factory=lambda: [0.02, 0.02])
    """Along x and along y."""
    base_lowering_m: float = 0.08
    """How far at most the base is lowered."""
    tilt_rad: float = 0.03
    """Of roll, pitch and yaw of the base, each."""
    joint_offset_rad: float = 0.1
    """Of every joint that belongs to no leg."""
    clearance_m: float = 0.02
    """Least distance of the arms to an obstacle."""

    def __post_init__(self) -> None:
        if len(self.base_offset_m) != 2:
            raise ValueError(f"start: base_offset_m must be [x, y]; got {self.base_offset_m}")
        for name in (
            "base_offset_m",
            "base_lowering_m",
            "tilt_rad",
            "joint_offset_rad",
            "clearance_m",
        ):
            value = np.asarray(getattr(self, name), dtype=float)
            if not ((value >= 0) & np.isfinite(value)).all():
                raise ValueError(
                    f"start: {name} must be finite and not negative; got {getattr(self, name)}"
                )


@dataclass(kw_only=True)
class TargetSampling:
    """The box that targets of the trained hand are drawn from, in the world [m].

    The other hand's targets come from its mirror image.
    """

    x_m: list[float] = field(default_factory=lambda: [0.45, 1.0])
    y_m: list[float] = field(default_factory=lambda: [-0.3, 1.3])
    z_m: list[float] = field(default_factory=lambda: [0.5, 1.6])

    def __post_init__(self) -> None:
        for name in ("x_m", "y_m", "z_m"):
            bounds = getattr(self, name)
            if len(bounds) != 2 or not -np.inf < bounds[0] < bounds[1] < np.inf:
                raise ValueError(f"target: {name} must be [lowest, highest], finite; got {bounds}")

    @property
    def box(self) -> np.ndarray:
        """Lowest and highest corner, (2, 3) [m]."""
        return np.array([self.x_m, self.y_m, self.z_m], dtype=float).T


@dataclass(kw_only=True)
class FairTargets:
    """The part of the target box in which a verdict is neither trivial nor absurd, in the world.

    Bounds that are left empty are the target box's own.
    """

    x_m: list[float] = field(default_factory=list)
    y_m: list[float] = field(default_factory=list)
    z_m: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        for name in ("x_m", "y_m", "z_m"):
            bounds = getattr(self, name)
            if bounds and (len(bounds) != 2 or not bounds[0] < bounds[1]):
                raise ValueError(f"fair: {name} must be [lowest, highest] or empty; got {bounds}")

    def box(self, target: TargetSampling) -> np.ndarray:
        """Lowest and highest corner, (2, 3) [m]."""
        bounds = [getattr(self, name) or getattr(target, name) for name in ("x_m", "y_m", "z_m")]
        return np.array(bounds, dtype=float).T


@dataclass(kw_only=True)
class ReachingParameters:
    """The task's part of the scenario file."""

    hand: str = ""
    """The hand that episodes are recorded of, a reaching frame of the robot; its first one by
    default."""
    plan_duration_s: float = 3.0
    """Duration of the planned motion [s]."""
    via_m: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Half-widths of how far plans bend aside half-way, along x, y and z; other plans than straight
    ones can be chosen from only where training has drawn such."""
    monitor_period_s: float = 0.02
    """Time between two looks at the margins [s]."""
    clearance_range_m: float = 0.1
    """Distances to obstacles beyond this count as this [m]."""
    safe_set: ReachingLimits = field(default_factory=ReachingLimits)
    start: PostureSampling = field(default_factory=PostureSampling)
    target: TargetSampling = field(default_factory=TargetSampling)
    fair: FairTargets = field(default_factory=FairTargets)
    obstacles: list[Obstacle] = field(default_factory=list)
    decorations: list[Obstacle] = field(default_factory=list)
    """Models without collision geometry, to be seen."""
    named_targets: dict[str, list[float]] = field(default_factory=dict)
    """Targets in the world that can be asked for by name, (3,) [m] each."""
    pushes: dict[str, Push] = field(default_factory=dict)
    """Pushes that a run can be disturbed with, by name."""
    assessment_period_s: float = 0.02
    """Time between two evaluations of Γ [s]."""
    view: View = field(default_factory=View)
    """Where pictures are taken from when the trained hand reaches."""

    def __post_init__(self) -> None:
        for name in (
            "plan_duration_s",
            "monitor_period_s",
            "clearance_range_m",
            "assessment_period_s",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"reaching: {name} must be positive; got {getattr(self, name)}")
        if len(self.via_m) != 3 or not all(0 <= width < np.inf for width in self.via_m):
            raise ValueError(
                f"reaching: via_m must be three finite widths, none negative; got {self.via_m}"
            )
        if not self.start.clearance_m <= self.clearance_range_m:
            raise ValueError(
                f"reaching: start.clearance_m must not exceed clearance_range_m, beyond which "
                f"distances count as {self.clearance_range_m}; got {self.start.clearance_m}"
            )
        for name, target in self.named_targets.items():
            if len(target) != 3 or not np.isfinite(target).all():
                raise ValueError(
                    f"reaching: named target '{name}' must be three numbers [m]; got {target}"
                )


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

    Raises:
        ValueError: A robot without feet or reaching frames, an unknown hand, one that is neither
            the trained hand nor its mirror image, a decoration that can be touched, or an
            assessment of another diagram.
    """

    Parameters = ReachingParameters
    online_parameters = (
        "decorations",
        "fair",
        "named_targets",
        "pushes",
        "assessment_period_s",
        "view",
    )
    added_parameters = ("via_m",)
    plan_variety = "its parameter 'via_m' says how far plans may bend aside, in training too"

    def __init__(
        self,
        scenario: Scenario,
        variation: str = "nominal",
        *,
        assessment: SafetyAssessment | None = None,
        meshcat: Meshcat | None = None,
        hand: str | None = None,
    ):
        super().__init__(scenario, variation, assessment)
        parameters = scenario.parameters
        horizon = scenario.assessment.horizon
        robot = load_robot(scenario.robot)
        if not robot.reaching_frames:
            raise ValueError(f"robot '{robot.name}' has no reaching frames, so it cannot reach")
        trained_hand = parameters.hand or next(iter(robot.reaching_frames))
        self.hand = trained_hand if hand is None else hand
        for name in (trained_hand, self.hand):
            robot.reaching_frame(name)
        builder = DiagramBuilder()

        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, scenario.time_step_s)
        plant.set_name("plant")
        plant.set_discrete_contact_approximation(DiscreteContactApproximation.kLagged)
        instance = add_robot(plant, robot, self.variation, scene_graph=scene_graph, servos=False)
        add_ground(plant, self.variation.foot_friction or robot.foot_friction)
        obstacles = add_obstacles(plant, parameters.obstacles)
        decorations = add_obstacles(plant, parameters.decorations)
        plant.SetUseSampledOutputPorts(False)
        plant.Finalize()
        for decoration, model in zip(parameters.decorations, decorations, strict=True):
            if collision_geometries(plant, [model]):
                raise ValueError(
                    f"reaching: decoration '{decoration.model}' has collision geometry, which no "
                    "margin would tell of; list it under 'obstacles'"
                )
        filter_collisions(plant, scene_graph, robot, obstacles)
        self.plant, self.robot, self.robot_instance = plant, robot, instance
        self.scene_graph = scene_graph

        nominal = scenario.variation("nominal")
        kinematics = RobotKinematics(robot, nominal)
        self.kinematics = kinematics
        n_q, n_v = kinematics.num_positions, kinematics.num_velocities
        plant_state = plant.get_state_output_port(instance)
        self.mirror = None if self.hand == trained_hand else Mirror(kinematics)
        if self.mirror is not None and self.mirror.hand(trained_hand) != self.hand:
            raise ValueError(
                f"reaching: scenario '{scenario.name}' is about hand '{trained_hand}' of robot "
                f"'{robot.name}' and its mirror image '{self.mirror.hand(trained_hand)}'; got "
                f"'{self.hand}'"
            )

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
                actuation_matrix=actuation_matrix(plant, robot, kinematics.joint_names),
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
        builder.Connect(
            controller.GetOutputPort("actuation"), plant.get_actuation_input_port(instance)
        )
        if self.variation.joint_friction_nm:
            # Without a desired state Drake disarms the servos that are the joints' friction.
            port = plant.get_desired_state_input_port(instance)
            rest = builder.AddNamedSystem("rest", ConstantVectorSource(np.zeros(port.size())))
            builder.Connect(rest.get_output_port(), port)

        clearance = Clearance(robot, parameters.obstacles, range_m=parameters.clearance_range_m)
        self.safe_set = ReachingSafeSet(
            controller.model, clearance, parameters.safe_set, is_mirrored=self.mirror is not None
        )
        monitor = builder.AddNamedSystem(
            "safety_monitor",
            SafetyMonitor(self.safe_set, n_q, n_v, period_s=parameters.monitor_period_s),
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
        self.angular_constraints = self.safe_set.angular_names
        self.named_targets = parameters.named_targets
        self.pushes = parameters.pushes
        self.view = parameters.view if self.mirror is None else parameters.view.mirrored()
        if assessment is not None:
            self.check_assessment()
            assessor = builder.AddNamedSystem(
                "safety_assessor",
                SafetyAssessor(assessment, period_s=parameters.assessment_period_s),
            )
            builder.Connect(
                assessor_observer.GetOutputPort("state"), assessor.GetInputPort("state")
            )
            builder.Connect(desired_preview, assessor.GetInputPort("desired_preview"))
            builder.Connect(features.GetOutputPort("features"), assessor.GetInputPort("features"))
            for i in range(assessor.num_output_ports()):
                port = assessor.get_output_port(i)
                builder.ExportOutput(port, port.get_name())
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
        builder.ExportInput(plant.get_applied_spatial_force_input_port(), "applied_spatial_force")
        if meshcat is not None:
            MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
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
        return self._of_this_hand(self.scenario.parameters.target.box)

    @property
    def fair_box(self) -> np.ndarray:
        """Lowest and highest corner of this hand's fair targets in the world, (2, 3) [m]."""
        parameters = self.scenario.parameters
        return self._of_this_hand(parameters.fair.box(parameters.target))

    def _of_this_hand(self, box: np.ndarray) -> np.ndarray:
        return box if self.mirror is None else np.sort(self.mirror.points(box), axis=0)

    @property
    def mirror_options(self) -> dict[str, str]:
        """The hand on the other side, if the robot has one there."""
        try:
            return {"hand": Mirror(self.kinematics).hand(self.hand)}
        except ValueError:  # No mirror, or nothing in it.
            return {}

    def goal_of(self, episode: Episode) -> np.ndarray:
        """The target of an episode in the world, (3,) [m], as exact as feet are placed."""
        return self._ends_of_plan(episode)[1]

    def is_fair(self, episode: Episode) -> bool:
        """Whether the target is in the fair box, and the plan leads through no obstacle."""
        path = np.linspace(*self._ends_of_plan(episode), _NUM_OUTLOOK)
        radius_m = self.robot.reaching_frame(self.hand).radius_m
        is_clear = self.safe_set.clearance.of_points(path, radius_m).min() > 0
        return bool(is_clear) and super().is_fair(episode)

    def _ends_of_plan(self, episode: Episode) -> tuple[np.ndarray, np.ndarray]:
        """Where the hand's motion begins and where it leads, in the world, (3,) each [m]."""
        # The preview carries no noise, but it may end before the motion does.
        preview = episode.desired_preview[episode.first_step].reshape(-1, 3)
        duration_s = self.scenario.parameters.plan_duration_s
        seen_s = min(self.scenario.step_s * (len(preview) - 1), duration_s)
        progress = interpolate(np.zeros(1), np.ones(1), duration_s).value(seen_s).item()
        start = preview[0]
        ends = np.array([start, start + (preview[-1] - start) / progress])
        if any(self.scenario.parameters.via_m) and len(preview) > 2:
            # A bent plan: what it is made of is told from all samples, not from the last alone.
            times = np.minimum(self.scenario.step_s * np.arange(len(preview)), duration_s)
            unit, still = np.ones(1), np.zeros(1)
            parts = [
                interpolate(still, unit, duration_s).vector_values(times)[0],
                interpolate(still, still, duration_s, via=unit).vector_values(times)[0],
            ]
            ends[1] = start + np.linalg.lstsq(np.column_stack(parts), preview - start)[0][0]
        if self.mirror is not None:
            ends = self.mirror.points(ends)
        # An episode begins on the feet of the standing posture.
        ends[:, :2] -= self.kinematics.nominal_base_offset
        return ends[0], ends[1]

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
            0: nothing disturbs an episode.

        Raises:
            ValueError: The goal is not three finite numbers.
            RuntimeError: No posture that is drawn is in the safe set.
        """
        q = self._sample_posture(rng)
        drawn = rng.uniform(*self.scenario.parameters.target.box)
        if goal is None:
            goal = drawn if self.mirror is None else self.mirror.points(drawn)
        self._set(context, q, goal, self._draw_via(rng))
        self._observers.reseed(context, rng)
        return 0

    def _draw_via(self, rng: np.random.Generator) -> np.ndarray | None:
        """A random bend (3,) [m]; None, and no draw, where plans are straight."""
        widths = np.array(self.scenario.parameters.via_m)
        if not widths.any():
            return None
        via = rng.uniform(-widths, widths)
        return via if self.mirror is None else self.mirror.points(via)

    def candidate_plans(
        self, context: Context, rng: np.random.Generator, num_plans: int
    ) -> list[PiecewisePolynomial]:
        """The plan that there is, the straight one and bent ones as training has drawn them."""
        planned = self._planner.get_plan(self._planner.GetMyContextFromRoot(context))
        if not any(self.scenario.parameters.via_m):
            return [planned]
        start, end = planned.start_time(), planned.end_time()
        ends = [planned.value(time).ravel() for time in (start, end)]
        bends = [np.zeros(3), *(self._draw_via(rng) for _ in range(num_plans - 2))]
        plans = [interpolate(*ends, end - start, start, via=via) for via in bends]
        return [planned, *plans][:num_plans]

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
        self._observers.reseed(context, np.random.default_rng(0) if rng is None else rng)
        self._observers.silence(context)

    def _sample_posture(self, rng: np.random.Generator) -> np.ndarray:
        sampling = self.scenario.parameters.start
        kinematics = self.kinematics
        legs = {name for foot in self.robot.feet.values() for name in foot.joints}
        is_free = np.array([name not in legs for name in kinematics.joint_names])
        standing = kinematics.standing_positions()
        p_WC = kinematics.contact_positions(standing)
        for _ in range(_MAX_TRIES):
            joints = kinematics.posture + is_free * sampling.joint_offset_rad * rng.uniform(
                -1, 1, kinematics.num_joints
            )
            offset = np.append(
                rng.uniform(-1, 1, 2) * sampling.base_offset_m,
                -rng.uniform(0, sampling.base_lowering_m),
            )
            rotation = RollPitchYaw(rng.uniform(-1, 1, 3) * sampling.tilt_rad)
            X_WB = RigidTransform(RotationMatrix(rotation), standing[4:NUM_BASE_POSITIONS] + offset)
            joints = solve_inverse_kinematics(kinematics, X_WB, p_WC, joints)
            q = kinematics.positions_at(X_WB, joints)
            v = np.zeros(kinematics.num_velocities)
            if self.mirror is not None:
                # The mirror image of what the trained hand's episode of these draws begins with.
                q, _ = self.mirror.plant_state(q, v, np.zeros(3))
            margins = self.safe_set.margins(q, v)
            clearance = margins[self.safe_set.names.index("collision")]
            if clearance >= sampling.clearance_m and margins.min() > 0:
                return q
        raise RuntimeError(
            f"reaching: none of {_MAX_TRIES} random postures of robot '{self.robot.name}' is in "
            f"the safe set with a clearance of {sampling.clearance_m} m: narrow 'start'"
        )

    def _set(
        self, context: Context, q: np.ndarray, goal: np.ndarray, via: np.ndarray | None = None
    ) -> None:
        goal = np.asarray(goal, dtype=float)
        if goal.shape != (3,) or not np.isfinite(goal).all():
            raise ValueError(f"reaching: a target is three finite numbers [m]; got {goal}")
        kinematics = self.kinematics
        # The state alone: parameters such as an assessor's beliefs are not an episode's to forget.
        context.SetTime(0.0)
        context.get_mutable_discrete_state().SetFrom(self._default.get_discrete_state())
        plant_context = self.plant.GetMyMutableContextFromRoot(context)
        apply_mass_scale(self.plant, plant_context, self.robot, self.variation.mass_scale)
        v = np.zeros(kinematics.num_velocities)
        self.plant.SetPositionsAndVelocities(
            plant_context, self.robot_instance, np.concatenate([q, v])
        )
        model = self._controller.model
        self._controller.set_reference(
            self._controller.GetMyMutableContextFromRoot(context), model.reference(q)
        )
        stance_pose = fit_stance(kinematics.contact_positions(q), kinematics.nominal_contacts)
        x, y, yaw = stance_pose
        X_SW = RigidTransform(RotationMatrix.MakeZRotation(yaw), [x, y, 0.0]).inverse()
        plan = interpolate(
            X_SW @ model.reaching_position(q),
            X_SW @ goal,
            self.scenario.parameters.plan_duration_s,
            via=None if via is None else X_SW.rotation() @ via,
        )
        self._planner.set_plan(
            self._planner.GetMyMutableContextFromRoot(context), plan, stance_pose
        )
