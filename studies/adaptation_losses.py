"""Losses of an adapted assessment by step: map, grid, and update from feedback."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np

from drake_safety.evaluation.metrics import Estimate
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.feedback import FeedbackSet
from drake_safety.learning.segments import Episodes, split
from studies.adaptation_study import TestSet
from studies.baselines import DirectClassifier

NUM_NEIGHBOURS = 50
STEPS = ("x", "psi", "grid", "update", "update_without_gpr")
"""The steps, see `losses`."""


def losses(
    prior: SafetyAssessment, feedback: Sequence[FeedbackSet], learned: Episodes, test: TestSet
) -> dict[str, Estimate]:
    """Brier scores of the steps from x to an adapted grid, each on the fresh episodes.

    - "x": gradient boosting on x, trained on many actual episodes.
    - "psi": share of unsafe ends among the nearest segments of these episodes in the embedding.
    - "grid": share of unsafe ends among their segments in the same cell.
    - "update": the grid after the paper's update from the feedback.
    - "update_without_gpr": the same without discrepancy function.

    The differences between steps are the losses of Ψ, of the grid and of the update. For an
    ensemble, "psi" and "grid" are those of the first map.

    Args:
        prior: The assessment before feedback.
        feedback: All feedback.
        learned: Many actual episodes, other than the fresh ones.
        test: The fresh episodes.

    Raises:
        ValueError: All actual episodes have the same end.
    """
    from sklearn.neighbors import KNeighborsClassifier

    parameters = prior.parameters
    known = split(learned, stride=1, discount=1.0, shortest=parameters.shortest)
    judged = test.segments
    boosting = DirectClassifier(
        "gradient_boosting", uses_features=prior.uses_features, shortest=parameters.shortest
    ).fit(learned)
    here, there = (
        prior.predict(
            one.state, one.desired_preview, one.features if prior.uses_features else None
        ).embedding
        for one in (judged, known)
    )
    neighbours = KNeighborsClassifier(min(NUM_NEIGHBOURS, len(known)))
    neighbours.fit(there, known.is_unsafe.astype(int))
    share = neighbours.predict_proba(here)[:, 1]
    cells, own = prior.grid_.locate(there), prior.grid_.locate(here)
    inside = cells >= 0
    count = np.bincount(cells[inside], minlength=prior.grid_.num_cells)
    unsafe = np.bincount(cells[inside], known.is_unsafe[inside], minlength=prior.grid_.num_cells)
    overall = known.is_unsafe.mean()
    by_cell = np.divide(unsafe, count, out=np.full(len(count), overall), where=count > 0)
    without_gpr = copy.copy(prior)
    without_gpr.parameters = copy.deepcopy(parameters)
    without_gpr.parameters.adaptation.gate = 0.0
    probability = {
        "x": boosting.predict_unsafe(judged.state, judged.desired_preview, judged.features),
        "psi": share,
        "grid": np.where(own >= 0, by_cell[own], overall),
        "update": test.unsafe_score(prior.adapt(feedback, method="paper")),
        "update_without_gpr": test.unsafe_score(without_gpr.adapt(feedback, method="paper")),
    }
    found = {}
    for name in STEPS:
        value = float(np.mean((probability[name] - judged.is_unsafe) ** 2))
        found[f"losses.{name}.brier"] = Estimate.exact(value, len(test.episodes))
    return found
