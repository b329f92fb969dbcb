"""Evaluation of verdicts on plans with a goal, at k = 0, against the simulated outcomes."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_safety.evaluation.metrics import Bootstrap, Estimate, proportion, segment_estimates
from drake_safety.evaluation.reachability import Reachability
from drake_safety.evaluation.scorers import Scorer
from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.calibration import (
    Calibration,
    episodes_needed,
    least_miss_rate,
    score_threshold,
)
from drake_safety.learning.causes import likely_causes
from drake_safety.learning.segments import DIVERGED, Episodes, Segments, split
from drake_safety.simulation.capabilities import HasGoals, is_fair, require
from drake_safety.simulation.closed_loop import ClosedLoop

SAFE_RECALL = 0.952
"""The paper's safe recall on 1000 random targets."""
UNSAFE_RECALL = 0.987
"""The paper's unsafe recall on these."""
PROMISED_UNSAFE_RECALL = 0.992
"""Unsafe recall for which thresholds are chosen: half a point above the paper's for scatter."""
SAFE = "safe"
"""Outcome of an episode that stayed in the safe set; otherwise the outcome is its cause."""

_LOGGER = logging.getLogger("drake_safety")


@dataclass(frozen=True, kw_only=True)
class Plans:
    """Plans of episodes: their inputs at k = 0 and their outcomes.

    Attributes:
        first: First segment of each episode, (N,); diverged episodes have none.
        goals: Goal of each plan in the world, (N, 3) [m].
        is_fair: Whether each goal belongs to the fair set, (N,).
        hand: Name of the reaching frame, if the task has one.
        outcomes: `SAFE` or the cause of all episodes, diverged ones included, (M,).
        is_outcome_fair: Whether each of these belongs to the fair set, (M,).
        num_failures: Number of controller failures of each of these, (M,).
        constraint_names: Names of the n_c safety constraints.
    """

    first: Segments
    goals: np.ndarray
    is_fair: np.ndarray
    hand: str | None
    outcomes: np.ndarray
    is_outcome_fair: np.ndarray
    num_failures: np.ndarray
    constraint_names: list[str]

    def __len__(self) -> int:
        return len(self.first)

    @property
    def is_unsafe(self) -> np.ndarray:
        """Whether each plan ended outside the safe set, (N,)."""
        return self.first.is_unsafe

    def fair(self) -> Plans:
        """The plans of the fair set."""
        return Plans(
            first=self.first.take(self.is_fair),
            goals=self.goals[self.is_fair],
            is_fair=self.is_fair[self.is_fair],
            hand=self.hand,
            outcomes=self.outcomes[self.is_outcome_fair],
            is_outcome_fair=self.is_outcome_fair[self.is_outcome_fair],
            num_failures=self.num_failures[self.is_outcome_fair],
            constraint_names=self.constraint_names,
        )


def plans_of(loop: ClosedLoop, episodes: Episodes) -> Plans:
    """The plans of episodes of a task whose plans have a goal.

    Args:
        loop: The closed loop that generated the episodes.
        episodes: The episodes.

    Raises:
        ValueError: The task's plans have no goal.
    """
    # Every episode has a first segment, however early it ends.
    segments = split(episodes, stride=episodes.info.horizon, discount=1.0, shortest=1)
    first = segments.take(segments.is_first)
    with_goals = require(loop, HasGoals)
    fair = np.array([is_fair(with_goals, episode) for episode in episodes])
    return Plans(
        first=first,
        goals=np.array([with_goals.goal_of(episodes[i]) for i in first.episode]),
        is_fair=fair[first.episode],
        hand=with_goals.hand,
        outcomes=np.array([SAFE if e.is_safe else e.cause for e in episodes]),
        is_outcome_fair=fair,
        num_failures=np.array([episode.num_controller_failures for episode in episodes]),
        constraint_names=list(episodes.info.constraint_names),
    )


@dataclass(frozen=True, kw_only=True)
class PlanRule:
    """A rule that accepts or refuses plans.

    Attributes:
        name: Its key in tables.
        unsafe_score: Maps plans to unsafe scores, (N,), in [0, 1]; NaN for "don't know", which is
            refused.
        threshold: Unsafe score above which a plan is refused; None to choose it on the calibration
            plans.
    """

    name: str
    unsafe_score: Callable[[Plans], np.ndarray]
    threshold: float | None = None


def scorer_rule(scorer: Scorer, calibration: Calibration | None = None) -> PlanRule:
    """The rule of a scorer.

    Args:
        scorer: The scorer.
        calibration: Its calibration; without one the threshold is None.
    """
    return PlanRule(
        name=scorer.name,
        unsafe_score=lambda plans: scorer.unsafe_score(plans.first),
        threshold=None if calibration is None else 1.0 - calibration.threshold,
    )


