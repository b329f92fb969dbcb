"""Search for the accepted goal nearest to a refused one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.blas_threads import one_blas_thread
from drake_safety.planning.goal_verdict import GoalVerdict, assess_goals, checked_goal, goal_inputs
from drake_safety.simulation.capabilities import HasGoals, require
from drake_safety.simulation.closed_loop import ClosedLoop

METHODS = ("both", "gradient", "search")
"""Methods of :func:`nearest_accepted_goal`."""
RESERVE = 0.8
"""Share of the interval from the threshold to 1 by which a suggested goal exceeds the threshold.

Of the goals at the threshold itself, about half are unsafe."""

_Nearest = Callable[[np.ndarray], GoalVerdict | None]
"""The accepted candidate, of (N, 3) [m], nearest to the goal."""

_DIFFERENCE_M = 1e-3  # Step of the finite differences of the inputs by the goal.
_MAX_STEPS = 12  # Along the gradient.
_LONGEST_STEP_M = 0.15  # The logit is nearly linear over that distance.
_MARGIN = 0.5  # By how much the target logit falls where Γ does not follow it.
_LARGEST_LOGIT = 8.0

_FIRST_RADIUS_M = 0.05
_GROWTH = 1.6  # From one ball of candidates to the next.
_LAST_CHANCE = 16  # Times as many candidates in the whole region if no ball had an accepted one.
_SPREAD = 0.25  # Radius of the candidates about the best goal, by its distance to the goal.
_NUM_ROUNDS, _ROUNDS_FROM_KNOWN = 6, 4  # Of candidates about the best goal.


@one_blas_thread
def nearest_accepted_goal(
    loop: ClosedLoop,
    assessment: SafetyAssessment,
    goal: np.ndarray,
    *,
    threshold: float,
    rng: np.random.Generator,
    reserve: float = RESERVE,
    num_candidates: int = 64,
    resolution_m: float = 1e-3,
    method: str = "both",
) -> GoalVerdict | None:
    """Finds an accepted goal near a given one, with a reserve.

    With reserve: probability ≥ threshold + reserve (p - threshold), where p is the largest
    probability: 1, or 1 - mu_ini in the paper's mode. The goal found lies at the limit of the
    search, and of the goals at the threshold itself many are unsafe.

    Descent along the gradient of the safety head's logit finds an accepted goal with few
    evaluations, but often not the nearest one: it stays in one basin, and Γ follows the logit only
    approximately. It bounds the radius of a search in all directions. If the descent finds nothing,
    or the maps have no safety head, the search covers the whole region.

    All candidates lie on a grid of ``resolution_m``, so that rounding does not change a verdict.

    Args:
        goal: In the world, (3,) [m]; it may lie outside the region sampled in training.
        threshold: Lowest probability of a safe goal.
        reserve: Share of the interval from the threshold to the largest probability, in [0, 1].
        num_candidates: Candidates of the search per batch; half as many if the descent has found
            an accepted goal.
        resolution_m: Spacing of the grid of candidates [m].
        method: ``both``, or the ``gradient`` or the ``search`` alone.

    Returns:
        The verdict on the goal found, with the threshold itself; None if the given goal is not
        finite, or no goal was found that is accepted with the reserve.

    Raises:
        ValueError: The loop's plans have no goal, the goal is not three numbers, the reserve is
            not in [0, 1], the method is unknown, or it is ``gradient`` and the maps have no safety
            head.
    """
    if method not in METHODS:
        raise ValueError(f"nearest accepted goal: method must be one of {METHODS}; got '{method}'")
    if not 0.0 <= reserve <= 1.0:
        raise ValueError(f"nearest accepted goal: reserve is {reserve}, expected a value in [0, 1]")
    # Without a logit the probability is b_safe.
    has_logit = assessment.base_logit_ is not None
    highest = 1.0 if has_logit else 1.0 - assessment.parameters.initial_uncertainty
    stricter = threshold + reserve * max(highest - threshold, 0.0)
    goal = checked_goal(goal)
    if not np.isfinite(goal).all():
        return None
    box = require(loop, HasGoals).target_box

    def nearest_of(candidates: np.ndarray) -> GoalVerdict | None:
        points = np.unique(on_grid(candidates, resolution_m), axis=0)
        inside = points[np.all((points >= box[0]) & (points <= box[1]), axis=1)]
        verdicts = assess_goals(loop, assessment, inside, threshold=stricter)
        return _nearest((verdict for verdict in verdicts if verdict.is_accepted), goal)

    best: GoalVerdict | None = None
    if method == "gradient" or (method == "both" and assessment.embedding_.has_safety_head):
        best = _descend(loop, assessment, goal, box, stricter, nearest_of, resolution_m)
    if method != "gradient":
        best = _search(goal, box, nearest_of, best, rng, num_candidates, resolution_m)
    return None if best is None else replace(best, threshold=threshold)


def _descend(
    loop: ClosedLoop,
    assessment: SafetyAssessment,
    goal: np.ndarray,
    box: np.ndarray,
    threshold: float,
    nearest_of: _Nearest,
    resolution_m: float,
) -> GoalVerdict | None:
    """Moves a refused goal along the gradient to an accepted one.

    Each step goes to the point nearest to the goal on the plane where the linearised logit has the
    target value. The gradient of the network is exact; the derivative of its inputs by the goal is
    a finite difference of four goals. The target value falls until Γ accepts the goal.
    """
    bound = 1.0 / (1.0 + math.exp(-_LARGEST_LOGIT))
    share = min(max(threshold, 1.0 - bound), bound)
    aim = math.log((1.0 - share) / share)
    best: GoalVerdict | None = None
    point = centre = np.clip(goal, *box)
    for _ in range(_MAX_STEPS):
        # Differences point inwards: there is no training data beyond the region.
        inwards = np.where(point + _DIFFERENCE_M > box[1], -_DIFFERENCE_M, _DIFFERENCE_M)
        inputs = goal_inputs(loop, point + np.vstack([np.zeros(3), np.diag(inwards)]))
        x, logit, gradient = assessment.unsafe_logits(*inputs)
        slope = (x[1:] - x[0]) @ gradient[0] / inwards
        found = nearest_of(point[None])
        if found is None and logit[0] <= aim + 0.1:
            aim = logit[0] - _MARGIN
        best = _nearest((best, found), goal)
        steepness = float(slope @ slope)
        if steepness < 1e-12:
            break
        ahead = goal + slope * (slope @ (point - goal) - (logit[0] - aim)) / steepness
        step = np.clip(ahead, *box) - point
        length = float(np.linalg.norm(step))
        if length < resolution_m:
            break
        point = point + step * min(1.0, _LONGEST_STEP_M / length)
    return None if best is None else _bisect(best, centre, nearest_of, resolution_m)


def _search(
    goal: np.ndarray,
    box: np.ndarray,
    nearest_of: _Nearest,
    known: GoalVerdict | None,
    rng: np.random.Generator,
    num_candidates: int,
    resolution_m: float,
) -> GoalVerdict | None:
    """Searches the nearest accepted goal in all directions.

    Candidates fill growing balls about the goal until one of them is accepted: up to the distance
    of the known goal, or else in the end the whole region. Each round of refinement then bisects
    towards the goal, and draws candidates about the best goal and in the ball that it bounds.
    """
    centre = np.clip(goal, *box)
    best = nearest_of(centre[None])
    num_in_ball, num_rounds = num_candidates, _NUM_ROUNDS
    radius, farthest = _FIRST_RADIUS_M, _distance(*box)
    if known is not None:
        num_candidates, num_rounds = max(num_candidates // 2, 2), _ROUNDS_FROM_KNOWN
        num_in_ball, farthest = num_candidates // 2, _distance(known.goal, goal)
    while best is None and radius < farthest:
        best = nearest_of(centre + radius * _in_unit_ball(rng, num_in_ball))
        radius *= _GROWTH
    best = _nearest((best, known), goal)
    if best is None:
        best = nearest_of(rng.uniform(box[0], box[1], (_LAST_CHANCE * num_candidates, 3)))
    if best is None:
        return None

    for _ in range(num_rounds):
        best = _bisect(best, centre, nearest_of, resolution_m)
        distance = _distance(best.goal, goal)
        if distance < resolution_m:
            break
        about = best.goal + _SPREAD * distance * _in_unit_ball(rng, num_candidates // 2)
        ball = goal + distance * _in_unit_ball(rng, num_candidates - num_candidates // 2)
        candidates = np.clip(np.concatenate([about, ball]), *box)
        is_nearer = np.linalg.norm(candidates - goal, axis=1) < distance
        found = nearest_of(candidates[is_nearer])
        if found is not None and _distance(found.goal, goal) < distance:
            best = found
    return best


def _bisect(
    best: GoalVerdict, centre: np.ndarray, nearest_of: _Nearest, resolution_m: float
) -> GoalVerdict:
    """Moves an accepted goal straight towards the centre while it stays accepted."""
    refused = centre
    while _distance(best.goal, refused) > resolution_m:
        between = 0.5 * (best.goal + refused)
        found = nearest_of(between[None])
        if found is None:
            refused = between
        elif _distance(found.goal, centre) < _distance(best.goal, centre):
            best = found
        else:
            break
    return best


def on_grid(points: np.ndarray, resolution_m: float) -> np.ndarray:
    """Rounds points to the grid of candidates."""
    # A multiple of the spacing differs in its last bits from the same number read from a text.
    return np.round(np.round(points / resolution_m) * resolution_m, 9)


def _nearest(verdicts: Iterable[GoalVerdict | None], goal: np.ndarray) -> GoalVerdict | None:
    found = [verdict for verdict in verdicts if verdict is not None]
    return min(found, key=lambda verdict: _distance(verdict.goal, goal), default=None)


def _in_unit_ball(rng: np.random.Generator, num_points: int) -> np.ndarray:
    """Points distributed uniformly in the unit ball, (N, 3)."""
    directions = rng.normal(size=(num_points, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * np.cbrt(rng.uniform(size=(num_points, 1)))


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(one - other))
