"""Which constraint a motion is most likely to violate: one rule for all who name a cause."""

import math
from collections.abc import Collection, Sequence

import numpy as np


def is_on(flag: float) -> bool:
    """Whether an alarm is on: it is above 0.5, or not finite."""
    return not -math.inf < flag <= 0.5


def is_outside(margins: np.ndarray) -> np.ndarray:
    """Where one of a state's margins (..., n_c) is negative or not finite, (...)."""
    return ~np.all((margins >= 0.0) & (margins < math.inf), axis=-1)


def violated(margins: np.ndarray) -> int:
    """The constraint that violates margins (n_c,) most; the first that is not finite, if any is."""
    is_finite = np.isfinite(margins)
    return int(np.argmin(margins if is_finite.all() else is_finite))


def likely_cause(
    names: Sequence[str],
    cause_probability: np.ndarray,
    predicted_margins: np.ndarray,
    margin_unit: float | np.ndarray = 1.0,
) -> str:
    """Returns the constraint that is most likely to be violated first; "" without evidence.

    By predicted margins [m, rad], it is that with the smallest in units of `margin_unit`; without
    them, as in the paper's mode, that with the largest part of b_unsafe.
    """
    relative = np.asarray(predicted_margins, dtype=float) / margin_unit
    is_known = np.isfinite(relative)
    if is_known.any():
        return names[int(np.where(is_known, relative, np.inf).argmin())]
    has_mass = np.max(cause_probability, initial=0.0) > 0.0
    return names[int(np.argmax(cause_probability))] if has_mass else ""


def cause_words(
    name: str, margin: float, angular_constraints: Collection[str], *, is_known: bool = True
) -> tuple[str, str]:
    """Returns "likely cause" and text of its margin [m, rad]; "" and "" without a name.

    If the margin is positive, or the belief is not known, the first is "nearest to its limit".
    """
    if not name:
        return "", ""
    label = "nearest to its limit" if margin > 0.0 or not is_known else "likely cause"
    return label, describe_margin(name, margin, angular_constraints)


def describe_margin(name: str, margin: float, angular_constraints: Collection[str]) -> str:
    """Text of a constraint and its margin [m, rad], if it is finite: ``collision, -1.2 cm``."""
    if not math.isfinite(margin):
        return name
    if name in angular_constraints:
        return f"{name}, {math.degrees(margin):+.1f}°"
    return f"{name}, {100 * margin:+.1f} cm"
