"""Balancing: a legged robot keeps its base over its feet along a plan, and steps when it must."""

from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.control.safe_sets import BalanceSafeSet
from drake_safety.diagrams.balancing_parameters import BalancingParameters, fitted_to_robot
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.models import load_robot
from drake_safety.plants.balls import Throw
from drake_safety.plants.physics import ENGINES_WITH_BALLS, Scene
from drake_safety.robots.robot_model import by_pattern
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.sampling import calm_start
from drake_safety.simulation.scenario import Scenario
from drake_safety.systems.inverse_kinematics_controller import InverseKinematicsController
from drake_safety.systems.recovery_switch import RecoverySwitch
from drake_safety.systems.trajectory_planner import interpolate

_NUM_OUTLOOK = 5  # Samples of the plan from now to its end that the features see.
_LATEST_HIT_S = 1.5  # Of a calm motion, in episodes that begin with a hit.


class Balancing(LeggedLoop):
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
    plan_variety = "its parameter 'start' says at what heights and after what durations plans end"

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
        # Γ, trigger, step planner and controller tick one after the other within a plant step.
        tick_offset_s = 0.25 * scenario.time_step_s
        builder = DiagramBuilder()

        has_ball = parameters.push.share > 0 if ball is None else ball
        physics = self._add_robot(builder, Scene(has_ball=has_ball), servos=True)
        self.ball = physics.ball
        kinematics = self.kinematics
        measured = self._add_observers(builder)
        planner = self._add_planner(
            builder, outlook_s=scenario.episode_duration_s, num_outlook=_NUM_OUTLOOK
        )
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
                    horizon=scenario.assessment.horizon,
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

        robot = self.robot
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
        self._watch(builder, safe_set, outlook=desired_outlook)
        assessor = self._export_robot(
            builder,
            assessment_period_s=parameters.recovery.assessment_period_s,
            desired_output=desired_output,
            desired_preview=desired_preview,
            meshcat=meshcat,
        )
        if assessor is not None and recovery:
            builder.Connect(
                assessor.GetOutputPort(self.trigger_port),
                switch.GetInputPort("safety_probability"),
            )
        elif recovery:
            builder.ExportInput(switch.GetInputPort("safety_probability"), "safety_probability")
        self.finish(builder)

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

    def reset(self, context: Context, rng: np.random.Generator) -> int:
        """Samples an initial state and a plan; some episodes begin as a ball hits."""
        parameters = self.scenario.parameters
        is_push = self.ball is not None and rng.random() < parameters.push.share
        if not is_push:
            self._begin(context, rng, parameters.start.sample(self.kinematics, rng))
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
        self._begin(context, rng, start)

    def start_of(self, context: Context) -> EpisodeStart:
        """What an episode that goes on from here begins with."""
        controller_context = self._controller.GetMyContextFromRoot(context)
        feet = self._controller.foot_positions(controller_context).copy()
        return replace(super().start_of(context), foot_positions=feet)

    def _begin(self, context: Context, rng: np.random.Generator, start: EpisodeStart) -> None:
        self._enter(context, start)
        self._observers.reseed(context, rng)

    def _output_of(self, q: np.ndarray) -> np.ndarray:
        return q[4:7]

    def _set_state(self, context: Context, start: EpisodeStart) -> None:
        super()._set_state(context, start)
        p_WC = start.feet(self.kinematics)
        self._controller.set_foot_positions(
            self._controller.GetMyMutableContextFromRoot(context), p_WC
        )
        if self._recovery_switch is not None:
            step_planner = self._recovery_switch.step_planner
            step_planner.set_stance(
                step_planner.GetMyMutableContextFromRoot(context), p_WC, self._stance_of(start)
            )

    def candidate_plans(
        self, context: Context, rng: np.random.Generator, num_plans: int
    ) -> list[PiecewisePolynomial]:
        """Plans that end over the same point, at other heights and after other durations.

        Both as training draws them. A motion that is under way goes on as it was planned.
        """
        planned = self._plan_of(context)
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

    @property
    def trigger_port(self) -> str:
        """Name of the output port that recovery is triggered by."""
        is_normalized = self.scenario.parameters.recovery.is_normalized
        return "normalized_safety_probability" if is_normalized else "safety_probability"

    def sample_throw(self, rng: np.random.Generator, time_s: float) -> Throw:
        """A random ball; touching at ``time_s`` [s]."""
        return self.scenario.parameters.push.sample(rng, time_s)

    def throw_ball(self, context: Context, throw: Throw, lead_s: float) -> float:
        """Sets the ball in flight, and says when it touches [s]."""
        if self.ball is None:
            raise ValueError("balancing: built without a ball; pass ball=True to make_loop")
        with self._physics.edited(context) as plant_context:
            self.ball.throw(plant_context, throw, lead_s)
        return context.get_time() + lead_s