def reachability_rule(
    reachability: Mapping[str, Reachability], name: str = "reachability"
) -> PlanRule:
    """The rule that accepts goals within reach of inverse kinematics.

    Args:
        reachability: Reachability by hand.
        name: Key of the rule.
    """

    def unsafe_score(plans: Plans) -> np.ndarray:
        if plans.hand is None or plans.hand not in reachability:
            raise ValueError(
                f"reachability: unknown hand '{plans.hand}'; the hands are {list(reachability)}"
            )
        return 1.0 - reachability[plans.hand].is_reachable(plans.goals)

    return PlanRule(name=name, unsafe_score=unsafe_score, threshold=0.5)


@dataclass(frozen=True, kw_only=True)
class PlanStudy:
    """The result of :func:`evaluate_plans`.

    Attributes:
        estimates: By dotted key.
        thresholds: Per rule, the unsafe score above which it refuses.
        unsafe_score: Per set ("plans", "plans.other_hand") and rule, the score of each plan, (N,).
    """

    estimates: dict[str, Estimate]
    thresholds: dict[str, float]
    unsafe_score: dict[str, dict[str, np.ndarray]]


def evaluate_plans(
    rules: Sequence[PlanRule],
    assessment: SafetyAssessment,
    calibration: Plans,
    sets: Mapping[str, Plans],
    twins: Sequence[str] = (),
) -> PlanStudy:
    """Evaluates rules on fresh plans, on all goals and on the fair ones.

    Thresholds that are None are chosen on the calibration plans of the whole target box: the one
    that accepts most while a future unsafe plan is refused with probability
    `PROMISED_UNSAFE_RECALL`, see :mod:`drake_safety.learning.calibration`. With too few unsafe
    calibration plans the promise is reduced to what they allow, with a warning, and reported as
    `promised_unsafe_recall`. Estimates give thresholds as Γ_thre, the safety probability below
    which a plan is refused.

    Args:
        rules: The rules; that of the assessment is named "sharpened".
        assessment: Γ, which names causes.
        calibration: Fresh plans for thresholds.
        sets: Other fresh plans by the prefix of their keys, such as "plans".
        twins: Prefixes of sets with the goals of "plans", in the same order, for the other hand.

    Raises:
        ValueError: No calibration plan is unsafe, so no threshold can be chosen.
    """
    miss_rate = promised_miss_rate(calibration)
    thresholds = {
        rule.name: score_threshold(rule.unsafe_score(calibration), calibration.is_unsafe, miss_rate)
        if rule.threshold is None
        else rule.threshold
        for rule in rules
    }
    own = next((rule for rule in rules if rule.name == "sharpened"), rules[0])

    promise = 1.0 - miss_rate
    num_unsafe = int(calibration.is_unsafe.sum())
    estimates = {"plans.promised_unsafe_recall": Estimate.exact(promise, num_unsafe)}
    scores: dict[str, dict[str, np.ndarray]] = {}
    for prefix, plans in sets.items():
        scores[prefix] = {rule.name: rule.unsafe_score(plans) for rule in rules}
        causes = named_causes(assessment, plans)
        for key, chosen, rows in (
            (prefix, plans, np.ones(len(plans), dtype=bool)),
            (f"{prefix}.fair", plans.fair(), plans.is_fair),
        ):
            for name, score in scores[prefix].items():
                found = verdict_estimates(chosen, score[rows], thresholds[name])
                estimates |= {f"{key}.{name}.{what}": estimate for what, estimate in found.items()}
                limit = 1.0 - thresholds[name]
                estimates[f"{key}.{name}.threshold"] = Estimate.exact(limit, len(calibration))
            found = _cause_estimates(
                chosen,
                {name: of_all[rows] for name, of_all in causes.items()},
                _is_refused(scores[prefix][own.name][rows], thresholds[own.name]),
            )
            found |= outcome_estimates(chosen)
            estimates |= {f"{key}.{what}": estimate for what, estimate in found.items()}
        estimates[f"{prefix}.share_fair"] = proportion(
            int(plans.is_outcome_fair.sum()), len(plans.outcomes)
        )
    for prefix in twins:
        for name, threshold in thresholds.items():
            found = recall_losses(
                sets["plans"],
                _is_refused(scores["plans"][name], threshold),
                sets[prefix],
                _is_refused(scores[prefix][name], threshold),
            )
            estimates |= {f"{prefix}.{name}.{what}": estimate for what, estimate in found.items()}
    return PlanStudy(estimates=estimates, thresholds=thresholds, unsafe_score=scores)


def promised_miss_rate(calibration: Plans) -> float:
    """Miss rate that thresholds promise: as wanted, or higher with few unsafe plans.

    Args:
        calibration: The plans on which thresholds are chosen.

    Raises:
        ValueError: None of them is unsafe.
    """
    num_unsafe, wanted = int(calibration.is_unsafe.sum()), 1.0 - PROMISED_UNSAFE_RECALL
    if num_unsafe == 0:
        raise ValueError(
            f"thresholds: 0 of {len(calibration)} calibration plans are unsafe; it takes "
            f"{episodes_needed(wanted)} to promise an unsafe recall of {PROMISED_UNSAFE_RECALL:g}"
        )
    least = least_miss_rate(num_unsafe)
    if least > wanted:
        _LOGGER.warning(
            "%d unsafe calibration episodes promise an unsafe recall of %.3f; %.3f takes %d",
            num_unsafe,
            1.0 - least,
            PROMISED_UNSAFE_RECALL,
            episodes_needed(wanted),
        )
    return max(least, wanted)


