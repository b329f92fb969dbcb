"""Periods, offsets and durations that are not positive and finite are refused by name."""

import math

import numpy as np
import pytest
from pydrake.systems.primitives import ConstantVectorSource

from drake_safety import load_scenario, record_episodes, run_motions
from drake_safety.plants.balls import Throw
from drake_safety.simulation.motion import End, simulate
from drake_safety.systems.inverse_kinematics_controller import InverseKinematicsController
from drake_safety.systems.recovery_trigger import RecoveryTrigger
from drake_safety.systems.safety_assessor import SafetyAssessor
from drake_safety.systems.sensor_faults import SensorFaults
from drake_safety.systems.trajectory_planner import TrajectoryPlanner, interpolate
from legged_robots import robot_kinematics
from system_doubles import AssessmentDouble, SlowIsSafe, guard

LAIKAGO = robot_kinematics("laikago")


def simulated(duration_s=1.0, **times):
    return simulate(ConstantVectorSource([1.0]), None, [], End(duration_s=duration_s), **times)


def recorded(**times):
    times = {"duration_s": 1.0, "step_s": 0.1, "monitor_period_s": 0.1} | times
    return record_episodes(None, 1, reset=None, **times)


TAKES = {  # Name of the time, and what takes it.
    "assessor": ("period_s", lambda **t: SafetyAssessor(AssessmentDouble(), **t)),
    "guard": ("period_s", lambda **t: guard(SlowIsSafe(), **t)),
    "trigger": ("period_s", lambda **t: RecoveryTrigger(**t)),
    "trigger's patience": ("persistence_s", lambda **t: RecoveryTrigger(period_s=0.01, **t)),
    "inverse kinematics": ("period_s", lambda **t: InverseKinematicsController(LAIKAGO, **t)),
    "faults": ("period_s", lambda **t: SensorFaults(["a"], **t)),
    "planner": ("step_s", lambda **t: TrajectoryPlanner(horizon=3, **t)),
    "plan": ("duration_s", lambda **t: interpolate(np.zeros(3), np.ones(3), **t)),
    "motion's rows": ("step_s", simulated),
    "motion": ("duration_s", simulated),
    "motions": ("duration_s", lambda **t: run_motions(load_scenario("pendulum"), **t)),
    "recording": ("duration_s", recorded),
    "throw": ("time_s", Throw),
}
OR_ZERO = ("trigger's patience", "throw", "motion")


@pytest.mark.parametrize("what", TAKES)
def test_a_time_that_is_not_positive_and_finite_is_refused(what):
    name, take = TAKES[what]
    for value in (-0.1, math.nan, math.inf, *([] if what in OR_ZERO else [0.0])):
        with pytest.raises(ValueError, match=name):
            take(**{name: value})
