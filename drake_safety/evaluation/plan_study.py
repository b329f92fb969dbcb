"""Plans with a goal, judged before anything moves: who accepts what, and what came of it."""

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
"""Share of the safe targets that the paper's method predicts safe, of 1000 random ones."""
UNSAFE_RECALL = 0.987
"""Share of the unsafe targets that it predicts unsafe."""
PROMISED_UNSAFE_RECALL = 0.992
"""What thresholds are chosen for: half a point above the paper's, as a finite test set scatters."""
SAFE = "safe"
"""Outcome of an episode that stayed in the safe set; else it is the episode's cause."""


_LOGGER = logging.getLogger("drake_safety")


@dataclass(frozen=True, kw_only=True)
class Plans:
    """Episodes seen at k = 0, when the plan is made: what is known then, and what came of it.

    Attributes:
        first: The segment that each episode starts with, (N,); diverged episodes have none.
        goals: Where each plan leads to, in the world, (N, 3) [m].
        is_fair: Whether each belongs to the fair set, (N,).
        hand: The robot's reaching frame that goes there, if it is one.
        outcomes: Of all episodes, diverged ones too: `SAFE` or the cause, (M,).
        is_outcome_fair: Whether each of them belongs to the fair set, (M,).
        num_failures: Controller failures of each of them, (M,).
        constraint_names: The n_c safety constraints.
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
        """Those of the fair set."""
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
    """What there is to judge in episodes of a loop whose plans have a goal.

    Args:
        loop: The closed loop that the episodes were made with.
        episodes: The episodes.

    Raises:
        ValueError: The task's plans have no goal.
    """
    # A segment that starts where the episode does, however early the episode ends.
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
    """Something that accepts or refuses plans.

    Attributes:
        name: Its key in tables.
        unsafe_score: How unsafe it takes each plan to be, (N,), in [0, 1]; NaN for "don't know",
            which refuses.
        threshold: Unsafe score above which a plan is refused; None to choose it on the calibration
            plans.
    """

    name: str
    unsafe_score: Callable[[Plans], np.ndarray]
    threshold: float | None = None


def scorer_rule(scorer: Scorer, calibration: Calibration | None = None) -> PlanRule:
    """A scorer of x.

    Args:
        scorer: The scorer.
        calibration: Its own; without one its threshold is left open.
    """
    return PlanRule(
        name=scorer.name,
        unsafe_score=lambda plans: scorer.unsafe_score(plans.first),
        threshold=None if calibration is None else 1.0 - calibration.threshold,
    )


def reachability_rule(reachability: Mapping[str, Reachability]) -> PlanRule:
    """Accepts what inverse kinematics reaches: yes or no, nothing to choose.

    Args:
        reachability: By hand.
    """

    def unsafe_score(plans: Plans) -> np.ndarray:
        if plans.hand is None or plans.hand not in reachability:
            raise ValueError(
                f"reachability: no hand '{plans.hand}' is known; known are {list(reachability)}"
            )
        return 1.0 - reachability[plans.hand].is_reachable(plans.goals)

    return PlanRule(name="reachability", unsafe_score=unsafe_score, threshold=0.5)


@dataclass(frozen=True, kw_only=True)
class PlanStudy:
    """What :func:`evaluate_plans` found.

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
    """Every rule on fresh plans, all of them and the fair ones.

    Thresholds left open are chosen on the calibration plans, all of the target box, so that an
    unsafe plan yet to come is refused with the probability `PROMISED_UNSAFE_RECALL`, see
    :mod:`drake_safety.learning.calibration`; of those the one that accepts most. With too few
    unsafe calibration plans for that promise it is the highest that can be kept, with a warning;
    `promised_unsafe_recall` says which it was. The figures give them as Γ_thre, the safety
    probability below which a plan is refused.

    Args:
        rules: Who is judged; the assessment's own rule is the one of this name: "sharpened".
        assessment: Γ, which names causes.
        calibration: Other fresh plans, for every choice that is to be made.
        sets: Fresh plans by the prefix of their keys, such as "plans".
        twins: Which of them have the targets of "plans", in the same order, for another hand.

    Raises:
        ValueError: There is no threshold to choose: no calibration plan is unsafe.
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
    estimates = {"plans.promised_unsafe_recall": Estimate(promise, promise, promise, num_unsafe)}
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
                estimates[f"{key}.{name}.threshold"] = Estimate(
                    limit, limit, limit, len(calibration)
                )
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
    """What share of unsafe plans thresholds may accept: as promised, or more if few were seen.

    Args:
        calibration: The plans that thresholds are chosen on.

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
    """How well scores (N,) tell unsafe plans from safe ones.

    Returns:
        `auc`, `safe_recall`, `unsafe_recall` and `brier`. Each plan is an episode of its own, so
        the recalls have Clopper-Pearson's interval.
    """
    return segment_estimates(plans.first, unsafe_score, threshold=threshold)


def recall_losses(
    plans: Plans, is_refused: np.ndarray, twins: Plans, is_twin_refused: np.ndarray
) -> dict[str, Estimate]:
    """What recalls lose from plans to their twins: the same targets, in the same order.

    Args:
        plans: Plans, maybe more than there are twins.
        is_refused: Which of them are refused, (N,).
        twins: Their twins.
        is_twin_refused: Which of those are refused, (M,).

    Returns:
        `safe_recall_loss` and `unsafe_recall_loss`: the recall of the plans that have a twin, less
        that of the twins. Intervals are found by drawing pairs again.
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
    """What came of the plans: `outcomes.safe`, `outcomes.CAUSE` and the controllers' failures.

    Returns:
        Shares of all episodes, diverged ones too. `episodes_with_controller_failures` is a share,
        `controller_failures` their number.
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
    estimates["controller_failures"] = Estimate(total, total, total, n)
    return estimates


def named_causes(assessment: SafetyAssessment, plans: Plans) -> dict[str, np.ndarray]:
    """The cause that Γ would name for each plan, as a column of the constraints, (N,).

    Returns:
        "right_cause", by the rule of :func:`~drake_safety.learning.causes.likely_causes`, and to
        compare with "by_cause_probability", the constraint with most of the unsafe mass.
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
    """Shares of the right causes among correctly refused plans, by either rule and by cause."""
    estimates = {}
    for name, causes in named.items():
        estimates[f"causes.{name}"], by_cause = _right_causes(plans, causes, is_refused)
        if name == "right_cause":
            estimates |= {f"causes.{cause}": estimate for cause, estimate in by_cause.items()}
    return estimates


def _right_causes(
    plans: Plans, named: np.ndarray, is_refused: np.ndarray
) -> tuple[Estimate, dict[str, Estimate]]:
    """The share whose named cause (N,) is the simulated one: of all correctly refused, by cause."""
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