def verdict_estimates(
    plans: Plans, unsafe_score: np.ndarray, threshold: float
) -> dict[str, Estimate]:
    """Estimates of verdicts by unsafe scores (N,).

    Returns:
        `auc`, `safe_recall`, `unsafe_recall` and `brier`. Each plan is one episode, so recalls have
        Clopper-Pearson intervals.
    """
    return segment_estimates(plans.first, unsafe_score, threshold=threshold)


def recall_losses(
    plans: Plans, is_refused: np.ndarray, twins: Plans, is_twin_refused: np.ndarray
) -> dict[str, Estimate]:
    """Differences of the recalls between plans and their twins, which have the same targets.

    Args:
        plans: Plans; some may have no twin.
        is_refused: Whether each is refused, (N,).
        twins: Their twins, in the same order.
        is_twin_refused: Whether each twin is refused, (M,).

    Returns:
        `safe_recall_loss` and `unsafe_recall_loss`: the recall of the plans that have a twin, minus
        that of the twins. Intervals are bootstraps over pairs.
    """
    _, rows, twin_rows = np.intersect1d(
        plans.first.episode, twins.first.episode, return_indices=True
    )
    pair = np.arange(len(rows))
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

        return Bootstrap().over_episodes(statistic, pair)

    return {
        "safe_recall_loss": loss(~unsafe, ~refused, ~twin_unsafe, ~twin_refused),
        "unsafe_recall_loss": loss(unsafe, refused, twin_unsafe, twin_refused),
    }


def outcome_estimates(plans: Plans) -> dict[str, Estimate]:
    """Outcomes of plans: `outcomes.safe`, `outcomes.CAUSE` and controller failures.

    Returns:
        Shares of all episodes, diverged ones included. `episodes_with_controller_failures` is a
        share, `controller_failures` a count.
    """
    n = len(plans.outcomes)
    estimates = {
        f"outcomes.{name}": proportion(int(np.sum(plans.outcomes == name)), n)
        for name in (SAFE, *plans.constraint_names, DIVERGED)
    }
    estimates["episodes_with_controller_failures"] = proportion(
        int(np.sum(plans.num_failures > 0)), n
    )
    total = float(plans.num_failures.sum())
    estimates["controller_failures"] = Estimate.exact(total, n)
    return estimates


def named_causes(assessment: SafetyAssessment, plans: Plans) -> dict[str, np.ndarray]:
    """The cause that Γ names for each plan, as index of the constraint, (N,).

    Returns:
        "right_cause", by :func:`~drake_safety.learning.causes.likely_causes`, and for comparison
        "by_cause_probability", the constraint with the largest unsafe mass.
    """
    first = plans.first
    result = assessment.predict(
        first.state if assessment.parameters.is_sharpened else first.true_state,
        first.desired_preview,
        first.features if assessment.uses_features else None,
    )
    no_margins = np.full_like(result.predicted_margins, np.nan)
    return {
        "right_cause": likely_causes(
            result.cause_probability, result.predicted_margins, assessment.parameters.margin_unit
        ),
        "by_cause_probability": likely_causes(result.cause_probability, no_margins),
    }


def _cause_estimates(
    plans: Plans, named: Mapping[str, np.ndarray], is_refused: np.ndarray
) -> dict[str, Estimate]:
    """Shares of correct causes among correctly refused plans, by either rule and by cause."""
    estimates = {}
    for name, causes in named.items():
        estimates[f"causes.{name}"], by_cause = _right_causes(plans, causes, is_refused)
        if name == "right_cause":
            estimates |= {f"causes.{cause}": estimate for cause, estimate in by_cause.items()}
    return estimates


def _right_causes(
    plans: Plans, named: np.ndarray, is_refused: np.ndarray
) -> tuple[Estimate, dict[str, Estimate]]:
    """Share of correctly refused plans whose named cause (N,) is the simulated one; by cause."""
    rows = is_refused & plans.is_unsafe
    is_right = (named == plans.first.cause)[rows]
    cause = plans.first.cause[rows]
    by_cause = {
        name: proportion(int(is_right[cause == i].sum()), int(np.sum(cause == i)))
        for i, name in enumerate(plans.constraint_names)
        if np.any(cause == i)
    }
    return proportion(int(is_right.sum()), len(is_right)), by_cause


def _is_refused(unsafe_score: np.ndarray, threshold: float) -> np.ndarray:
    return np.isnan(unsafe_score) | (unsafe_score > threshold)
