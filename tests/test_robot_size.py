"""Numbers carried from one robot to another by its size."""

from dataclasses import dataclass, field

import pytest

from drake_safety.robots.robot_size import RobotSize, overlaid, scaled_defaults

SMALL = RobotSize(height_m=0.4, half_length_m=0.2, half_width_m=0.1, mass_kg=20.0)


@dataclass(kw_only=True)
class Step:
    lift_m: float = 0.06


@dataclass(kw_only=True)
class Numbers:
    reach_m: list[float] = field(default_factory=lambda: [0.2, 0.1])
    heights_m: list[float] = field(default_factory=lambda: [0.3, 0.5])
    share: float = 0.5
    step: Step = field(default_factory=Step)


def test_a_robot_four_times_as_high_moves_twice_as_fast_and_half_as_often():
    big = RobotSize(height_m=1.6, half_length_m=0.8, half_width_m=0.4, mass_kg=1280.0)
    factors = big.factors(SMALL)
    assert factors["height"] == factors["length"] == factors["width"] == pytest.approx(4.0)
    assert factors["duration"] == pytest.approx(2.0)
    assert factors["speed_x"] == factors["speed_y"] == factors["speed_z"] == pytest.approx(2.0)
    assert factors["rate"] == pytest.approx(0.5)
    assert factors["mass"] == pytest.approx(64.0)


def test_sideways_the_spacing_of_the_feet_counts_and_the_same_size_changes_nothing():
    wide = RobotSize(height_m=0.4, half_length_m=0.2, half_width_m=0.15, mass_kg=20.0)
    factors = wide.factors(SMALL)
    assert factors["width"] == factors["speed_y"] == pytest.approx(1.5)
    assert factors["length"] == factors["height"] == factors["speed_x"] == 1.0
    assert set(SMALL.factors(SMALL).values()) == {1.0}


def test_fields_are_scaled_by_their_quantities_and_others_left_out():
    quantities = {"reach_m": ["length", "width"], "heights_m": "height", "step": {"lift_m": "one"}}
    factors = {"length": 2.0, "width": 3.0, "height": 0.5, "one": 1.0}
    scaled = {"reach_m": [0.4, 0.3], "heights_m": [0.15, 0.25], "step": {"lift_m": 0.06}}
    assert scaled_defaults(Numbers(), quantities, factors) == scaled


def test_what_a_file_states_stands():
    below = {"step": {"lift_m": 0.1, "reach_m": 1.0}, "share": 0.5}
    both = {"step": {"lift_m": 0.2, "reach_m": 1.0}, "share": 0.5, "name": "x"}
    assert overlaid(below, {"step": {"lift_m": 0.2}, "name": "x"}) == both
    assert below["step"]["lift_m"] == 0.1
