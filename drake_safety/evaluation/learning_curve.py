"""How much better Γ judges plans the more episodes it has learned from."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

from drake_safety.evaluation.metrics import Figure
from drake_safety.evaluation.plan_study import (
    Plans,
    promised_miss_rate,
    scorer_rule,
    verdict_figures,
)
from drake_safety.evaluation.scorers import StageProgress, assessment_scorer
from drake_safety.learning.assessment import AssessmentParameters, SafetyAssessment
from drake_safety.learning.calibration import score_threshold
from drake_safety.simulation.dataset import completed, load_episodes
from drake_safety.simulation.rollouts import parallel_map


def check_sizes(num_episodes: int, sizes: Sequence[int]) -> None:
    """Refuses sizes of training sets that cannot be.

    Args:
        num_episodes: How many training episodes there are.
        sizes: How many of them to learn from.

    Raises:
        ValueError: A size is not positive, or more than there are.
    """
    misfits = [size for size in sizes if not 1 <= size <= num_episodes]
    if misfits:
        raise ValueError(
            f"learning curve: there are {num_episodes} training episodes; got sizes {misfits}"
        )


def learning_curve(
    path: str | os.PathLike[str],
    sizes: Sequence[int],
    parameters: AssessmentParameters,
    calibration: Plans,
    test: Plans,
    *,
    known: Mapping[int, SafetyAssessment] | None = None,
    num_workers: int | None = None,
    progress: StageProgress | None = None,
) -> dict[str, Figure]:
    """Trains on the first n episodes, for several n, and judges the same plans each time.

    Args:
        path: Folder of the training episodes.
        sizes: The n.
        parameters: How Γ is learned.
        calibration: Plans on which each Γ's threshold is chosen.
        test: Fresh plans.
        known: What was learned already, by n.
        num_workers: Processes.
        progress: Called with a stage, the number done and the number wanted.

    Returns:
        By "N.auc", "N.safe_recall", "N.unsafe_recall", "N.brier" and "N.threshold" (Γ_thre), the
        same by "N.fair.…" for the fair set.

    Raises:
        ValueError: A size is not positive, or more than there are.
    """
    check_sizes(len(completed(path)), sizes)
    learned, wanted = dict(known or {}), sorted(set(sizes))
    missing = [size for size in wanted if size not in learned]
    done = len(wanted) - len(missing)
    if progress is not None:
        progress("learning curve", done, len(wanted))
    # The largest first: nobody waits for it at the end.
    arguments = [(os.fspath(path), size, parameters) for size in reversed(missing)]
    for size, assessment in parallel_map(_learn, arguments, num_workers):
        learned[size] = assessment
        done += 1
        if progress is not None:
            progress("learning curve", done, len(wanted))
    figures: dict[str, Figure] = {}
    miss_rate = promised_miss_rate(calibration)
    for size in wanted:
        rule = scorer_rule(assessment_scorer("sharpened", learned[size], "calibrated"))
        threshold = score_threshold(
            rule.unsafe_score(calibration), calibration.is_unsafe, miss_rate
        )
        score = rule.unsafe_score(test)
        for key, plans, chosen in (
            (f"{size}", test, score),
            (f"{size}.fair", test.fair(), score[test.is_fair]),
        ):
            found = verdict_figures(plans, chosen, threshold)
            limit = 1.0 - threshold
            found["threshold"] = Figure(limit, limit, limit, len(calibration))
            figures |= {f"{key}.{what}": figure for what, figure in found.items()}
    return figures


def _learn(path: str, size: int, parameters: AssessmentParameters) -> tuple[int, SafetyAssessment]:
    return size, SafetyAssessment(parameters).fit(load_episodes(path)[:size])
