"""Periods, offsets and durations that are not positive and finite are refused by name."""

import math

import numpy as np
import pytest
from pydrake.systems.primitives import ConstantVectorSource

from drake_safety import load_scenario, record_episodes, run_motions
from drake_safety.control.recovery_step import RecoveryStepParameters
from drake_safety.diagrams.pendulum.task import PendulumController, PendulumParameters
from drake_safety.plants.balls import Throw
from drake_safety.policies.policy import GaitClock
from drake_safety.simulation.motion import End, simulate
from drake_safety.systems.feedback_recorder import FeedbackRecorder
from drake_safety.systems.inverse_kinematics_controller import InverseKinematicsController
from drake_safety.systems.push_source import PushSource
from drake_safety.systems.recovery_step_planner import RecoveryStepPlanner
from drake_safety.systems.recovery_trigger import RecoveryTrigger
from drake_safety.systems.safety_assessor import SafetyAssessor
from drake_safety.systems.sensor_faults import SensorFaults
from drake_safety.systems.trajectory_planner import TrajectoryPlanner, interpolate, plan_shape
from drake_safety.systems.whole_body_controller import WholeBodyController
from legged_robots import robot_kinematics
from system_doubles import INFO, AssessmentDouble, SlowIsSafe, guard

STEPS = RecoveryStepParameters()
ROWS = {"horizon": 4, "num_outlook": 3}
WRONG = (0.0, -0.1, math.nan, math.inf)
LAIKAGO = robot_kinematics("laikago")


def push_source(period_s):
    instance = LAIKAGO.plant.GetModelInstanceByName(LAIKAGO.robot.name)
    return PushSource(LAIKAGO.plant, instance, period_s=period_s)


def simulated(duration_s=1.0, **times):
    return simulate(ConstantVectorSource([1.0]), None, [], End(duration_s=duration_s), **times)


def recorded(**times):
    times = {"duration_s": 1.0, "step_s": 0.1, "monitor_period_s": 0.1} | times
    return record_episodes(None, 1, reset=None, **times)


def recorder(watch_period_s):
    return FeedbackRecorder(INFO, num_steps=5, plant_state_size=2, watch_period_s=watch_period_s)


TAKES = {  # Name of the time, and what takes it.
    "assessor": ("period_s", lambda **t: SafetyAssessor(AssessmentDouble(), **t)),
    "guard": ("period_s", lambda **t: guard(SlowIsSafe(), **t)),
    "guard's offset": ("offset_s", lambda **t: guard(SlowIsSafe(), **t)),
    "trigger": ("period_s", lambda **t: RecoveryTrigger(**t)),
    "trigger's patience": ("persistence_s", lambda **t: RecoveryTrigger(period_s=0.01, **t)),
    "steps": ("period_s", lambda **t: RecoveryStepPlanner(LAIKAGO, STEPS, **ROWS, **t)),
    "inverse kinematics": ("period_s", lambda **t: InverseKinematicsController(LAIKAGO, **t)),
    "whole body": ("period_s", lambda **t: WholeBodyController(LAIKAGO, **t)),
    "faults": ("period_s", lambda **t: SensorFaults(["a"], **t)),
    "pushes": ("period_s", push_source),
    "recorder": ("watch_period_s", recorder),
    "pendulum": ("period_s", lambda period_s: PendulumController(PendulumParameters(), period_s)),
    "planner": ("step_s", lambda **t: TrajectoryPlanner(horizon=3, **t)),
    "outlook": ("outlook_s", lambda **t: TrajectoryPlanner(horizon=3, step_s=0.1, **t)),
    "plan": ("duration_s", lambda **t: interpolate(np.zeros(3), np.ones(3), **t)),
    "shape": ("step_s", lambda **t: plan_shape(np.zeros((3, 3)), duration_s=1.0, **t)),
    "motion's rows": ("step_s", simulated),
    "motion": ("duration_s", simulated),
    "motion's watch": ("watch_period_s", simulated),
    "motions": ("duration_s", lambda **t: run_motions(load_scenario("pendulum"), **t)),
    "recording": ("duration_s", recorded),
    "recording's watch": ("monitor_period_s", recorded),
    "policy's clock": ("period_s", GaitClock),
    "throw": ("time_s", Throw),
}
OR_ZERO = ("offset_s", "persistence_s", "outlook_s", "time_s", "motion", "policy's clock")


@pytest.mark.parametrize("what", TAKES)
def test_a_time_that_is_not_positive_and_finite_is_refused(what):
    name, take = TAKES[what]
    may_be_zero = name in OR_ZERO or what in OR_ZERO
    for value in WRONG:
        # Without a watch a motion is watched at its rows.
        is_right = (value == 0.0 and may_be_zero) or (value, what) == (math.inf, "motion's watch")
        if not is_right:
            with pytest.raises(ValueError, match=name):
                take(**{name: value})


@pytest.mark.parametrize("value", WRONG)
@pytest.mark.parametrize(
    ("scenario", "key"),
    [
        ("laikago_balancing", "recovery.assessment_period_s"),
        ("go2_walking", "guard.period_s"),
    ],
)
def test_a_scenario_with_such_a_time_is_refused(scenario, key, value):
    with pytest.raises(ValueError, match=key.rpartition(".")[2]):
        load_scenario(scenario, {f"parameters.{key}": value})
