"""What an assessment says of inputs: beliefs read from the grid where the maps send them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drake_safety.learning import beliefs as belief_masses
from drake_safety.learning.grid import OUTSIDE, Grid
from drake_safety.learning.trained_maps import Embedding, EmbeddingOutput

LOGIT_LIMIT = 8.0
"""Largest logit that a head is believed."""
SHIFT_LIMIT = 100.0
"""Largest shift of L: beyond it sigma is 0 or 1 anyway, and exp must not overflow."""


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
    """L, one logit of an unsafe end from what the maps' heads say.

    ``offset + safety_slope z - margin_slope m / margin_unit``, where z is the mean logit of the
    safety heads and m the smallest predicted margin; a head that is missing has no part in it.

    Attributes:
        margin_unit: Unit of margins [unit of the margins].
        margin_range: Margins are clipped to this range [unit of the margins].
        offset: L where both heads are zero.
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
        """L, (N,), of what `heads` gave."""
        logit = self.offset + heads @ (self.safety_slope, self.margin_slope)
        return np.clip(logit, -LOGIT_LIMIT, LOGIT_LIMIT)

    def heads_one(self, logits: list[float], margin: float | None) -> tuple[float, float]:
        """`heads` of one input in plain floats, for the online run.

        Args:
            logits: Of each member's safety head; none without heads.
            margin: Smallest predicted margin, if there is a margin head.
        """
        z = nearness = 0.0
        if logits:
            z = sum([min(max(one, -LOGIT_LIMIT), LOGIT_LIMIT) for one in logits]) / len(logits)
        if margin is not None:
            low, high = self.margin_range
            nearness = -min(max(margin, low), high) / self.margin_unit
        return z, nearness

    def of_one(self, z: float, nearness: float) -> float:
        """L of what `heads_one` gave."""
        logit = self.offset + self.safety_slope * z + self.margin_slope * nearness
        return min(max(logit, -LOGIT_LIMIT), LOGIT_LIMIT)


@dataclass(eq=False, slots=True)
class Correction:
    """What feedback adds to L: a change of its three numbers, and of what else the maps know.

    Attributes:
        change: What is added to L's offset, safety slope and margin slope, (3,).
        hidden: What each activation of the maps' last hidden layer, and a last entry of 1, adds to
            L, (K, num_activations + 1).
        hidden_range: Least and most that they add together, (2,): what they added in feedback, for
            beyond it nobody knows.
        guard: 1 in cells of each map where L must not fall, else 0, (K, R*R).
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

    def residual(self, embedding: Embedding, x: np.ndarray) -> np.ndarray:
        """What the hidden layer adds to L at finite inputs (N, n_x), (N,)."""
        if not self.hidden.any():
            return np.zeros(len(x))
        added = hidden_sum(embedding.activations(x), self.hidden)
        return np.clip(added, *self.hidden_range)

    def shift(self, heads: np.ndarray, residual: np.ndarray, guard: np.ndarray) -> np.ndarray:
        """What is added to L, (N,).

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
        correction: What feedback adds to L.
        base_logit: L; None without heads.
        is_sharpened: Whether beliefs are interpolated between cell centres.
    """
    output = embedding.evaluate(x)
    num_members, _, num_columns = beliefs.shape
    columns = np.concatenate([beliefs, correction.guard[..., None]], axis=2)
    masses = np.zeros((len(x), num_columns))
    guard = np.zeros(len(x))
    num_inside = np.zeros(len(x), dtype=int)
    for values, points in zip(columns, output.embedding, strict=True):
        read, is_outside = _read(values, points, grid, is_sharpened)
        guard += read[:, -1]
        num_inside += ~is_outside
        read = read[:, :-1]
        read[is_outside] = belief_masses.empty((), num_columns - 3)
        masses += read
    masses /= num_members
    safe = masses[:, belief_masses.SAFE]
    # As a sum, not as 1 - mu: rounding must not lift the share above one.
    known = safe + masses[:, belief_masses.UNSAFE]
    normalized = np.divide(safe, known, out=np.zeros_like(safe), where=known > 0.0)
    calibrated = normalized.copy()
    if base_logit is not None:
        is_known = known > 0.0
        heads = base_logit.heads(output)[is_known]
        residual = correction.residual(embedding, x[is_known])
        shift = correction.shift(heads, residual, guard[is_known] / num_inside[is_known])
        calibrated[is_known] = sigmoid(-base_logit.of_heads(heads) - shift)
    margins = np.full((len(x), num_columns - 3), np.nan)
    if output.margins.shape[2]:
        margins = output.margins.mean(axis=0)
    return Assessments(
        # Gamma(x) = b_safe of the cell v = L(x)
        safety_probability=safe.copy(),
        normalized=normalized,
        belief=masses[:, :3].copy(),
        embedding=output.embedding[0],
        cause_probability=masses[:, 3:].copy(),
        predicted_margins=margins,
        unsafe_logit=output.unsafe_logit.mean(axis=0),
        calibrated=calibrated,
    )


def _read(
    values: np.ndarray, points: np.ndarray, grid: Grid, is_sharpened: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Cell values (R*R, c) at points (N, 2) of one map, zero outside, and which lie outside."""
    if is_sharpened:
        cells, weights = grid.bilinear(points)
        return np.einsum("nk,nkc->nc", weights, values[cells]), cells[:, 0] == OUTSIDE
    cells = grid.locate(points)
    is_outside = cells == OUTSIDE
    return np.where(is_outside[:, None], 0.0, values[cells]), is_outside


