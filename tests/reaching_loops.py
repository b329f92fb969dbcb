"""Reaching for the tests: a made-up robot with a shelf before it, and the package's own scenario.

Loops and episodes are made once; a loop keeps nothing between two episodes.
"""

import functools
import tempfile
from pathlib import Path

import numpy as np
import yaml

from drake_safety import load_scenario, run_episode
from drake_safety.robots.robot import PlantVariation
from legged_robots import write_porter
from toy_tasks import evaluated

SCENES = "package://drake_safety_models/scenes"
NOISE = {"position": 0.001, "velocity": 0.01}
# The porter's shelf stands before it, its boards above and below its hands.
PORTING = {
    "task": "drake_safety.diagrams.reaching:Reaching",
    "robot": "robot.yaml",
    "episode_duration_s": 1.2,
    "step_s": 0.1,
    "time_step_s": 0.002,
    "control_period_s": 0.004,
    "variations": {
        "nominal": {},
        "rough": {"joint_friction_nm": 0.4},
        "noisy": {"observation_noise": NOISE},
    },
    "assessment": {
        "horizon": 8,
        "shortest_segment": 3,
        "perplexity": 5.0,
        "epochs": 5,
        "ensemble_size": 1,
        "hidden_sizes": [32],
    },
    "parameters": {
        "plan_duration_s": 1.0,
        "start": {"base_lowering_m": 0.04, "joint_offset_rad": 0.05},
        "target": {"x_m": [0.15, 0.35], "y_m": [0.0, 0.3], "z_m": [0.5, 0.75]},
        "obstacles": [{"model": f"{SCENES}/bookshelf.urdf", "position": [0.55, 0.0, -0.15]}],
        "decorations": [{"model": f"{SCENES}/red_can.sdf", "position": [0.5, 0.1, 0.56]}],
    },
}
EASY = np.array([0.28, 0.18, 0.65])


def porting(folder, write=write_porter, **changes):
    """The path of a scenario in a folder of its own, beside its robot."""
    write(folder)
    path = folder / "porting.yaml"
    parameters = PORTING["parameters"] | changes.pop("parameters", {})
    path.write_text(yaml.safe_dump(PORTING | changes | {"parameters": parameters}))
    return path


@functools.cache
def porter_path():
    """The path of the porter's scenario, in a folder of its own."""
    return porting(Path(tempfile.mkdtemp(prefix="porting")))


@functools.cache
def porter(variation="nominal", **options):
    """The porter's loop."""
    return load_scenario(porter_path()).make_loop(variation, **options)


@functools.cache
def atlas(**options):
    """The loop of the package's scenario without its noise."""
    scenario = load_scenario("atlas_reaching")
    scenario.variations["nominal"] = PlantVariation()
    return scenario.make_loop(**options)


LOOPS = {"porter": porter, "atlas": atlas}


@functools.cache
def easy_episode(variation="nominal", hand="left"):
    """The porter's first episode towards an easy target."""
    loop = porter(variation, hand=hand)
    return run_episode(loop, 0, goal=EASY if loop.mirror is None else EASY * [1, -1, 1])


def started(loop, seed=0, *goal):
    context = loop.CreateDefaultContext()
    loop.reset(context, np.random.default_rng(seed), *goal)
    return context


def positions(loop, context):
    return evaluated(loop, context, "plant_state")[: loop.kinematics.num_positions]


def goal_of(loop, context):
    """Where the plan ends, in the world."""
    end = context.Clone()
    end.SetTime(loop.scenario.parameters.plan_duration_s + 1.0)
    return evaluated(loop, end, "desired_output")
