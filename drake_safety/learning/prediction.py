"""Evaluation of an assessment: beliefs read from the grid at the maps' outputs."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from drake_safety.learning import beliefs as belief_masses
from drake_safety.learning.grid import OUTSIDE, Grid
from drake_safety.learning.novelty import Novelty
from drake_safety.learning.trained_maps import Embedding, EmbeddingOutput

LOGIT_LIMIT = 8.0
"""Heads' logits are clipped to this magnitude."""
SHIFT_LIMIT = 100.0
"""Largest shift of the base logit, which keeps exp from overflowing."""

LITERAL, NORMALIZED, CALIBRATED = "literal", "normalized", "calibrated"
"""Fields of an assessment's result."""
GAMMA = {LITERAL: "literal Γ", NORMALIZED: "normalised Γ", CALIBRATED: "calibrated Γ"}
"""What messages, tables and figures call a field."""
PORTS = {
    LITERAL: "safety_probability",
    NORMALIZED: "normalized_safety_probability",
    CALIBRATED: "calibrated_safety_probability",
}
"""Output port of :class:`~drake_safety.systems.safety_assessor.SafetyAssessor` for a field."""


def gamma_of_port(port: str) -> str:
    """What messages call the quantity of an output port.

    Args:
        port: One of `PORTS`.
    """
    return next(GAMMA[name] for name, its_port in PORTS.items() if its_port == port)


@dataclass(kw_only=True, eq=False)
class Assessments:
    """Assessments of N inputs.

    Attributes:
        literal: Literal Γ, b_safe of the grid, (N,). At most 1 - mu.
        normalized: Normalised Γ, b_safe / (1 - mu), the safe share of the known mass, (N,); 0 where
            mu is 1.
        belief: (b_safe, b_unsafe, mu), (N, 3); empty for novel inputs.
        embedding: y of the first map, (N, 2); NaN for inputs that are not finite.
        cause_probability: b_unsafe split by the violated constraint, (N, n_c).
        predicted_margins: Smallest margin of each constraint until the episode's end [unit of the
            margins], (N, n_c); NaN for inputs that are not finite or without a margin head.
        unsafe_logit: Mean logit of the maps' safety heads, (N,); NaN without a head.
        calibrated: Calibrated Γ, a probability of safety from the base logit with the correction by
            feedback, (N,); 0 where the belief is "don't know", see `is_unknown`. Without heads, as
            in the paper's mode, otherwise equal to `normalized`.
        novelty: Distance of x from the training inputs in units of the largest known one, (N,);
            novel above 1, infinite for inputs that are not finite.
    """

    literal: np.ndarray
    normalized: np.ndarray
    belief: np.ndarray
    embedding: np.ndarray
    cause_probability: np.ndarray
    predicted_margins: np.ndarray
    unsafe_logit: np.ndarray
    calibrated: np.ndarray
    novelty: np.ndarray

    def one(self, row: int) -> Assessment:
        """Returns the assessment in one row."""
        return Assessment(
            literal=float(self.literal[row]),
            normalized=float(self.normalized[row]),
            belief=self.belief[row],
            cause_probability=self.cause_probability[row],
            embedding=self.embedding[row],
            predicted_margins=self.predicted_margins[row],
            calibrated=float(self.calibrated[row]),
            novelty=float(self.novelty[row]),
        )


@dataclass(kw_only=True, eq=False, slots=True)
class Assessment:
    """Assessment of one input; the fields of `Assessments` without the axis N."""

    literal: float
    normalized: float
    belief: np.ndarray
    cause_probability: np.ndarray
    embedding: np.ndarray
    predicted_margins: np.ndarray
    calibrated: float
    novelty: float

    def unknown(self) -> Assessment:
        """The assessment with the empty belief."""
        return replace(
            self,
            literal=0.0,
            normalized=0.0,
            calibrated=0.0,
            belief=np.array([0.0, 0.0, 1.0]),
            cause_probability=np.zeros_like(self.cause_probability),
        )

    def outside(self, cause: int) -> Assessment:
        """The assessment of a state outside the safe set: what was safe is unsafe.

        Args:
            cause: Number of the violated constraint.
        """
        safe, unsafe, uncertainty = self.belief
        cause_probability = self.cause_probability.copy()
        cause_probability[cause] += safe
        return replace(
            self,
            literal=0.0,
            normalized=0.0,
            calibrated=0.0,
            belief=np.array([0.0, unsafe + safe, uncertainty]),
            cause_probability=cause_probability,
        )


