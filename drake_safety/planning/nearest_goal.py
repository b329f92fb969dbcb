"""Search for the accepted goal nearest to a refused one."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.blas_threads import ONE_BLAS_THREAD
from drake_safety.planning.goal_verdict import GoalVerdict, assess_goals, checked_goal, goal_inputs
from drake_safety.simulation.capabilities import HasGoals, require
from drake_safety.simulation.closed_loop import ClosedLoop

_DIFFERENCE_M = 1e-3  # Step of the finite differences of the inputs by the goal.
_MAX_STEPS = 12  # Along the gradient.
_LONGEST_STEP_M = 0.15  # The logit is nearly linear over that distance.
_MARGIN = 0.5  # Decrease of the aimed-at logit where Γ does not follow it.
_LARGEST_LOGIT = 8.0
_FIRST_RADIUS_M = 0.05
_GROWTH = 1.6  # From one ball of candidates to the next.
_LAST_CHANCE = 16  # Times as many candidates in the whole region if no ball had an accepted one.
_SPREAD = 0.25  # Radius of the candidates about the best goal, by its distance to the goal.
_NUM_ROUNDS, _ROUNDS_FROM_KNOWN = 6, 4  # Rounds of candidates about the best goal.


@ONE_BLAS_THREAD
def nearest_accepted_goal(
    loop: ClosedLoop,
    assessment: SafetyAssessment,
    goal: np.ndarray,
    *,
    threshold: float,
    rng: np.random.Generator,
    reserve: float = 0.8,
    num_candidates: int = 64,
    resolution_m: float = 1e-3,
) -> GoalVerdict | None:
    """Finds an accepted goal near a given one, (3,) [m], with a reserve; None if there is none.

    Descent along the gradient of the safety head's logit, if any, bounds a search in all
    directions.

    Args:
        reserve: Share r of p - threshold in the least probability, threshold + r (p - threshold);
            p is 1, or 1 - mu_ini without heads, as in the paper's mode.
        resolution_m: Spacing of the grid of goals; rounding then does not change a verdict.
    """
    unknown = assessment.parameters.initial_uncertainty if assessment.base_logit_ is None else 0.0
    stricter = threshold + reserve * max(1.0 - unknown - threshold, 0.0)
    goal = checked_goal(goal)
    if not np.isfinite(goal).all():
        return None
    box = require(loop, HasGoals).target_box
    near = _Search(loop, assessment, goal, box, stricter, resolution_m)
    known = near.descend() if assessment.embedding_.has_heads else None
    best = near.search(known, rng, num_candidates)
    return None if best is None else replace(best, threshold=threshold)


@dataclass(frozen=True)
class _Search:
    """The search for the goal in a box, (2, 3) [m], that is nearest to a given one."""

    loop: ClosedLoop
    assessment: SafetyAssessment
    goal: np.ndarray
    box: np.ndarray
    threshold: float
    resolution_m: float

    def accepted(self, candidates: np.ndarray) -> GoalVerdict | None:
        """The nearest candidate (N, 3) [m] that is accepted, if any."""
        # A multiple of the spacing differs in its last bits from the same number read from a text.
        on_grid = np.round(np.round(candidates / self.resolution_m) * self.resolution_m, 9)
        points = np.unique(on_grid, axis=0)
        inside = points[np.all((points >= self.box[0]) & (points <= self.box[1]), axis=1)]
        verdicts = assess_goals(self.loop, self.assessment, inside, threshold=self.threshold)
        return self.nearest(verdict for verdict in verdicts if verdict.is_accepted)

    def nearest(self, verdicts: Iterable[GoalVerdict | None]) -> GoalVerdict | None:
        known = filter(None, verdicts)
        return min(known, key=lambda verdict: self.distance(verdict.goal), default=None)

    def distance(self, point: np.ndarray) -> float:
        return float(np.linalg.norm(point - self.goal))

    def descend(self) -> GoalVerdict | None:
        """Moves a refused goal along the gradient to an accepted one."""
        goal, box, best = self.goal, self.box, None
        bound = 1.0 / (1.0 + math.exp(-_LARGEST_LOGIT))
        share = min(max(self.threshold, 1.0 - bound), bound)
        aim = math.log((1.0 - share) / share)
        point = np.clip(goal, *box)
        for _ in range(_MAX_STEPS):
            # Differences point inwards: training data end at the region's edge.
            inwards = np.where(point + _DIFFERENCE_M > box[1], -_DIFFERENCE_M, _DIFFERENCE_M)
            inputs = goal_inputs(self.loop, point + np.vstack([np.zeros(3), np.diag(inwards)]))
            x, logit, gradient = self.assessment.unsafe_logits(*inputs)
            slope = (x[1:] - x[0]) @ gradient[0] / inwards
            here = self.accepted(point[None])
            if here is None and logit[0] <= aim + 0.1:
                aim = logit[0] - _MARGIN
            best = self.nearest((best, here))
            if (steepness := float(slope @ slope)) < 1e-12:
                break
            # The nearest point on the plane where the linearised logit has the value aimed at.
            ahead = goal + slope * (slope @ (point - goal) - (logit[0] - aim)) / steepness
            step = np.clip(ahead, *box) - point
            if (length := float(np.linalg.norm(step))) < self.resolution_m:
                break
            point = point + step * min(1.0, _LONGEST_STEP_M / length)
        return None if best is None else self.bisect(best)

    def search(
        self, known: GoalVerdict | None, rng: np.random.Generator, num_candidates: int
    ) -> GoalVerdict | None:
        """Searches growing balls about the goal, then refines the best candidate in rounds."""
        goal, box = self.goal, self.box
        centre = np.clip(goal, *box)
        best = self.accepted(centre[None])
        num_in_ball, num_rounds = num_candidates, _NUM_ROUNDS
        radius, farthest = _FIRST_RADIUS_M, float(np.linalg.norm(box[0] - box[1]))
        if known is not None:
            num_candidates, num_rounds = max(num_candidates // 2, 2), _ROUNDS_FROM_KNOWN
            num_in_ball, farthest = num_candidates // 2, self.distance(known.goal)
        while best is None and radius < farthest:
            best = self.accepted(centre + radius * _in_unit_ball(rng, num_in_ball))
            radius *= _GROWTH
        best = self.nearest((best, known))
        if best is None:
            best = self.accepted(rng.uniform(box[0], box[1], (_LAST_CHANCE * num_candidates, 3)))
        if best is None:
            return None
        for _ in range(num_rounds):
            best = self.bisect(best)
            if (distance := self.distance(best.goal)) < self.resolution_m:
                break
            about = best.goal + _SPREAD * distance * _in_unit_ball(rng, num_candidates // 2)
            ball = goal + distance * _in_unit_ball(rng, num_candidates - num_candidates // 2)
            candidates = np.clip(np.concatenate([about, ball]), *box)
            is_nearer = np.linalg.norm(candidates - goal, axis=1) < distance
            best = self.nearest((best, self.accepted(candidates[is_nearer]))) or best
        return best

    def bisect(self, best: GoalVerdict) -> GoalVerdict:
        """Moves an accepted goal straight towards the given one while it stays accepted."""
        refused = centre = np.clip(self.goal, *self.box)
        while np.linalg.norm(best.goal - refused) > self.resolution_m:
            between = 0.5 * (best.goal + refused)
            if (nearer := self.accepted(between[None])) is None:
                refused = between
            elif np.linalg.norm(nearer.goal - centre) < np.linalg.norm(best.goal - centre):
                best = nearer
            else:
                break
        return best


def _in_unit_ball(rng: np.random.Generator, num_points: int) -> np.ndarray:
    """Points distributed uniformly in the unit ball, (N, 3)."""
    directions = rng.normal(size=(num_points, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * np.cbrt(rng.uniform(size=(num_points, 1)))
