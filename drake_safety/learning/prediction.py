"""Prediction: beliefs read from the grid at the maps' outputs, and the probability beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
from pydantic import FiniteFloat

from drake_safety.files.schema import Positive
from drake_safety.learning import beliefs as belief_masses
from drake_safety.learning.fall_logit import FallLogit
from drake_safety.learning.grid import Grid
from drake_safety.learning.novelty import Novelty
from drake_safety.learning.trained_maps import Embedding, EmbeddingOutput
from drake_safety.learning.trees import Trees

LOGIT_LIMIT = 8.0  # Largest magnitude of the heads' logits.
SHIFT_LIMIT = 100.0  # Bounds the shift of the base logit, so that exp does not overflow.


@dataclass(kw_only=True, eq=False)
class Prediction:
    """Assessment of N inputs, or of one input without the axis N.

    Attributes:
        belief: (b_safe, b_unsafe, mu), (N, 3); empty for novel inputs. b_safe is the paper's Γ.
        probability: Probability of staying safe, (N,); b_safe in the paper's mode, 0 where the
            belief is "don't know".
        cause_probability: b_unsafe split by the violated constraint, (N, n_c).
        embedding: y of the first map, (N, 2); NaN for inputs that are not finite.
        predicted_margins: Smallest margin of each constraint until the episode's end, (N, n_c); NaN
            for inputs that are not finite and in the paper's mode.
        novelty: Distance of x from the training inputs, (N,); novel above 1.
        fall_probability: Probability of a fall, (N,); 1 for inputs that are not finite, NaN without
            a `FallLogit`.
    """

    belief: np.ndarray
    probability: Any
    cause_probability: np.ndarray
    embedding: np.ndarray
    predicted_margins: np.ndarray
    novelty: Any
    fall_probability: Any

    def one(self, row: int) -> Prediction:
        """Returns the prediction for one of the inputs."""
        return Prediction(**{name: values[row] for name, values in vars(self).items()})

    def unknown(self) -> Prediction:
        """The prediction for one input with the empty belief."""
        return replace(
            self,
            probability=0.0,
            belief=belief_masses.EMPTY,
            cause_probability=np.zeros_like(self.cause_probability),
        )

    def outside(self, cause: int) -> Prediction:
        """The prediction for a state outside the safe set: what was safe is unsafe."""
        safe, unsafe, uncertainty = self.belief
        cause_probability = self.cause_probability.copy()
        cause_probability[cause] += safe
        return replace(
            self,
            probability=0.0,
            belief=np.array([0.0, unsafe + safe, uncertainty]),
            cause_probability=cause_probability,
        )


@dataclass(frozen=True, kw_only=True)
class BaseLogit:
    """The base logit: a logit of an unsafe end from the maps' heads and the trees.

    It is ``offset + safety_slope z - margin_slope m / margin_unit + trees_slope t``. Here z is the
    mean logit of the safety heads, m the smallest predicted margin, clipped to `margin_range`, and
    t the logit of the trees.

    Departure: the paper judges by the map alone. Boosted trees, taught by the ends of the motions,
    and maps, taught by margins too, err on different inputs.
    """

    margin_unit: Positive
    margin_range: tuple[FiniteFloat, FiniteFloat]
    offset: FiniteFloat = 0.0
    safety_slope: FiniteFloat = 1.0
    margin_slope: FiniteFloat = 1.0
    trees_slope: FiniteFloat = 0.0

    def at(self, temperature: float) -> BaseLogit:
        """The base logit divided by a temperature."""
        names = ("offset", "safety_slope", "margin_slope", "trees_slope")
        return replace(self, **{name: getattr(self, name) / temperature for name in names})

    @property
    def slopes(self) -> tuple[float, float, float]:
        """The slopes of the values of `heads`."""
        return self.safety_slope, self.margin_slope, self.trees_slope

    def heads(
        self, maps: EmbeddingOutput, margins: np.ndarray, trees_logit: np.ndarray | None = None
    ) -> np.ndarray:
        """Returns z, -m / margin_unit and, with trees, t, (N, 2) or (N, 3); m is of `margins`."""
        heads = np.empty((len(margins), 2 if trees_logit is None else 3))
        heads[:, 0] = mean_of_maps(_clip(maps.unsafe_logit, -LOGIT_LIMIT, LOGIT_LIMIT))
        smallest = np.minimum.reduce(margins, axis=1)
        heads[:, 1] = _clip(smallest, *self.margin_range) / -self.margin_unit
        if trees_logit is not None:
            heads[:, 2] = _clip(trees_logit, -LOGIT_LIMIT, LOGIT_LIMIT)
        return heads

    def of_heads(self, heads: np.ndarray) -> np.ndarray:
        """Returns the base logit (N,) from the values of `heads`, (N, 2) or (N, 3)."""
        logit = self.offset + _weighted(heads, self.slopes[: heads.shape[1]])
        return _clip(logit, -LOGIT_LIMIT, LOGIT_LIMIT)


@dataclass(eq=False, slots=True)
class Correction:
    """Correction of the base logit by feedback."""

    change: np.ndarray  # Change of offset and slopes of the heads, (3,), or (4,) with trees.
    hidden: np.ndarray  # Weights of the last hidden layer, and a constant, (K, n + 1).
    hidden_range: np.ndarray  # To which the sum of their terms is clipped: that in feedback, (2,).
    guard: np.ndarray  # 1 in cells where the base logit must not fall, else 0, (K, R*R).

    @classmethod
    def none(cls, embedding: Embedding, grid: Grid, trees: Trees | None) -> Correction:
        """Returns the zero correction."""
        return cls(
            change=np.zeros(3 if trees is None else 4),
            hidden=np.zeros((embedding.num_members, embedding.num_activations + 1)),
            hidden_range=np.zeros(2),
            guard=np.zeros((embedding.num_members, grid.num_cells)),
        )

    @property
    def is_any(self) -> bool:
        """Whether the correction is not zero."""
        # Without weights the hidden layer has the range zero.
        return any(self.change.tolist()) or any(self.hidden_range.tolist())

    def residual(self, activations: np.ndarray) -> np.ndarray:
        """Returns the hidden layer's contribution, (N,), by its activations (K, N, n)."""
        return _clip(hidden_sum(activations, self.hidden), *self.hidden_range)

    def shift(self, heads: np.ndarray, residual: np.ndarray, guard: np.ndarray) -> np.ndarray:
        """The shift of the base logit, (N,), from heads, hidden layer and interpolated guard."""
        offset, *slopes = self.change
        shift = _weighted(heads, slopes, offset) + residual
        shift = _clip(shift, -SHIFT_LIMIT, SHIFT_LIMIT)
        return np.where(shift < 0.0, (1.0 - guard) * shift, shift)


