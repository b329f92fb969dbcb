"""Definitions of n_f in the paper's adaptation: segments of the cell, or all."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

from drake_safety.evaluation.metrics import Bootstrap, Estimate, segment_estimates
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.feedback import FeedbackSet
from studies.adaptation_study import THRESHOLD, TestSet
from studies.baselines import auc_difference

BEFORE, PER_CELL, TOTAL = "before_feedback", "n_f_per_cell", "n_f_total"


def counting_estimates(
    prior: SafetyAssessment,
    feedback: Sequence[FeedbackSet],
    test: TestSet,
    *,
    bootstrap: Bootstrap | None = None,
) -> dict[str, dict[str, Estimate]]:
    """Evaluates an assessment before feedback, and after it with either definition.

    Args:
        prior: The assessment before feedback.
        feedback: The feedback sets.
        test: Fresh episodes of the actual robot.
        bootstrap: Settings of the intervals.

    Returns:
        By assessment, the estimates on every segment by key; `auc_gain` is over the prior.
    """
    bootstrap = bootstrap or Bootstrap()
    judged = {BEFORE: prior}
    for name, count in ((PER_CELL, "cell"), (TOTAL, "segments")):
        one = copy.copy(prior)
        settings = replace(prior.parameters.adaptation, count=count)
        one.parameters = replace(prior.parameters, adaptation=settings)
        judged[name] = one.adapt(feedback, method="paper")
    segments = test.segments
    scores = {name: test.unsafe_score(one) for name, one in judged.items()}
    found = {}
    for name, score in scores.items():
        found[name] = segment_estimates(
            segments, score, threshold=1.0 - THRESHOLD, bootstrap=bootstrap
        )
        found[name]["auc_gain"] = auc_difference(
            score, scores[BEFORE], segments.is_unsafe, segments.episode, bootstrap=bootstrap
        )
    return found
