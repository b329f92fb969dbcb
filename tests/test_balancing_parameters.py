"""Defaults of balancing fit the robot that they were chosen on, and grow with another one."""

import math
from dataclasses import asdict

import pytest

from drake_safety.diagrams.balancing_parameters import BalancingParameters, fitted_to_robot
from legged_robots import ROBOT_NAMES, robot_kinematics


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


@pytest.mark.parametrize("name", [name for name in ROBOT_NAMES if name != "laikago"])
def test_heights_grow_with_the_robot_and_durations_with_the_root(name):
    kinematics = robot_kinematics(name)
    ratio = kinematics.standing_height / robot_kinematics("laikago").standing_height
    defaults, fitted = asdict(BalancingParameters()), fitted_to_robot({}, kinematics)
    for factor, part, names in (
        (ratio, "safe_set", ["height_m", "fall_height_m"]),
        (ratio, "start", ["base_height_m", "target_height_m"]),
        (math.sqrt(ratio), "start", ["plan_duration_s"]),
    ):
        for one in names:
            expected = leaves(defaults[part][one])
            found = leaves(fitted[part][one])
            assert found == pytest.approx({k: factor * v for k, v in expected.items()}, rel=2e-3)


def test_what_the_file_states_stands():
    stated = {"push": {"share": 0.5, "mass_kg": [1.0, 1.5]}, "scale_to_robot": True}
    fitted = fitted_to_robot(stated, robot_kinematics("laikago"))
    assert fitted["push"]["mass_kg"] == [1.0, 1.5]
    assert fitted["push"]["share"] == 0.5
    assert fitted["scale_to_robot"]
    assert "height_m" in fitted["push"]