class Evaluation(NamedTuple):
    """Outputs of maps and trees for N inputs; heads and logit are None for maps without heads."""

    maps: EmbeddingOutput
    margins: np.ndarray  # Mean of the maps' predicted margins, (N, n_c); NaN without heads.
    heads: np.ndarray | None  # By `BaseLogit.heads`.
    logit: np.ndarray | None  # Before its correction, (N,).


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """All that a prediction is made from; the attributes are learned by `SafetyAssessment`."""

    embedding: Embedding
    grid: Grid
    beliefs: np.ndarray
    correction: Correction
    novelty: Novelty
    base_logit: BaseLogit | None
    trees: Trees | None
    initial_uncertainty: float
    fall_logit: FallLogit | None = None

    @property
    def num_causes(self) -> int:
        """n_c, the number of constraints."""
        return self.beliefs.shape[2] - 3

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """Shapes of the beliefs and of the correction's arrays."""
        c = self.correction
        return [a.shape for a in (self.beliefs, c.change, c.hidden, c.hidden_range, c.guard)]

    def evaluate(self, x: np.ndarray) -> Evaluation:
        """Evaluates maps, trees and base logit at inputs (N, n_x)."""
        maps = self.embedding.evaluate(x)
        if self.base_logit is None:
            return Evaluation(maps, np.full((len(x), self.num_causes), np.nan), None, None)
        margins = mean_of_maps(maps.margins)
        trees_logit = None if self.trees is None else self.trees.evaluate(x)
        heads = self.base_logit.heads(maps, margins, trees_logit)
        return Evaluation(maps, margins, heads, self.base_logit.of_heads(heads))

    def predict(self, x: np.ndarray) -> Prediction:
        """Assesses inputs; the belief is empty for an input that is novel or not finite."""
        maps, margins, heads, logit = self.evaluate(x)
        num_members, _, num_columns = self.beliefs.shape
        has_correction = logit is not None and self.correction.is_any
        table = self.beliefs
        if has_correction:
            table = np.concatenate([table, self.correction.guard[..., None]], axis=2)
        values, is_inside = self.grid.read(maps.embedding, table)
        summed = np.add.reduce(values, axis=0)
        masses = summed[:, :num_columns] / num_members
        if np.count_nonzero(is_inside) < is_inside.size:
            # A map whose output lies outside its grid contributes the empty belief.
            share_inside = np.add.reduce(is_inside, axis=0) / num_members
            masses[:, belief_masses.UNCERTAINTY] += 1.0 - share_inside
        # Departure: beyond the training inputs the maps place x in cells of others.
        distance = self.novelty.of(x)
        # Nothing is known either where a cell's belief is not finite.
        is_empty = ~((distance <= 1.0) & np.isfinite(np.add.reduce(masses, axis=1)))
        if np.count_nonzero(is_empty):
            masses[is_empty] = belief_masses.empty((), num_columns - 3)
        fall_probability = np.full(len(x), np.nan)
        if heads is None or logit is None:
            # The paper's Γ(x) = b_safe of the cell of Psi(x).
            probability = masses[:, belief_masses.SAFE].copy()
        else:
            if has_correction:
                is_usable = np.isfinite(logit)
                guard = summed[:, num_columns] / np.maximum(np.add.reduce(is_inside, axis=0), 1)
                residual = np.zeros(len(x))
                activations = self.embedding.activations(x[is_usable])
                residual[is_usable] = self.correction.residual(activations)
                logit += self.correction.shift(heads, residual, guard)
            probability = 1.0 / (1.0 + np.exp(logit))
            if self.fall_logit is not None:
                fall_probability = sigmoid(self.fall_logit.of(margins, logit, x))
                fall_probability[np.isnan(maps.embedding[0, :, 0])] = 1.0
        probability[is_unknown(masses, self.initial_uncertainty)] = 0.0
        return Prediction(
            belief=masses[:, :3],
            probability=probability,
            embedding=maps.embedding[0],
            cause_probability=masses[:, 3:],
            predicted_margins=margins,
            novelty=distance,
            fall_probability=fall_probability,
        )


