"""Basic belief assignments over {safe, unsafe} and the fusion operator F.

A belief is an array (..., 3 + n_c): the masses of safe, unsafe and uncertainty, which sum to one,
then optionally n_c columns that split the unsafe mass by cause and sum to it.
"""

import numpy as np

SAFE, UNSAFE, UNCERTAINTY = 0, 1, 2  # Columns; columns from 3 on split `UNSAFE` by cause.
EMPTY = np.array([0.0, 0.0, 1.0])  # B_0: no safety estimate can be made.
EMPTY.setflags(write=False)


def empty(shape: tuple[int, ...], num_causes: int = 0) -> np.ndarray:
    """Empty beliefs, (*shape, 3 + num_causes)."""
    beliefs = np.zeros((*shape, 3 + num_causes))
    beliefs[..., UNCERTAINTY] = 1.0
    return beliefs


def safe_share(beliefs: np.ndarray) -> np.ndarray:
    """Returns b_safe / (1 - mu), the safe share of what is known, (...); 0 for empty beliefs."""
    # A sum instead of 1 - mu, so that rounding cannot raise the share above one.
    known = beliefs[..., SAFE] + beliefs[..., UNSAFE]
    return np.asarray(beliefs[..., SAFE] / np.maximum(known, 1e-300))


def from_scores(
    score: np.ndarray,
    uncertainty: float | np.ndarray,
    cause: np.ndarray | None = None,
    num_causes: int = 0,
) -> np.ndarray:
    """Converts unsafety scores lambda (N,) and mu, scalar or (N,), to beliefs, (N, 3 + n_c).

    `cause` is the column of the constraint that each unsafe mass is assigned to, -1 for none.
    """
    score = np.asarray(score, dtype=float)
    uncertainty = np.broadcast_to(np.asarray(uncertainty, dtype=float), score.shape)
    for name, values in (("score", score), ("uncertainty", uncertainty)):
        if not np.all((values >= 0.0) & (values <= 1.0)):
            raise ValueError(f"from_scores: every {name} must lie in [0, 1], got {values}")
    beliefs = np.zeros((*score.shape, 3 + num_causes))
    # Eq. (bba_training_data)
    beliefs[..., SAFE] = (1.0 - uncertainty) * (1.0 - score)
    beliefs[..., UNSAFE] = (1.0 - uncertainty) * score
    beliefs[..., UNCERTAINTY] = uncertainty
    if num_causes:
        column = np.full(score.shape, -1) if cause is None else np.asarray(cause)
        has_cause = column >= 0
        if np.any(~has_cause & (score > 0.0)) or np.any(column >= num_causes):
            raise ValueError(f"from_scores: an unsafe score needs a cause in 0..{num_causes - 1}")
        rows = np.flatnonzero(has_cause)
        beliefs[rows, 3 + column[rows]] = beliefs[rows, UNSAFE]
    return beliefs


def fuse(beliefs: np.ndarray) -> np.ndarray:
    """Applies F, the joint fusion of a set of beliefs (N, 3 + n_c), to one, (3 + n_c,).

    Certain beliefs (mu = 0) outweigh all others and are averaged; vacuous beliefs (mu = 1) have no
    weight. F accumulates no evidence (equal mu stays mu) and is not associative: fuse all at once.

    Departure: the printed products of uncertainties underflow from about 600 beliefs on. Divided
    by their common product they become the weights w = (1 - mu) / mu, which give the same value.
    """
    beliefs = np.asarray(beliefs, dtype=float)
    return fuse_cells(beliefs, np.zeros(len(beliefs), dtype=int), num_cells=1, min_count=0)[0]


def fuse_cells(
    beliefs: np.ndarray,
    cells: np.ndarray,
    *,
    num_cells: int,
    min_count: int,
    multiplicity: np.ndarray | None = None,
) -> np.ndarray:
    """Fuses the beliefs (N, 3 + n_c) in every grid cell jointly, (V, 3 + n_c).

    Args:
        cells: Cell of each belief, -1 for outside, (N,).
        min_count: k_min, the number of beliefs below which a cell stays empty.
        multiplicity: Number of equal beliefs that each stands for, (N,); one by default.
    """
    is_inside = cells >= 0
    times = np.ones(int(is_inside.sum())) if multiplicity is None else multiplicity[is_inside]
    beliefs, cells = beliefs[is_inside], cells[is_inside]
    num_columns = beliefs.shape[1]
    uncertainty = beliefs[:, UNCERTAINTY]
    count = np.bincount(cells, minlength=num_cells)

    # The smallest mu of a cell scales its weights, so that a tiny mu cannot overflow. Where it is
    # zero, only the certain beliefs keep a weight, the limit of w = (1 - mu) / mu.
    smallest = np.full(num_cells, np.inf)
    np.minimum.at(smallest, cells, uncertainty)
    is_certain = uncertainty == 0.0
    ratio = np.where(is_certain, 1.0, smallest[cells] / np.where(is_certain, 1.0, uncertainty))
    weight = times * (1.0 - uncertainty) * ratio
    total = np.bincount(cells, weights=weight, minlength=num_cells)

    fused = empty((num_cells,), num_columns - 3)
    # Eq. (compute_prior_estmate_bba): k_v >= k_min as in the equation; the paper's text has >.
    is_filled = (count >= min_count) & (total > 0.0)
    divisor = np.where(is_filled, total, 1.0)
    for column in range(num_columns):
        if column == UNCERTAINTY:
            # Eq. (fuse_op): mu = sum(1 - mu) / sum(w)
            known = times * (1.0 - uncertainty)
            summed = np.bincount(cells, weights=known, minlength=num_cells)
            summed = summed * np.where(np.isfinite(smallest), smallest, 0.0)
        else:
            # Eq. (fuse_op): b = sum(w b) / sum(w)
            summed = np.bincount(cells, weights=weight * beliefs[:, column], minlength=num_cells)
        fused[is_filled, column] = (summed / divisor)[is_filled]
    return fused


def average_cells(beliefs: np.ndarray, cells: np.ndarray, uncertainty: np.ndarray) -> np.ndarray:
    """Applies G: averages the certain beliefs in every grid cell, and sets its uncertainty (V,)."""
    num_cells, num_columns = len(uncertainty), beliefs.shape[1]
    is_inside = cells >= 0
    beliefs, cells = beliefs[is_inside], cells[is_inside]
    count = np.bincount(cells, minlength=num_cells)
    averaged = empty((num_cells,), num_columns - 3)
    is_filled = count > 0
    known = (1.0 - uncertainty[is_filled]) / count[is_filled]
    for column in range(num_columns):
        summed = np.bincount(cells, weights=beliefs[:, column], minlength=num_cells)
        averaged[is_filled, column] = known * summed[is_filled]
    averaged[is_filled, UNCERTAINTY] = uncertainty[is_filled]
    return averaged
