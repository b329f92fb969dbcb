"""Scorers: whatever says how probable safety is, the assessment and its rivals alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drake_safety.evaluation.baselines import KINDS, DirectClassifier
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.prediction import is_unknown
from drake_safety.learning.seeds import UsedEpisodes
from drake_safety.learning.segments import Episodes, Segments

StageProgress = Callable[[str, int, int], None]
"""Called with what is under way, the number done and the number wanted."""


@dataclass(frozen=True, kw_only=True)
class Scorer:
    """Something that says how probable safety is.

    Attributes:
        name: Its key in tables.
        probability: Safety probability, (N,), of states (N, n_s), previews (N, H*n_z) and features
            (N, n_f); NaN where it does not know.
        uses_true_state: Whether nominal episodes show it the state without noise.
        used: The episodes that it was learned, calibrated or adapted with.
    """

    name: str
    probability: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    uses_true_state: bool = False
    used: Sequence[UsedEpisodes] = ()

    def unsafe_score(self, segments: Segments) -> np.ndarray:
        """How unsafe it takes each segment to be, as the metrics expect it, (N,)."""
        state = segments.true_state if self.uses_true_state else segments.state
        return 1.0 - self.probability(state, segments.desired_preview, segments.features)


def assessment_scorer(name: str, assessment: SafetyAssessment, published: str) -> Scorer:
    """Γ as a scorer.

    Args:
        name: Its key in tables.
        assessment: A fitted assessment.
        published: Which of Γ's forms it scores by: "safety_probability", literally b_safe;
            "normalized", b_safe / (1 - μ); or "calibrated", what the maps' heads say, 0 where the
            belief is "don't know".
    """

    def probability(
        state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray
    ) -> np.ndarray:
        result = assessment.predict(
            state, desired_preview, features if assessment.uses_features else None
        )
        probability = getattr(result, published)
        if published == "calibrated":
            mu = assessment.parameters.initial_uncertainty
            return np.where(is_unknown(result.belief, mu), 0.0, probability)
        return probability

    return Scorer(
        name=name,
        probability=probability,
        uses_true_state=not assessment.parameters.is_sharpened,
        used=assessment.used_,
    )


def classifier_scorers(
    episodes: Episodes, progress: StageProgress | None = None, *, shortest: int | None = None
) -> list[Scorer]:
    """The direct classifiers, trained on the assessment's own training episodes.

    Args:
        episodes: The episodes.
        progress: Called with a stage, the number done and the number wanted.
        shortest: Steps that a safe episode's segment has at least; the horizon by default.
    """
    scorers = []
    for i, kind in enumerate(KINDS):
        if progress is not None:
            progress("direct classifiers", i, len(KINDS))
        classifier = DirectClassifier(kind, shortest=shortest).fit(episodes)
        used = [UsedEpisodes.of("training", episodes.info, len(episodes))]
        scorers.append(_classifier_scorer(classifier, used))
    if progress is not None:
        progress("direct classifiers", len(KINDS), len(KINDS))
    return scorers


def _classifier_scorer(classifier: DirectClassifier, used: Sequence[UsedEpisodes]) -> Scorer:
    def probability(
        state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray
    ) -> np.ndarray:
        return 1.0 - classifier.predict_unsafe(state, desired_preview, features)

    return Scorer(name=classifier.kind, probability=probability, used=used)
