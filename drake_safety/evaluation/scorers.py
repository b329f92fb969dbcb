"""Scorers: safety probabilities of assessments, and of others, behind one interface."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.prediction import is_unknown
from drake_safety.learning.seeds import UsedEpisodes
from drake_safety.learning.segments import Segments


@dataclass(frozen=True, kw_only=True)
class Scorer:
    """Safety probabilities (N,) of states, previews and features (N, ...); NaN is "don't know"."""

    name: str
    probability: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    uses_true_state: bool = False  # Without noise, in nominal episodes.
    used: Sequence[UsedEpisodes] = ()

    def unsafe_score(self, segments: Segments) -> np.ndarray:
        """Unsafe score of each segment, (N,): one minus its safety probability, 1 if unknown."""
        state = segments.true_state if self.uses_true_state else segments.state
        probability = self.probability(state, segments.desired_preview, segments.features)
        return 1.0 - np.nan_to_num(probability, nan=0.0)


def assessment_scorer(name: str, assessment: SafetyAssessment) -> Scorer:
    """The probability of an assessment as a scorer."""

    def probability(*rows: np.ndarray) -> np.ndarray:
        result = assessment.predict(*rows)
        unknown = is_unknown(result.belief, assessment.parameters.initial_uncertainty)
        return np.where(unknown, np.nan, result.probability)

    return Scorer(
        name=name,
        probability=probability,
        uses_true_state=assessment.settings.is_paper,
        used=assessment.used_,
    )
