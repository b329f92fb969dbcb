"""Verdicts on plans with a goal: fair goals, the other hand, inverse kinematics, and causes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_safety.evaluation.episode_study import first_segments, promised_miss_rate
from drake_safety.evaluation.metrics import Bootstrap, Estimate, proportion, segment_estimates
from drake_safety.evaluation.scorers import Scorer
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.calibration import PLAN, least_miss_rate, score_threshold
from drake_safety.learning.causes import likely_causes
from drake_safety.learning.segments import DIVERGED, Episodes, Segments
from drake_safety.simulation.capabilities import HasGoals, is_fair, require
from drake_safety.simulation.closed_loop import ClosedLoop
from studies.reachability import Reachability

SAFE_RECALL = 0.952
"""The paper's safe recall on 1000 random targets."""
UNSAFE_RECALL = 0.987
"""The paper's unsafe recall on these."""


@dataclass(frozen=True, kw_only=True)
class Plans:
    """Plans of episodes: their inputs at k = 0 and their outcomes.

    Attributes:
        episodes: The M episodes.
        first: First segment of each, (N,); diverged episodes have none.
        goals: Goal of each segment's plan in the world, (N, 3) [m].
        is_fair: Whether the goal of each episode belongs to the fair set, (M,).
        hand: Name of the reaching frame, if the task has one.
    """

    episodes: Episodes
    first: Segments
    goals: np.ndarray
    is_fair: np.ndarray
    hand: str | None


def plans_of(loop: ClosedLoop, episodes: Episodes) -> Plans:
    """The plans of episodes that a closed loop with goals generated."""
    first, with_goals = first_segments(episodes), require(loop, HasGoals)
    return Plans(
        episodes=episodes,
        first=first,
        goals=np.array([with_goals.goal_of(episodes[i]) for i in first.episode]),
        is_fair=np.array([is_fair(with_goals, episode) for episode in episodes]),
        hand=with_goals.hand,
    )


Rule = Callable[[Plans], np.ndarray]
"""Maps plans to unsafe scores, (N,), in [0, 1]."""


def scorer_rule(scorer: Scorer) -> Rule:
    """The rule of a scorer."""
    return lambda plans: scorer.unsafe_score(plans.first)


def reachability_rule(reachability: Mapping[str, Reachability]) -> Rule:
    """The rule, by hand, that accepts goals within reach of inverse kinematics."""
    return lambda plans: 1.0 - reachability[plans.hand or ""].is_reachable(plans.goals)


def evaluate_plans(
    rules: Mapping[str, Rule],
    thresholds: Mapping[str, float],
    assessment: SafetyAssessment,
    calibration: Plans,
    sets: Mapping[str, Plans],
    twins: Sequence[str] = (),
) -> tuple[dict[str, Estimate], dict[str, float]]:
    """Evaluates rules on fresh plans, on all goals and on the fair ones.

    Missing thresholds are chosen on the calibration plans, with the promise of a calibrated
    assessment if they can keep it.

    Args:
        rules: The rules by name; "sharpened" is that of the assessment.
        thresholds: Unsafe score above which a rule refuses.
        assessment: Γ, which names causes.
        calibration: Fresh plans for thresholds.
        sets: Other fresh plans by the prefix of their keys, such as "plans".
        twins: Prefixes of sets with the goals of "plans", in the same order, for the other hand.

    Returns:
        The estimates by dotted key, and all thresholds.
    """
    label = calibration.first.is_unsafe
    stored = assessment.calibrations_.get(PLAN)
    if stored is None:
        miss_rate = promised_miss_rate(label)
    else:
        miss_rate = max(stored.miss_rate, least_miss_rate(int(label.sum())))
    limits = {
        name: thresholds[name]
        if name in thresholds
        else score_threshold(rule(calibration), label, miss_rate)
        for name, rule in rules.items()
    }
    estimates = {"plans.promised_unsafe_recall": Estimate.exact(1.0 - miss_rate, int(label.sum()))}
    refused: dict[str, dict[str, np.ndarray]] = {}
    for prefix, plans in sets.items():
        scores = {name: rule(plans) for name, rule in rules.items()}
        refused[prefix] = {name: score > limits[name] for name, score in scores.items()}
        causes = named_causes(assessment, plans)
        everywhere = np.ones(len(plans.episodes), dtype=bool)
        for key, chosen in ((prefix, everywhere), (f"{prefix}.fair", plans.is_fair)):
            rows = chosen[plans.first.episode]
            first = plans.first.take(rows)
            for name, score in scores.items():
                found = segment_estimates(first, score[rows], threshold=limits[name])
                found["threshold"] = Estimate.exact(1.0 - limits[name], len(label))
                estimates |= {f"{key}.{name}.{what}": one for what, one in found.items()}
            names = plans.episodes.info.constraint_names
            is_right = refused[prefix]["sharpened"][rows] & first.is_unsafe
            found = _cause_estimates(
                first, {k: v[rows] for k, v in causes.items()}, is_right, names
            )
            outcomes = np.array([one.cause or "safe" for one in plans.episodes])[chosen]
            for name in ("safe", *names, DIVERGED):
                share = proportion(int(np.sum(outcomes == name)), len(outcomes))
                found[f"outcomes.{name}"] = share
            estimates |= {f"{key}.{what}": one for what, one in found.items()}
    for prefix in twins:
        for name in rules:
            one, other = sets["plans"].first, sets[prefix].first
            found = recall_losses(one, refused["plans"][name], other, refused[prefix][name])
            estimates |= {f"{prefix}.{name}.{what}": one for what, one in found.items()}
    return estimates, limits


