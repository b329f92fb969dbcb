"""Scorers: safety probabilities of assessments and baseline classifiers behind one interface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drake_safety.evaluation.baselines import KINDS, DirectClassifier
from drake_safety.files.progress import StageProgress, shown
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.prediction import is_unknown
from drake_safety.learning.seeds import UsedEpisodes
from drake_safety.learning.segments import Episodes, Segments


@dataclass(frozen=True, kw_only=True)
class Scorer:
    """A source of safety probabilities.

    Attributes:
        name: Its key in tables.
        probability: Safety probability, (N,), of states (N, n_s), previews (N, H*n_z) and features
            (N, n_f); NaN where nothing is known.
        uses_true_state: Whether it takes the state without noise in nominal episodes.
        used: Episodes used to train, calibrate or adapt it.
    """

    name: str
    probability: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    uses_true_state: bool = False
    used: Sequence[UsedEpisodes] = ()

    def unsafe_score(self, segments: Segments) -> np.ndarray:
        """Unsafe score of each segment, one minus its safety probability, (N,).

        Where nothing is known it is 1.
        """
        state = segments.true_state if self.uses_true_state else segments.state
        probability = self.probability(state, segments.desired_preview, segments.features)
        return 1.0 - np.nan_to_num(probability, nan=0.0)


def assessment_scorer(name: str, assessment: SafetyAssessment) -> Scorer:
    """The probability of an assessment as a scorer.

    Args:
        name: Its key in tables.
        assessment: A fitted assessment.
    """

    def probability(
        state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray
    ) -> np.ndarray:
        result = assessment.predict(
            state, desired_preview, features if assessment.uses_features else None
        )
        unknown = is_unknown(result.belief, assessment.parameters.initial_uncertainty)
        return np.where(unknown, np.nan, result.probability)

    return Scorer(
        name=name,
        probability=probability,
        uses_true_state=not assessment.parameters.is_sharpened,
        used=assessment.used_,
    )


def classifier_scorers(
    episodes: Episodes, progress: StageProgress | bool | None = None, *, shortest: int | None = None
) -> list[Scorer]:
    """The baseline classifiers, trained on the training episodes of the assessment.

    Args:
        episodes: Training episodes.
        progress: Called with a stage, the number done and the number wanted; True shows it.
        shortest: Minimum length of a segment of a safe episode [steps]; the horizon by default.
    """
    scorers = []
    with shown(progress, lambda stages: stages) as report:
        for i, kind in enumerate(KINDS):
            if report is not None:
                report("baseline classifiers", i, len(KINDS))
            classifier = DirectClassifier(kind, shortest=shortest).fit(episodes)
            used = [UsedEpisodes.of("training", episodes.info, len(episodes))]
            scorers.append(_classifier_scorer(classifier, used))
        if report is not None:
            report("baseline classifiers", len(KINDS), len(KINDS))
    return scorers


def _classifier_scorer(classifier: DirectClassifier, used: Sequence[UsedEpisodes]) -> Scorer:
    def probability(
        state: np.ndarray, desired_preview: np.ndarray, features: np.ndarray
    ) -> np.ndarray:
        return 1.0 - classifier.predict_unsafe(state, desired_preview, features)

    return Scorer(name=classifier.kind, probability=probability, used=used)
