import copy
import math
from dataclasses import asdict

import numpy as np
import pytest

from drake_safety.control.kinematics import RobotKinematics
from drake_safety.diagrams.balancing.parameters import BalancingParameters, fitted_to_robot
from drake_safety.models import load_robot
from legged_robots import robot_kinematics


def leaves(values, name=""):
    """The numbers in nested mappings and lists, by their path."""
    if isinstance(values, dict):
        return {k: v for key in values for k, v in leaves(values[key], f"{name}.{key}").items()}
    if isinstance(values, list):
        return {k: v for i, one in enumerate(values) for k, v in leaves(one, f"{name}.{i}").items()}
    return {name: values}


def test_on_the_robot_of_the_defaults_nothing_changes():
    defaults = leaves(asdict(BalancingParameters()))
    fitted = leaves(fitted_to_robot({}, robot_kinematics("laikago")))
    assert fitted == pytest.approx({name: defaults[name] for name in fitted}, rel=2e-3)


def test_heights_grow_with_the_robot_and_durations_with_the_root():
    kinematics = robot_kinematics("hexapod")
    ratio = kinematics.standing_height / robot_kinematics("laikago").standing_height
    defaults, fitted = asdict(BalancingParameters()), fitted_to_robot({}, kinematics)
    for factor, part, name in (
        (ratio, "safe_set", "height_m"),
        (ratio, "safe_set", "fall_height_m"),
        (ratio, "start", "target_height_m"),
        (math.sqrt(ratio), "start", "plan_duration_s"),
    ):
        expected = factor * np.array(defaults[part][name])
        np.testing.assert_allclose(fitted[part][name], expected, rtol=2e-3)


def test_what_the_file_states_stands():
    stated = {"push": {"share": 0.5, "mass_kg": [1.0, 1.5]}, "scale_to_robot": True}
    fitted = fitted_to_robot(stated, robot_kinematics("laikago"))
    assert fitted["push"]["mass_kg"] == [1.0, 1.5] and fitted["scale_to_robot"]
    assert "height_m" in fitted["push"]


def with_stiffness(factor):
    robot = copy.deepcopy(load_robot("laikago"))
    for gains in robot.joint_gains.values():
        gains.stiffness *= factor
    return RobotKinematics(robot)


@pytest.mark.parametrize(("factor", "is_held"), [(1.0, True), (4.0, False)])
def test_a_recovery_holds_its_heading_where_the_feet_can_bear_the_twist(factor, is_held):
    fitted = fitted_to_robot({}, with_stiffness(factor))
    assert ("max_twist_rad" not in fitted["recovery"]["step"]) == is_held
    stated = {"recovery": {"step": {"max_twist_rad": 0.1}}}
    fitted = fitted_to_robot(stated, with_stiffness(factor))
    assert fitted["recovery"]["step"]["max_twist_rad"] == 0.1
