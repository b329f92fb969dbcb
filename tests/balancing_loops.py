"""Balancing for the tests: any robot starts standing and shall go on standing."""

import functools
from pathlib import Path

import numpy as np
import yaml

from drake_safety.simulation.scenario import load_scenario, parse_scenario
from legged_robots import robot_kinematics, robot_model
from system_doubles import begun

PACKAGED = "laikago"


@functools.cache
def scenario_of(robot, **changes):
    """A scenario in which the robot starts standing and shall go on standing."""
    height = robot_kinematics(robot).standing_height
    path = Path(robot_model(robot).source_dir) / "robot.yaml"
    start = {
        "foot_offset_m": 0.0,
        "base_offset_m": [0.0, 0.0],
        "base_height_m": [height, height],
        "tilt_rad": 0.0,
        "velocity_std_m_s": [0.0, 0.0, 0.0],
        "angular_velocity_std_rad_s": 0.0,
        "joint_std_rad": 0.0,
        "target_offset_m": [0.0, 0.0],
        "target_height_m": [height, height],
    }
    safe_set = {"height_m": [0.7 * height, 1.3 * height], "fall_height_m": 0.4 * height}
    text = {
        "task": "drake_safety.diagrams.balancing:Balancing",
        "robot": robot if robot == PACKAGED else str(path),
        "variations": {
            "nominal": {},
            "light": {"mass_scale": 0.8},
            "slippery": {"foot_friction": 0.123},
            "noisy": {"observation_noise": {"position": 0.004, "velocity": 0.016}},
            "blurred": {"input_noise": {"position": 0.004, "velocity": 0.016}},
        },
        "parameters": {"start": start, "safe_set": safe_set, "push": {"share": 0.0}},
    }
    return parse_scenario(yaml.safe_dump(text), name=f"{robot}_standing", folder=Path("/"))


@functools.cache
def standing_loop(robot=PACKAGED, variation="nominal", **options):
    return scenario_of(robot).make_loop(variation, **options)


@functools.cache
def packaged_loop(variation="nominal", **options):
    return load_scenario("laikago_balancing").make_loop(variation, **options)


def started(loop, seed=0):
    """A simulator at the start of an episode, and its context."""
    return begun(loop, loop.reset, np.random.default_rng(seed))
