"""Balancing: a legged robot moves its base over its feet along a plan, with recovery steps."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.trajectories import PiecewisePolynomial

from drake_safety.control.safe_sets import BalanceSafeSet
from drake_safety.diagrams.balancing.parameters import BalancingParameters
from drake_safety.diagrams.balancing.sampling import calm_start, undisturbed_start
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.plants.balls import Throw
from drake_safety.plants.physics import ENGINES_WITH_BALLS, Scene
from drake_safety.simulation.closed_loop import Purpose
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.scenario import Scenario
from drake_safety.systems.inverse_kinematics_controller import InverseKinematicsController
from drake_safety.systems.recovery_switch import RecoverySwitch
from drake_safety.systems.trajectory_planner import interpolate

_NUM_OUTLOOK = 5  # Samples of the plan from now to its end, for the features.
_LATEST_HIT_S = 1.5  # Latest time of an initial impact in the undisturbed motion.


class Balancing(LeggedLoop):
    """The diagram of the balancing task, for any robot.yaml with feet and joint gains.

    Args:
        recovery: Whether to add recovery steps; by default if there is an assessment to trigger
            them. Without one the diagram has an input port ``safety_probability``.
        ball: Whether the plant has a ball; by default if pushes are sampled.

    Raises:
        ValueError: A robot without feet or gains, an assessment of another diagram, or a ball
            with an engine that does not support it.
    """

    Parameters = BalancingParameters
    plan_variety = "its parameter 'start' bounds the final heights and durations of plans"

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
        self._control_offset_s = 3 * self.tick_s  # After assessor, trigger and step planner.
        builder = DiagramBuilder()

        has_ball = parameters.push.share > 0 if ball is None else ball
        physics = self._add_robot(builder, Scene(has_ball=has_ball), servos=True, meshcat=meshcat)
        self.ball = physics.ball
        kinematics = self.kinematics
        measured = self._add_observers(builder)
        planner = self._add_planner(
            builder, outlook_s=scenario.episode_duration_s, num_outlook=_NUM_OUTLOOK
        )
        names = ("desired_output", "desired_preview", "desired_outlook")
        desired = {name: planner.GetOutputPort(name) for name in names}

        self._recovery_switch = recovery_active = None
        if recovery:
            switch = builder.AddNamedSystem(
                "recovery_switch",
                RecoverySwitch(
                    kinematics,
                    parameters.recovery.step,
                    threshold=parameters.recovery.threshold,
                    persistence_s=parameters.recovery.persistence_s,
                    initial_uncertainty=scenario.assessment.initial_uncertainty,
                    period_s=scenario.control_period_s,
                    offset_s=self.tick_s,
                    horizon=scenario.assessment.horizon,
                    num_outlook=_NUM_OUTLOOK,
                ),
            )
            self._recovery_switch = switch
            builder.Connect(measured, switch.GetInputPort("plant_state"))
            for name, port in desired.items():
                builder.Connect(port, switch.GetInputPort(f"nominal_{name}"))
            builder.Connect(
                switch.GetOutputPort("stance_pose"), planner.GetInputPort("stance_pose")
            )
            desired = {name: switch.GetOutputPort(name) for name in names}
            recovery_active = switch.GetOutputPort("recovery_active")
            builder.ExportOutput(recovery_active, "recovery_active")

        controller = builder.AddNamedSystem(
            "inverse_kinematics_controller",
            InverseKinematicsController(
                kinematics,
                period_s=scenario.control_period_s,
                offset_s=self._control_offset_s,
            ),
        )
        self._controller = controller
        builder.Connect(measured, controller.GetInputPort("plant_state"))
        builder.Connect(desired["desired_output"], controller.GetInputPort("desired_output"))
        if recovery:
            for name in ("desired_foot_positions", "desired_yaw"):
                builder.Connect(switch.GetOutputPort(name), controller.GetInputPort(name))
        command = self._servo_command(builder, controller.GetOutputPort("desired_joint_state"))
        physics.connect_servos(builder, kinematics.joint_names, command)

        safe_set = BalanceSafeSet(kinematics, parameters.safe_set)
        self._watch(
            builder,
            safe_set,
            outlook=desired.pop("desired_outlook"),
            command=controller.GetOutputPort("desired_joint_state"),
            has_gravity=True,
        )
        self.monitored = {"features": self.feature_names[-kinematics.num_joints :]}
        assessor = self.export(
            builder,
            desired,
            period_s=parameters.recovery.assessment_period_s,
            hold=recovery_active,
        )
        if assessor is not None and recovery:
            assessor.connect_recovery(builder, switch)
        elif recovery:
            builder.ExportInput(switch.GetInputPort("safety_probability"), "safety_probability")
        builder.BuildInto(self)

    @classmethod
    def options_for(cls, purpose: Purpose, scenario: Scenario, variation: str) -> dict[str, Any]:
        """Removes the ball for the paper's mode, or if not both engines of a pair support it."""
        if purpose == "paper":
            # "We also add a random offset to the initial state to simulate the disturbances".
            return {"ball": False}
        if purpose == "pairs" and scenario.variation(variation).engine not in ENGINES_WITH_BALLS:
            return {"ball": False}
        return {}

    def reset(self, context: Context, rng: np.random.Generator) -> int:
        """Samples an initial state and a plan; some episodes begin with the impact of a ball."""
        parameters = self.scenario.parameters
        is_push = self.ball is not None and rng.random() < parameters.push.share
        if not is_push:
            self._begin(context, rng, parameters.start.sample(self.kinematics, rng))
            return 0
        # The impact is at any time of an undisturbed motion, not only at its start.
        self._start_calm(context, rng, elapsed_s=rng.uniform(0.0, _LATEST_HIT_S))
        # The impact is up to one assessment step before the first row after it.
        lead_s = rng.uniform(0.0, 1.0) * self.scenario.step_s
        self.throw_ball(context, parameters.push.sample(rng, lead_s), lead_s)
        return 1

    def reset_calm(self, context: Context, rng: np.random.Generator) -> None:
        """Samples an undisturbed motion near the stance, for throws."""
        self._start_calm(context, rng, elapsed_s=0.0)

    def reset_undisturbed(
        self, context: Context, rng: np.random.Generator, duration_s: float
    ) -> None:
        """Samples base motions about the stance, one after another, with rests between them."""
        parameters = self.scenario.parameters
        start = undisturbed_start(self.kinematics, rng, parameters.start, duration_s)
        self._begin(context, rng, start)

    def _start_calm(self, context: Context, rng: np.random.Generator, elapsed_s: float) -> None:
        """Starts ``elapsed_s`` [s] into an undisturbed motion, without tracking error."""
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
        """State, plan and foot positions of a Context, as a start."""
        controller_context = self._controller.GetMyContextFromRoot(context)
        feet = self._controller.foot_positions(controller_context).copy()
        return replace(super().start_of(context), foot_positions=feet)

    def set_plan(self, context: Context, plan: PiecewisePolynomial) -> None:
        """Sets the plan and keeps the state; see `PlannedLoop.set_plan`."""
        super().set_plan(context, plan)
        if context.get_time() == 0.0:  # Nothing was commanded yet.
            self.start_control(context)

    def start_control(self, context: Context) -> None:
        """Sets the command for the present state and plan; see `LeggedLoop`."""
        self._controller.start(self._controller.GetMyMutableContextFromRoot(context))

    def advance_control(self, context: Context, time_s: float) -> None:
        """Moves the Context to a time, with the controller's updates until then."""
        period_s, offset_s = self.scenario.control_period_s, self._control_offset_s
        first, last = (
            max(math.ceil((time - offset_s) / period_s), 0) for time in (context.get_time(), time_s)
        )
        for update in range(first, last):
            context.SetTime(update * period_s + offset_s)
            self._controller.update(self._controller.GetMyMutableContextFromRoot(context))
        context.SetTime(time_s)

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
        """Plans to the same horizontal point with other final heights and durations.

        Both are drawn as in training. A plan that has begun is not changed.
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

    def sample_throw(self, rng: np.random.Generator, time_s: float) -> Throw:
        """Samples a ball with its impact at ``time_s`` [s]."""
        return self.scenario.parameters.push.sample(rng, time_s)

    def throw_ball(self, context: Context, throw: Throw, lead_s: float) -> None:
        """Sets the ball in flight, which hits the base at rest after ``lead_s`` [s].

        The monitor waits from now until the impact has settled.
        """
        if self.ball is None:
            raise ValueError("balancing: built without a ball; pass ball=True to make_loop")
        with self._physics.edited(context) as plant_context:
            self.ball.throw(plant_context, throw, lead_s)
        now_s = context.get_time()
        self.expect_disturbance(context, now_s, now_s + lead_s)