def predict_row(
    parts: tuple[np.ndarray, ...],
    *,
    embedding: Embedding,
    grid: Grid,
    beliefs: np.ndarray,
    correction: Correction,
    base_logit: BaseLogit | None,
    is_sharpened: bool,
) -> np.ndarray:
    """`predict` of one input as one vector, for the online run: what it costs is most of the tick.

    Args:
        parts: Vectors that the input consists of, in their order, (n_x,) together.
        embedding: The maps.
        grid: The grid of their cells.
        beliefs: Beliefs of the cells, (K, R*R, 3 + n_c).
        correction: What feedback adds to L.
        base_logit: L; None without heads.
        is_sharpened: Whether beliefs are interpolated between cell centres.

    Returns:
        The fields of `Assessment` one after the other, in their order, (8 + 2 n_c,).
    """
    num_members, num_cells, num_columns = beliefs.shape
    row = np.empty(2 + 2 * num_columns)
    masses = row[2 : 2 + num_columns]
    margins = row[4 + num_columns : -1]
    evaluated = embedding.evaluate_one(*parts)
    output = None if evaluated is None else evaluated[0]
    rows: list[int] = []
    weights: list[float] = []
    if output is None:
        row[2 + num_columns : -1] = np.nan
    elif is_sharpened:
        for member, (first, second) in enumerate(output[:, :2].tolist()):
            corners = grid.bilinear_one(first, second)
            if corners is not None:
                start = member * num_cells
                rows += [start + cell for cell in corners[0]]
                weights += corners[1]
        if rows:
            np.dot(weights, beliefs.reshape(-1, num_columns).take(rows, axis=0), out=masses)
            masses /= num_members
            # A map that sends the input outside its grid knows nothing of it.
            masses[belief_masses.UNCERTAINTY] += 1.0 - len(rows) / (4 * num_members)
    else:
        cell = grid.locate_one(*output[0, :2].tolist())
        if cell != OUTSIDE:
            rows, weights = [cell], [1.0]
            masses[:] = beliefs[0, cell]
    if not rows:
        masses[:] = 0.0
        masses[belief_masses.UNCERTAINTY] = 1.0
    safe, unsafe = masses[:2].tolist()
    known = safe + unsafe
    row[0] = safe
    row[1] = row[-1] = safe / known if known > 0.0 else 0.0
    if evaluated is not None:
        output, activations = evaluated
        row[2 + num_columns : 4 + num_columns] = output[0, :2]
        margins[:] = np.nan
        if embedding.num_margins:
            np.add.reduce(output[:, 2:], out=margins)
            margins /= num_members
        if known > 0.0 and base_logit is not None:
            z, nearness = base_logit.heads_one(
                embedding.unsafe_logit_one(output[:, :2]) if embedding.has_safety_head else [],
                float(margins.min()) if embedding.num_margins else None,
            )
            offset, safety_slope, margin_slope = correction.change.tolist()
            shift = offset + safety_slope * z + margin_slope * nearness
            least, most = correction.hidden_range.tolist()
            shift += min(max(float(np.vdot(activations, correction.hidden)), least), most)
            shift = min(max(shift, -SHIFT_LIMIT), SHIFT_LIMIT)
            if shift < 0.0:
                guard = float(np.dot(weights, correction.guard.ravel().take(rows)))
                shift *= 1.0 - guard / sum(weights)
            row[-1] = 1.0 / (1.0 + math.exp(base_logit.of_one(z, nearness) + shift))
    return row
