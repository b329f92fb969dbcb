"""What an assessment says of inputs: beliefs read from the grid where the maps send them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_safety.learning import beliefs as belief_masses
from drake_safety.learning.grid import OUTSIDE, Grid
from drake_safety.learning.trained_maps import Embedding, EmbeddingOutput

LOGIT_LIMIT = 8.0
"""Largest logit that a head is believed."""
SHIFT_LIMIT = 100.0
"""Largest shift of the base logit: beyond it sigma is 0 or 1 anyway, and exp must not overflow."""


@dataclass(kw_only=True, eq=False)
class Assessments:
    """What an assessment says of N inputs.

    Attributes:
        safety_probability: Gamma = b_safe, (N,). At most 1 - mu: not a calibrated probability.
        normalized: b_safe / (1 - mu), the safe share of what is known, (N,); 0 where nothing is.
        belief: (b_safe, b_unsafe, mu), (N, 3); empty for inputs that are not finite.
        embedding: y by the first map, (N, 2); NaN for inputs that are not finite.
        cause_probability: b_unsafe split by the constraint that will be violated, (N, n_c).
        predicted_margins: Smallest margin of each constraint until the episode's end [unit of the
            margins], (N, n_c); NaN for inputs that are not finite, without a margin head, and
            always in the paper's mode.
        unsafe_logit: Mean logit of the maps' safety heads, (N,); NaN where there is none.
        calibrated: Safety probability by the maps' heads, corrected by what feedback of the actual
            robot has shown, (N,); 0 where nothing is known. Without heads it is `normalized`.
    """

    safety_probability: np.ndarray
    normalized: np.ndarray
    belief: np.ndarray
    embedding: np.ndarray
    cause_probability: np.ndarray
    predicted_margins: np.ndarray
    unsafe_logit: np.ndarray
    calibrated: np.ndarray

    def one(self, row: int) -> Assessment:
        """What it says of one of them."""
        return Assessment(
            safety_probability=float(self.safety_probability[row]),
            normalized=float(self.normalized[row]),
            belief=self.belief[row],
            cause_probability=self.cause_probability[row],
            embedding=self.embedding[row],
            predicted_margins=self.predicted_margins[row],
            calibrated=float(self.calibrated[row]),
        )


@dataclass(kw_only=True, eq=False, slots=True)
class Assessment:
    """What an assessment says of one input; the fields of `Assessments` without the axis N."""

    safety_probability: float
    normalized: float
    belief: np.ndarray
    cause_probability: np.ndarray
    embedding: np.ndarray
    predicted_margins: np.ndarray
    calibrated: float


@dataclass(frozen=True, kw_only=True)
class BaseLogit:
    """The base logit: one logit of an unsafe end from what the maps' heads say.

    ``offset + safety_slope z - margin_slope m / margin_unit``, where z is the mean logit of the
    safety heads and m the smallest predicted margin; a head that is missing has no part in it.

    Attributes:
        margin_unit: Unit of margins [unit of the margins].
        margin_range: Margins are clipped to this range [unit of the margins].
        offset: The base logit where both heads are zero.
        safety_slope: What a logit of the safety heads counts for.
        margin_slope: Logits by which a margin of one unit is safer.
    """

    margin_unit: float
    margin_range: tuple[float, float]
    offset: float = 0.0
    safety_slope: float = 1.0
    margin_slope: float = 1.0

    def heads(self, output: EmbeddingOutput) -> np.ndarray:
        """z and -m / margin_unit of all inputs, (N, 2); zero for a head that is missing."""
        found = np.zeros((output.embedding.shape[1], 2))
        if np.isfinite(output.unsafe_logit).any() or not output.margins.shape[2]:
            found[:, 0] = np.clip(output.unsafe_logit, -LOGIT_LIMIT, LOGIT_LIMIT).mean(axis=0)
        if output.margins.shape[2]:
            smallest = output.margins.mean(axis=0).min(axis=1)
            found[:, 1] = -np.clip(smallest, *self.margin_range) / self.margin_unit
        return found

    def of_heads(self, heads: np.ndarray) -> np.ndarray:
        """The base logit, (N,), of what `heads` gave."""
        logit = self.offset + heads @ (self.safety_slope, self.margin_slope)
        return np.clip(logit, -LOGIT_LIMIT, LOGIT_LIMIT)


@dataclass(eq=False, slots=True)
class Correction:
    """What feedback adds to the base logit: to its three numbers, and by what else the maps know.

    Attributes:
        change: What is added to the offset, safety slope and margin slope, (3,).
        hidden: What each activation of the maps' last hidden layer, and a last entry of 1, adds to
            the base logit, (K, num_activations + 1).
        hidden_range: Least and most that they add together, (2,): what they added in feedback, for
            beyond it nobody knows.
        guard: 1 in cells of each map where the base logit must not fall, else 0, (K, R*R).
    """

    change: np.ndarray
    hidden: np.ndarray
    hidden_range: np.ndarray
    guard: np.ndarray

    @classmethod
    def none(cls, embedding: Embedding, grid: Grid) -> Correction:
        """No correction, as before any feedback."""
        return cls(
            change=np.zeros(3),
            hidden=np.zeros((embedding.num_members, embedding.num_activations + 1)),
            hidden_range=np.zeros(2),
            guard=np.zeros((embedding.num_members, grid.num_cells)),
        )

    @property
    def is_any(self) -> bool:
        """Whether anything is added at all."""
        return bool(self.change.any() or self.hidden.any())

    def residual(self, embedding: Embedding, x: np.ndarray) -> np.ndarray:
        """What the hidden layer adds at finite inputs (N, n_x), (N,)."""
        if not self.hidden.any():
            return np.zeros(len(x))
        added = hidden_sum(embedding.activations(x), self.hidden)
        return np.clip(added, *self.hidden_range)

    def shift(self, heads: np.ndarray, residual: np.ndarray, guard: np.ndarray) -> np.ndarray:
        """What is added to the base logit, (N,).

        Args:
            heads: z and -m / margin_unit, (N, 2).
            residual: What the hidden layer adds, (N,).
            guard: What is read from the cells' guard, (N,).
        """
        shift = self.change[0] + heads @ self.change[1:] + residual
        shift = np.clip(shift, -SHIFT_LIMIT, SHIFT_LIMIT)
        return np.where(shift < 0.0, (1.0 - guard) * shift, shift)


def hidden_sum(activations: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """What activations (K, N, n) amount to by weights (K, n + 1), the last one constant, (N,)."""
    return np.einsum("kni,ki->n", activations, hidden[:, :-1]) + hidden[:, -1].sum()


def is_unknown(belief: np.ndarray, initial_uncertainty: float) -> np.ndarray:
    """Where more than half of a belief comes from cells that know nothing, (N,).

    Args:
        belief: (b_safe, b_unsafe, mu), (N, 3).
        initial_uncertainty: mu_ini, what a cell that knows all it can leaves open.
    """
    return belief[:, belief_masses.UNCERTAINTY] > 0.5 * (1.0 + initial_uncertainty)


def sigmoid(z: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-z)) of logits that are not beyond some hundreds."""
    return 1.0 / (1.0 + np.exp(-z))