LEARNED = [one.name for one in fields(Model) if one.name != "initial_uncertainty"]
"""Attributes of `Model`, each of which is a learned attribute of `SafetyAssessment`."""


def _weighted(heads: np.ndarray, slopes: Sequence[float], offset: float = 0.0) -> np.ndarray:
    # A product of matrices would round by the number of rows.
    return np.add.reduce(heads * slopes, axis=1) + offset


def hidden_sum(activations: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Sums activations (K, N, n) by weights (K, n + 1), the last of which is constant, (N,)."""
    summed = activations[:, :, None] @ hidden[:, None, :-1, None]
    return summed[..., 0, 0].sum(axis=0) + hidden[:, -1].sum()


def is_unknown(belief: np.ndarray, initial_uncertainty: float) -> np.ndarray:
    """Returns where a belief is "don't know": half of it or more comes from empty cells, (...)."""
    return belief[..., belief_masses.UNCERTAINTY] > unknown_above(initial_uncertainty)


def unknown_above(initial_uncertainty: float) -> float:
    """The uncertainty above which a belief is "don't know", with room for rounding."""
    return 0.5 * (1.0 + initial_uncertainty) - 1e-9


def mean_of_maps(values: np.ndarray) -> np.ndarray:
    """Averages over the maps, (K, ...); as np.mean, at a third of its cost for a few values."""
    return np.add.reduce(values, axis=0) / len(values)


def _clip(values: np.ndarray, least: float, largest: float) -> np.ndarray:
    """As np.clip, at a fifth of its cost for a few values."""
    return np.minimum(np.maximum(values, least), largest)


def sigmoid(z: np.ndarray) -> np.ndarray:
    """Returns 1 / (1 + exp(-z)) for logits of moderate magnitude."""
    return 1.0 / (1.0 + np.exp(-z))
