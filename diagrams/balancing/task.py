"""Balancing: a legged robot moves its base over its feet along a plan, with recovery steps."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, DiagramBuilder

from drake_safety.control.safe_sets import BalanceSafeSet
from drake_safety.diagrams.balancing.parameters import BalancingParameters
from drake_safety.diagrams.balancing.sampling import throw_start, undisturbed_start
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.plants.balls import Throw
from drake_safety.plants.physics import Scene
from drake_safety.simulation.closed_loop import Purpose
from drake_safety.simulation.episode_start import EpisodeStart
from drake_safety.simulation.legged_loop import LeggedLoop
from drake_safety.simulation.scenario import Scenario
from drake_safety.systems.inverse_kinematics_controller import InverseKinematicsController
from drake_safety.systems.recovery_switch import RecoverySwitch

_NUM_OUTLOOK = 5  # Samples of the plan from now to its end, for the features.
_LATEST_HIT_S = 1.5  # Latest time of an initial impact in the undisturbed motion.


class Balancing(LeggedLoop):
    """The diagram of the balancing task, for any robot.yaml with feet and joint gains.

    By default, it has recovery steps with an assessment, and a ball if pushes are sampled. With
    ``recovery`` and without an assessment it has an input port ``safety_probability``.
    """

    Parameters = BalancingParameters

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
        parameters, kinematics = scenario.parameters, self.kinematics
        period_s = scenario.control_period_s
        self._control_offset_s = 3 * self.tick_s  # After assessor, trigger and step planner.
        builder = DiagramBuilder()
        has_ball = parameters.push.share > 0 if ball is None else ball
        physics = self._add_robot(builder, Scene(has_ball=has_ball), servos=True, meshcat=meshcat)
        self.ball = physics.ball
        measured = self._add_observers(builder)
        planner = self._add_planner(
            builder, outlook_s=scenario.episode_duration_s, num_outlook=_NUM_OUTLOOK
        )
        controller = self._controller = InverseKinematicsController(
            kinematics, period_s=period_s, offset_s=self._control_offset_s
        )
        builder.AddNamedSystem("inverse_kinematics_controller", controller)
        names = ("desired_output", "desired_preview", "desired_outlook")
        desired = {name: planner.GetOutputPort(name) for name in names}
        self._recovery_switch = switch = None
        if recovery:
            self._recovery_switch = switch = RecoverySwitch(
                kinematics,
                parameters.recovery.step,
                threshold=parameters.recovery.threshold,
                persistence_s=parameters.recovery.persistence_s,
                initial_uncertainty=scenario.assessment.initial_uncertainty,
                period_s=period_s,
                offset_s=self.tick_s,
                horizon=scenario.assessment.horizon,
                num_outlook=_NUM_OUTLOOK,
            )
            builder.AddNamedSystem("recovery_switch", switch)
            builder.Connect(measured, switch.GetInputPort("plant_state"))
            for name, port in desired.items():
                builder.Connect(port, switch.GetInputPort(f"nominal_{name}"))
            desired = {name: switch.GetOutputPort(name) for name in names}
            stance_pose = switch.GetOutputPort("stance_pose")
            builder.Connect(stance_pose, planner.GetInputPort("stance_pose"))
            for name in ("desired_foot_positions", "desired_yaw"):
                builder.Connect(switch.GetOutputPort(name), controller.GetInputPort(name))
            desired["desired_foot_positions"] = switch.GetOutputPort("desired_foot_positions")
        builder.Connect(measured, controller.GetInputPort("plant_state"))
        builder.Connect(desired["desired_output"], controller.GetInputPort("desired_output"))
        joint_state = controller.GetOutputPort("desired_joint_state")
        received = self._servo_command(builder, joint_state)
        physics.connect_servos(builder, kinematics.joint_names, received)
        self._add_push_source(builder)
        self._assess(
            builder,
            BalanceSafeSet(kinematics, parameters.safe_set),
            desired,
            period_s=parameters.recovery.assessment_period_s,
            command=joint_state,
            has_gravity=True,
            recovery=switch,
            hold=switch and switch.GetOutputPort("recovery_active"),
        )
        loads = [name for name in self.feature_names if name.startswith("servo_load_")]
        self.monitored = {"features": loads}
        builder.BuildInto(self)

    @classmethod
    def options_for(cls, purpose: Purpose, scenario: Scenario, variation: str) -> dict[str, Any]:
        """Removes the ball for the paper's mode, or if not both engines of a pair support it."""
        # "We also add a random offset to the initial state to simulate the disturbances" (paper).
        is_without_ball = scenario.variation(variation).engine != "drake"
        if purpose == "paper" or (purpose == "pairs" and is_without_ball):
            return {"ball": False}
        return {}

    def reset(self, context: Context, rng: np.random.Generator) -> int:
        """Samples an initial state and a plan; some episodes begin with the impact of a ball."""
        parameters = self.scenario.parameters
        if self.ball is None or rng.random() >= parameters.push.share:
            self._begin(context, rng, parameters.start.sample(self.kinematics, rng))
            return 0
        # The impact is at any time of an undisturbed motion, not only at its start.
        self.reset_calm(context, rng, elapsed_s=rng.uniform(0.0, _LATEST_HIT_S))
        # The impact is up to one assessment step before the first row after it.
        lead_s = rng.uniform(0.0, 1.0) * self.scenario.step_s
        self.throw_ball(context, parameters.push.sample(rng, lead_s), lead_s)
        return 1

    def reset_calm(
        self, context: Context, rng: np.random.Generator, elapsed_s: float = 0.0
    ) -> None:
        """Samples an undisturbed motion near the stance, for throws, which began before [s]."""
        parameters = self.scenario.parameters
        start = throw_start(
            self.kinematics,
            rng,
            half_widths_m=parameters.push.target_offset_m,
            plan_duration_s=parameters.start.plan_duration_s,
            elapsed_s=elapsed_s,
        )
        self._begin(context, rng, start)

    def reset_undisturbed(
        self, context: Context, rng: np.random.Generator, duration_s: float
    ) -> None:
        """Samples base motions about the stance, one after another, with rests between them."""
        sampling = self.scenario.parameters.start
        self._begin(context, rng, undisturbed_start(self.kinematics, rng, sampling, duration_s))

    def start_of(self, context: Context) -> EpisodeStart:
        """State, plan and foot positions of a Context, as a start."""
        controller_context = self._controller.GetMyContextFromRoot(context)
        feet = self._controller.foot_positions(controller_context).copy()
        return replace(super().start_of(context), foot_positions=feet)

    def start_control(self, context: Context) -> None:
        """Sets the command for the present state and plan."""
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
        p_WC, controller = start.feet(self.kinematics), self._controller
        controller.set_foot_positions(controller.GetMyMutableContextFromRoot(context), p_WC)
        if self._recovery_switch is not None:
            planner = self._recovery_switch.step_planner
            own_context = planner.GetMyMutableContextFromRoot(context)
            discrete_state = own_context.get_mutable_discrete_state()
            planner.set_stance(discrete_state, p_WC, self._stance_of(start))

    def throw_ball(self, context: Context, throw: Throw, lead_s: float) -> None:
        """Sets the ball in flight, which hits the base after ``lead_s`` [s]; the monitor waits."""
        if self.ball is None:
            raise ValueError("balancing: built without a ball; pass ball=True to make_loop")
        with self._physics.edited(context) as plant_context:
            self.ball.throw(plant_context, throw, lead_s)
        now_s = context.get_time()
        self.expect_disturbance(context, now_s, now_s + lead_s)
