"""Numbers that were chosen on one robot, carried over to another of the same build by its size.

Lengths are in proportion to the standing height or to the spacing of the feet, durations to
√(height), as a pendulum's are (equal Froude numbers), speeds to a length over a duration, and the
masses of what is thrown to the robot's own.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from drake_safety.control.kinematics import RobotKinematics

_DIGITS = 4  # Significant ones: no sampling range is worth more, and the file stays readable.


@dataclass(frozen=True, kw_only=True)
class RobotSize:
    """How large a robot is, as far as standing and stepping go."""

    height_m: float
    """Of the base, standing."""
    half_length_m: float
    """Of the feet's rectangle, along x."""
    half_width_m: float
    """Of the feet's rectangle, along y."""
    mass_kg: float

    @classmethod
    def of(cls, kinematics: RobotKinematics) -> "RobotSize":
        """The size of a robot in its standing posture."""
        half_length_m, half_width_m = np.abs(kinematics.nominal_contacts).max(axis=0).tolist()
        return cls(
            height_m=kinematics.standing_height,
            half_length_m=half_length_m,
            half_width_m=half_width_m,
            mass_kg=kinematics.total_mass,
        )

    def factors(self, reference: "RobotSize") -> dict[str, float]:
        """What to multiply a quantity of the reference robot by, by the quantity's name.

        Args:
            reference: The robot that numbers were chosen on.

        Returns:
            ``height``, ``length``, ``width`` for lengths upwards, along x and along y;
            ``duration``; ``speed_x``, ``speed_y``, ``speed_z``, ``rate`` for speeds and turning;
            ``mass``; ``one``.
        """
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


def scaled_defaults(
    defaults: Any, quantities: Mapping[str, Any], factors: Mapping[str, float]
) -> dict[str, Any]:
    """The defaults of a dataclass of dataclasses, scaled.

    Args:
        defaults: The dataclass.
        quantities: For each field that is scaled its quantity, a list of them for a list of
            different ones, or such a mapping for a dataclass.
        factors: By quantity.

    Returns:
        The scaled fields alone, nested as they are.

    Raises:
        ValueError: The dataclass has no such field.
    """
    known = [entry.name for entry in fields(defaults)]
    scaled: dict[str, Any] = {}
    for name, quantity in quantities.items():
        if name not in known:
            raise ValueError(f"{type(defaults).__name__} has no field '{name}'; it has {known}")
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
    """Two nested mappings as one; where both say something, what lies above stands."""
    merged = dict(below)
    for name, value in above.items():
        lower = merged.get(name)
        both = isinstance(lower, Mapping) and isinstance(value, Mapping)
        merged[name] = overlaid(lower, value) if both else value  # type: ignore[arg-type]
    return merged


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