def predict(
    x: np.ndarray,
    *,
    embedding: Embedding,
    grid: Grid,
    beliefs: np.ndarray,
    correction: Correction,
    base_logit: BaseLogit | None,
    is_sharpened: bool,
) -> Assessments:
    """Assesses inputs; rows that are not finite get the empty belief.

    Args:
        x: Inputs, (N, n_x).
        embedding: The maps.
        grid: The grid of their cells.
        beliefs: Beliefs of the cells, (K, R*R, 3 + n_c).
        correction: What feedback adds to the base logit.
        base_logit: The base logit; None without heads.
        is_sharpened: Whether beliefs are interpolated between cell centres.
    """
    output = embedding.evaluate(x)
    cells, weights = _cells(output.embedding, grid, is_sharpened)
    is_outside = cells[..., 0] == OUTSIDE
    # Rows of all members' cells; a point outside has weights of zero, so any row will do for it.
    cells = cells + grid.num_cells * np.arange(len(cells))[:, None, None]
    num_members, _, num_columns = beliefs.shape
    masses = np.einsum("knw,knwc->nc", weights, beliefs.reshape(-1, num_columns)[cells])
    # A map that sends the input outside its grid knows nothing of it.
    masses[:, belief_masses.UNCERTAINTY] += is_outside.sum(axis=0)
    masses /= num_members
    safe = masses[:, belief_masses.SAFE]
    # As a sum, not as 1 - mu: rounding must not lift the share above one.
    known = safe + masses[:, belief_masses.UNSAFE]
    is_known = known > 0.0
    normalized = np.divide(safe, known, out=np.zeros_like(safe), where=is_known)
    calibrated = normalized.copy()
    if base_logit is not None and is_known.any():
        heads = base_logit.heads(output)
        shift = np.zeros(len(x))
        if correction.is_any:
            guard = np.einsum("knw,knw->n", weights, correction.guard.ravel()[cells])
            guard /= np.maximum(num_members - is_outside.sum(axis=0), 1)
            residual = np.zeros(len(x))
            residual[is_known] = correction.residual(embedding, x[is_known])
            shift = correction.shift(heads, residual, guard)
        calibrated[is_known] = sigmoid(-base_logit.of_heads(heads) - shift)[is_known]
    margins = np.full((len(x), num_columns - 3), np.nan)
    if output.margins.shape[2]:
        margins = output.margins.mean(axis=0)
    return Assessments(
        # Gamma(x) = b_safe of the cell that Psi(x) lies in
        safety_probability=safe.copy(),
        normalized=normalized,
        belief=masses[:, :3].copy(),
        embedding=output.embedding[0],
        cause_probability=masses[:, 3:].copy(),
        predicted_margins=margins,
        unsafe_logit=output.unsafe_logit.mean(axis=0),
        calibrated=calibrated,
    )


def _cells(points: np.ndarray, grid: Grid, is_sharpened: bool) -> tuple[np.ndarray, np.ndarray]:
    """Cells that beliefs are read from and their weights, (K, N, 4), or (K, N, 1) as printed."""
    if is_sharpened:
        return grid.bilinear(points)
    cells = grid.locate(points)[..., None]
    return cells, (cells != OUTSIDE).astype(float)