@dataclass(frozen=True, kw_only=True)
class BaseLogit:
    """The base logit: a logit of an unsafe end from the outputs of the maps' heads.

    ``offset + safety_slope z - margin_slope m / margin_unit``, where z is the mean logit of the
    safety heads and m the smallest predicted margin; the term of a missing head is zero.

    Attributes:
        margin_unit: Unit of margins [unit of the margins].
        margin_range: Range that margins are clipped to [unit of the margins].
        offset: The base logit where both heads are zero.
        safety_slope: Slope in the logit of the safety heads.
        margin_slope: Slope in the negative margin, in `margin_unit`.
    """

    margin_unit: float
    margin_range: tuple[float, float]
    offset: float = 0.0
    safety_slope: float = 1.0
    margin_slope: float = 1.0

    def heads(self, output: EmbeddingOutput) -> np.ndarray:
        """Returns z and -m / margin_unit of all inputs, (N, 2); zero for a missing head."""
        found = np.zeros((output.embedding.shape[1], 2))
        if np.isfinite(output.unsafe_logit).any() or not output.margins.shape[2]:
            found[:, 0] = np.clip(output.unsafe_logit, -LOGIT_LIMIT, LOGIT_LIMIT).mean(axis=0)
        if output.margins.shape[2]:
            smallest = output.margins.mean(axis=0).min(axis=1)
            found[:, 1] = -np.clip(smallest, *self.margin_range) / self.margin_unit
        return found

    def of_heads(self, heads: np.ndarray) -> np.ndarray:
        """Returns the base logit (N,) from the values of `heads`, (N, 2)."""
        logit = self.offset + heads @ (self.safety_slope, self.margin_slope)
        return np.clip(logit, -LOGIT_LIMIT, LOGIT_LIMIT)


@dataclass(eq=False, slots=True)
class Correction:
    """Correction of the base logit by feedback.

    Attributes:
        change: Changes of the offset, safety slope and margin slope, (3,).
        hidden: Weights of the activations of the maps' last hidden layer, and a constant, (K,
            num_activations + 1).
        hidden_range: Least and largest sum of the hidden layer's terms in feedback, to which it is
            clipped, (2,).
        guard: 1 in cells of each map where the base logit must not fall, else 0, (K, R*R).
    """

    change: np.ndarray
    hidden: np.ndarray
    hidden_range: np.ndarray
    guard: np.ndarray

    @classmethod
    def none(cls, embedding: Embedding, grid: Grid) -> Correction:
        """Returns the zero correction."""
        return cls(
            change=np.zeros(3),
            hidden=np.zeros((embedding.num_members, embedding.num_activations + 1)),
            hidden_range=np.zeros(2),
            guard=np.zeros((embedding.num_members, grid.num_cells)),
        )

    @property
    def is_any(self) -> bool:
        """Whether the correction is not zero."""
        return bool(self.change.any() or self.hidden.any())

    def residual(self, embedding: Embedding, x: np.ndarray) -> np.ndarray:
        """Returns the hidden layer's contribution at finite inputs (N, n_x), (N,)."""
        if not self.hidden.any():
            return np.zeros(len(x))
        added = hidden_sum(embedding.activations(x), self.hidden)
        return np.clip(added, *self.hidden_range)

    def shift(self, heads: np.ndarray, residual: np.ndarray, guard: np.ndarray) -> np.ndarray:
        """Returns the shift of the base logit, (N,).

        Args:
            heads: z and -m / margin_unit, (N, 2).
            residual: Contribution of the hidden layer, (N,).
            guard: Interpolated guard of the cells, (N,).
        """
        shift = self.change[0] + heads @ self.change[1:] + residual
        shift = np.clip(shift, -SHIFT_LIMIT, SHIFT_LIMIT)
        return np.where(shift < 0.0, (1.0 - guard) * shift, shift)


