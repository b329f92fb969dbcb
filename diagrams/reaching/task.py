"""Reaching: a standing robot moves a hand to a target."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import MatrixGain
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.kinematics import planar_pose
from drake_safety.control.mirror import Mirror
from drake_safety.diagrams.reaching.parameters import ReachingParameters
from drake_safety.diagrams.reaching.safe_set import ReachingSafeSet
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.plants.obstacles import Clearance
from drake_safety.plants.physics import Scene
from drake_safety.plants.pushes import Push
from drake_safety.robots.model_files import model_file
from drake_safety.simulation.closed_loop import Purpose
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.scenario import Scenario
from drake_safety.systems.trajectory_planner import interpolate
from drake_safety.systems.whole_body_controller import WholeBodyController

_USUAL_SHARES = (0.1, 0.5)  # Shares of the way to a target, in undisturbed motion.
_NUM_OUTLOOK = 31  # Samples of the whole plan: dense enough for thin obstacles.


class Reaching(LeggedLoop):
    """The diagram of the reaching task, for any robot.yaml with feet and reaching frames.

    For the other hand, ``state``, ``desired_preview`` and ``features`` are mirrored, so that one
    assessment applies to both hands.
    ``hand`` reaches, by default the scenario's. If ``exploring``, episodes with random goals have
    the scenario's detours and pushes.
    """

    Parameters = ReachingParameters

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
        parameters, robot, kinematics = scenario.parameters, self.robot, self.kinematics
        if not robot.reaching_frames:
            raise ValueError(f"robot '{robot.name}' has no reaching frames, so it cannot reach")
        self._is_exploring = exploring
        trained_hand = parameters.hand or next(iter(robot.reaching_frames))
        self.hand = trained_hand if hand is None else hand
        self.mirror = self._mirror_to(trained_hand)
        self.named_targets, self.pushes = parameters.named_targets, parameters.pushes
        self.view = parameters.view if self.mirror is None else parameters.view.mirrored()
        builder = DiagramBuilder()
        scene = Scene(obstacles=parameters.obstacles, decorations=parameters.decorations)
        physics = self._add_robot(builder, scene, servos=False, meshcat=meshcat)
        measured = self._add_observers(builder, hand=self.hand, mirror=self.mirror)
        planner = self._add_planner(
            builder, outlook_s=parameters.plan_duration_s, num_outlook=_NUM_OUTLOOK
        )
        preview = planner.GetOutputPort("desired_preview")
        if self.mirror is not None:
            reflection = np.tile(self.mirror.points(np.ones(3)), scenario.assessment.horizon)
            gain = MatrixGain(D=np.diag(reflection))
            reflected = builder.AddNamedSystem("preview_reflection", gain)
            builder.Connect(preview, reflected.get_input_port())
            preview = reflected.get_output_port()
        controller = self._controller = WholeBodyController(
            kinematics,
            hand=self.hand,
            actuation_matrix=physics.actuation_matrix(kinematics.joint_names),
            period_s=scenario.control_period_s,
            offset_s=2 * self.tick_s,  # After the update of the noise.
        )
        builder.AddNamedSystem("whole_body_controller", controller)
        self._connect_controller(builder, controller, measured)
        actuators = map(self.plant.get_joint_actuator, self.plant.GetJointActuatorIndices())
        names = [each.name() for each in actuators if each.model_instance() == self.robot_instance]
        torques = self._as_received(builder, controller.GetOutputPort("actuation"), names)
        physics.connect_torques(builder, torques)
        self._add_push_source(builder)
        self.safe_set = ReachingSafeSet(
            controller.model,
            Clearance(robot, parameters.obstacles, range_m=parameters.clearance_range_m),
            parameters.safe_set,
            is_mirrored=self.mirror is not None,
        )
        self.angular_constraints = self.safe_set.angular_names
        self.monitored = {"features": []}  # Its controller follows the preview.
        ports = {
            "desired_outlook": planner.GetOutputPort("desired_outlook"),
            "desired_preview": preview,
            "solver_status": controller.GetOutputPort("solver_status"),
            "num_controller_failures": controller.GetOutputPort("num_failures"),
        }
        period_s = parameters.assessment_period_s
        self._assess(builder, self.safe_set, ports, period_s=period_s, has_gravity=True)
        builder.BuildInto(self)

    @classmethod
    def model_files(cls, scenario: Scenario) -> list[Path]:
        """The robot's YAML and model file, and the obstacles' model files."""
        files = [model_file(obstacle.model) for obstacle in scenario.parameters.obstacles]
        return [*super().model_files(scenario), *files]

    @property
    def target_box(self) -> np.ndarray:
        """Lowest and highest corner of the targets of this hand in the world, (2, 3) [m]."""
        return np.sort(self._reflected(self.scenario.parameters.target.box), axis=0)

    @classmethod
    def options_for(cls, purpose: Purpose, scenario: Scenario, variation: str) -> dict[str, Any]:
        """Straight plans without pushes for evaluation and the paper's mode."""
        del scenario, variation
        # "We do not sample an offset and do not add it to the initial state since we do not
        # consider disturbances here."
        return {} if purpose == "pairs" else {"exploring": False}

    def _mirror_to(self, trained_hand: str) -> Mirror | None:
        for name in (trained_hand, self.hand):
            self.robot.reaching_frame(name)
        if self.hand == trained_hand:
            return None
        mirror = Mirror(self.kinematics)
        if (image := mirror.hand(trained_hand)) != self.hand:
            hands = f"'{trained_hand}' and its mirror image '{image}'"
            raise ValueError(f"reaching: hands are {hands}; got '{self.hand}'")
        return mirror

    def _reflected(self, points: np.ndarray) -> np.ndarray:
        return points if self.mirror is None else self.mirror.points(points)

    def _reflected_push(self, push: Push) -> Push:
        return replace(push, force_n=self._reflected(np.array(push.force_n)).tolist())

    def reset(
        self, context: Context, rng: np.random.Generator, goal: np.ndarray | None = None
    ) -> int:
        """Samples a standing posture and a target, and plans the hand's motion between them."""
        parameters = self.scenario.parameters
        q = parameters.start.sample(self.safe_set, rng, self.mirror)
        drawn = rng.uniform(*parameters.target.box)
        detour = push = None
        noise_rng = rng.spawn(1)[0]
        if goal is None:
            goal = self._reflected(drawn)
            if self._is_exploring:
                push = parameters.random_pushes.sample(rng, self.robot.base)
                detour = parameters.detours.sample(rng)
        self._set(context, q, goal, None if detour is None else self._reflected(detour))
        self._observers.reseed(context, noise_rng)
        if push is None:
            return 0
        self.set_push(context, self._reflected_push(push))
        end_s = push.time_s + push.duration_s + self.scenario.control_period_s
        return math.ceil(end_s / self.scenario.step_s)

    def sample_push(self, rng: np.random.Generator) -> Push:
        """Samples a push from the distribution of the episodes' initial pushes."""
        push = self.scenario.parameters.random_pushes.draw(rng, self.robot.base)
        return self._reflected_push(push)

    def reset_undisturbed(
        self, context: Context, rng: np.random.Generator, duration_s: float
    ) -> None:
        """Samples straight motions of the hand, up to half of the way to targets, and back."""
        piece_s = self.scenario.parameters.plan_duration_s
        q = self.scenario.parameters.start.sample(self.safe_set, rng, self.mirror)
        self._set(context, q, self._output_of(q))
        X_SW, plan = self._stance_in_world(q).inverse(), PiecewisePolynomial()
        home = self.start_of(context).plan.value(0.0).ravel()
        for i in range(math.ceil(duration_s / (2.0 * piece_s))):
            target = X_SW @ rng.uniform(*self.target_box)
            goal = home + rng.uniform(*_USUAL_SHARES) * (target - home)
            plan.ConcatenateInTime(interpolate(home, goal, piece_s, 2 * i * piece_s))
            plan.ConcatenateInTime(interpolate(goal, home, piece_s, (2 * i + 1) * piece_s))
        self.set_plan(context, plan)
        self._observers.reseed(context, rng)

    def reset_standing(
        self, context: Context, goal: np.ndarray, rng: np.random.Generator | None = None
    ) -> None:
        """Starts in the standing posture with a plan to a target; without initial noise."""
        self._set(context, self.kinematics.standing_positions(), goal)
        self._observers.reseed(context, rng)
        self._observers.silence(context)

    def _output_of(self, q: np.ndarray) -> np.ndarray:
        return self._controller.model.reaching_position(q)

    def _set(
        self, context: Context, q: np.ndarray, goal: np.ndarray, detour: np.ndarray | None = None
    ) -> None:
        goal = np.asarray(goal, dtype=float)
        if goal.shape != (3,) or not np.isfinite(goal).all():
            raise ValueError(f"reaching: a target is three finite numbers [m]; got {goal}")
        q = q.copy()
        q[6] -= self.scenario.parameters.start.sink_m
        X_SW = self._stance_in_world(q).inverse()
        plan = interpolate(
            X_SW @ self._output_of(q),
            X_SW @ goal,
            self.scenario.parameters.plan_duration_s,
            detour=None if detour is None else X_SW.rotation() @ detour,
        )
        v = np.zeros(self.kinematics.num_velocities)
        self._enter(context, EpisodeStart(q=q, v=v, plan=plan))

    def _stance_in_world(self, q: np.ndarray) -> RigidTransform:
        return planar_pose(self.kinematics.stance_pose(q))

    def _set_state(self, context: Context, start: EpisodeStart) -> None:
        super()._set_state(context, start)
        self._controller.set_reference(
            self._controller.GetMyMutableContextFromRoot(context),
            self._controller.model.reference(start.q),
        )
