"""Which constraint a motion is most likely to violate: one rule for all who name a cause."""

from __future__ import annotations

import numpy as np

NO_CAUSE = -1
"""Where nothing speaks for any constraint."""


def likely_causes(
    cause_probability: np.ndarray,
    predicted_margins: np.ndarray,
    margin_unit: float | np.ndarray = 1.0,
) -> np.ndarray:
    """The constraint that is most likely to be violated first.

    Where margins are predicted it is the one with the smallest, in its unit; elsewhere, as in the
    paper's mode, the one with most of the unsafe mass. Cells of the map hold segments that end
    alike but for different reasons, so the mass says less of a single motion than the margins do.

    Args:
        cause_probability: b_unsafe split by constraint, (N, n_c).
        predicted_margins: Smallest margin of each that is expected [m, rad], (N, n_c); NaN where
            none is predicted.
        margin_unit: What counts as one [m, rad], for all or (n_c,).

    Returns:
        Columns of the constraints, (N,); `NO_CAUSE` where there is neither.
    """
    probability = np.asarray(cause_probability, dtype=float)
    relative = np.asarray(predicted_margins, dtype=float) / margin_unit
    if probability.shape[1] == 0:
        return np.full(len(probability), NO_CAUSE)
    by_mass = np.where(probability.max(axis=1) > 0.0, probability.argmax(axis=1), NO_CAUSE)
    has_margins = np.isfinite(relative).any(axis=1)
    by_margin = np.where(np.isfinite(relative), relative, np.inf).argmin(axis=1)
    return np.where(has_margins, by_margin, by_mass)