def check_shapes(given: tuple[np.ndarray, Correction], own: tuple[np.ndarray, Correction]) -> None:
    """Checks that beliefs and a correction are shaped as those of an assessment.

    Raises:
        ValueError: An array has another shape.
    """
    pairs = [("beliefs", given[0], own[0])]
    for field in fields(Correction):
        sides = (getattr(correction, field.name) for _, correction in (given, own))
        pairs.append((f"the correction's {field.name}", *sides))
    for name, one, expected in pairs:
        if one.shape != expected.shape:
            raise ValueError(
                f"SafetyAssessment: the shape of {name} is {one.shape}, expected {expected.shape}"
            )


def hidden_sum(activations: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Sums activations (K, N, n) by weights (K, n + 1), the last of which is constant, (N,)."""
    return np.einsum("kni,ki->n", activations, hidden[:, :-1]) + hidden[:, -1].sum()


def is_unknown(belief: np.ndarray, initial_uncertainty: float) -> np.ndarray:
    """Returns where more than half of a belief comes from empty cells, (N,).

    Args:
        belief: (b_safe, b_unsafe, mu), (N, 3).
        initial_uncertainty: mu_ini, the uncertainty of a filled cell.
    """
    return belief[:, belief_masses.UNCERTAINTY] > 0.5 * (1.0 + initial_uncertainty)


def sigmoid(z: np.ndarray) -> np.ndarray:
    """Returns 1 / (1 + exp(-z)) for logits of moderate magnitude."""
    return 1.0 / (1.0 + np.exp(-z))


def predict(
    x: np.ndarray,
    *,
    embedding: Embedding,
    grid: Grid,
    beliefs: np.ndarray,
    correction: Correction,
    base_logit: BaseLogit | None,
    novelty: Novelty,
    initial_uncertainty: float,
    is_sharpened: bool,
) -> Assessments:
    """Assesses inputs; novel ones and those that are not finite get the empty belief.

    Args:
        x: Inputs, (N, n_x).
        embedding: The maps.
        grid: The grid.
        beliefs: Beliefs of the cells, (K, R*R, 3 + n_c).
        correction: Correction of the base logit by feedback.
        base_logit: The base logit; None without heads.
        novelty: Says which inputs are novel.
        initial_uncertainty: mu_ini, the uncertainty of a filled cell.
        is_sharpened: Whether beliefs are interpolated between cell centres.
    """
    output = embedding.evaluate(x)
    cells, weights = _cells(output.embedding, grid, is_sharpened)
    is_outside = cells[..., 0] == OUTSIDE
    # Rows of all members' cells; points outside have zero weights, so their row is arbitrary.
    cells = cells + grid.num_cells * np.arange(len(cells))[:, None, None]
    num_members, _, num_columns = beliefs.shape
    masses = np.einsum("knw,knwc->nc", weights, beliefs.reshape(-1, num_columns)[cells])
    # A map whose output lies outside its grid contributes the empty belief.
    masses[:, belief_masses.UNCERTAINTY] += is_outside.sum(axis=0)
    masses /= num_members
    # Departure: beyond the training inputs the maps place x in cells of others.
    distance = novelty.of(x)
    masses[distance > 1.0] = 0.0
    masses[distance > 1.0, belief_masses.UNCERTAINTY] = 1.0
    safe = masses[:, belief_masses.SAFE]
    # A sum instead of 1 - mu, so that rounding cannot raise the share above one.
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
    calibrated[is_unknown(masses, initial_uncertainty)] = 0.0
    margins = np.full((len(x), num_columns - 3), np.nan)
    if output.margins.shape[2]:
        margins = output.margins.mean(axis=0)
    return Assessments(
        # The paper's Γ(x) = b_safe of the cell of Psi(x).
        literal=safe.copy(),
        normalized=normalized,
        belief=masses[:, :3].copy(),
        embedding=output.embedding[0],
        cause_probability=masses[:, 3:].copy(),
        predicted_margins=margins,
        unsafe_logit=output.unsafe_logit.mean(axis=0),
        calibrated=calibrated,
        novelty=distance,
    )


def _cells(points: np.ndarray, grid: Grid, is_sharpened: bool) -> tuple[np.ndarray, np.ndarray]:
    """Cells to read and their weights, (K, N, 4), or (K, N, 1) in the paper's mode."""
    if is_sharpened:
        return grid.bilinear(points)
    cells = grid.locate(points)[..., None]
    return cells, (cells != OUTSIDE).astype(float)
