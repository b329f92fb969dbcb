"""Scaling of parameters from one robot to another of the same build.

Lengths scale with the standing height or the foot spacing, durations with √height (equal Froude
numbers). Speeds scale with length over duration, and the masses of balls with the robot's mass.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass
from typing import Any

GRAVITY_M_S2 = 9.81  # As in Drake.


@dataclass(frozen=True, kw_only=True)
class RobotSize:
    """Height of a standing robot's base, the feet's extent from their centroid, and its mass."""

    height_m: float
    half_length_m: float
    half_width_m: float
    mass_kg: float

    @property
    def load(self) -> float:
        """Mass times height [kg·m], with which torques grow."""
        return self.mass_kg * self.height_m

    def factors(self, reference: "RobotSize") -> dict[str, float]:
        """Returns scale factors by quantity, from the robot that parameters were chosen for."""
        height = self.height_m / reference.height_m
        length = self.half_length_m / reference.half_length_m
        width = self.half_width_m / reference.half_width_m
        duration = math.sqrt(height)
        return {
            "height": height,
            "length": length,
            "width": width,
            "duration": duration,
            "speed_x": length / duration,
            "speed_y": width / duration,
            "speed_z": height / duration,
            "rate": 1.0 / duration,
            "mass": self.mass_kg / reference.mass_kg,
            "one": 1.0,
        }


BALANCING_REFERENCE = RobotSize(
    height_m=0.4245, half_length_m=0.2194, half_width_m=0.1245, mass_kg=25.43
)
"""The robot that the defaults of the balancing task were chosen for."""


def scaled_defaults(
    defaults: Any, quantities: Mapping[str, Any], factors: Mapping[str, float]
) -> dict[str, Any]:
    """Scales the defaults of nested dataclasses by quantities nested alike."""
    scaled: dict[str, Any] = {}
    for name, quantity in quantities.items():
        value = getattr(defaults, name)
        if is_dataclass(value):
            scaled[name] = scaled_defaults(value, quantity, factors)
        elif isinstance(value, list):
            each = [quantity] * len(value) if isinstance(quantity, str) else quantity
            scaled[name] = [_rounded(v * factors[q]) for v, q in zip(value, each, strict=True)]
        else:
            scaled[name] = _rounded(value * factors[quantity])
    return scaled


def overlaid(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Merges two nested mappings; values of ``above`` take precedence."""
    merged = dict(below)
    for name, value in above.items():
        lower = merged.get(name)
        both = isinstance(lower, Mapping) and isinstance(value, Mapping)
        merged[name] = overlaid(lower, value) if both else value  # type: ignore[arg-type]
    return merged


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
