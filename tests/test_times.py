"""Periods, offsets and durations that are not positive and finite are refused by name."""

import math

import numpy as np
import pytest
from pydrake.systems.primitives import ConstantVectorSource

from drake_safety import load_assessment, load_scenario
from drake_safety.control.recovery_step import RecoveryStepParameters
from drake_safety.diagrams.pendulum.task import PendulumController, PendulumParameters
from drake_safety.plants.balls import Throw
from drake_safety.policies.policy import GaitClock
from drake_safety.simulation.motion import simulate
from drake_safety.simulation.recording import record_episodes
from drake_safety.simulation.rollouts import run_motions
from drake_safety.systems.feedback_recorder import FeedbackRecorder
from drake_safety.systems.inverse_kinematics_controller import InverseKinematicsController
from drake_safety.systems.monitored_assessor import MonitoredSafetyAssessor
from drake_safety.systems.push_source import PushSource
from drake_safety.systems.recovery_step_planner import RecoveryStepPlanner
from drake_safety.systems.recovery_switch import RecoverySwitch
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


def kinematics():
    return robot_kinematics("laikago")


def switch(period_s=0.01, offset_s=0.001, persistence_s=0.0):
    times = {"period_s": period_s, "offset_s": offset_s, "persistence_s": persistence_s}
    return RecoverySwitch(kinematics(), STEPS, threshold=0.5, **times, **ROWS)


def push_source(period_s):
    robot = kinematics()
    instance = robot.plant.GetModelInstanceByName(robot.robot.name)
    return PushSource(robot.plant, instance, period_s=period_s)


def simulated(**times):
    return simulate(ConstantVectorSource([1.0]), None, [], **{"duration_s": 1.0} | times)


def recorded(**times):
    times = {"duration_s": 1.0, "step_s": 0.1, "monitor_period_s": 0.1} | times
    return record_episodes(None, 1, reset=None, **times)


def recorder(watch_period_s):
    return FeedbackRecorder(INFO, num_steps=5, plant_state_size=2, watch_period_s=watch_period_s)


TAKES = {  # Name of the time, whether it may be zero, and what takes it.
    "evaluator": ("period_s", lambda **t: SafetyAssessor(AssessmentDouble(), **t)),
    "assessor": (
        "period_s",
        lambda **t: MonitoredSafetyAssessor(load_assessment("laikago_balancing"), **t),
    ),
    "guard": ("period_s", lambda **t: guard(SlowIsSafe(), **t)),
    "guard's offset": ("offset_s", lambda **t: guard(SlowIsSafe(), **t)),
    "trigger": ("period_s", lambda **t: RecoveryTrigger(**t)),
    "trigger's offset": ("offset_s", lambda **t: RecoveryTrigger(period_s=0.01, **t)),
    "trigger's patience": ("persistence_s", lambda **t: RecoveryTrigger(period_s=0.01, **t)),
    "switch": ("period_s", switch),
    "switch's offset": ("offset_s", switch),
    "steps": ("period_s", lambda **t: RecoveryStepPlanner(kinematics(), STEPS, **ROWS, **t)),
    "inverse kinematics": ("period_s", lambda **t: InverseKinematicsController(kinematics(), **t)),
    "whole body": ("period_s", lambda **t: WholeBodyController(kinematics(), **t)),
    "faults": ("period_s", lambda **t: SensorFaults(["a"], **t)),
    "faults' offset": ("offset_s", lambda **t: SensorFaults(["a"], period_s=0.1, **t)),
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
    "after leaving": ("after_leaving_s", simulated),
    "motions": ("duration_s", lambda **t: run_motions(load_scenario("pendulum"), **t)),
    "recording": ("duration_s", recorded),
    "recording's rows": ("step_s", recorded),
    "recording's watch": ("monitor_period_s", recorded),
}
OR_ZERO = ("offset_s", "persistence_s", "outlook_s", "after_leaving_s")
# Without one, a motion is watched at its rows, or goes on to its end.
OR_INFINITE = ("motion's watch", "after leaving")


@pytest.mark.parametrize("what", TAKES)
def test_a_time_that_is_not_positive_and_finite_is_refused(what):
    name, take = TAKES[what]
    may_be_zero = name in OR_ZERO or what == "motion"
    for value in WRONG:
        if (value == 0.0 and may_be_zero) or (value == math.inf and what in OR_INFINITE):
            continue
        with pytest.raises(ValueError, match=f"{name} must (be positive|not be negative)"):
            take(**{name: value})


@pytest.mark.parametrize("value", [0.0, -0.1, math.nan, math.inf])
@pytest.mark.parametrize(
    ("scenario", "key"),
    [
        ("laikago_balancing", "recovery.assessment_period_s"),
        ("go2_walking", "assessment_period_s"),
        ("go2_walking", "guard.period_s"),
        ("go2_walking", "recovery.persistence_s"),
        ("laikago_balancing", "recovery.persistence_s"),
    ],
)
def test_a_scenario_with_such_a_time_is_refused(scenario, key, value):
    *path, name = key.split(".")
    kind = type(load_scenario(scenario).parameters)
    for step in path:
        kind = type(getattr(kind(), step))
    if value == 0.0 and name == "persistence_s":
        return
    with pytest.raises(ValueError, match=name):
        kind(**{name: value})


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_a_clock_and_a_throw_need_a_finite_time(value):
    with pytest.raises(ValueError, match="period_s"):
        GaitClock(period_s=value)
    with pytest.raises(ValueError, match="time_s"):
        Throw(time_s=value)
