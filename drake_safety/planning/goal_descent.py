"""A refused goal moved to the nearest accepted one along the gradient of what the maps expect."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.gradients import unsafe_logits
from drake_safety.planning.goal_verdict import (
    RESERVE,
    GoalVerdict,
    assess_goals,
    checked_goal,
    goal_inputs,
    nearest_accepted_goal,
    on_grid,
    target_box,
    threshold_with_reserve,
)
from drake_safety.simulation.closed_loop import ClosedLoop

_DIFFERENCE_M = 1e-3  # Between the goals that tell how inputs change with them.
_LONGEST_STEP_M = 0.15  # The logit is nearly straight over that much.
_MARGIN = 0.5  # By how much the logit that is aimed at falls where Γ does not follow.
_LARGEST_LOGIT = 8.0
_ROUNDS_FROM_KNOWN = 4  # Of the search, once the gradient has found an accepted goal.


@dataclass(frozen=True, kw_only=True, eq=False)
class Descent:
    """Where the gradient led.

    Attributes:
        verdict: On the nearest accepted goal that was found; None where none was.
        num_judged: Goals whose inputs were computed on the way, what a search costs.
    """

    verdict: GoalVerdict | None
    num_judged: int


def descend_to_accepted(
    loop: ClosedLoop,
    assessment: SafetyAssessment,
    goal: np.ndarray,
    *,
    threshold: float,
    reserve: float = RESERVE,
    num_steps: int = 12,
    resolution_m: float = 1e-3,
) -> Descent:
    """Moves a refused goal to the nearest one that is accepted with reserve.

    Each step goes to the point nearest to the goal on the plane on which the logit, were it
    straight, would have the value aimed at. Network and inputs share the chain rule: the network's
    gradient is exact, the inputs' change with the goal a difference of four goals. What is aimed at
    falls as long as Γ, which decides, does not accept.

    It finds the nearest accepted goal of one basin, where
    :func:`~drake_safety.planning.goal_verdict.nearest_accepted_goal` searches everywhere;
    :func:`suggest_goal` does both.

    Args:
        loop: A closed loop whose plans have a goal.
        assessment: What was learned from its episodes, in the sharpened mode.
        goal: In the world, (3,) [m]; finite.
        threshold: From which Γ, calibrated, on a goal is safe.
        reserve: Share of the way from the threshold to certainty that is asked for besides.
        num_steps: How many steps at most.
        resolution_m: Spacing of the grid that the goal found lies on [m].

    Raises:
        ValueError: The loop's plans have no goal, the maps no safety head, the goal is not three
            finite numbers, or the reserve is not in [0, 1].
    """
    stricter = threshold_with_reserve(threshold, reserve)
    goal, box = checked_goal(goal), target_box(loop)
    if not np.isfinite(goal).all():
        raise ValueError(f"descent: a goal is three finite numbers [m]; got {goal.tolist()}")
    bound = 1.0 / (1.0 + math.exp(-_LARGEST_LOGIT))
    share = min(max(stricter, 1.0 - bound), bound)
    aim = math.log((1.0 - share) / share)
    num_judged = 0
    best: GoalVerdict | None = None

    def judged(point: np.ndarray) -> GoalVerdict:
        nonlocal num_judged, best
        num_judged += 1
        candidate = np.clip(on_grid(point, resolution_m), *box)
        (verdict,) = assess_goals(loop, assessment, candidate[None], threshold=stricter)
        if verdict.is_accepted and (best is None or _far(verdict, goal) < _far(best, goal)):
            best = verdict
        return verdict

    point = np.clip(goal, *box)
    for _ in range(num_steps):
        # Beyond the region nothing was learned: differences point inwards.
        inwards = np.where(point + _DIFFERENCE_M > box[1], -_DIFFERENCE_M, _DIFFERENCE_M)
        inputs = goal_inputs(loop, point + np.vstack([np.zeros(3), np.diag(inwards)]))
        num_judged += 4
        x, logit, gradient = unsafe_logits(assessment, *inputs)
        slope = (x[1:] - x[0]) @ gradient[0] / inwards
        is_accepted = judged(point).is_accepted
        if not is_accepted and logit[0] <= aim + 0.1:
            aim = logit[0] - _MARGIN
        steepness = float(slope @ slope)
        if steepness < 1e-12:
            break
        ahead = goal + slope * (slope @ (point - goal) - (logit[0] - aim)) / steepness
        step = np.clip(ahead, *box) - point
        length = float(np.linalg.norm(step))
        if length < resolution_m:
            break
        point = point + step * min(1.0, _LONGEST_STEP_M / length)
    if best is not None:
        # Straight towards the goal for as long as it stays accepted.
        inside, refused = best.goal, np.clip(goal, *box)
        while np.linalg.norm(inside - refused) > 2.0 * resolution_m:
            between = 0.5 * (inside + refused)
            if judged(between).is_accepted:
                inside = between
            else:
                refused = between
        best = replace(best, threshold=threshold)
    return Descent(verdict=best, num_judged=num_judged)


def suggest_goal(
    loop: ClosedLoop,
    assessment: SafetyAssessment,
    goal: np.ndarray,
    *,
    threshold: float,
    rng: np.random.Generator,
    reserve: float = RESERVE,
    num_candidates: int = 64,
    resolution_m: float = 1e-3,
) -> GoalVerdict | None:
    """The goal nearest to a given one that is accepted with reserve: by gradient, then by search.

    The gradient finds an accepted goal with few goals judged, often not the nearest one: it follows
    one basin, and Γ, which decides, not exactly. A search no farther than that, in all directions,
    takes fewer goals than one that knows none yet. Where the gradient finds nothing, or the maps
    have none to follow, the search is the whole one.

    Args:
        loop: A closed loop whose plans have a goal.
        assessment: What was learned from its episodes.
        goal: In the world, (3,) [m]; it may lie outside the region sampled in training.
        threshold: From which Γ, calibrated, on a goal is safe.
        rng: Source of the candidates.
        reserve: Share of the way from the threshold to certainty, in [0, 1].
        num_candidates: That the search judges at a time, half as many where the gradient has found
            an accepted goal.
        resolution_m: Spacing of the grid that the goal found lies on [m].

    Returns:
        The verdict on it, by the threshold itself; None when the goal is not finite, or nothing in
        the region is accepted with reserve.

    Raises:
        ValueError: The loop's plans have no goal, the goal is not three numbers, or the reserve is
            not in [0, 1].
    """
    options: dict[str, Any] = {
        "threshold": threshold,
        "reserve": reserve,
        "resolution_m": resolution_m,
    }
    known = None
    # Matrices this small are multiplied sooner by one thread than by several.
    with threadpool_limits(1):
        if np.isfinite(checked_goal(goal)).all() and assessment.embedding_.has_safety_head:
            known = descend_to_accepted(loop, assessment, goal, **options).verdict
        if known is not None:
            options |= {"known": known, "num_rounds": _ROUNDS_FROM_KNOWN}
            num_candidates = max(num_candidates // 2, 2)
        return nearest_accepted_goal(
            loop, assessment, goal, rng=rng, num_candidates=num_candidates, **options
        )


def _far(verdict: GoalVerdict, goal: np.ndarray) -> float:
    return float(np.linalg.norm(verdict.goal - goal))