def recall_losses(
    plans: Segments, is_refused: np.ndarray, twins: Segments, is_twin_refused: np.ndarray
) -> dict[str, Estimate]:
    """Recalls of plans that have a twin, minus those of the twins, which have the same targets.

    Args:
        plans: First segments of plans; some may have no twin.
        is_refused: Whether each is refused, (N,).
        twins: First segments of their twins, in the same order.
        is_twin_refused: Whether each twin is refused, (M,).

    Returns:
        `safe_recall_loss` and `unsafe_recall_loss`, with bootstraps over pairs.
    """
    _, rows, twin_rows = np.intersect1d(plans.episode, twins.episode, return_indices=True)
    unsafe, refused = plans.is_unsafe[rows], is_refused[rows]
    twin_unsafe, twin_refused = twins.is_unsafe[twin_rows], is_twin_refused[twin_rows]

    def loss(
        relevant: np.ndarray, right: np.ndarray, twin_relevant: np.ndarray, twin_right: np.ndarray
    ) -> Estimate:
        def statistic(weight: np.ndarray) -> float:
            total, twin_total = weight @ relevant, weight @ twin_relevant
            if not (total and twin_total):
                return math.nan
            recall = weight @ (relevant & right) / total
            return float(recall - weight @ (twin_relevant & twin_right) / twin_total)

        return Bootstrap().over_episodes(statistic, np.arange(len(rows)))

    return {
        "safe_recall_loss": loss(~unsafe, ~refused, ~twin_unsafe, ~twin_refused),
        "unsafe_recall_loss": loss(unsafe, refused, twin_unsafe, twin_refused),
    }


def named_causes(assessment: SafetyAssessment, plans: Plans) -> dict[str, np.ndarray]:
    """The cause that Γ names for each plan, as index of the constraint, (N,).

    Returns:
        "right_cause", by :func:`~drake_safety.learning.causes.likely_causes`, and for comparison
        "by_cause_probability", the constraint with the largest unsafe mass.
    """
    first = plans.first
    result = assessment.predict_rows(first)
    no_margins = np.full_like(result.predicted_margins, np.nan)
    return {
        "right_cause": likely_causes(
            result.cause_probability, result.predicted_margins, assessment.parameters.margin_unit
        ),
        "by_cause_probability": likely_causes(result.cause_probability, no_margins),
    }


def _cause_estimates(
    first: Segments, named: Mapping[str, np.ndarray], rows: np.ndarray, names: Sequence[str]
) -> dict[str, Estimate]:
    """Shares of correct causes among the correctly refused rows, by either rule and by cause."""
    cause = first.cause[rows]
    is_right = {name: (found == first.cause)[rows] for name, found in named.items()}
    estimates = {f"causes.{k}": proportion(int(v.sum()), len(v)) for k, v in is_right.items()}
    for i, name in enumerate(names):
        if np.any(cause == i):
            count = int(is_right["right_cause"][cause == i].sum())
            estimates[f"causes.{name}"] = proportion(count, int(np.sum(cause == i)))
    return estimates
